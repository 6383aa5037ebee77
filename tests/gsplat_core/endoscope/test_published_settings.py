"""Defaults of the checks of a stream: rates of false alarms in the docs and the benchmarks hold for these."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from gsplat_core.endoscope.cuts import CutSettings
from gsplat_core.endoscope.exposure import ExposureSettings
from gsplat_core.endoscope.field_of_view import FieldOfViewSettings
from gsplat_core.endoscope.highlights import HighlightSettings
from gsplat_core.endoscope.interlacing import InterlacingSettings
from gsplat_core.endoscope.mask_and_depth import MaskAndDepthSettings
from gsplat_core.endoscope.ordinary import OrdinarySettings
from gsplat_core.endoscope.sequence import SequenceSettings
from gsplat_core.endoscope.sharpness import SharpnessSettings
from gsplat_core.endoscope.stream_clock import ClockSettings
from gsplat_core.endoscope.strip import StripSettings

DEFAULTS = {
    CutSettings: dict(same_difference=0.15, same_structure=0.72, same_moved=0.83, same_after_gap_difference=0.2,
                      same_after_gap_colours=0.65, longest_doubt_frames=6, views=4, view_every=15, rate_ratio=1.4, rate_frames=15),
    ExposureSettings: dict(dead_zone=0.08, drift_zone=0.1, more_pixels=1.5, anchor_zone=0.15, release=0.04, settled_change=0.02,
                           settled_frames=6, references=12, reference_every=4, young_references=4, least_clear_jump=1.5,
                           least_clear_drift=1.0, most_unlike=0.25, largest_gain=8.0, forget_s=300.0, darkest=14, brightest=225),
    FieldOfViewSettings: dict(darkest_level=40, surround_range=12, edge_contrast=18, edge_share=0.6, least_surround=0.015,
                              least_field=0.15, ellipse_share=0.7, ellipse_distance=0.015, lit_outside=0.25, margin=0.01,
                              window_frames=30, windows_to_change=3),
    HighlightSettings: dict(brightest_channel=235, darkest_channel=170, above_surroundings=30, surroundings=0.12, grown=0.003, most=0.25),
    InterlacingSettings: dict(comb_ratio=1.2, comb_levels=5.0, comb_share=0.02, combed_frames=4, of_frames=12, forgotten_frames=600,
                              stand_out_levels=4),
    MaskAndDepthSettings: dict(least_tissue=0.02, lost_tool_share=0.05, lost_frames=5, farthest_mm=2000.0, wrong_depth_share=0.2,
                               usual_depth_ratio=4.0, unusual_frames=10),
    OrdinarySettings: dict(look_every_s=0.2, most_change=2.0, least_change=0.4, brightness_levels=2.0, sharpness_share=0.08,
                           interval_share=1.7),
    SequenceSettings: dict(black_level=20, one_colour_levels=3, odd_share=0.03, noise_share=0.5, same_levels=2, same_share=0.9995,
                           frozen_s=0.25, frozen_frames=8, torn_share=0.08, moving_share=0.9),
    SharpnessSettings: dict(blurred_below=0.75, sharp_above=0.82, smoke_contrast=0.75, smoke_saturation=0.8, smoke_haze=15.0,
                            clear_above=0.87, recent_s=1.5, recent_frames=5, clear_frames=300),
    ClockSettings: dict(longest_step_s=10.0, arrival_agrees_s=1.0, late_frames=4, gap_intervals=4.0),
    StripSettings: dict(band=0.08, every=4, first_after=10, remembered=40, edge_levels=10.0, edge_steadiness=2.5, edge_share=0.15,
                        whole_share=0.6, text_levels=25.0, text_steadiness=5.0, text_length=0.02),
}  # fmt: skip


@pytest.mark.parametrize("kind", DEFAULTS, ids=lambda kind: kind.__name__)
def test_defaults_are_the_published_ones(kind):
    assert asdict(kind()) == asdict(kind()) | DEFAULTS[kind]
