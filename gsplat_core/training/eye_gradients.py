"""Whose colours a step trains where the two eyes of a stereo scope see different ones.

Geometry is that of both. Each eye's colours are trained by its own pictures alone: what the eyes see differently, highlights above all, would
otherwise pull every colour to and fro. Where colours change over time, that is learned from the left eye, and holds for both.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

LEFT, RIGHT = "sh", "right_sh"
"""Names of the tensors of `Gaussians`; the right eye sees their sum."""


def with_eye(gradients: Mapping[str, Tensor], of_right: bool) -> dict[str, Tensor]:
    """The gradients of a picture with those of both eyes' colours, 0 for the eye that did not see it."""
    nothing = torch.zeros_like(gradients[LEFT])
    colours = (nothing, gradients[LEFT]) if of_right else (gradients[LEFT], nothing)
    return {**gradients, **dict(zip((LEFT, RIGHT), colours, strict=True))}
