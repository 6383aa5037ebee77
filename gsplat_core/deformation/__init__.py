"""Deformation fields: how canonical Gaussians move in time."""

from __future__ import annotations

from gsplat_core.deformation.basis import BasisField
from gsplat_core.deformation.basis_adam import BasisRates
from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.deformation.kind import FieldKind, NewField
from gsplat_core.deformation.rates import FieldRates
from gsplat_core.deformation.registry import FIELDS, field_from_config, kind_of, new_field

__all__ = [
    "FIELDS",
    "BasisField",
    "BasisRates",
    "DeformationField",
    "FieldKind",
    "FieldRates",
    "HexPlaneField",
    "NewField",
    "field_from_config",
    "kind_of",
    "new_field",
]
