"""A scope that comes back recognises what it saw, and its drift is corrected by that."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.geometry.tracks import SmallPicture, SmallPictures, StreamTracks
from gsplat_core.io.recordings.synthetic.rendered import RenderedRecording, RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug
from gsplat_core.poses import live_odometry
from gsplat_core.poses.live_odometry import KeyFrame, LiveOdometry, LocalMap, PlaceRecognition, seen_again
from gsplat_core.poses.se3 import exp
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, depth_of_surface, seen_from

AWAY_MM, COUNT = 110.0, 81


@pytest.fixture(scope="module")
def returning_scope() -> RenderedRecording:
    """A scope goes sideways until it sees none of what it saw at first, and back; the tissue stands still."""
    moving, at_rest = Tissue.points, Tug((0.0, 0.0), (0.0, 0.0, 0.0))

    def on_way(scene: SyntheticScene, time_s: float) -> Camera:
        pose = np.eye(4)
        pose[0, 3] = -AWAY_MM / 2 * (1 - np.cos(2 * np.pi * time_s * 10 / (COUNT - 1)))
        return scene.camera.with_pose(pose)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tissue, "points", lambda self, u, v, time_s, tug: moving(self, u, v, 0.0, at_rest))
        patch.setattr(SyntheticScene, "_left_at", on_way)
        return render_recording(RenderSettings(COUNT, 192, 144, fps=10, seed=3, camera="moving"))


def drift(recording: RenderedRecording) -> tuple[float, LiveOdometry]:
    """Return the error of the last position relative to the length of the trajectory."""
    odometry = LiveOdometry(recording.camera, measured=False)
    poses = [odometry.place(frame) for frame in recording]
    places = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    return float(np.linalg.norm(places[-1] - places[0]) / np.ptp(places[:, 0])), odometry


@pytest.mark.slow
def test_place_recognition_halves_drift(returning_scope, monkeypatch):
    with_return, odometry = drift(returning_scope)
    assert odometry.returned >= 3 and odometry.begun == 1
    monkeypatch.setattr(live_odometry, "FOLLOWED_KEYS", 0)
    monkeypatch.setattr(live_odometry, "MATCHED_KEYS", 0)
    without, odometry = drift(returning_scope)
    assert odometry.returned == 0
    assert with_return < 0.5 * without and with_return < 0.02


@pytest.fixture
def kept() -> tuple[KeyFrame, LocalMap]:
    """A key frame of a known surface, and a map of its points."""
    picture, tracks, places = small(), StreamTracks(), LocalMap()
    tracks.begin(picture)
    tracks.take_up()
    column, row = tracks.pixels.round().astype(int).T
    depth = torch.from_numpy(depth_of_surface()[row, column].astype(np.float64))[:, None]
    rays = torch.from_numpy(picture.rays(tracks.pixels))
    places.add_points(tracks.numbers, torch.cat([rays * depth, depth], 1))
    key = KeyFrame(
        torch.eye(4, dtype=torch.float64), tracks.numbers, tracks.pixels, picture, picture.rays(tracks.pixels)
    )
    places.add_key(key)
    return key, places


def small(position: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SmallPicture:
    return SmallPictures(FIRST).of(seen_from(position, depth_of_surface()))


def test_seen_again_corrects_drifted_pose(kept):
    key, places = kept
    drifted = exp(torch.tensor([0.02, 0.01, 0.0, 0.0, 0.0, 0.02])).numpy().astype(np.float64)
    found = seen_again(key, places, small((0.05, 0.0, 0.0)), drifted)
    assert found is not None and found.key is key and len(found.numbers) == len(found.pixels) > 30
    np.testing.assert_allclose(found.pose[:3, 3], [-0.05, 0.0, 0.0], atol=0.01)


def test_seen_again_is_none_for_already_tracked_points(kept):
    key, places = kept
    assert seen_again(key, places, small(), np.eye(4), key.numbers) is None


@pytest.mark.parametrize("position", [(0.05, 0.0, 0.0), (0.1, 0.05, 0.0)])
def test_place_recognition_finds_key_frame_by_features(kept, position):
    found = PlaceRecognition().find(small(position), [kept], 1)
    assert found is not None
    np.testing.assert_allclose(found.pose[:3, 3], [-each for each in position], atol=0.02)


@pytest.mark.parametrize("shown", ["mirrored", "grey", "noise"])
def test_place_recognition_rejects_other_pictures(kept, shown):
    image = seen_from((0.0, 0.0, 0.0), depth_of_surface()).image
    other = {
        "mirrored": np.ascontiguousarray(image[:, ::-1]),
        "grey": np.full_like(image, 90),
        "noise": np.random.default_rng(0).integers(0, 255, image.shape).astype(np.uint8),
    }[shown]
    picture = SmallPictures(FIRST).of(Frame(0, 0, other))
    assert PlaceRecognition().find(picture, [kept], 1) is None
    assert seen_again(*kept, picture, np.eye(4)) is None


def test_place_recognition_tries_key_frames_in_turn(kept):
    recognition, asked = PlaceRecognition(), []
    recognition._pose_by = lambda key, *_: asked.append(key)
    candidates = [(number, None) for number in range(3)]
    for _ in range(2):
        assert recognition.find(small(), candidates, 2) is None
    assert asked == [0, 1, 2, 0] and recognition.find(small(), [], 2) is None


def test_brought_back_moves_later_key_frames_and_keeps_earlier():
    places, picture = LocalMap(), small()
    pixels = np.zeros((1, 2), np.float32)
    for number in range(5):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -number
        places.add_points(np.array([number]), torch.tensor([[float(number), 0.0, 2.0]], dtype=torch.float64))
        places.add_key(KeyFrame(pose, np.array([number]), pixels, picture, picture.rays(pixels)))
    before = [picture.pixels(seen(places, number)) for number in range(5)]
    twist = torch.tensor([0.4, 0.0, 0.0, 0.0, 0.0, 0.08], dtype=torch.float64)
    places.brought_back(places.keys[1], exp(twist), 1.1)
    positions = np.stack([key.position for key in places.keys])
    np.testing.assert_array_equal(positions[:2], [[0, 0, 0], [1, 0, 0]])
    expected = (exp(twist)[:3, :3] @ torch.tensor([4.4, 0, 0], dtype=torch.float64) + exp(twist)[:3, 3]).numpy()
    np.testing.assert_allclose(positions[4], expected, atol=1e-12)
    for number in range(5):
        np.testing.assert_allclose(picture.pixels(seen(places, number)), before[number], atol=1e-3)


def seen(places: LocalMap, number: int) -> np.ndarray:
    """The point that only this key frame sees, in its camera."""
    pose = places.keys[number].pose
    return (places.points(np.array([number])) @ pose[:3, :3].T + pose[:3, 3]).numpy()
