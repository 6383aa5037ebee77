"""Ranges of options that several applications take, at both of their borders."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gsplat_core.deformation.kinds import PARAMETER_BYTES
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.config import ReconstructorConfig
from operators.applications import limits
from operators.settings import check_option
from operators.sources.source import SourceDescription


def camera(width_px, height_px):
    return Camera.from_focal(30.0, width_px, height_px)


POSSIBLE = [
    (check_option, ("seed", 0)),
    (check_option, ("seed", 9223372036854775807)),
    (check_option, ("steps", 1)),
    (check_option, ("steps", 100_000_000)),
    (check_option, ("max_frames", None)),
    (check_option, ("max_frames", 1)),
    (check_option, ("max_frames", 1_000_000_000)),
    (check_option, ("scale", 1e-9)),
    (check_option, ("scale", 64.0)),
    (limits.check_picture, (camera(8192, 8192), 1.0)),
    (limits.check_picture, (camera(32768, 2048), 1.0)),
    (limits.check_picture, (camera(2048, 32768), 1.0)),
    (limits.check_width, (32768,)),
]
IMPOSSIBLE = [
    (check_option, ("seed", -1), "seed is -1; it must be from 0 to 9223372036854775807"),
    (check_option, ("seed", 9223372036854775808), "seed is 9223372036854775808"),
    (check_option, ("steps", 0), "steps is 0; it must be from 1 to 100000000"),
    (check_option, ("steps", 100_000_001), "steps is 100000001"),
    (check_option, ("max_frames", 0), "max_frames is 0; it must be from 1 to 1000000000"),
    (check_option, ("max_frames", 1_000_000_001), "max_frames is 1000000001"),
    (check_option, ("scale", 0.0), "scale is 0.0; it must be above 0"),
    (check_option, ("scale", math.inf), "scale is inf; it must be above 0"),
    (check_option, ("scale", math.nan), "scale is nan; it must be above 0"),
    (check_option, ("scale", 64.01), "scale is 64.01; it must be above 0 and at most 64"),
    (
        limits.check_picture,
        (camera(8193, 8192), 2.0),
        "at scale 2 a picture has 8193x8192 px; at most 64 million and 32768",
    ),
    (limits.check_picture, (camera(32769, 1), 2.0), "32769x1 px"),
    (limits.check_picture, (camera(1, 32769), 2.0), "1x32769 px"),
    (limits.check_width, (32769,), "32769 px wide; at most 32768"),
]


@pytest.mark.parametrize(("check", "given"), POSSIBLE)
def test_limit_checks_accept_boundary_values(check, given):
    check(*given)


@pytest.mark.parametrize(("check", "given", "said"), IMPOSSIBLE)
def test_limit_checks_refuse_values_beyond_boundary(check, given, said):
    with pytest.raises(InvalidSetting, match=said):
        check(*given)


@pytest.mark.parametrize(
    ("window_s", "fps", "frames"),
    [((0.0, 0.0), 25, 1), ((1.0, 2.0), 25, 26), ((0.0, 0.1), 30, 4), ((0.0, 0.999), 1, 1), ((0.0, 0.5), 1000, 501)],
)
def test_frames_to_render_includes_both_ends_of_window(window_s, fps, frames):
    assert limits.frames_to_render(window_s, fps) == frames


@pytest.mark.parametrize("fps", [0, -1, 1000.5, math.inf, math.nan])
def test_frames_to_render_refuses_fps_out_of_range(fps):
    with pytest.raises(InvalidSetting, match=r"it must be at least 0\.001 and at most 1000"):
        limits.frames_to_render((0.0, 1.0), fps)


def test_frames_to_render_refuses_more_than_a_million_frames():
    assert limits.frames_to_render((5.0, 1004.999), 1000) == 1_000_000
    with pytest.raises(InvalidSetting, match=r"from 5 to 1005 s is 1e\+06 frames at fps 1000; at most 1000000"):
        limits.frames_to_render((5.0, 1005.0), 1000)


def test_replay_bytes_sums_frames_gaussians_and_field():
    """Frames, Gaussians and the field are summed, limited to the window except offline."""
    size = {"width_px": 640, "height_px": 512}
    config = ReconstructorConfig(gaussians=10_000, max_gaussians=30_000, window_frames=60, motion_spacing_s=0.1)

    def needed(frames, config=config, *, offline=False, **changed):
        source = SourceDescription("x", fps=25.0, frame_count=frames, camera=None, **{**size, **changed})
        return limits.replay_bytes(source, config, offline=offline)

    pixels = 640 * 512
    per_second = needed(1060) - needed(1035)
    assert per_second > 0, "the field grows with the duration"
    assert needed(60) - needed(35) == per_second + 25 * 26 * pixels
    assert needed(None) == needed(60)
    assert needed(60, width_px=1280) - needed(60) == (200 + 26 * 60) * pixels
    more = replace(config, gaussians=20_000)
    assert needed(60, more) > needed(60) + 10_000 * PARAMETER_BYTES
    assert needed(60, replace(config, max_gaussians=40_000)) == needed(60)
    assert needed(60, replace(more, gaussians=30_000)) + 40 * 26 * pixels + 40 / 25 * 3 * per_second == pytest.approx(
        needed(100, offline=True), rel=1e-3
    )


def test_render_bytes_counts_pixels_and_gaussians():
    assert limits.render_bytes(640, 512, 1000) == 16 * 2**20 + 640 * 512 * 60 + 12_000
