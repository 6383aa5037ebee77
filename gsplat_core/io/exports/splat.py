"""Gaussians as `.splat`, the layout of antimatter15's viewer that many browsers' viewers read: 32 bytes for each, without a header.

Position and scale (standard deviations) as three float32 each, colour as red, green, blue and opacity in a byte each, rotation as w, x, y, z in a byte each
(128 is 0, 128 steps are 1). Colours are those of the constant harmonics alone. The most important one comes first, by size and opacity, because
viewers show what has arrived.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.exports.rows import Rows
from gsplat_core.scene.gaussians import SH_C0

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def splat_bytes(rows: Rows) -> bytes:
    """The file's content."""
    table = np.empty(len(rows.means), ROW)
    table["position"], table["scale"] = rows.means, rows.scales
    colour = np.column_stack([0.5 + SH_C0 * rows.sh[:, 0], rows.opacities])
    table["colour"] = _byte(colour * 255)
    table["rotation"] = _byte(rows.rotations * 128 + 128)
    importance = rows.scales.astype(np.float64).prod(axis=1) * rows.opacities
    return table[np.argsort(-importance, kind="stable")].tobytes()


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
