"""Depth of rendered tissue that breathes and is pulled before a moving scope, against its true depth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from gsplat_core.experimental import breathing_depth
from gsplat_core.experimental.breathing_depth import OTHERWISE, TOO_FEW, TOO_SHORT, MovingTissue
from gsplat_core.io.recordings.synthetic.rendered import RenderedRecording, RenderSettings, render_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, DEPTH_ORIGINS, Frame

FPS = 10.0


@cache
def recording() -> RenderedRecording:
    return render_recording(RenderSettings(56, 192, 144, fps=FPS, seed=1, camera="moving"))


def given(frames: slice = slice(None)) -> tuple[list[Frame], list[Camera]]:
    """Return the chosen frames without depth, and their cameras."""
    whole = recording()
    chosen = list(whole)[frames]
    return [each.with_fields(depth=None, depth_origin=None) for each in chosen], [
        whole.camera_at(each.seq) for each in chosen
    ]


@pytest.mark.slow
def test_moving_tissue_depth_of_every_frame() -> None:
    frames, cameras = given()
    found = MovingTissue(frames, cameras)
    assert found.doubts == ()
    (frequencies,) = found.frequencies_hz
    np.testing.assert_allclose(frequencies, [1 / 3.4, 1 / 0.9], atol=0.02)
    errors, shares = [], []
    for number in range(3, len(frames), 7):
        depth, true = found.depth_of(number), list(recording())[number].depth
        assert depth.origin is DEPTH_ORIGINS["parallax"]
        assert depth.doubt is None
        tissue = frames[number].mask
        assert tissue is not None
        assert not depth.confidence[tissue == 0].any()
        believed = depth.confidence >= BELIEVED
        shares.append(believed.sum() / tissue.sum())
        errors.append(np.median(np.abs(depth.depth / true - 1)[believed]))
    assert np.mean(errors) < 0.02
    assert np.mean(shares) > 0.6


@pytest.mark.slow
def test_moving_tissue_interpolates_depth_of_skipped_frame(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(breathing_depth, "RATE_HZ", FPS / 2)
    frames, cameras = given()
    found = MovingTissue(frames, cameras)
    before, here, after = (found.depth_of(number).depth.astype(np.float64) for number in (20, 21, 22))
    assert np.median(np.abs(here / (0.5 * before + 0.5 * after) - 1)) < 0.01


@pytest.mark.slow
def test_moving_tissue_doubts_too_short_recording() -> None:
    found = MovingTissue(*given(slice(0, 14)))
    assert found.doubts == (TOO_SHORT,)
    depth = found.depth_of(4)
    assert depth.doubt == TOO_SHORT
    assert not depth.confidence.any()


@pytest.mark.slow
def test_moving_tissue_doubts_wrong_poses() -> None:
    frames, cameras = given(slice(0, 40))
    poses = np.random.default_rng(0).permutation(len(cameras))
    found = MovingTissue(frames, [cameras[number] for number in poses])
    assert set(found.doubts) <= {OTHERWISE, TOO_SHORT}
    assert found.doubts


@pytest.mark.slow
def test_moving_tissue_doubts_images_without_texture() -> None:
    frames, cameras = given(slice(0, 16))
    grey = [frame.with_fields(image=np.full_like(frame.image, 120)) for frame in frames]
    found = MovingTissue(grey, cameras)
    assert found.doubts
    assert set(found.doubts) <= {OTHERWISE, TOO_SHORT, TOO_FEW}
