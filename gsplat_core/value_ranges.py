"""Checks of external values (from files, messages or text written by a user) before the values are used.

`int` and `float` also accept `1_0` and the digits of other scripts. In a command line or an address, such text is a
typing error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsplat_core.errors import InvalidInput, InvalidSetting


@dataclass(frozen=True)
class IntegerIn:
    """Integer from `low` to `high`, both included; bools are rejected."""

    low: int
    high: int

    def __str__(self) -> str:
        return f"an integer from {self.low} to {self.high}"

    def checked(self, name: str, value: object) -> int:
        """Return the value, or raise InvalidInput if it is outside the range."""
        if not isinstance(value, int) or isinstance(value, bool) or not self.low <= value <= self.high:
            raise InvalidInput(f"{name} must be {self}, got {shortened(value)}")
        return value


@dataclass(frozen=True)
class NumberIn:
    """Finite number from `low` to `high`, both included; bools are rejected."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"a number from {self.low:g} to {self.high:g}"

    def checked(self, name: str, value: object) -> float:
        """Return the value, or raise InvalidInput if it is outside the range."""
        # Compare before the conversion to float, which overflows for huge integers.
        if not isinstance(value, int | float) or isinstance(value, bool) or not self.low <= value <= self.high:
            raise InvalidInput(f"{name} must be {self}, got {shortened(value)}")
        assert math.isfinite(value)
        return float(value)


@dataclass(frozen=True)
class ListOf:
    """List of `shortest` to `longest` values, each in the range `item`."""

    item: IntegerIn | NumberIn
    shortest: int
    longest: int

    def __str__(self) -> str:
        lengths = str(self.shortest) if self.shortest == self.longest else f"{self.shortest} to {self.longest}"
        return f"a list of {lengths} values, each {self.item}"

    def checked(self, name: str, value: object) -> list[float]:
        """Return the list, or raise InvalidInput for another type, length or value."""
        if not isinstance(value, list | tuple) or not self.shortest <= len(value) <= self.longest:
            raise InvalidInput(f"{name} must be {self}, got {shortened(value)}")
        return [self.item.checked(f"{name}[{index}]", each) for index, each in enumerate(value)]


ValueRange = IntegerIn | NumberIn | ListOf


def shortened(value: object, most: int = 80) -> str:
    """Return the `repr` of a value, truncated to `most` characters, or only kind and length of a huge value."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, list | tuple | dict | str) and len(value) > 64:
        return f"a {type(value).__name__} of {len(value)}"
    text = repr(value)
    return text if len(text) <= most else text[:most] + "…"


def check_seen_at(time_s: float, window_s: tuple[float, float]) -> None:
    """Raise InvalidSetting for a time outside the model's observed window (start, end), in seconds."""
    start_s, end_s = window_s
    if not start_s - 1e-6 <= time_s <= end_s + 1e-6:
        raise InvalidSetting(
            f"the model has seen nothing at {time_s:g} s; its window is {start_s:.3f} to {end_s:.3f} s"
        )


def is_plain(text: str) -> bool:
    """Return True if a text has ASCII characters only, and neither underscores nor surrounding blanks."""
    return text.isascii() and "_" not in text and text == text.strip()


def plain_float(text: str) -> float:
    """Return the number that a text states.

    Raises:
        ValueError: if the text is no number, or is written with underscores, blanks or digits of other scripts.
    """
    if not is_plain(text):
        raise ValueError(f"{text!r} is not a plain number")
    return float(text)
