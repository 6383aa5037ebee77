"""Deformation fields: how canonical Gaussians move in time."""

from __future__ import annotations

from typing import Any

from gsplat_core.deformation.basis import BasisField, BasisRates
from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians

__all__ = [
    "FIELD_KINDS",
    "BasisField",
    "BasisRates",
    "DeformationField",
    "HexPlaneField",
    "field_from_config",
    "new_field",
]

FIELD_KINDS = ("auto", "basis", "hexplane")
"""Names of `--field`; `auto` is the basis field, which learns faster and better (benchmarks/RESULTS.md)."""


def new_field(
    kind: str, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any
) -> DeformationField:
    """An untrained field (the identity) for these Gaussians; `architecture` goes to the field's constructor."""
    if kind in ("auto", "basis"):
        return BasisField(gaussians.count, time_window_s, **architecture)
    if kind == "hexplane":
        return HexPlaneField(gaussians, time_window_s, **architecture)
    raise InvalidInput(f"unknown deformation field {kind!r}; known are {', '.join(FIELD_KINDS)}")


def field_from_config(config: dict[str, Any], gaussians: Gaussians) -> DeformationField:
    """An untrained field of the architecture that `DeformationField.config` described."""
    kind = config.get("kind")
    if kind == BasisField.kind:
        return BasisField.from_config(config, gaussians.count)
    if kind == HexPlaneField.kind:
        return HexPlaneField.from_config(config, gaussians)
    raise InvalidInput(f"unknown deformation field {kind!r} in the config; known are basis and hexplane")
