"""Checks of external values (from files, messages or text written by a user) before the values are used.

`JsonObject` reads JSON of untrusted files: no NaN, no duplicate keys, bounded nesting, and values in the expected ranges.

`int` and `float` also accept `1_0` and the digits of other scripts. In a command line or an address, such text is a
typing error.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from gsplat_core.errors import BundleCorrupt, InvalidInput, InvalidSetting


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
    """Return True if a text is suited for a number: ASCII characters only, and neither underscores nor surrounding blanks."""
    return text.isascii() and "_" not in text and text == text.strip()


def plain_float(text: str) -> float:
    """Return the number that a text states.

    Raises:
        ValueError: if the text is no number, or is written with underscores, blanks or digits of other scripts.
    """
    if not is_plain(text):
        raise ValueError(f"{text!r} is not a plain number")
    return float(text)


MAX_NESTING = 16
"""Maximum nesting depth of objects and lists in accepted JSON."""


class JsonObject:
    """JSON object with typed, validated access by key.

    A missing or out-of-range value raises BundleCorrupt with its location and value.
    """

    def __init__(self, values: object, name: str) -> None:
        if not isinstance(values, dict):
            raise BundleCorrupt(f"{name} must be a JSON object, got {shortened(values)}")
        self.values: dict[str, Any] = values
        self.name = name

    @staticmethod
    def parse(text: bytes, name: str) -> JsonObject:
        """Parse a JSON object; `name` identifies the file in messages."""
        try:
            values = json.loads(text.decode(), parse_constant=_refuse_constant, object_pairs_hook=_without_duplicates)
        except (ValueError, RecursionError) as error:
            raise BundleCorrupt(f"{name} is not valid JSON ({error}); copy it again") from error
        _check_nesting(values, name)
        return JsonObject(values, name)

    def nested(self, key: str) -> JsonObject:
        """Return the nested JSON object stored under a key."""
        return JsonObject(self.values.get(key), f"{self.name}: {key}")

    def integer(self, key: str, wanted: IntegerIn) -> int:
        """Return the integer stored under a key, in the range `wanted`."""
        return int(self._checked(key, wanted))

    def number(self, key: str, wanted: NumberIn) -> float:
        """Return the number stored under a key, in the range `wanted`."""
        return float(self._checked(key, wanted))

    def matrix(self, key: str, size: int, wanted: NumberIn) -> list[list[float]]:
        """Return the square matrix stored under a key: `size` rows of `size` numbers, each in the range `wanted`."""
        return self._matrix(key, self.values.get(key), size, wanted)

    def matrices(self, key: str, size: int, wanted: NumberIn, most: int) -> list[list[list[float]]]:
        """Return the list of 1 to `most` square matrices stored under a key, each `size` rows of `size` numbers."""
        listed = self.values.get(key)
        if not isinstance(listed, list) or not 1 <= len(listed) <= most:
            raise BundleCorrupt(f"{self.name}: {key} must be a list of 1 to {most} matrices, got {shortened(listed)}")
        return [self._matrix(f"{key}[{index}]", rows, size, wanted) for index, rows in enumerate(listed)]

    def numbers(self, key: str, wanted: NumberIn, most: int) -> list[float]:
        """Return the list of 1 to `most` numbers stored under a key, each in the range `wanted`."""
        return [float(value) for value in self._checked(key, ListOf(wanted, 1, most))]

    def integers(self, key: str, wanted: IntegerIn, most: int) -> tuple[int, ...]:
        """Return the list of at most `most` integers stored under a key, each in the range `wanted`."""
        listed = self.values.get(key)
        if not isinstance(listed, list) or len(listed) > most:
            raise BundleCorrupt(
                f"{self.name}: {key} must be a list of at most {most} integers, got {shortened(listed)}"
            )
        try:
            return tuple(int(wanted.checked(f"{key}[{index}]", value)) for index, value in enumerate(listed))
        except InvalidInput as error:
            raise BundleCorrupt(f"{self.name}: {error}") from error

    def window(self, key: str, wanted: NumberIn, longest: float) -> tuple[float, float]:
        """Return start and end of a time window in seconds; the end is not earlier than the start and at most `longest` later."""
        start, end = self._checked(key, ListOf(wanted, 2, 2))
        if not start <= end <= start + longest:
            raise BundleCorrupt(
                f"{self.name}: {key} must be two times in order, at most {longest:g} s apart, got {[start, end]}"
            )
        return start, end

    def choice(self, key: str, choices: tuple[str, ...]) -> str:
        """Return the string stored under a key, which must be one of `choices`."""
        value = self.values.get(key)
        if not isinstance(value, str) or value not in choices:
            raise BundleCorrupt(f"{self.name}: {key} must be one of {', '.join(choices)}, got {shortened(value)}")
        return value

    def boolean(self, key: str) -> bool:
        """Return the boolean stored under a key."""
        value = self.values.get(key)
        if not isinstance(value, bool):
            raise BundleCorrupt(f"{self.name}: {key} must be true or false, got {shortened(value)}")
        return value

    def digest(self, key: str) -> str:
        """Return the SHA-256 digest stored under a key, in hexadecimal."""
        value = self.values.get(key)
        if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise BundleCorrupt(
                f"{self.name}: {key} must be a SHA-256 in lower-case hexadecimal, got {shortened(value)}"
            )
        return value

    def _matrix(self, key: str, rows: object, size: int, wanted: NumberIn) -> list[list[float]]:
        if not isinstance(rows, list) or len(rows) != size:
            raise BundleCorrupt(f"{self.name}: {key} must be {size} rows of {size} numbers, got {shortened(rows)}")
        try:
            return [ListOf(wanted, size, size).checked(f"{key}[{index}]", row) for index, row in enumerate(rows)]
        except InvalidInput as error:
            raise BundleCorrupt(f"{self.name}: {error}") from error

    def _checked(self, key: str, wanted: IntegerIn | NumberIn | ListOf) -> Any:
        try:
            return wanted.checked(key, self.values.get(key))
        except InvalidInput as error:
            raise BundleCorrupt(f"{self.name}: {error}") from error


def _refuse_constant(value: str) -> None:
    raise ValueError(f"{value} is not a number of JSON")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {shortened(twice)} occurs twice in one object")
    return values


def _check_nesting(values: object, name: str) -> None:
    level = [values]
    for _ in range(MAX_NESTING):
        level = [
            inner
            for each in level
            if isinstance(each, dict | list)
            for inner in (each.values() if isinstance(each, dict) else each)
        ]
        if not level:
            return
    raise BundleCorrupt(f"{name} nests objects and lists more than {MAX_NESTING} deep; it is not a manifest")
