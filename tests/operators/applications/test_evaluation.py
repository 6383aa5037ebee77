"""Settings of an evaluation at their borders."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from operators.applications.evaluate import EvaluationSettings


@pytest.mark.parametrize(
    ("name", "possible", "impossible"),
    [
        ("protocols", [(), ("heldout", "causal"), ("geometry",)], [("all",), ("heldout", "")]),
        ("motion_prior", [None], ["crystal ball"]),
        ("scale", [None, 64.0], [0.0, 64.1]),
        ("steps_per_frame", [None, 1], [0]),
        ("max_frames", [None, 1], [0]),
    ],
)
def test_settings_of_an_evaluation_have_ranges(name, possible, impossible):
    for value in possible:
        assert getattr(EvaluationSettings("clip.mp4", **{name: value}), name) == value
    for value in impossible:
        with pytest.raises(InvalidSetting):
            EvaluationSettings("clip.mp4", **{name: value})
