"""Layout of the raw-parameter rows [N, 16] that hold deformation deltas and their gradients.

Raw parameters are those that the optimiser changes: log-scales, opacity logits, and the coefficient
of the constant spherical harmonic as colour. `gsplat_core/native/raw_layout.h` defines the same
numbers for the kernels.
"""

from __future__ import annotations

RAW_COLUMNS = 16
"""Columns of a row; those beyond `OPACITY` are unused and zero, so that a row is four aligned float4."""
POSITION = slice(0, 3)
"""x, y, z."""
ROTATION = slice(3, 7)
"""Quaternion as w, x, y, z."""
LOG_SCALE = slice(7, 10)
COLOUR = slice(10, 13)
"""Red, green, blue of the first spherical-harmonics coefficient."""
OPACITY = slice(13, 14)
"""Logit of the opacity."""


def width_of(*groups: slice) -> int:
    """Return the total number of columns of the groups."""
    return sum(group.stop - group.start for group in groups)


BASIS_GROUPS = (POSITION, ROTATION, LOG_SCALE, COLOUR)
"""Parameters deformed by the basis-function field: the first `BASIS_CHANNELS` columns."""
BASIS_CHANNELS = width_of(*BASIS_GROUPS)

HEAD_GROUPS = (POSITION, LOG_SCALE, ROTATION, OPACITY)
"""Output order of the HexPlane field's network, with log-scales before rotation as in G-SHARP."""
HEAD_COLUMNS = tuple(column for group in HEAD_GROUPS for column in range(group.start, group.stop))
"""Raw column of each output of that network."""
