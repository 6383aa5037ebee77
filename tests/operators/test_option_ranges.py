"""Accepted ranges of numeric options, which commands, settings files and clients rely on."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from tests.operators.test_settings import EVERY

RANGES: dict[str, tuple[float, float, float, float]] = {
    "budget_ms": (0, 0.001, 10_000, 10_001),
    "engine_scale": (0, 0.001, 1, 1.001),
    "fps": (0, 0.001, 1000, 1001),
    "max_frames": (0, 1, 10_000_000, 10_000_001),
    "minutes": (0, 0.001, 100_000, 100_001),
    "samples": (0, 1, 1024, 1025),
    "scale": (0, 0.001, 4, 4.001),
    "seconds": (0, 0.001, 999_999_999, 1_000_000_000),
    "seed": (-1, 0, 2_147_483_647, 2_147_483_648),
    "steps": (0, 1, 100_000_000, 100_000_001),
    "steps_per_frame": (0, 1, 10_000, 10_001),
    "supersampling": (0, 1, 4, 5),
}
"""A value that is too small, the smallest and the largest one accepted, and one that is too large."""


def test_each_numeric_option_has_a_range():
    assert set(RANGES) == {name for name, each in EVERY.items() if each.plain in (int, float)}


@pytest.mark.parametrize("name", RANGES)
def test_numeric_option_accepts_only_values_in_range(name):
    each = EVERY[name]
    below, least, most, above = (each.plain(value) for value in RANGES[name])
    for value in (least, most):
        assert each.checked(value) == value
    for value in (below, above):
        with pytest.raises(InvalidSetting, match=f"^{name} is "):
            each.checked(value)
