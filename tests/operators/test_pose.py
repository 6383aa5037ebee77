"""Frames get poses estimated from their pictures, and the report states their reliability."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.poses.live_odometry import MOSTLY, LiveOdometry
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS
from operators.outcome import OutcomeBuilder
from operators.pose import AutoPoseOp, EstimatedPoses, PoseOp, check_poses, pose_operators
from tests.gsplat_core.geometry.moving_scope import FIRST, HEIGHT, SIDEWAYS, WIDTH, video

COUNT = 8


@pytest.fixture(scope="module")
def frames():
    """Return pictures of a scope that moves sideways, without poses."""
    return [frame.with_fields(seq=number, pose=None) for number, frame in enumerate(video(COUNT, SIDEWAYS)[0])]


def started(**settings) -> PoseOp:
    operator = PoseOp(None, camera=FIRST, **settings)
    operator.start()
    return operator


def outcome_of(operator: PoseOp) -> OutcomeBuilder:
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome


def test_pose_op_adds_pose_and_changes_nothing_else(frames, compute):
    operator = started()
    for frame in frames:
        (given,) = compute(operator, frame=frame)
        assert given.image is frame.image and given.depth is None and given.seq == frame.seq
        assert given.pose.shape == (4, 4) and given.pose.dtype == np.float64
    assert given.pose[0, 3] < -1, "the scope went to the right"
    found = outcome_of(operator).find(EstimatedPoses)
    assert (found.frames, found.not_placed, found.begun, found.measured) == (COUNT, 0, 1, False)
    assert found.explained > 0.95


def test_pose_op_ignores_recorded_pose(frames, compute):
    wrong = np.eye(4)
    wrong[:3, 3] = 7
    plain, misled = started(), started()
    for frame in frames[:4]:
        (first,), (second,) = (
            compute(plain, frame=frame),
            compute(misled, frame=frame.with_fields(pose=wrong)),
        )
        assert np.array_equal(first.pose, second.pose)


def test_pose_op_start_resets_odometry(frames, compute):
    operator = started()
    first = [compute(operator, frame=frame)[0].pose for frame in frames[:4]]
    operator.start()
    assert np.array_equal(first, [compute(operator, frame=frame)[0].pose for frame in frames[:4]])


def test_pose_op_notes_that_poses_are_relative(frames, compute):
    operator = started()
    for frame in frames:
        compute(operator, frame=frame)
    (note,) = outcome_of(operator).notes
    assert "frame by frame" in note and "have no scale" in note and "60 away" in note and "breathing" in note


@pytest.mark.parametrize("measured", [True, False])
def test_pose_op_takes_unit_from_measured_depth(frames, compute, measured):
    plane = np.full((HEIGHT, WIDTH), 75, np.float32)
    operator = started(measured=measured)
    compute(operator, frame=frames[0].with_fields(depth=plane, depth_origin=DEPTH_ORIGINS["measured"]))
    outcome = outcome_of(operator)
    assert outcome.find(EstimatedPoses).measured == measured
    assert ("the unit of the depth" in outcome.notes[0]) == measured


def test_pose_op_notes_unplaced_and_poorly_explained_frames(frames, compute, monkeypatch):
    monkeypatch.setattr(LiveOdometry, "explained", 0.5)
    operator = started()
    grey = np.full_like(frames[0].image, 90)
    for frame in [*frames[:3], frames[3].with_fields(image=grey)]:
        compute(operator, frame=frame)
    notes = outcome_of(operator).notes
    assert any("1 frames could not be placed" in note for note in notes)
    assert any("the scope may be at rest" in note for note in notes)


def test_pose_op_without_frames_adds_no_note():
    outcome = outcome_of(started())
    assert outcome.notes == () and outcome.find(EstimatedPoses).frames == 0


def test_pose_operators_by_setting():
    assert list(pose_operators(None, "given", FIRST, "auto")) == []
    (operator,) = pose_operators(None, "estimated", FIRST, "none")
    assert not operator.measured


def test_check_poses_refuses_fisheye_and_unknown_setting():
    fisheye = Camera(np.array([[100.0, 0, 40], [0, 100, 32], [0, 0, 1]]), 80, 64, model="fisheye")
    check_poses("given", fisheye)
    with pytest.raises(InvalidSetting, match="this one is fisheye"):
        check_poses("estimated", fisheye)
    with pytest.raises(InvalidSetting, match="poses is 'guessed'; choose given, auto, estimated"):
        check_poses("guessed", FIRST)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, [0]),
        ({"explained": MOSTLY}, [0]),
        ({"explained": MOSTLY - 1e-6}, [0, "explain little"]),
        ({"not_placed": 1}, [0, "1 frames could not be placed"]),
        ({"begun": 2}, [0, "the scope was lost 1 times"]),
        ({"frames": 0, "begun": 9}, []),
    ],
)
def test_pose_op_notes_by_odometry_result(fields, said):
    values = {"frames": 9, "not_placed": 0, "begun": 1, "returned": 3, "explained": 1.0, "is_measured": False}
    operator = PoseOp(None, camera=Camera.from_focal(300.0, WIDTH, HEIGHT))
    operator._odometry = SimpleNamespace(**(values | fields))
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    result, notes = outcome.find(EstimatedPoses), outcome.notes
    expected = values | fields
    assert (result.frames, result.not_placed, result.begun, result.returned) == tuple(
        expected[name] for name in ("frames", "not_placed", "begun", "returned")
    )
    assert len(notes) == len(said)
    for note, part in zip(notes[1:], said[1:], strict=True):
        assert part in note
    if notes:
        assert "lengths have no scale" in notes[0]


def test_auto_estimates_poses_once_the_scope_moves(frames, compute):
    """Still pictures first, then a moving scope, then tissue that moves in stripes."""
    columns = np.arange(WIDTH)
    still = [frames[0]] * 12
    striped = [
        frames[-1].with_fields(image=frames[-1].image[:, (columns - 4 * n * (columns // 40 % 2)) % WIDTH])
        for n in range(12)
    ]
    operator = AutoPoseOp(None, camera=FIRST, measured=False)
    operator.start()
    poses = []
    for number, frame in enumerate([*still, *frames, *striped]):
        (given,) = compute(operator, frame=frame.with_fields(seq=number, pts_ns=number * 300_000_000))
        poses.append(given.pose)
    assert all(pose is None for pose in poses[: len(still)])
    moved = poses[len(still) + len(frames) - 1]
    assert moved is not None and moved[0, 3] < -0.5
    assert np.array_equal(poses[-1], poses[-2])
    assert 0 < outcome_of(operator).find(EstimatedPoses).frames < len(frames) + len(striped)


def test_auto_keeps_recorded_poses(frames, compute):
    operator = AutoPoseOp(None, camera=FIRST)
    operator.start()
    recorded = np.eye(4)
    (given,) = compute(operator, frame=frames[0].with_fields(pose=recorded))
    assert given.pose is recorded and outcome_of(operator).find(EstimatedPoses) is None
