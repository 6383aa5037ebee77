"""Settings accept extreme but usable values and refuse unusable ones by name."""

from __future__ import annotations

import pytest

from gsplat_core.endoscope.cuts import CutSettings
from gsplat_core.endoscope.exposure import ExposureSettings
from gsplat_core.endoscope.highlights import HighlightSettings
from gsplat_core.endoscope.interlacing import InterlacingSettings
from gsplat_core.endoscope.mask_and_depth import MaskAndDepthSettings
from gsplat_core.endoscope.sequence import SequenceSettings
from gsplat_core.endoscope.sharpness import SharpnessSettings
from gsplat_core.endoscope.stream_clock import ClockSettings
from gsplat_core.endoscope.strip import StripSettings
from gsplat_core.errors import InvalidSetting

CASES = [
    (CutSettings, "same_difference", (0.0, 9.0), (-0.1, 20.0)),
    (CutSettings, "same_structure", (0.0, 1.0), (-0.1, 1.1)),
    (CutSettings, "longest_doubt_frames", (1, 9000), (0, 15_000)),
    (CutSettings, "same_after_gap_difference", (0.0, 9.0), (-0.1, 20.0)),
    (CutSettings, "views", (1, 100), (0, 150)),
    (CutSettings, "rate_ratio", (1.05, 90.0), (1.0, 0.5, 200.0)),
    (CutSettings, "rate_frames", (3, 9000), (2, 15_000)),
    (ExposureSettings, "more_pixels", (0.0, 90.0), (-1.0, 200.0)),
    (ExposureSettings, "settled_frames", (1, 1000), (0, 1500)),
    (ExposureSettings, "references", (1, 100), (0, 150)),
    (ExposureSettings, "reference_every", (1, 1000), (0, 1500)),
    (ExposureSettings, "young_references", (1, 100), (0, 150)),
    (ExposureSettings, "least_clear_jump", (0.0, 90.0), (-1.0, 200.0)),
    (ExposureSettings, "least_clear_drift", (0.0, 90.0), (-1.0, 200.0)),
    (ExposureSettings, "largest_gain", (1.0, 90.0), (0.5, 200.0)),
    (ExposureSettings, "forget_s", (1.0, 86_400.0), (0.0, 1e7)),
    (ExposureSettings, "darkest", (1, 100), (0, 150)),
    (ExposureSettings, "brightest", (128, 255), (90, 256)),
    (HighlightSettings, "brightest_channel", (0, 255), (-1, 256)),
    (HighlightSettings, "above_surroundings", (0, 255), (-1, 256)),
    (HighlightSettings, "surroundings", (0.02, 1.0), (0.0, 1.5)),
    (HighlightSettings, "grown", (0.0, 0.04), (-0.01, 0.2)),
    (InterlacingSettings, "combed_frames", (1, 900_000), (0, 1_500_000)),
    (InterlacingSettings, "comb_ratio", (1.0, 90.0), (0.9, 200.0)),
    (InterlacingSettings, "comb_levels", (0.2, 255.0), (0.0, 256.0)),
    (InterlacingSettings, "comb_share", (0.001, 1.0), (0.0, 1.5)),
    (InterlacingSettings, "stand_out_levels", (0, 255), (-1, 256)),
    (MaskAndDepthSettings, "farthest_mm", (1.0, 1e8), (0.0, 1e10)),
    (MaskAndDepthSettings, "usual_depth_ratio", (1.1, 1e5), (1.0, 1e7)),
    (SequenceSettings, "black_level", (0, 255), (-1, 256)),
    (SequenceSettings, "one_colour_levels", (0, 255), (-1, 256)),
    (SequenceSettings, "noise_share", (0.02, 9.0), (0.0, 20.0)),
    (SequenceSettings, "same_levels", (0, 255), (-1, 256)),
    (SequenceSettings, "frozen_s", (0.0, 3600.0), (-1.0, 4000.0)),
    (SequenceSettings, "frozen_frames", (1, 90_000), (0, 150_000)),
    (SequenceSettings, "torn_share", (0.02, 1.0), (0.0, 1.5)),
    (SharpnessSettings, "clear_above", (0.02, 1.0), (0.0, 1.5)),
    (SharpnessSettings, "smoke_haze", (0.0, 255.0), (-1.0, 300.0)),
    (SharpnessSettings, "recent_s", (0.02, 60.0), (0.0, 70.0)),
    (SharpnessSettings, "recent_frames", (1, 90_000), (0, 150_000)),
    (ClockSettings, "longest_step_s", (0.02, 86_400.0), (0.0, 1e7)),
    (ClockSettings, "arrival_agrees_s", (0.0, 86_400.0), (-1.0, 1e7)),
    (ClockSettings, "late_frames", (1, 9000), (0, 15_000)),
    (ClockSettings, "gap_intervals", (1.0, 1e5), (0.5, 1e7)),
    (StripSettings, "edge_share", (0.02, 1.0), (0.0, 1.5)),
    (StripSettings, "whole_share", (0.02, 1.0), (0.0, 1.5)),
]


@pytest.mark.parametrize(("kind", "name", "usable", "unusable"), CASES, ids=[f"{c[0].__name__}.{c[1]}" for c in CASES])
def test_unusable_values_are_refused_by_name(kind, name, usable, unusable):
    for value in usable:
        assert getattr(kind(**{name: value}), name) == value
    for value in (*unusable, float("nan"), "1", None):
        with pytest.raises(InvalidSetting, match=f"{kind.__name__}.{name}"):
            kind(**{name: value})
