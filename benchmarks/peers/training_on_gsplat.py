"""A training step as it is usually written on gsplat: deform, rasterize, masked L1, autograd, `torch.optim.Adam`.

The pictures are on the GPU as floats before the step, so that only the step is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from gpu_scenes import Scene
from peers.deformation_plain import PlainBasis, PlainHexPlane
from torch import Tensor, nn

Raw = tuple[Tensor, ...]
"""Means, rotations, log-scales, logit opacities, harmonics."""


class GsplatStep:
    """Training step on gsplat; each call trains at the given time."""

    def __init__(
        self,
        rasterization: Callable,
        scene: Scene,
        raw: Raw,
        deform: Callable[[Raw, float], Raw],
        field: nn.Module,
        target: Tensor,
        mask: Tensor,
        *,
        fused_adam: bool,
    ) -> None:
        """`target` [H, W, 3] in 0..1 and `mask` [H, W], 1 where it counts."""
        self._rasterization, self._deform = rasterization, deform
        self._raw = tuple(nn.Parameter(tensor.clone()) for tensor in raw)
        self._view = {name: scene.arguments[name] for name in ("viewmats", "Ks", "width", "height", "packed")}
        self._degree = round(raw[4].shape[1] ** 0.5) - 1
        self._target, self._mask = target, mask[..., None]
        self._weight = 1 / (3 * float(mask.sum()))
        self._adam = torch.optim.Adam([*self._raw, *field.parameters()], lr=1e-4, fused=fused_adam)

    def __call__(self, time: float) -> Tensor:
        means, quats, log_scales, logit_opacities, sh = self._deform(self._raw, time)
        image, _, _ = self._rasterization(
            means, quats, log_scales.exp(), logit_opacities.sigmoid(), sh, sh_degree=self._degree, **self._view
        )
        loss = ((image[0] - self._target).abs() * self._mask).sum() * self._weight
        loss.backward()
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        return loss.detach()


def with_hexplane(field: PlainHexPlane, box: Tensor) -> Callable[[Raw, float], Raw]:
    """`box` [2, 3]: corners of the positions; time in [0, 1]."""

    def deform(raw: Raw, time: float) -> Raw:
        means, quats, log_scales, logit_opacities, sh = raw
        positions = 2 * (means - box[0]) / (box[1] - box[0]) - 1
        moved, turned, grown, faded = field(positions, 2 * time - 1)
        return means + moved, quats + turned, log_scales + grown, logit_opacities + faded[:, 0], sh

    return deform


def with_basis(field: PlainBasis) -> Callable[[Raw, float], Raw]:
    """Bumps over time in [0, 1]; the colour goes to the first coefficient."""

    def deform(raw: Raw, time: float) -> Raw:
        means, quats, log_scales, logit_opacities, sh = raw
        moved, turned, grown, coloured = field(time).split([3, 4, 3, 3], dim=1)
        colours = torch.cat([sh[:, :1] + coloured[:, None], sh[:, 1:]], dim=1)
        return means + moved, quats + turned, log_scales + grown, logit_opacities, colours

    return deform


def first(raw: Sequence[Tensor], count: int, degree: int) -> Raw:
    """Return the first `count` Gaussians with harmonics up to `degree`."""
    means, quats, log_scales, logit_opacities, sh = (tensor[:count] for tensor in raw)
    return means, quats, log_scales, logit_opacities, sh[:, : (degree + 1) ** 2].contiguous()
