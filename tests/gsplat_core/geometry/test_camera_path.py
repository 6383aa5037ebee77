"""Path of a scope through a recording without poses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.poses import odometry
from gsplat_core.poses.odometry import MOVING_SHARE, CameraPath, MotionTest, Trajectory, camera_path_of, rigid_share
from gsplat_core.poses.se3 import exp
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, SIDEWAYS, depth_of_surface, video
from tests.gsplat_core.geometry.test_tracks import wide_texture


@pytest.fixture(scope="module")
def frames():
    return [frame.with_fields(seq=n, pts_ns=n * 100_000_000) for n, frame in enumerate(video(12, SIDEWAYS)[0])]


def test_rigid_share_is_high_only_for_moving_scope(frames):
    assert rigid_share(frames) > MOVING_SHARE
    still = [frames[0].with_fields(seq=frame.seq, pts_ns=frame.pts_ns) for frame in frames]
    assert rigid_share(still) == 0.0
    # Stripes of tissue that move by different amounts, before a scope at rest.
    columns = np.arange(FIRST.width_px)
    pulled = [
        frame.with_fields(image=frames[0].image[:, (columns - 3 * n * (columns // 40 % 2)) % FIRST.width_px])
        for n, frame in enumerate(frames)
    ]
    assert rigid_share(pulled) < MOVING_SHARE


def test_camera_path_interpolates_poses_between_frames():
    twists = torch.tensor([[0.0] * 6, [0.2, 0.0, 0.1, 0.0, 0.1, 0.0]], dtype=torch.float64)
    ends = exp(twists).numpy()
    path = CameraPath(np.array([1.0, 2.0, 3.0]), np.stack([ends[0], np.eye(4) * 7, ends[1]]), None)
    assert np.array_equal(path.at(0.0), ends[0]) and np.array_equal(path.at(9.0), ends[1])
    assert np.array_equal(path.at(2.0), np.eye(4) * 7)
    np.testing.assert_allclose(path.interpolated(2.0), exp(0.5 * twists[1]).numpy(), atol=1e-12)


def test_camera_path_of_has_unit_of_depth(frames):
    trained = [frame for frame in frames if frame.seq != 5]
    trained[0] = trained[0].with_fields(depth=depth_of_surface())
    path = camera_path_of(trained, FIRST)
    centre = -path.at(0.5)[:3, :3].T @ path.at(0.5)[:3, 3]
    np.testing.assert_allclose(centre, 5 * np.array(SIDEWAYS), atol=0.02)


def test_camera_path_of_refuses_more_than_600_frames(frames):
    with pytest.raises(InvalidInput, match="at most 600 frames, not for 601"):
        camera_path_of([frames[0]] * 601, FIRST)


def test_camera_path_of_ends_with_exception_of_after_frame(frames):
    tracked = []

    def after_frame():
        tracked.append(len(tracked))
        if len(tracked) == 3:
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        camera_path_of(frames, FIRST, after_frame)
    assert tracked == [0, 1, 2]


BLANK = np.zeros((8, 12, 3), np.uint8)


def at_times(times_s, image=BLANK) -> list[Frame]:
    return [Frame(number, round(each * 1e9), image) for number, each in enumerate(times_s)]


@pytest.fixture
def compared(monkeypatch):
    """Replace the comparison of pictures: by the numbers of two frames it returns median motion and rest."""
    pairs, answers = [], {}

    def compare(first, second):
        pairs.append((first.seq, second.seq))
        return answers.get(first.seq, (10.0, 1.0))

    monkeypatch.setattr(odometry, "_compared", compare)
    return pairs, answers


@pytest.mark.parametrize(("rate_hz", "count", "gap"), [(10, 100, 3), (30, 100, 9), (2, 100, 1), (10, 3, 2), (10, 2, 1)])
def test_rigid_share_compares_twelve_pairs_0_3_s_apart(compared, rate_hz, count, gap):
    times_s = [number / rate_hz for number in range(count)]
    assert rigid_share(at_times(times_s)) == pytest.approx(0.99)
    first, second = np.array(compared[0]).T
    assert (second - first).tolist() == [gap] * len(first)
    assert first[0] == 0 and second[-1] == count - 1
    assert len(first) == min(12, count - gap) and (len(first) < 12 or np.ptp(np.diff(first)) <= 1)


def test_rigid_share_is_zero_for_one_frame_or_one_time(compared):
    assert rigid_share(at_times([2.0] * 9)) == rigid_share(at_times([2.0])) == 0.0 and compared[0] == []
    assert rigid_share(at_times([0, 0, 0.3, 0.3, 0.6, 0.6])) > 0 and compared[0][0] == (0, 1)


@pytest.mark.parametrize(("motion_px", "share"), [(1.55, 0.0), (1.65, 0.75)])
def test_rigid_share_requires_motion_of_half_a_percent_of_side(compared, motion_px, share):
    compared[1].update({number: (motion_px, motion_px / 2) for number in range(12)})
    compared[1][0], compared[1][1] = (99.0, 0.0), (0.1, 0.1)
    assert rigid_share(at_times([0.3 * number for number in range(9)])) == pytest.approx(share)
    compared[1].update(dict.fromkeys(range(12)))
    assert rigid_share(at_times([0.3 * number for number in range(9)])) == 0.0, "no point was found again"


def test_motion_test_uses_five_newest_pairs(compared):
    pairs, answers = compared
    answers.update({0: (10.0, 10.0), 3: (10.0, 10.0), 6: (10.0, 5.0), 9: (10.0, 0.0), 12: (10.0, 0.0), 15: (10.0, 1.0)})
    answers[18] = None
    test = MotionTest()
    shares = [test.share(each) for each in at_times([0.11 * number for number in range(22)])]
    assert pairs == [(number, number + 3) for number in range(0, 21, 3)]
    known = {number: share for number, share in enumerate(shares) if share is not None}
    assert known == pytest.approx({9: 0.0, 12: 0.375, 15: 0.75, 18: 0.99})


@pytest.mark.parametrize(("gap_s", "begun"), [(0.95, False), (1.05, True)])
def test_motion_test_resets_after_gap_of_one_second(compared, gap_s, begun):
    times_s = [0.31 * number for number in range(4)]
    test = MotionTest()
    shares = [test.share(each) for each in at_times([*times_s, *(times_s[-1] + gap_s + each for each in times_s)])]
    known = [number for number, share in enumerate(shares) if share is not None]
    assert known == ([3, 7] if begun else [3, 4, 5, 6, 7])


def test_motion_test_resets_at_other_picture_size(compared):
    test = MotionTest()
    first, later = (at_times([start + 0.31 * number for number in range(5)]) for start in (0.0, 1.55))
    shares = [test.share(each) for each in [*first, *(each.with_fields(image=BLANK[:6].copy()) for each in later)]]
    assert [number for number, share in enumerate(shares) if share is not None] == [3, 4, 8, 9]


def moved(by_px: int, side_px: int) -> np.ndarray:
    """Return a picture of a texture that is moved to the right."""
    whole = cv2.resize(wide_texture(0), (2 * side_px, side_px))
    return np.ascontiguousarray(whole[: side_px * 3 // 4, side_px // 2 - by_px :][:, :side_px])


@pytest.mark.parametrize("side_px", [640, 320, 240])
def test_compared_motion_is_in_pixels_at_width_320(side_px):
    first, second = (Frame(number, 0, moved(6 * number, side_px)) for number in range(2))
    pair = odometry._compared(first, second)
    assert pair is not None
    assert pair[0] == pytest.approx(6 * 320 / side_px, abs=0.05) and pair[1] < 0.1


def test_compared_ignores_masked_pixels():
    """Tissue moves by 4 pixels in the left half. The right half stands still, or is a tool."""
    picture, image = moved(0, 320), moved(4, 320)
    image[:, 150:] = picture[:, 150:]
    mask = np.ones(picture.shape[:2], np.uint8)
    mask[:, 130:] = 0
    masked, whole = (odometry._compared(Frame(0, 0, picture, mask=each), Frame(1, 0, image)) for each in (mask, None))
    assert masked is not None and masked[0] == pytest.approx(4, abs=0.05) and masked[1] < 0.1
    assert whole is not None and whole[0] < 2


@pytest.mark.parametrize(("side_px", "found"), [(40, False), (90, True)])
def test_compared_requires_24_points(side_px, found):
    mask = np.zeros((240, 320), np.uint8)
    mask[60 : 60 + side_px, 60 : 60 + side_px] = 1
    pair = odometry._compared(Frame(0, 0, moved(0, 320), mask=mask), Frame(1, 0, moved(2, 320)))
    assert (pair is not None) == found
    assert odometry._compared(Frame(0, 0, moved(0, 320)), Frame(1, 0, np.full((240, 320, 3), 90, np.uint8))) is None


def measured(times: float, count: int = 40, depth_confidence: np.ndarray | None = None) -> Frame:
    """Return a frame whose depth at `count` points of the scene is a multiple of theirs, and unknown elsewhere."""
    depth = np.full((90, 120), np.nan, np.float32)
    depth[30, 30 : 30 + count] = times * np.linspace(1, 2, 60, dtype=np.float32)[:count]
    return Frame(0, 0, np.zeros((90, 120, 3), np.uint8), depth=depth, depth_confidence=depth_confidence)


def unit_of(*frames: Frame) -> float:
    """Return the unit of a trajectory that stands still before 60 points in one row, and others that are not shown."""
    camera = Camera(np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]]), 120, 90)
    z = np.linspace(1, 2, 60)
    shown = np.stack([(np.arange(30, 90) + 0.5 - 60) / 100 * z, np.full(60, (30.5 - 45) / 100) * z, z], 1)
    hidden = np.array([[0.0, 0, -1], [5, 0, 1], [-5, 0, 1], [0, 5, 1], [0, -5, 1]])
    poses = np.stack([np.eye(4)] * len(frames))
    return odometry._unit(frames, Trajectory(poses, np.concatenate([shown, hidden]), 0.1, 1.0, ()), camera)


def test_path_unit_is_median_ratio_of_depths():
    none = Frame(0, 0, np.zeros((90, 120, 3), np.uint8))
    assert unit_of(none) == 1.0 and unit_of(none, measured(30.0)) == pytest.approx(30, rel=1e-5)
    assert unit_of(measured(20.0), measured(90.0), measured(30.0)) == pytest.approx(30, rel=1e-5)
    assert unit_of(measured(20.0, 24)) == pytest.approx(20, rel=1e-5) and unit_of(measured(20.0, 23)) == 1.0
    sure = np.zeros((90, 120), np.float32)
    sure[:, 50:] = 1
    known = measured(20.0, 60, sure)
    spoilt = known.depth.copy()
    spoilt[:, :50] *= 9
    spoilt[:, 85:] = 0
    assert unit_of(known.with_fields(depth=spoilt)) == pytest.approx(20, rel=1e-5)
