"""Ranges of the settings in this package: each part has one frozen dataclass of them, checked when it is made."""

from __future__ import annotations

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.value_ranges import ValueRange


def check_settings(settings: object, **ranges: ValueRange) -> None:
    """Raises InvalidSetting, with the name and the range, when an attribute of `settings` is not in its range."""
    for name, allowed in ranges.items():
        try:
            allowed.checked(f"{type(settings).__name__}.{name}", getattr(settings, name))
        except InvalidInput as error:
            raise InvalidSetting(str(error)) from None
