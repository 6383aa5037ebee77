"""Range checks of the frozen settings dataclasses of this package."""

from __future__ import annotations

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.value_ranges import ValueRange


def check_settings(settings: object, **ranges: ValueRange) -> None:
    """Check attributes of `settings` against ranges.

    Raises:
        InvalidSetting: with name and range of the first attribute out of range.
    """
    for name, allowed in ranges.items():
        try:
            allowed.checked(f"{type(settings).__name__}.{name}", getattr(settings, name))
        except InvalidInput as error:
            raise InvalidSetting(str(error)) from None
