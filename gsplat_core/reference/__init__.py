"""Every op again in plain torch, any dtype: the oracle of the tests, and a way to run without the compiled core."""

from gsplat_core.reference.deformation import (
    basis_field,
    basis_field_backward,
    basis_field_backward_adam_,
    hexplane_features,
    hexplane_modulate,
    hexplane_space,
)

__all__ = [
    "basis_field",
    "basis_field_backward",
    "basis_field_backward_adam_",
    "hexplane_features",
    "hexplane_modulate",
    "hexplane_space",
]
