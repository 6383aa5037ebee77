"""Parser of source addresses: `scheme:place?option=value&option=value`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import overload
from urllib.parse import parse_qsl

from gsplat_core.errors import InvalidSetting
from gsplat_core.plain_numbers import plain_float

_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})", re.ASCII)
_FLAGS = {"1": True, "true": True, "yes": True, "": True, "0": False, "false": False, "no": False}
MAX_SIDE_PX = 8192


@dataclass
class Address:
    """A parsed address. Sources query the options by name, and `refuse_others` rejects the rest."""

    scheme: str
    place: str
    options: dict[str, str] = field(default_factory=dict)
    _asked: set[str] = field(default_factory=set)

    @classmethod
    def parse(cls, scheme: str, rest: str) -> Address:
        """Parse the text after `scheme:`. Raises InvalidSetting if an option occurs twice."""
        place, _, query = rest.partition("?")
        pairs = parse_qsl(query, keep_blank_values=True)
        options = dict(pairs)
        if len(options) < len(pairs):
            twice = next(name for name, _ in pairs if sum(name == other for other, _ in pairs) > 1)
            raise InvalidSetting(f"{scheme}: the option {twice!r:.60} is there twice; give it once")
        return cls(scheme, place, options)

    def text(self, name: str, default: str | None = None) -> str | None:
        """Return an option as text."""
        self._asked.add(name)
        return self.options.get(name, default)

    def choice(self, name: str, default: str, choices: tuple[str, ...]) -> str:
        """Return an option that must be one of `choices`. Raises InvalidSetting."""
        value = self.text(name, default)
        if value not in choices:
            raise InvalidSetting(f"{self.scheme}: {name} is {value!r:.60}; choose {', '.join(choices)}")
        return value

    @overload
    def number(self, name: str, default: float, least: float, most: float) -> float: ...
    @overload
    def number(self, name: str, default: float | None, least: float, most: float) -> float | None: ...
    def number(self, name: str, default: float | None, least: float, most: float) -> float | None:
        """Return a numeric option.

        Args:
            name: name of the option.
            default: value if the option is missing.
            least: smallest valid value.
            most: largest valid value.

        Raises:
            InvalidSetting: the option is not a number or out of range.
        """
        text = self.text(name)
        if text is None:
            return default
        try:
            value = plain_float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; it must be a number from {least:g} to {most:g}"
            )
        return value

    @overload
    def whole(self, name: str, default: int, least: int, most: int) -> int: ...
    @overload
    def whole(self, name: str, default: int | None, least: int, most: int) -> int | None: ...
    def whole(self, name: str, default: int | None, least: int, most: int) -> int | None:
        """Return an integer option between `least` and `most`. Raises InvalidSetting."""
        text = self.text(name)
        if text is None:
            return default
        if not (text.isascii() and text.isdecimal() and len(text) <= 20 and least <= int(text) <= most):
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; it must be a whole number from {least} to {most}"
            )
        return int(text)

    def flag(self, name: str, default: bool = False) -> bool:
        """Return a boolean option. Raises InvalidSetting."""
        text = self.text(name)
        if text is None:
            return default
        if text.lower() not in _FLAGS:
            raise InvalidSetting(f"{self.scheme}: {name} is {text!r:.60}; it must be 1 or 0")
        return _FLAGS[text.lower()]

    def size(self, name: str = "size") -> tuple[int, int] | None:
        """Return an option for width and height in pixels, such as `640x512`. Raises
        InvalidSetting.
        """
        text = self.text(name)
        if text is None:
            return None
        match = _SIZE.fullmatch(text)
        width, height = (int(side) for side in match.groups()) if match else (0, 0)
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; give it as 640x512, with sides from 1 to {MAX_SIDE_PX} px"
            )
        return width, height

    def refuse_others(self) -> None:
        """Raise InvalidSetting, listing the known names, if an option was never queried."""
        for name in self.options:
            if name not in self._asked:
                known = ", ".join(sorted(self._asked)) or "none"
                raise InvalidSetting(f"{self.scheme}: unknown option {name!r:.60}; known are {known}")
