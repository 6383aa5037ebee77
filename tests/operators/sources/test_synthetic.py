"""The synthetic scene as a camera without an end."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from operators.sources import recording
from operators.sources.address import SourceOptions
from operators.sources.registry import open_source

SOON_S = 300.0
SMALL = "width=48&height=40&frames=5"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_synthetic_source_plays_forwards_and_backwards():
    source = open_source(f"synthetic:?{SMALL}&moving=1&fps=20", SourceOptions(speed=float("inf")))
    about = source.description
    assert (about.width_px, about.height_px, about.fps, about.frame_count) == (48, 40, 20, None)
    assert about.fields == {"mask", "depth", "pose"}
    source.open()
    frames = [source.read(SOON_S) for _ in range(18)]
    source.close()
    order = [0, 1, 2, 3, 4, 3, 2, 1, 0, 1, 2, 3, 4, 3, 2, 1, 0, 1]
    rendered = list(render_recording(RenderSettings(frames=5, width_px=48, height_px=40, fps=20, camera="moving")))
    for k, (frame, index) in enumerate(zip(frames, order, strict=True)):
        assert (frame.seq, frame.pts_ns) == (k, k * 50_000_000)
        for name in ("image", "mask", "depth", "pose"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(rendered[index], name))


def test_render_recording_equals_synthesize_output(tmp_path):
    folder = synthesize(tmp_path / "written", frames=2, width_px=48, height_px=40, camera="moving", seed=3)
    written = list(open_recording(folder))
    kept = render_recording(RenderSettings(frames=2, width_px=48, height_px=40, camera="moving", seed=3, stereo=True))
    for a, b in zip(kept, written, strict=True):
        for name in ("image", "right_image", "mask"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_allclose(a.depth, b.depth, atol=0.006)
        np.testing.assert_allclose(a.pose, b.pose, atol=1e-12)
    assert kept.fields == {"mask", "depth", "pose", "right_image"} and kept.stereo_baseline_mm > 0
    assert not np.array_equal(kept.camera_at(1).world_to_camera, kept.camera.world_to_camera)


def test_synthetic_address_applies_scale_seed_and_eyes():
    source = open_source("synthetic:?width=96&height=80&frames=1&eyes=2", SourceOptions(scale=0.5, max_frames=3))
    assert (source.description.width_px, source.description.frame_count) == (48, 3)
    assert "right_image" in source.description.fields
    one, other = (open_source(f"synthetic://?{SMALL}&seed={seed}").recording for seed in (0, 1))
    assert one.digest != other.digest and (next(iter(one)).image != next(iter(other)).image).any()


def test_synthetic_frame_count_is_limited_by_memory(monkeypatch):
    monkeypatch.setattr(recording, "MOST_BYTES", 3 * 48 * 40 * 8)
    assert open_source(f"synthetic:?{SMALL}").recording.frame_count == 3


@pytest.mark.parametrize(
    ("query", "what"),
    [
        ("width=1", "width is '1'"),
        ("width=1e3", "width is '1e3'"),
        ("height=99999", "height is '99999'"),
        ("fps=0", "fps is '0'"),
        ("seed=-1", "seed is '-1'"),
        ("frames=0", "frames is '0'"),
        ("eyes=3", "eyes is '3'"),
        ("moving=maybe", "moving is 'maybe'"),
        ("colour=red", "unknown option 'colour'"),
    ],
)
def test_synthetic_address_error_names_invalid_option(query, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(f"synthetic:?{query}")
