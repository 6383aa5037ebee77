"""Pairs of small pictures, of every kind that matching must get right or must survive, for both devices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

CASES = [
    # kind, height, width, lowest, count
    ("texture", 1, 1, 0, 16),
    ("texture", 1, 40, 0, 16),
    ("texture", 40, 1, -3, 16),
    ("texture", 9, 7, 0, 32),  # narrower than its disparities
    ("texture", 23, 37, -20, 48),
    ("texture", 64, 101, 0, 16),
    ("texture", 33, 130, -3, 64),
    ("texture", 17, 70, 2, 80),
    ("texture", 21, 90, -100, 112),
    ("texture", 12, 150, -5, 128),
    ("texture", 15, 66, -130, 256),
    ("texture", 70, 65, 0, 32),  # more rows than one band, more columns than one block
    ("texture", 20, 30, 300, 16),  # all of it outside the right picture
    ("noise", 40, 50, -8, 32),
    ("flat", 30, 45, -4, 16),
    ("black", 13, 20, 0, 16),
    ("same", 25, 60, -16, 32),
    ("stripes", 20, 64, -8, 48),  # as good at many disparities
    ("steps", 45, 80, 0, 32),
]
ids = ["-".join(map(str, case)) for case in CASES]
every_case = pytest.mark.parametrize("case", CASES, ids=ids)

SHIFT_PX = 6


def pair(kind: str, height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Left and right picture uint8 [H, W]."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    if kind in ("flat", "black"):
        plain = torch.full((height, width), 90 if kind == "flat" else 0, dtype=torch.uint8)
        return plain, plain.clone()
    if kind == "noise":
        return (255 * random(height, width)).byte(), (255 * random(height, width)).byte()
    if kind == "stripes":
        stripes = 255 * (torch.arange(width) // 4 % 2)
        return (stripes.byte().repeat(height, 1),) * 2
    wide = random(1, 1, height + 4, width + 3 * SHIFT_PX + 4)
    wide = 255 * torch.nn.functional.avg_pool2d(wide, 3, 1, 1)[0, 0, 2:-2, 2:-2]
    left = wide[:, :width]
    if kind == "same":
        return left.byte(), left.byte()
    noise = 4 * random(height, width)
    right = wide[:, SHIFT_PX : SHIFT_PX + width]
    if kind == "steps":  # a part in front, three times as near
        near = (torch.arange(height)[:, None] > height // 3) & (torch.arange(width) > width // 3)
        right = torch.where(near, wide[:, 3 * SHIFT_PX : 3 * SHIFT_PX + width], right)
    return left.byte(), (right + noise).clamp(0, 255).byte()
