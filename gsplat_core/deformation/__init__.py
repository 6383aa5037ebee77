"""Deformation fields, which move, rotate and scale canonical Gaussians over time; some also change colour or opacity."""

from __future__ import annotations

from gsplat_core.choices import FIELDS
from gsplat_core.deformation.basis import BasisField
from gsplat_core.deformation.basis_bumps import BasisRates
from gsplat_core.deformation.field import Capabilities, DeformationField
from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.deformation.kinds import FieldKind, FieldRates, NewField, field_from_config, kind_of, new_field

__all__ = [
    "FIELDS",
    "BasisField",
    "BasisRates",
    "Capabilities",
    "DeformationField",
    "FieldKind",
    "FieldRates",
    "HexPlaneField",
    "NewField",
    "field_from_config",
    "kind_of",
    "new_field",
]
