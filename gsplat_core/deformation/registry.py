"""The kinds of deformation field, by name. Another one is a module with a `FieldKind`, and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsplat_core.deformation.field import DeformationField, FieldKind
from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry
from gsplat_core.scene.gaussians import Gaussians

FIELDS: Registry[FieldKind[Any]] = Registry(
    "deformation field",
    {
        "auto": "gsplat_core.deformation.basis:KIND",  # the better one in benchmarks/notes/replay.md
        "basis": "gsplat_core.deformation.basis:KIND",
        "hexplane": "gsplat_core.deformation.hexplane:KIND",
    },
)
"""Kinds of deformation fields by the names that a user can choose; `auto` is an alias."""


def kind_of(name: object) -> FieldKind[Any]:
    """Return the kind with this canonical name, as stated by a field or manifest; not `auto`.

    Raises:
        InvalidSetting: if the name is unknown.
    """
    if not isinstance(name, str) or name not in FIELDS or FIELDS[name].name != name:
        known = [each for each in FIELDS if FIELDS[each].name == each]
        raise InvalidSetting(f"unknown deformation field {name!r:.80}; known are {', '.join(known)}")
    return FIELDS[name]


def new_field(
    kind: str, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any
) -> DeformationField:
    """An untrained field (the identity) of the default architecture for these Gaussians, or of another one.

    Args:
        kind: a name in `FIELDS`; another one raises InvalidSetting.
        architecture: values of `DeformationField.config` that replace the default ones (`bumps=9`).
    """
    made: DeformationField = FIELDS[kind].field.for_gaussians(gaussians, time_window_s, **architecture)
    return made


def field_from_config(config: Mapping[str, Any], gaussians: Gaussians) -> DeformationField:
    """An untrained field of the configuration that `DeformationField.config` returned.

    Raises InvalidSetting for an unknown kind, InvalidInput for a value that is not in its range.
    """
    kind = kind_of(config.get("kind"))
    rebuilt: DeformationField = kind.field.from_config(kind.checked_config(config), gaussians)
    return rebuilt
