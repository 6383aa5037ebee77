"""The scope's poses frame by frame, against those of a rendered scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.geometry.tracks import SmallPictures, StreamTracks
from gsplat_core.io.recordings.synthetic.rendered import RenderedRecording, RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug
from gsplat_core.poses import live_odometry
from gsplat_core.poses.live_odometry import LiveOdometry, seen_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame, FrameStatus

COUNT = 24


@pytest.fixture(scope="module")
def rigid() -> RenderedRecording:
    """A moving scope before tissue that stands still, seen by both eyes."""
    moving, at_rest = Tissue.points, Tug((0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tissue, "points", lambda self, u, v, time_s, tug: moving(self, u, v, 0.0, at_rest))
        return render_recording(RenderSettings(COUNT, 256, 192, fps=10, seed=3, camera="moving", stereo=True))


def blind(frames) -> list[Frame]:
    """Return the frames with pictures and masks only."""
    return [
        replace(frame, pose=None, depth=None, depth_origin=None, right_image=None, right_camera=None)
        for frame in frames
    ]


def placed(frames, odometry: LiveOdometry) -> np.ndarray:
    return np.stack([odometry.place(frame) for frame in frames])


def errors(poses: np.ndarray, rigid: RenderedRecording, chosen=slice(None)):
    found = evaluate_trajectory(poses[chosen], np.stack([frame.pose for frame in rigid])[chosen])
    assert found is not None
    return found


@pytest.fixture(scope="module")
def found(rigid) -> np.ndarray:
    return placed(blind(rigid), LiveOdometry(rigid.camera))


def test_live_odometry_follows_moving_scope(rigid, found):
    assert errors(found, rigid).similarity_share < 0.02


def test_live_odometry_reports_explained_share(rigid):
    odometry = LiveOdometry(rigid.camera)
    placed(blind(rigid), odometry)
    assert (odometry.frames, odometry.not_placed, odometry.begun) == (COUNT, 0, 1)
    assert odometry.explained > 0.95 and not odometry.is_measured


@pytest.mark.parametrize("threads", [1, 3])
def test_live_odometry_is_deterministic_for_any_thread_count(rigid, found, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        again = placed(blind(rigid)[:15], LiveOdometry(rigid.camera))
    finally:
        torch.set_num_threads(before)
    assert again.tobytes() == found[:15].tobytes()


def test_live_odometry_first_pose_is_camera_pose(rigid, found):
    pose = np.eye(4)
    pose[:3, 3] = 1, -2, 3
    moved = placed(blind(rigid)[:5], LiveOdometry(rigid.camera.with_pose(pose)))
    np.testing.assert_allclose(moved, found[:5] @ pose, atol=1e-12)
    np.testing.assert_array_equal(found[0], np.eye(4))


@pytest.mark.parametrize("kept", ["depth", "right_image"])
def test_live_odometry_has_unit_of_frame_depth(rigid, kept):
    fields = {"depth": ("depth", "depth_origin"), "right_image": ("right_image", "right_camera")}[kept]
    frames = [
        each.with_fields(**{name: getattr(frame, name) for name in fields})
        for each, frame in zip(blind(rigid), rigid, strict=True)
    ]
    odometry = LiveOdometry(rigid.camera)
    measured = errors(placed(frames, odometry), rigid)
    assert odometry.is_measured and measured.scale == pytest.approx(1, abs=0.1) and measured.rigid_share < 0.03
    unmeasured = LiveOdometry(rigid.camera, measured=False)
    placed(frames[:4], unmeasured)
    assert not unmeasured.is_measured


def test_live_odometry_first_points_take_pixel_depth_or_median(rigid):
    first = next(iter(rigid))
    depth = first.depth.copy()
    depth[:, : rigid.camera.width_px // 2] = 0
    odometry = LiveOdometry(rigid.camera)
    odometry.place(blind([first])[0].with_fields(depth=depth, depth_origin=first.depth_origin))
    points = odometry.map.points(odometry.map.keys[0].numbers).numpy()
    column, row = (points[:, :2] / points[:, 2:] @ rigid.camera.K[:2, :2].T + rigid.camera.K[:2, 2]).astype(int).T
    known = depth[row, column] > 0
    assert 20 < known.sum() < len(known) - 20
    np.testing.assert_allclose(points[known, 2], depth[row, column][known], rtol=0.03)
    np.testing.assert_allclose(points[~known, 2], np.median(points[known, 2]), rtol=0.01)


@pytest.mark.parametrize("side_px", [256, 100])
def test_seen_depth_clamps_points_to_picture_edge(rigid, side_px):
    """Positions between pixels are up to a pixel outside at each edge."""
    first = next(iter(rigid))
    picture = SmallPictures(rigid.camera, side_px).of(first)
    height, width = picture.grey.shape
    depth = np.arange(first.depth.size, dtype=np.float32).reshape(first.depth.shape) + 1
    pixels = np.array([[-0.6, -0.6], [width - 0.4, -0.6], [-0.6, height - 0.4], [width - 0.4, height - 0.4]])
    found = seen_depth(first.with_fields(depth=depth, depth_confidence=None), picture, pixels)
    assert np.array_equal(found, depth[[0, 0, -1, -1], [0, -1, 0, -1]])


def test_live_odometry_repeats_pose_for_unusable_frame(rigid):
    frames = blind(rigid)
    frames[8] = frames[8].with_fields(image=np.full_like(frames[8].image, 90))
    frames[12] = frames[12].with_fields(withheld="blur")
    frames[13] = frames[13].with_fields(status=FrameStatus.DAMAGED)
    odometry = LiveOdometry(rigid.camera)
    poses = placed(frames, odometry)
    for index in (8, 12, 13):
        assert np.array_equal(poses[index], poses[index - 1])
    assert (odometry.not_placed, odometry.begun) == (3, 1)
    others = [index for index in range(COUNT) if index not in (8, 12, 13)]
    assert errors(poses, rigid, others).similarity_share < 0.02, "points are found again behind it"


def test_live_odometry_waits_for_first_textured_frame(rigid):
    frames = blind(rigid)
    grey = np.full_like(frames[0].image, 90)
    odometry = LiveOdometry(rigid.camera)
    poses = placed([frame.with_fields(image=grey) for frame in frames[:3]] + frames[3:8], odometry)
    assert np.array_equal(poses[3], np.eye(4)) and not np.array_equal(poses[7], np.eye(4))
    assert (odometry.not_placed, odometry.begun) == (3, 1)


def test_live_odometry_starts_new_map_after_15_frames_without_points(rigid):
    """A new map begins where a frame has points again after more of them."""
    first = blind([next(iter(rigid))])[0]
    grey, other = (first.with_fields(image=each) for each in (np.full_like(first.image, 120), first.image[::-1].copy()))
    for waited, begun in ((14, 1), (15, 2)):
        odometry = LiveOdometry(rigid.camera)
        placed([first, *waited * [grey], other], odometry)
        assert odometry.begun == begun


def test_live_odometry_starts_new_map_for_other_scene(rigid, monkeypatch):
    monkeypatch.setattr(live_odometry, "MOST_NOT_PLACED", 3)
    frames = blind(rigid)
    other = [frame.with_fields(image=np.ascontiguousarray(frame.image[::-1])) for frame in frames[8:20]]
    odometry = LiveOdometry(rigid.camera)
    poses = placed(frames[:8] + other, odometry)
    assert odometry.begun == 2 and 3 <= odometry.not_placed <= 5
    assert not np.array_equal(poses[-1], poses[-2]), "poses go on in the other scene"


def test_live_odometry_relocalises_lost_scope_by_key_frames(rigid, found, monkeypatch):
    frames = blind(rigid)
    grey = [frame.with_fields(image=np.full_like(frame.image, 90)) for frame in frames[:2]]
    odometry = LiveOdometry(rigid.camera)
    before = placed(frames[:16] + grey, odometry)
    assert (odometry.not_placed, odometry.begun, odometry.returned) == (2, 1, 0)
    with monkeypatch.context() as patch:  # it has gone too far to be followed
        patch.setattr(StreamTracks, "follow", lambda self, picture, guess: (self.numbers[:0], self.pixels[:0]))
        first = placed(frames[2:3], odometry)
    poses = np.concatenate([before, first, placed(frames[3:6], odometry)])
    assert (odometry.not_placed, odometry.begun) == (2, 1) and odometry.returned >= 1
    apart = np.linalg.norm(centres(poses[-4:]) - centres(found[2:6]), axis=1)
    assert apart.max() < 0.5 < np.linalg.norm(centres(found[15:16]) - centres(found[2:3]))


def test_live_odometry_resumes_left_map_after_other_scene(rigid, found):
    frames = blind(rigid)
    other = [frame.with_fields(image=np.ascontiguousarray(frame.image[::-1])) for frame in frames[8:14]]
    other[0] = other[0].with_fields(new_scene="cut")
    back = frames[3:8]
    back[0] = back[0].with_fields(new_scene="cut")
    odometry = LiveOdometry(rigid.camera)
    poses = placed(frames[:8] + other + back, odometry)
    assert odometry.begun == 2 and odometry.returned >= 1, "a cut is not waited for"
    assert np.linalg.norm(centres(poses[-4:]) - centres(found[4:8]), axis=1).max() < 0.5


def centres(poses: np.ndarray) -> np.ndarray:
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


@pytest.mark.slow
def test_live_odometry_memory_is_bounded(rigid, monkeypatch):
    monkeypatch.setattr(live_odometry, "MOST_KEY_FRAMES", 5)
    monkeypatch.setattr(live_odometry, "WINDOW", 3)
    odometry = LiveOdometry(rigid.camera)
    there = blind(rigid)
    sizes = []
    for _ in range(2):
        placed(there + there[::-1], odometry)
        sizes.append(len(odometry.map))
    assert len(odometry.map.keys) == 5 and sizes[1] < 1.2 * sizes[0]
    assert odometry.map.keys[0].pose.equal(torch.eye(4, dtype=torch.float64)), "the first one says where the world is"


def test_live_odometry_refuses_fisheye_camera():
    fisheye = Camera(np.array([[100.0, 0, 40], [0, 100, 32], [0, 0, 1]]), 80, 64, model="fisheye")
    with pytest.raises(InvalidInput, match="this one is fisheye: undistort"):
        LiveOdometry(fisheye)


def test_live_odometry_unit_without_depth_is_relative_distance(rigid):
    odometry = LiveOdometry(rigid.camera)
    placed(blind(rigid), odometry)
    first = odometry.map.keys[0]
    assert float(odometry.map.points(first.numbers)[:, 2].median()) == pytest.approx(RELATIVE_DISTANCE, rel=0.02)
