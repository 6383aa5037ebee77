"""Depth by parallax is used if two maps agree on the relief, and rejected if moving tissue looks like relief."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.depth.maps import MOST_DISAGREEMENT, UNCONFIRMED, ReducedDepth, agree, disagreement
from gsplat_core.depth.multiview import ParallaxDepth, _confirmed
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from tests.gsplat_core.geometry.test_key_frames import answers, stream

WIDTH, HEIGHT, FOCAL = 120, 90, 100.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)


def moved_by(x: float, y: float, z: float) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -x, -y, -z
    return CAMERA.with_pose(pose)


def relief(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """z of the tissue at (x, y) mm."""
    return 60 + 6 * np.sin(x / 9) + 5 * np.cos(y / 8)


def true_depth(camera: Camera) -> NDArray[np.float32]:
    """z of `relief` before a camera that looks straight ahead, by fixed-point iteration of each ray."""
    centre = camera.position
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    slope_x, slope_y = (column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL
    z = np.full((HEIGHT, WIDTH), 60.0)
    for _ in range(200):
        z = 0.5 * z + 0.5 * (relief(centre[0] + z * slope_x, centre[1] + z * slope_y) - centre[2])
    return z.astype(np.float32)


def reduced_depth(camera: Camera, depth: NDArray[np.float32] | None = None) -> ReducedDepth:
    return ReducedDepth.of(true_depth(camera) if depth is None else depth, None, camera)


def test_true_depth_maps_agree_from_any_position() -> None:
    for place in ((0.0, 0.0, 0.0), (5.0, -3.0, 4.0), (-8.0, 6.0, -5.0)):
        assert disagreement(reduced_depth(CAMERA), reduced_depth(moved_by(*place))) < 0.06


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_depth_maps_at_other_distances_disagree(factor: float) -> None:
    other = moved_by(4.0, 0.0, 0.0)
    assert not agree(reduced_depth(CAMERA), reduced_depth(other, factor * true_depth(other)))


def test_wrong_relief_disagrees() -> None:
    other = moved_by(4.0, 2.0, 0.0)
    assert not agree(reduced_depth(CAMERA), reduced_depth(other, np.flip(true_depth(other), axis=1).copy()))
    flat = np.full((HEIGHT, WIDTH), 60, np.float32)
    assert disagreement(reduced_depth(CAMERA), reduced_depth(other, flat)) == np.inf


def test_disagreement_by_noise_is_relative_to_relief() -> None:
    other, random = moved_by(4.0, 0.0, 0.0), np.random.default_rng(2)
    noise = lambda share: np.exp(share * random.standard_normal((HEIGHT, WIDTH))).astype(np.float32)
    found = [
        disagreement(reduced_depth(CAMERA), reduced_depth(other, true_depth(other) * noise(share)))
        for share in (0.005, 0.02, 0.08)
    ]
    assert found[0] < MOST_DISAGREEMENT < found[2] and found == sorted(found)


def test_disagreement_is_infinite_without_shared_tissue() -> None:
    assert disagreement(reduced_depth(CAMERA), reduced_depth(moved_by(200.0, 0.0, 0.0))) == np.inf
    nothing = ReducedDepth.of(np.zeros((HEIGHT, WIDTH), np.float32), None, CAMERA)
    assert disagreement(nothing, reduced_depth(CAMERA)) == disagreement(reduced_depth(CAMERA), nothing) == np.inf
    unsure = ReducedDepth.of(true_depth(CAMERA), np.full((HEIGHT, WIDTH), 0.2, np.float32), CAMERA)
    assert disagreement(unsure, reduced_depth(CAMERA)) == np.inf


def test_stream_returns_depth_after_second_map_confirms_first() -> None:
    found = answers(ParallaxDepth(), stream(20))
    assert [each.doubt for each in found if each is not None] == [None, None]


def test_stream_depth_is_not_confirmed_by_old_map() -> None:
    estimator, frames = ParallaxDepth(), stream(20)
    late = [frame.with_fields(pts_ns=frame.pts_ns + 10_000_000_000) for frame in frames[8:]]
    found = answers(estimator, frames[:5]) + answers(estimator, late)
    assert all(each is None for each in found[:10])


@pytest.fixture(scope="module")
def breathing():
    """Tissue that breathes before a moving scope: for a while it looks as if it stood still at another distance."""
    return render_recording(RenderSettings(18, 160, 128, seed=0, camera="moving"))


def test_stream_of_breathing_tissue_gets_no_parallax_depth(breathing) -> None:
    estimator, found = ParallaxDepth(), []
    for frame in breathing:
        bare = frame.with_fields(depth=None, depth_origin=None)
        found.append(estimator.estimate(bare, breathing.camera_at(frame.seq)))
    assert all(each is None or each.doubt is not None for each in found)
    assert UNCONFIRMED in {each.doubt for each in found if each is not None}


@pytest.mark.parametrize(("factors", "kept"), [((1.0, 1.3, 1.0, 1.0, 1.0), 5), ((1.0, 1.3, 1.7, 1.0, 1.0), 0)])
def test_offline_keeps_all_depth_if_most_maps_are_confirmed(factors: tuple[float, ...], kept: int) -> None:
    """Frames that keep depth next to frames that lose it would start at different distances."""
    cameras = [moved_by(2.0 * number, 0.0, 0.0) for number in range(5)]
    frames = [
        Frame(
            number,
            number,
            np.zeros((HEIGHT, WIDTH, 3), np.uint8),
            depth=factor * true_depth(camera),
            depth_origin=DEPTH_ORIGINS["parallax"],
        )
        for number, (camera, factor) in enumerate(zip(cameras, factors, strict=True))
    ]
    given = _confirmed(frames, Counter(), cameras)
    assert sum(frame.depth is not None for frame in given.frames) == kept
    assert given.doubts.get(UNCONFIRMED, 0) == 5 - kept and given.at_rest


@pytest.mark.parametrize("factor", [0.9, 1.05, 1.5])
def test_disagreement_is_log_of_scale_error_over_spread_of_relief(factor: float) -> None:
    depth = true_depth(CAMERA).astype(np.float64)
    spread = np.median(np.abs(np.log(depth) - np.median(np.log(depth))))
    found = disagreement(reduced_depth(CAMERA), reduced_depth(CAMERA, (factor * depth).astype(np.float32)))
    assert found == pytest.approx(abs(np.log(factor)) / spread, rel=0.03)


@pytest.mark.parametrize(("rows", "is_compared"), [(6, False), (14, True)])
def test_depth_maps_must_share_a_tenth_of_the_picture(rows: int, is_compared: bool) -> None:
    depth = true_depth(CAMERA)
    depth[rows:] = 0
    assert np.isfinite(disagreement(reduced_depth(CAMERA), reduced_depth(CAMERA, depth))) == is_compared
    assert np.isfinite(disagreement(reduced_depth(CAMERA, depth), reduced_depth(CAMERA))) == is_compared


@pytest.mark.parametrize(("size", "compared"), [((640, 480), (120, 160)), ((100, 80), (80, 100))])
def test_large_depth_maps_are_compared_at_160_pixels(size: tuple[int, int], compared: tuple[int, int]) -> None:
    camera = Camera.from_focal(100.0, *size)
    depth = np.full(size[::-1], 50, np.float32)
    depth[:, : size[0] // 2] = 0
    confidence = np.full(size[::-1], 0.9, np.float32)
    confidence[: size[1] // 2] = 0.1
    found = ReducedDepth.of(depth, confidence, camera)
    assert found.inverse.shape == found.believed.shape == compared
    columns, rows = np.arange(compared[1]) >= compared[1] // 2, np.arange(compared[0]) >= compared[0] // 2
    np.testing.assert_allclose(found.inverse, np.tile(columns / 50, (compared[0], 1)))
    np.testing.assert_array_equal(found.believed, columns[None] & rows[:, None])
