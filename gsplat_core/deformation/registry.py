"""Creation of deformation fields by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsplat_core.choices import FIELDS
from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.kinds import FieldKind
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.gaussians import Gaussians

__all__ = ["FIELDS", "field_from_config", "kind_of", "new_field"]


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
    """Create an untrained identity field for these Gaussians.

    Args:
        kind: name in `FIELDS`.
        architecture: values of `DeformationField.config` that replace the defaults (`bumps=9`).

    Raises:
        InvalidSetting: if the kind is unknown.
    """
    made: DeformationField = FIELDS[kind].field.for_gaussians(gaussians, time_window_s, **architecture)
    return made


def field_from_config(config: Mapping[str, Any], gaussians: Gaussians) -> DeformationField:
    """Create an untrained field from the result of `DeformationField.config`.

    Raises:
        InvalidSetting: if the kind is unknown.
        InvalidInput: if a value is out of range.
    """
    kind = kind_of(config.get("kind"))
    rebuilt: DeformationField = kind.field.from_config(kind.checked_config(config), gaussians)
    return rebuilt
