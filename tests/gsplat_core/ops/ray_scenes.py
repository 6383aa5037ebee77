"""Splats with ray coefficients for the tests of ray blending, and the comparison with plain torch in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core import reference
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.ray_blending import blend_rays
from gsplat_core.ops.splat_rays import splat_rays
from gsplat_core.ops.tiles import bin_splats

INPUTS = ("means2d", "conics", "opacities", "rays", "values")
OUTPUTS = ("values", "alphas", "depths", "medians", "variances")


@dataclass(frozen=True)
class RayScene:
    """Splats of one image."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    rays: Tensor
    values: Tensor
    width: int
    height: int
    max_alpha: float = 0.99

    def lists(self) -> tuple[Tensor, Tensor]:
        """Return tile offsets and ids, sorted by the depth of the centres."""
        covers = torch.full((1, len(self.means2d), 2), 2**30, dtype=torch.int32)
        grid = TileGrid(16, -(-self.width // 16), -(-self.height // 16))
        options = dict(
            conics=self.conics[None].nan_to_num(posinf=0.1), opacities=self.opacities[None].nan_to_num(posinf=0.5)
        )
        depths = self.rays[None, :, 0].nan_to_num(posinf=5.0).contiguous()
        _, ids, offsets = bin_splats(self.means2d[None].nan_to_num(posinf=20.0), covers, depths, grid, **options)
        return offsets[0], ids

    def run(
        self,
        blend: Callable[..., tuple[Tensor, ...]] = blend_rays,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
    ) -> dict[str, Tensor]:
        """Return the outputs and the gradients of a fixed random linear function of them, on the CPU."""
        inputs = {name: getattr(self, name).to(device, dtype, copy=True).requires_grad_() for name in INPUTS}
        lists = [tensor.to(device) for tensor in self.lists()]
        outputs = blend(*inputs.values(), self.width, self.height, *lists, max_alpha=self.max_alpha)
        random = torch.Generator().manual_seed(11)
        total = torch.zeros((), device=device, dtype=dtype)
        for output in outputs[:4]:
            total = total + (output * torch.randn(output.shape, generator=random).to(device)).sum()
        for tensor in inputs.values():
            total = (
                total + 0 * tensor.nan_to_num(posinf=0, neginf=0).sum()
            )  # a scene without splats has a gradient, too
        total.backward()
        results = {name: output.detach().cpu() for name, output in zip(OUTPUTS, outputs, strict=True)}
        return results | {f"v_{name}": tensor.grad.cpu() for name, tensor in inputs.items() if tensor.grad is not None}


def gaussians(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return means, quaternions and scales of `count` Gaussians in front of a camera at the origin, in float64."""
    random = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=random, dtype=torch.float64)
    means = draw(count, 3) * torch.tensor([10.0, 8.0, 6.0]) + torch.tensor([0.0, 0.0, 40.0])
    means[:, :2] = means[:, :2].clamp(-0.4 * means[:, 2:], 0.4 * means[:, 2:])
    return means, draw(count, 4), torch.exp(draw(count, 3) * 0.7 + 0.3)


def intrinsics(width: int, height: int) -> Tensor:
    """Return a pinhole camera's matrix in float64."""
    return torch.tensor([[50.0, 0, width / 2], [0, 52.0, height / 2], [0, 0, 1]], dtype=torch.float64)


def view() -> Tensor:
    """Return a turned and moved world-to-camera matrix in float64."""
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.15], [-0.2, 0.15, 0]], dtype=torch.float64)
    )
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = turn, torch.tensor([1.0, -2.0, 3.0])
    return matrix


