"""A key frame that shows an earlier place again: the drift is corrected, and only its points are tracked."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsplat_core.geometry.tracks import SmallPictures
from gsplat_core.poses.live_odometry import CORRECTED_PX, MOST_LEFT, LiveOdometry, Recognised
from gsplat_core.poses.se3 import inverse
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

CAMERA = Camera(np.array([[200.0, 0, 160], [0, 200, 128], [0, 0, 1]]), 320, 256)
PICTURE = SmallPictures(CAMERA).of(Frame(0, 0, np.full((256, 320, 3), 90, np.uint8)))
NUMBERS = np.arange(40)
TURN = torch.tensor([[0.8, 0, 0.6, 4], [0, 1, 0, -2], [-0.6, 0, 0.8, 9], [0, 0, 0, 1]], dtype=torch.float64)


class Map:
    """Map of known points, which the present pose shows at twice the right distance."""

    def __init__(self, points: torch.Tensor) -> None:
        self._points, self.corrections = points, []

    def points(self, numbers: np.ndarray) -> torch.Tensor:
        return self._points[numbers]

    def depth_around(self, pose: torch.Tensor, rays: Any, numbers: np.ndarray, pixels: np.ndarray) -> torch.Tensor:
        right = self._points @ TURN[2, :3] + TURN[2, 3]
        return 2 * right

    def brought_back(self, key: Any, motion: torch.Tensor, scale: float) -> None:
        self.corrections.append((key, motion, scale))


class Tracks:
    def __init__(self) -> None:
        self.numbers, self.pixels, self.adopted, self.begun = NUMBERS, np.zeros((40, 2), np.float32), [], 0

    def adopt(self, numbers: np.ndarray, pixels: np.ndarray) -> None:
        self.adopted.append((numbers, pixels))

    def begin(self, picture: Any) -> None:
        self.begun += 1


@pytest.fixture
def odometry(monkeypatch: pytest.MonkeyPatch) -> LiveOdometry:
    local = np.random.default_rng(0).uniform([-20, -15, 50], [20, 15, 70], (40, 3))
    odometry = LiveOdometry(CAMERA)
    points = (torch.from_numpy(local) - TURN[:3, 3]) @ TURN[:3, :3]  # seen at `local` from the pose TURN
    odometry.map, odometry._tracks = Map(points), Tracks()
    pixels = PICTURE.pixels(local).astype(np.float32)
    key = SimpleNamespace(numbers=NUMBERS)
    found = Recognised(key, odometry.map, TURN.numpy(), NUMBERS, pixels)
    monkeypatch.setattr(odometry, "_seen_by_pose", lambda picture: found)
    monkeypatch.setattr(odometry, "found", found, raising=False)
    return odometry


def turned(angle: float) -> torch.Tensor:
    """Return the right pose, turned about the camera's x axis by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], dtype=torch.float64) @ TURN


@pytest.mark.parametrize(("off_px", "is_corrected"), [(0.8, False), (1.25, True)])
def test_close_loop_corrects_drift_beyond_threshold(odometry: LiveOdometry, off_px: float, is_corrected: bool) -> None:
    """A turn by one pixel at the focal length moves points by about one pixel."""
    odometry._pose = before = turned(off_px * CORRECTED_PX / 200)
    odometry._close_loop(PICTURE)
    found = odometry.found
    (adopted,) = odometry._tracks.adopted
    assert adopted == (found.numbers, found.pixels) and odometry.returned == 1 and odometry._tracks.begun == 0
    if not is_corrected:
        assert odometry.map.corrections == [] and odometry._pose is before
        return
    ((key, motion, scale),) = odometry.map.corrections
    assert key is found.key and scale == pytest.approx(0.5) and torch.equal(odometry._pose, TURN)
    half = before.clone()
    half[:3, 3] /= 2
    torch.testing.assert_close(motion, inverse(TURN) @ half)


def test_close_loop_without_recognised_place_changes_nothing(
    odometry: LiveOdometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def find(picture: Any, candidates: Any, most: int) -> None:
        asked.append([key for key, _ in candidates])

    odometry._left = [SimpleNamespace(keys=["left"])]
    odometry.map.earlier = lambda position, most: ["near"]
    monkeypatch.setattr(odometry, "_seen_by_pose", lambda picture: None)
    monkeypatch.setattr(odometry._recognition, "find", find)
    odometry._close_loop(PICTURE)
    assert asked == [["near", "left"]]
    assert odometry.returned == 0 and odometry._tracks.adopted == [] and odometry.map.corrections == []


@pytest.mark.parametrize("close", [True, False])
def test_relocalise_continues_left_map_and_keeps_present_map(
    odometry: LiveOdometry, monkeypatch: pytest.MonkeyPatch, close: bool
) -> None:
    found, present = odometry.found, odometry.map
    others = [Map(present._points) for _ in range(MOST_LEFT)]
    odometry._left = others
    for other in others:
        other.keys = ["old", "new"]
    present.keys = ["first", "last"]
    asked = []

    def find(picture: Any, candidates: Any, most: int) -> Recognised:
        asked.extend(key for key, _ in candidates)
        return again

    again = Recognised(found.key, others[0], found.pose, found.numbers, found.pixels)
    monkeypatch.setattr(odometry, "_seen_by_pose", lambda picture: again)
    monkeypatch.setattr(odometry._recognition, "find", find)
    odometry._waiting = 3
    if close:
        odometry._close_loop(PICTURE)
    else:
        assert odometry._relocalise(PICTURE)
        assert asked[:4] == ["last", "first", "new", "old"], "newest key frames of the present map first"
    assert odometry.map is others[0] and odometry.returned == 1
    assert odometry._left[0] is present and len(odometry._left) == MOST_LEFT and others[0] not in odometry._left
    assert odometry._tracks.begun == 1 and len(odometry._tracks.adopted) == 1
    assert torch.equal(odometry._pose, TURN) and odometry._waiting == 0
    assert present.corrections == []


def test_relocalise_without_recognised_place_stays_lost(
    odometry: LiveOdometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    odometry.map.keys = []
    monkeypatch.setattr(odometry._recognition, "find", lambda *_: None)
    assert not odometry._relocalise(PICTURE)
    assert odometry.returned == 0 and odometry._tracks.begun == 0
