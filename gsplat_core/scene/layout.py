"""The layout of a Gaussian's row of raw parameters: deformation deltas [N, 16] are added in it, and their gradient has it too.

Raw parameters are what training changes: scales as logarithms, opacities as logits, colours as the coefficient of the constant basis
function of the spherical harmonics. `gsplat_core/native/raw_layout.h` has the same numbers for the kernels.
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
    """How many columns these groups have together."""
    return sum(group.stop - group.start for group in groups)


BASIS_GROUPS = (POSITION, ROTATION, LOG_SCALE, COLOUR)
"""What the basis-function field moves: the first `BASIS_CHANNELS` columns."""
BASIS_CHANNELS = width_of(*BASIS_GROUPS)

HEAD_GROUPS = (POSITION, LOG_SCALE, ROTATION, OPACITY)
"""What the HexPlane field's network puts out, in this order: G-SHARP's, which has log-scales before the rotation."""
HEAD_COLUMNS = tuple(column for group in HEAD_GROUPS for column in range(group.start, group.stop))
"""The raw column of every output of that network."""
