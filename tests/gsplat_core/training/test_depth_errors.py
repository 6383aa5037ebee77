"""Errors that a model states for its depth: those of the frames' depth, and its own difference from it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training.observations import Observation
from gsplat_core.training.placement import MOST_TIMES, depth_errors
from tests.gsplat_core.training.test_late_depth import CAMERA, found, frame_at, learner


@pytest.fixture(scope="module")
def placed():
    """Reconstruction of a plane at 80 mm."""
    made = learner(frames=0)
    for k in range(4):
        made.observe(found(frame_at(k)), steps=3)
    return made


def seen(k: int, depth: float, error: float | None = 0.0) -> Observation:
    return Observation.of(found(frame_at(k), depth).with_fields(depth_error=error), CAMERA)


def test_depth_errors_are_difference_of_model_and_frame_depth(placed):
    model = placed.snapshot()
    right, far = depth_errors(model, [seen(0, 80.0), seen(2, 100.0)])
    assert right.time_s == frame_at(0).time_s and right.relative < 0.02
    assert far.time_s == frame_at(2).time_s and far.relative == pytest.approx(0.2, abs=0.03)


def test_depth_errors_include_standard_error_of_frame_depth(placed):
    model = placed.snapshot()
    sure, unsure, unknown = (depth_errors(model, [seen(0, 80.0, error)])[0].relative for error in (0.0, 0.3, None))
    assert unsure == pytest.approx(math.hypot(sure, 0.3))
    assert unknown == pytest.approx(math.hypot(sure, DEPTH_ORIGINS["stereo"].relative_error))


def test_depth_errors_are_limited_to_few_times_within_window(placed):
    model = placed.snapshot()
    end_s = model.time_window_s[1]
    observations = [replace(seen(0, 80.0), time_s=end_s * k / 20) for k in range(25)]
    times = [each.time_s for each in depth_errors(model, observations)]
    assert len(times) == MOST_TIMES and times == sorted(times) and times[0] == 0 and times[-1] <= end_s
    without = replace(seen(0, 80.0), depth=None)
    assert depth_errors(model, [without]) == ()


def test_with_depth_errors_changes_only_depth_source(placed):
    model = placed.snapshot()
    stated = placed.with_depth_errors(model)
    assert model.depth_source.errors == () and len(stated.depth_source.errors) == 4
    assert replace(stated, depth_source=model.depth_source).sha256() == model.sha256() != stated.sha256()
    assert stated.depth_source.origin is DEPTH_ORIGINS["stereo"]
