"""Base class of the settings sections, with rules for every value."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

MOST = 1e15
MOST_SECONDS = 366 * 86400.0
MOST_DAYS = 36_600.0


class Section(BaseModel):
    """Immutable settings section without unknown keys. Errors do not repeat secrets. Numbers are
    finite, and booleans are not accepted as numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _of_its_kind(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse implicit conversions of pydantic: true as 1, 1 as true, 8000.0 as 8000."""
        kinds = _kinds(cls.model_fields[str(info.field_name)].annotation)
        if isinstance(value, bool) and bool not in kinds and kinds & {int, float}:
            raise ValueError(f"it must be a number, not {str(value).lower()}")
        if isinstance(value, int | float) and not isinstance(value, bool) and bool in kinds:
            raise ValueError(f"it must be true or false, not {value:g}")
        if isinstance(value, float) and int in kinds and float not in kinds:
            raise ValueError(f"it must be a whole number, not {value}")
        return value

    @field_validator("*", mode="after")
    @classmethod
    def _in_bounds(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            name = str(info.field_name)
            most = MOST_SECONDS if name.endswith("_s") and "_per_" not in name else MOST
            most = MOST_DAYS if name.endswith("_days") else most
            if abs(value) > most:
                raise ValueError(f"it must be at most {most:g}")
        return value


def _kinds(annotation: Any) -> set[Any]:
    """Return the classes that an annotation names, those of its unions included."""
    return {annotation, *(kind for each in get_args(annotation) for kind in _kinds(each))}
