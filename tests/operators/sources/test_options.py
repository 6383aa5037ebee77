"""Ranges of the options that every source takes."""

from __future__ import annotations

import math

import pytest

from gsplat_core.errors import InvalidSetting
from operators.sources.options import SourceOptions


@pytest.mark.parametrize(
    ("name", "possible", "impossible"),
    [
        ("speed", [1e-9, 1000.0, math.inf], [0.0, -1.0, 1000.001, math.nan]),
        ("fps", [None, 1e-9, 1000.0], [0.0, -1.0, 1000.001, math.inf, math.nan]),
        ("waiting", [1, 64], [0, 65]),
        ("stereo", [None, "side_by_side", "top_bottom"], ["both", ""]),
    ],
)
def test_options_have_ranges(name, possible, impossible):
    for value in possible:
        assert getattr(SourceOptions(**{name: value}), name) == value
    for value in impossible:
        with pytest.raises(InvalidSetting, match=f"^{name} is "):
            SourceOptions(**{name: value})


def test_a_source_that_is_asked_for_nothing_keeps_two_frames_and_the_recorded_pace():
    options = SourceOptions()
    assert (options.waiting, options.speed, options.scale, options.fps, options.max_frames) == (2, 1.0, 1.0, None, None)
    assert not (options.realtime or options.loop or options.bounce)
