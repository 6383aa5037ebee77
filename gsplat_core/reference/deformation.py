"""Deformation ops in plain torch, re-exported from the fields' own fallback implementations.

They are the test reference of the C++ and CUDA kernels.
"""

from __future__ import annotations

from gsplat_core.ops.basis_field.plain_torch import (
    basis_field,
    basis_field_add_colours_,
    basis_field_backward,
    basis_field_backward_adam_,
    basis_field_move_to_,
)
from gsplat_core.ops.hexplane.plain_torch import (
    hexplane_decode,
    hexplane_deltas,
    hexplane_features,
    hexplane_modulate,
    hexplane_space,
)

__all__ = [
    "basis_field",
    "basis_field_add_colours_",
    "basis_field_backward",
    "basis_field_backward_adam_",
    "basis_field_move_to_",
    "hexplane_decode",
    "hexplane_deltas",
    "hexplane_features",
    "hexplane_modulate",
    "hexplane_space",
]