def splat_results(count: int, device: str | None) -> dict[str, Tensor]:
    """Return ray coefficients, normals and gradients of a fixed random linear function; device None is the reference."""
    kind = torch.float64 if device is None else torch.float32
    place = "cpu" if device is None else device
    inputs = [tensor.to(place, kind).requires_grad_() for tensor in gaussians(count)]
    camera = [tensor.to(place, kind) for tensor in (view(), intrinsics(70, 45))]
    outputs = reference.splat_rays(*inputs, *camera) if device is None else splat_rays(*inputs, *camera, "pinhole")
    random = torch.Generator().manual_seed(3)
    total = sum((output * torch.randn(output.shape, generator=random).to(place, kind)).sum() for output in outputs)
    gradients = torch.autograd.grad(total, inputs)  # type: ignore[arg-type]
    names = "rays", "normals", "v_means", "v_quats", "v_scales"
    return {name: tensor.detach().cpu() for name, tensor in zip(names, (*outputs, *gradients), strict=True)}


def ray_scene(
    count: int, width: int = 70, height: int = 45, channels: int = 3, seed: int = 0, **options: float
) -> RayScene:
    """Project random Gaussians."""
    means, quats, scales = gaussians(count, seed)
    K, viewmat = intrinsics(width, height), torch.eye(4, dtype=torch.float64)
    projected = reference.fully_fused_projection(means, None, quats, scales, viewmat[None], K[None], width, height)
    rays = reference.splat_rays(means, quats, scales, viewmat, K)[0]
    random = torch.Generator().manual_seed(seed + 1)
    opacities = torch.sigmoid(1 + 2 * torch.randn(count, generator=random))
    values = torch.randn(count, channels, generator=random)
    columns = (projected[1][0], projected[3][0], opacities, rays, values)
    return RayScene(*(column.float().contiguous() for column in columns), width, height, **options)  # type: ignore[arg-type]


def exact_contributions(s: RayScene) -> Tensor:
    """Return the largest weight of each splat in float64: the blended values of a one-hot channel per splat."""
    count = len(s.means2d)
    columns = [getattr(s, name).double() for name in INPUTS[:4]]
    blended = reference.blend_rays(*columns, torch.eye(count, dtype=torch.float64), s.width, s.height, *s.lists())
    return blended[0].reshape(-1, count).amax(0) if count else torch.zeros(0)


def assert_close(s: RayScene, device: str = "cpu") -> dict[str, Tensor]:
    """Compare with the reference: pixels within 2e-4 of their scale, gradients within 2e-3 of their norm.

    A transmittance within rounding of 1/2 selects another splat for the median, and an alpha within rounding of 1/255 is
    skipped or not. A few pixels may therefore differ.
    """
    wanted = s.run(reference.blend_rays, torch.float64)
    seen = s.run(device=device)
    depth = float(s.rays[:, 0].nan_to_num(posinf=0).abs().max()) if len(s.rays) else 1.0
    for name in OUTPUTS:
        scale = {"alphas": 1.0, "values": 3.0, "variances": depth}.get(name, depth)
        assert seen[name].shape == wanted[name].shape
        off = (seen[name].double() - wanted[name]).abs() > 2e-4 * scale
        assert int(off.sum()) <= max(1, 1e-3 * off.numel()), (name, int(off.sum()), off.numel())
    for name in (f"v_{name}" for name in INPUTS):
        if not wanted[name].numel():
            continue
        w = wanted[name].double()
        error = seen[name].double() - w
        assert seen[name].isfinite().all(), name
        if w.ndim == 2 and name == "v_rays":  # columns have different units
            for column in range(w.shape[1]):
                assert error[:, column].norm() <= 2e-3 * w[:, column].norm(), (name, column)
        else:
            assert error.norm() <= 2e-3 * w.norm(), (name, float(error.norm() / w.norm()))
    return seen


def with_bad_values(s: RayScene) -> tuple[RayScene, Tensor]:
    """Return the scene with values that are not finite, and the mask [N] of the splats that have them."""
    bad = torch.zeros(len(s.means2d), dtype=torch.bool)
    s = replace(s, **{name: getattr(s, name).clone() for name in INPUTS})
    row = 0
    for value in (float("nan"), float("inf"), -float("inf")):
        for name in INPUTS:
            tensor = getattr(s, name)
            tensor.reshape(len(bad), -1)[row, -1] = value
            bad[row] = True
            row += 1
    return s, bad
