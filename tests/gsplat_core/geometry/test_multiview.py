"""Depth from pictures of a known surface, and what must not be believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.depth.maps import DepthMap
from gsplat_core.depth.multiview import (
    MOST_VIEWS,
    Parallax,
    chosen_views,
    depth_of_view,
    explained_by_poses,
    view_of,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, DEPTH_ORIGINS, Frame
from tests.gsplat_core.geometry.moving_scope import (
    FIRST,
    HEIGHT,
    SIDEWAYS,
    WIDTH,
    camera_at,
    depth_of_surface,
    video,
)


def found_in(frames: Sequence[Frame], cameras: Sequence[Camera]) -> DepthMap:
    """The first frame's depth from the others."""
    views = [view_of(frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    return depth_of_view(views[0], views[1:], (HEIGHT, WIDTH))


def errors(found: DepthMap) -> NDArray[np.float64]:
    """Relative errors where the depth is believed; near the border the pictures show a reflection of the surface."""
    assert found.doubt is None
    believed = np.zeros((HEIGHT, WIDTH), bool)
    believed[12:-12, 12:-12] = found.confidence[12:-12, 12:-12] >= BELIEVED
    return np.abs(found.depth / depth_of_surface() - 1)[believed].astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("step", [SIDEWAYS, (0.0, 0.02, 0.0), (0.015, 0.01, 0.01)])
def test_depth_of_slanted_surface_is_accurate(step: tuple[float, float, float]) -> None:
    found = found_in(*video(8, step))
    assert found.depth.shape == found.confidence.shape == (HEIGHT, WIDTH)
    assert found.origin is DEPTH_ORIGINS["parallax"]
    assert not found.metric
    wrong = errors(found)
    assert wrong.size > 0.5 * HEIGHT * WIDTH
    assert np.median(wrong) < 0.015
    assert np.percentile(wrong, 95) < 0.05


def test_depth_has_unit_of_poses() -> None:
    frames, cameras = video(8, SIDEWAYS)
    larger = [camera_at(tuple(1000 * camera.position)) for camera in cameras]  # type: ignore[arg-type]
    np.testing.assert_allclose(found_in(frames, larger).depth, 1000 * found_in(frames, cameras).depth, rtol=1e-3)


def test_same_frames_give_same_bytes() -> None:
    first, again = (found_in(*video(6, SIDEWAYS)) for _ in range(2))
    assert first.depth.tobytes() == again.depth.tobytes()
    assert first.confidence.tobytes() == again.confidence.tobytes()


def test_tool_pixels_are_not_compared() -> None:
    frames, cameras = video(8, SIDEWAYS)
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[40:80, 60:110] = 0
    pattern = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    masked = []
    for frame in frames:  # a tool that stays where it is in the picture
        image = frame.image.copy()
        image[40:80, 60:110] = pattern
        masked.append(frame.with_fields(image=image, mask=mask))
    found = found_in(masked, cameras)
    assert np.median(errors(found)) < 0.02
    assert found.confidence[42:78, 62:108].max() < BELIEVED


def test_moving_object_gets_no_confident_depth() -> None:
    frames, cameras = video(8, SIDEWAYS)
    pattern = np.random.default_rng(1).integers(0, 255, (40, 40, 3), dtype=np.uint8)
    moved = []
    for number, frame in enumerate(frames):  # a part that goes upwards while the scope goes sideways
        image = frame.image.copy()
        image[70 - 4 * number : 110 - 4 * number, 60:100] = pattern
        moved.append(frame.with_fields(image=image))
    found = found_in(moved, cameras)
    assert (found.confidence[75:105, 65:95] >= BELIEVED).mean() < 0.2
    assert np.median(errors(found)) < 0.02


def test_moving_tissue_gets_no_confident_depth() -> None:
    found = found_in(*video(8, (0.0, 0.02, 0.0), tissue_px=0.3))
    assert found.doubt is None
    assert found.confidence.max() < BELIEVED
    # Still something to start from.
    assert np.median(found.depth) == pytest.approx(np.median(depth_of_surface()), rel=0.2)


def test_tissue_without_texture_gets_no_confident_depth() -> None:
    frames, cameras = video(8, SIDEWAYS)
    random = np.random.default_rng(2)
    bare = []
    for frame in frames:
        image = frame.image.copy()
        image[:, 80:] = 128 + random.integers(-1, 2, image[:, 80:].shape)
        bare.append(frame.with_fields(image=image.astype(np.uint8)))
    found = found_in(bare, cameras)
    assert found.doubt is None
    assert (found.confidence[:, 90:] >= BELIEVED).mean() < 0.05


def test_moving_poses_of_still_pictures_are_rejected() -> None:
    still, _ = video(8, (0.0, 0.0, 0.0))
    found = found_in(still, [camera_at((0.02 * number, 0.0, 0.0)) for number in range(8)])
    assert found.doubt is not None
    assert "hardly" in found.doubt
    assert not found.confidence.any()


def test_scope_without_translation_gives_no_depth() -> None:
    frames, _ = video(6, SIDEWAYS)
    turned = np.eye(4)
    turned[:2, :2] = [[0.999, -0.0447], [0.0447, 0.999]]
    for other in (FIRST, FIRST.with_pose(turned)):
        found = found_in(frames, [FIRST] + [other] * 5)
        assert found.doubt == "the scope does not move"


def test_view_with_outlier_pose_is_left_out() -> None:
    frames, cameras = video(8, SIDEWAYS)
    cameras[4] = camera_at((0.02 * 4, 0.1, -0.1))
    assert np.median(errors(found_in(frames, cameras))) < 0.02


@pytest.mark.parametrize("wrong", ["shuffled", "inverted", "across", "noise"])
def test_wrong_poses_give_no_depth(wrong: str) -> None:
    frames, cameras = video(8, (0.015, 0.01, 0.01))
    random = np.random.default_rng(5)
    if wrong == "shuffled":
        cameras = [cameras[0], *(cameras[number] for number in (6, 2, 7, 1, 4, 3, 5))]
    if wrong == "inverted":
        cameras = [FIRST.with_pose(np.linalg.inv(each.world_to_camera)) for each in cameras]
    if wrong == "across":
        cameras = [camera_at((-each.position[1], each.position[0], 0.0)) for each in cameras]
    if wrong == "noise":
        frames = [
            frame.with_fields(image=random.integers(0, 255, frame.image.shape, dtype=np.uint8)) for frame in frames
        ]
    found = found_in(frames, cameras)
    assert found.doubt is not None
    assert not found.confidence.any()


def test_pictures_without_corners_give_no_depth() -> None:
    frames, cameras = video(4, SIDEWAYS)
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    for blind in ({"mask": nothing}, {"loss_mask": nothing}, {"image": np.full((HEIGHT, WIDTH, 3), 90, np.uint8)}):
        found = found_in([frame.with_fields(**blind) for frame in frames], cameras)
        assert found.doubt == "too few points of the tissue can be tracked"


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize(("width_px", "are_tracked"), [(8, False), (14, True)])
def test_corners_are_tracked_four_pixels_inside_tissue_edges(width_px: int, are_tracked: bool, upright: bool) -> None:
    frames, cameras = video(3, SIDEWAYS)
    tissue = np.zeros((HEIGHT, WIDTH), np.uint8)
    across = tissue.T if upright else tissue
    for start in range(6, len(across) - 20, 20):
        across[start : start + width_px] = 255
    views = [view_of(frame.with_fields(mask=tissue), camera) for frame, camera in zip(frames, cameras, strict=True)]
    assert isinstance(explained_by_poses(views[0], views[1:]), Parallax) is are_tracked


def test_chosen_views_are_spread_over_baselines() -> None:
    frames, cameras = video(40, (0.01, 0.0, 0.0))
    views = [view_of(frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    chosen = chosen_views(views[0], views)
    places = [float(view.camera.position[0]) for view in chosen]
    assert len(chosen) == MOST_VIEWS
    assert places == sorted(places)
    assert places[0] >= 0.039
    assert places[-1] == pytest.approx(0.39)
