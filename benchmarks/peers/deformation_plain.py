"""Deformation fields in plain PyTorch, as peers of the fused ones.

`PlainHexPlane` is HexPlane (Cao and Johnson 2023) with a small network as in 4D Gaussian Splatting (Wu et al. 2024) and G-SHARP: six
`grid_sample`s per level, their product, the levels concatenated, a trunk, heads. `PlainBasis` is bumps in time per Gaussian, shared
by 13 channels (after Deform3DGS, Yang et al. 2024).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

HEADS = (3, 4, 3, 1)
"""Position, rotation, log-scale, opacity logit."""


class PlainHexPlane(nn.Module):
    """`deltas(positions, time)`: positions [N, 3] and time within [-1, 1] to one tensor per head."""

    def __init__(
        self, channels: int, resolution: Sequence[int], levels: Sequence[int], trunk: Sequence[int], deep_heads: bool
    ) -> None:
        """`trunk`: widths of its layers; `deep_heads`: a hidden layer in every head, as G-SHARP has."""
        super().__init__()
        self.planes = nn.ParameterList()
        for level in levels:
            sizes = [size * level for size in resolution[:3]] + [resolution[3]]
            for u, v in combinations(range(4), 2):
                plane = torch.empty(1, channels, sizes[v], sizes[u])
                self.planes.append(nn.init.ones_(plane) if v == 3 else nn.init.uniform_(plane, 0.1, 0.5))
        widths = [channels * len(levels), *trunk]
        layers = [layer for a, b in pairwise(widths) for layer in (nn.ReLU(), nn.Linear(a, b))]
        self.trunk = nn.Sequential(*layers[1:])
        hidden = [nn.ReLU(), nn.Linear(widths[-1], widths[-1])] if deep_heads else []
        self.heads = nn.ModuleList(nn.Sequential(*hidden, nn.ReLU(), nn.Linear(widths[-1], size)) for size in HEADS)
        for head in self.heads:
            nn.init.normal_(head[-1].weight, std=1e-3)
            nn.init.zeros_(head[-1].bias)

    def forward(self, positions: Tensor, time: float) -> list[Tensor]:
        at = torch.cat([positions, torch.full_like(positions[:, :1], time)], dim=1)
        features = []
        for planes in zip(*[iter(self.planes)] * 6, strict=True):
            product: Tensor | None = None
            for axes, plane in zip(combinations(range(4), 2), planes, strict=True):
                grid = at[:, list(axes)].view(1, -1, 1, 2)
                sample = functional.grid_sample(plane, grid, align_corners=True, padding_mode="border")
                sample = sample.view(plane.shape[1], -1).t()
                product = sample if product is None else product * sample
            assert product is not None
            features.append(product)
        hidden = self.trunk(torch.cat(features, dim=1))
        return [head(hidden) for head in self.heads]


def gsharp() -> PlainHexPlane:
    """Return a field of G-SHARP's size: 85.3 million parameters in the planes."""
    return PlainHexPlane(64, (64, 64, 64, 100), (1, 2, 4, 8), (32,), deep_heads=True).cuda()


def small() -> PlainHexPlane:
    """Return a field of the size in gsplat's surgical trainer."""
    return PlainHexPlane(32, (64, 64, 64, 25), (1, 2), (64, 64, 64), deep_heads=False).cuda()


class PlainBasis(nn.Module):
    """`deltas(time)` [N, 13] of bumps exp(-((time - centre) / width)²): position, rotation, log-scale, colour."""

    def __init__(self, gaussians: int, bumps: int) -> None:
        super().__init__()
        self.centres = nn.Parameter(torch.linspace(0, 1, bumps, device="cuda").repeat(gaussians, 1))
        self.log_widths = nn.Parameter(torch.full((gaussians, bumps), 1 / bumps, device="cuda").log())
        self.weights = nn.Parameter(torch.zeros(gaussians, bumps, 13, device="cuda"))

    def forward(self, time: float) -> Tensor:
        bumps = torch.exp(-(((time - self.centres) / self.log_widths.exp()) ** 2))
        return torch.einsum("nb,nbc->nc", bumps, self.weights)
