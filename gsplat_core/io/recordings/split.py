"""Held-out split customary for endoscopic reconstruction: frames with (i - 1) % 8 == 0 (1, 9, 17, …) are test frames.

EndoGaussian, Deform3DGS and SurgicalGaussian use it on EndoNeRF's clips, which have no official split.
"""

from __future__ import annotations

HELDOUT_STRIDE = 8


def is_heldout(index: int) -> bool:
    """Return True if the frame with this 0-based index is held out from training."""
    return (index - 1) % HELDOUT_STRIDE == 0
