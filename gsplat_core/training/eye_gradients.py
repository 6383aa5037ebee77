"""Assignment of colour gradients to the eyes of a stereo scope.

Both eyes train the geometry. Each eye's colours are trained by its own pictures only, because
view-dependent differences such as highlights would otherwise pull every colour back and forth.
Temporal colour changes are learned from the left eye and apply to both.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

LEFT, RIGHT = "sh", "right_sh"
"""Tensor names in `Gaussians`. The right eye sees the sum of both."""


def with_eye(gradients: Mapping[str, Tensor], of_right: bool) -> dict[str, Tensor]:
    """Return the gradients of a picture extended to the colours of both eyes, with 0 for the other
    eye.
    """
    nothing = torch.zeros_like(gradients[LEFT])
    colours = (nothing, gradients[LEFT]) if of_right else (gradients[LEFT], nothing)
    return {**gradients, **dict(zip((LEFT, RIGHT), colours, strict=True))}
