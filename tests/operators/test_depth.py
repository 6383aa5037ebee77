"""Frames get the requested depth, and the report states its source."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.depth import maps
from gsplat_core.depth.maps import DEPTHS, DepthMap, doubted
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, DEPTH_ORIGINS, FrameStatus
from gsplat_core.training.config import ReconstructorConfig
from operators.depth import DepthCounts, DepthOp, FoundDepth, without_depth, without_right_eye
from operators.outcome import OutcomeBuilder

CAMERA = Camera.from_focal(20.0, 24, 16)
PLANE = np.full((16, 24), 50, np.float32)


class Fixed:
    """Answers every frame in the same way, and keeps what it was asked."""

    def __init__(self, answer: DepthMap | None) -> None:
        self.answer, self.asked = answer, []

    def estimate(self, frame, camera):
        self.asked.append((frame, camera))
        return self.answer


@pytest.fixture
def registered():
    """Registers estimators for a test."""
    names = []

    def add(name, answer):
        estimator = Fixed(answer)
        DEPTHS.add(name, lambda: estimator)
        names.append(name)
        return estimator

    yield add
    for name in names:
        DEPTHS.remove(name)


def started(choice):
    operator = DepthOp(None, choice=choice, camera=CAMERA)
    operator.start()
    return operator


def outcome_of(operator):
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome


@pytest.mark.parametrize("choice", ["auto", "recorded"])
def test_depth_op_passes_recorded_depth_unchanged(frame, compute, choice):
    given = frame(0, depth=PLANE, depth_origin=DEPTH_ORIGINS["measured"])
    operator = started(choice)
    (passed,) = compute(operator, frame=given)
    assert passed is given
    outcome = outcome_of(operator)
    assert outcome.find(FoundDepth) == FoundDepth({"measured": 1}, 1.0, True, {})
    assert outcome.notes == ()


def test_depth_none_drops_recorded_depth_with_note(frame, compute):
    operator = started("none")
    (passed,) = compute(operator, frame=frame(0, depth=PLANE, depth_origin=DEPTH_ORIGINS["measured"]))
    assert (passed.depth, passed.depth_confidence, passed.depth_origin) == (None, None, None)
    assert outcome_of(operator).notes == ("the depth delivered with 1 frames was not used (depth is 'none')",)


@pytest.mark.parametrize("choice", ["auto", "recorded", "stereo"])
def test_depth_op_without_stereo_or_poses_finds_no_depth(frame, compute, choice):
    given = frame(0)
    (passed,) = compute(started(choice), frame=given)
    assert passed.depth is None


def test_depth_op_zeroes_depth_below_confidence_threshold(frame, compute, registered):
    confidence = np.ones((16, 24), np.float32)
    confidence[:8] = 0.4
    registered("half", DepthMap(PLANE, confidence, DEPTH_ORIGINS["light"], metric=False))
    operator = started("half")
    (passed,) = compute(operator, frame=frame(0))
    assert (passed.depth[:8] == 0).all() and (passed.depth[8:] == 50).all()
    assert passed.depth_confidence is confidence and passed.depth_origin is DEPTH_ORIGINS["light"]
    outcome = outcome_of(operator)
    assert outcome.find(FoundDepth) == FoundDepth({"light": 1}, 0.5, False, {})
    assert outcome.notes == (
        "depth was estimated from the pictures for 1 frames, in 50% of their pixels; it is relative: its unit is not known",
    )


def test_depth_op_drops_doubted_depth_with_note(frame, compute, registered):
    registered("wrong", doubted((16, 24), DEPTH_ORIGINS["stereo"], "the eyes are swapped"))
    operator = started("wrong")
    for seq in range(3):
        (passed,) = compute(operator, frame=frame(seq))
        assert passed.depth is None
    assert outcome_of(operator).notes == ("3 frames got no depth: the eyes are swapped",)


def test_depth_op_passes_camera_with_frame_pose_to_estimator(frame, compute, registered):
    pose = np.eye(4)
    pose[2, 3] = 7
    asked = registered("asked", None).asked
    compute(started("asked"), frame=frame(0, pose=pose))
    assert asked[0][1] == CAMERA.with_pose(pose)


@pytest.mark.parametrize("fields", [{"status": FrameStatus.DAMAGED}, {"withheld": "blur"}])
def test_depth_op_skips_damaged_and_withheld_frames(frame, compute, registered, fields):
    asked = registered("asked", None).asked
    compute(started("asked"), frame=frame(0, **fields))
    assert asked == []


def test_depth_op_refuses_unknown_estimator():
    with pytest.raises(InvalidSetting, match="depth is 'sonar'; choose auto, recorded, stereo"):
        DepthOp(None, choice="sonar", camera=CAMERA)


def test_without_depth_note_states_start_on_plane():
    config = ReconstructorConfig()
    assert without_depth("auto", frozenset({"depth"}), config) is None
    said = without_depth("none", frozenset({"depth"}), config)
    assert said.startswith("the recording's depth is not used (depth is 'none'): the scene starts on a plane")
    assert without_depth("auto", frozenset(), config).startswith(
        "the recording has no depth: the scene starts on a plane"
    )
    assert "unless the two eyes show" in without_depth("auto", frozenset({"right_image"}), config)
    assert "unless the given poses show" in without_depth("auto", frozenset({"pose"}), config)
    assert "unless" not in without_depth("recorded", frozenset({"pose"}), config)


@pytest.mark.parametrize(
    ("depth", "eyes", "asked"),
    [
        ("stereo", "both", "depth is 'stereo' and eyes is 'both'"),
        ("stereo", None, "depth is 'stereo'"),
        ("auto", "both", "eyes is 'both'"),
        ("auto", "left", None),
        ("parallax", None, None),
    ],
)
def test_without_right_eye_note_for_stereo_settings(depth, eyes, asked):
    found = without_right_eye(depth, eyes, frozenset({"pose"}), "clip.mp4")
    assert found == (None if asked is None else f"{asked}, but clip.mp4 has one eye, so that this has no effect")
    assert without_right_eye(depth, eyes, frozenset({"right_image"}), "clip.mp4") is None


def test_without_depth_note_mentions_light_and_network_estimators():
    said = without_depth("light", frozenset(), ReconstructorConfig())
    assert "unless light and shade show how far away it is" in said
    said = without_depth("onnx:net.onnx", frozenset(), ReconstructorConfig())
    assert "unless answers of the depth network show how far away it is" in said


@pytest.mark.parametrize("has_time", [True, False])
@pytest.mark.parametrize("fields", [{}, {"pose": np.eye(4)}], ids=["fixed", "with poses"])
def test_auto_depth_never_uses_light_estimator(frame, compute, monkeypatch, has_time, fields):
    by_light = Fixed(None)
    monkeypatch.setattr(maps, "DEPTHS", {**{name: DEPTHS[name] for name in DEPTHS}, "light": lambda: by_light})
    operator = DepthOp(None, choice="auto", camera=CAMERA, has_time=has_time)
    operator.start()
    for seq in range(3):
        compute(operator, frame=frame(seq, **fields))
    assert by_light.asked == []
    said = without_depth("auto", frozenset({"pose"} if fields else ()), ReconstructorConfig.offline())
    assert "light" not in said


@pytest.mark.parametrize(("has_time", "asked"), [(True, [0, 2, 3]), (False, [])])
def test_auto_depth_uses_slow_estimator_only_offline_and_not_for_heldout(frame, compute, monkeypatch, has_time, asked):
    slow = Fixed(None)
    monkeypatch.setattr(maps, "DEPTHS", {**{name: DEPTHS[name] for name in DEPTHS}, "parallax": lambda: slow})
    operator = DepthOp(None, choice="auto", camera=CAMERA, has_time=has_time, held_out=lambda given: given.seq == 1)
    operator.start()
    for seq in range(4):
        compute(operator, frame=frame(seq, pose=np.eye(4)))
    compute(operator, frame=frame(4))
    assert [given.seq for given, _ in slow.asked] == asked


def finder(doubts=(), remarks=()):
    return SimpleNamespace(
        doubts=SimpleNamespace(counted=lambda: dict(doubts)), remarks=SimpleNamespace(counted=lambda: list(remarks))
    )


def test_depth_counts_contribute_shares_and_notes(frame):
    half = PLANE.copy()
    half[:8] = 0
    sure = np.full((16, 24), BELIEVED, np.float32)
    sure[:, :6] = np.nextafter(np.float32(BELIEVED), np.float32(0))
    first, second, outcome = DepthCounts(), DepthCounts(), OutcomeBuilder()
    measured = frame(depth=half)
    first.take(measured, measured)
    found = frame(depth=PLANE, depth_confidence=sure, depth_origin=DEPTH_ORIGINS["stereo"])
    second.take(frame(), found)
    second.take(frame(depth=PLANE), frame())
    second.take(frame(), frame())
    first.passed_over, second.passed_over = 2, 3
    (first + second).contribute(outcome, "stereo", finder({"dark": 4}, ["it was slow"]))
    result = outcome.find(FoundDepth)
    assert dict(result.frames) == {"measured": 1, "stereo": 1} and result.known_share == pytest.approx(0.625)
    assert result.passed_over == 5 and result.doubts == {"dark": 4}
    text = " | ".join(outcome.notes)
    for said in (
        "depth was estimated from the pictures for 1 frames, in 62% of their pixels",
        "not estimated for 5 frames",
        "it was slow",
        "4 frames got no depth: dark",
        "the depth delivered with 1 frames was not used (depth is 'stereo')",
    ):
        assert said in text


def test_depth_counts_without_frames_add_no_note():
    outcome = OutcomeBuilder()
    DepthCounts().contribute(outcome, "auto", None)
    result = outcome.find(FoundDepth)
    assert (dict(result.frames), result.known_share, result.metric, result.passed_over) == ({}, 0.0, True, 0)
    assert outcome.notes == ()


@pytest.mark.parametrize(
    ("choice", "fields", "motion", "ways"),
    [
        ("auto", {"depth"}, False, None),
        ("recorded", {"depth"}, False, None),
        ("none", {"depth"}, False, "the recording's depth is not used (depth is 'none'): the scene"),
        ("auto", set(), False, "the recording has no depth: the scene"),
        ("auto", {"right_image"}, False, "unless the two eyes show"),
        ("stereo", {"right_image"}, False, "unless the two eyes show"),
        ("none", {"right_image"}, False, "no depth: the scene"),
        ("onnx:a", {"right_image"}, False, "unless answers of the depth network show"),
        ("auto", {"pose"}, False, "unless the given poses show"),
        ("parallax", {"pose"}, False, "unless the given poses show"),
        ("none", {"pose"}, True, "unless the given poses show"),
        ("none", {"pose"}, False, "no depth: the scene"),
        ("auto", {"right_image", "pose"}, False, "unless the two eyes or the given poses show"),
        ("light", set(), False, "unless light and shade show"),
    ],
)
def test_without_depth_note_lists_possible_estimators(choice, fields, motion, ways):
    config = SimpleNamespace(depth_of_recording="parallax" if motion else None, default_depth_mm=50.0)
    note = without_depth(choice, frozenset(fields), config)
    assert (note is None) if ways is None else (ways in note and "a plane 50 mm away" in note)
