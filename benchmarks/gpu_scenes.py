"""Seeded scenes of the GPU benchmarks, equal to those of the peers' figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Scene:
    """Gaussians of degree 3 in front of one camera, on the GPU."""

    arguments: dict[str, Any]
    """Keyword arguments of `rasterization`, equal in gsplat and here: linear scales and opacities."""

    @property
    def size_px(self) -> tuple[int, int]:
        return self.arguments["width"], self.arguments["height"]

    @property
    def camera(self) -> tuple[Tensor, Tensor]:
        """Return viewmat [4, 4] and K [3, 3]."""
        return self.arguments["viewmats"][0], self.arguments["Ks"][0]

    def raw(self) -> tuple[Tensor, ...]:
        """Return means, rotations, log-scales, logit opacities and harmonics, the arguments of the frame path."""
        of = self.arguments
        return of["means"], of["quats"], of["scales"].log(), of["opacities"].logit(), of["colors"]

    def leaves(self) -> dict[str, Tensor]:
        """Return copies of the parameters that require gradients."""
        return {name: self.arguments[name].clone().requires_grad_() for name in PARAMETERS}


def surgical(count: int, width: int, height: int, seed: int = 0) -> Scene:
    """Return a bumpy tissue-like surface: flat, mostly opaque Gaussians of about 1.6 px."""
    g, focal_px = torch.Generator().manual_seed(seed), 560.0
    u, v = torch.rand(count, generator=g) * width, torch.rand(count, generator=g) * height
    z = 60 + 12 * torch.sin(u / 90) * torch.cos(v / 70) + 0.3 * torch.randn(count, generator=g)
    size_px = 1.6 * torch.exp(0.5 * torch.randn(count, 3, generator=g))
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.3 * torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(1.5 + 1.5 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] += torch.tensor([1.0, -0.4, -0.6])
    flat = torch.tensor([1.0, 1.0, 0.3])
    return _scene((u, v, z), focal_px, size_px * flat, quats, opacities, sh, (width, height))


def volume(count: int, width: int, height: int, seed: int = 1) -> Scene:
    """Return Gaussians of log-normal screen size (median 1.2 px) in a deep frustum."""
    g, focal_px = torch.Generator().manual_seed(seed), 1400.0
    u = torch.rand(count, generator=g) * width * 1.2 - 0.1 * width
    v = torch.rand(count, generator=g) * height * 1.2 - 0.1 * height
    z = torch.exp(torch.rand(count, generator=g) * 3.0) * 2
    size_px = 1.2 * torch.exp(0.9 * torch.randn(count, 3, generator=g)).clamp(max=60)
    quats = torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(2.0 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] += torch.randn(count, 3, generator=g)
    return _scene((u, v, z), focal_px, size_px, quats, opacities, sh, (width, height))


def _scene(
    seen: tuple[Tensor, Tensor, Tensor],
    focal_px: float,
    size_px: Tensor,
    quats: Tensor,
    opacities: Tensor,
    sh: Tensor,
    size: tuple[int, int],
) -> Scene:
    (u, v, z), (width, height) = seen, size
    tensors = {
        "means": torch.stack([(u - width / 2) / focal_px * z, (v - height / 2) / focal_px * z, z], -1),
        "quats": torch.nn.functional.normalize(quats, dim=-1),
        "scales": size_px * (z / focal_px)[:, None],
        "opacities": opacities,
        "colors": sh,
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]]),
    }
    settings = {"width": width, "height": height, "sh_degree": 3, "packed": False, "render_mode": "RGB+ED"}
    return Scene({name: tensor.cuda() for name, tensor in tensors.items()} | settings)


SCENES: dict[str, Callable[[], Scene]] = {
    "surgical50k_640x512": lambda: surgical(50_000, 640, 512),
    "surgical200k_1280x1024": lambda: surgical(200_000, 1280, 1024),
    "volume1m_1080p": lambda: volume(1_000_000, 1920, 1080),
    "volume4m_4k": lambda: volume(4_000_000, 3840, 2160),
}
