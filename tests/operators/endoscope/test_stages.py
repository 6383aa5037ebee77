"""Stages add fields, count by reason, and leave good video unchanged; withheld frames do not change their state."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.scene.frames import Frame, FrameStatus
from operators.checks import (
    CutCounts,
    CutStage,
    FieldOfViewStage,
    InterlacingStage,
    MaskAndDepthCounts,
    MaskAndDepthStage,
    SequenceCounts,
    SequenceStage,
    SharpnessStage,
    StageOp,
    StripStage,
    picture_stages,
)
from operators.outcome import OutcomeBuilder
from tests.gsplat_core.endoscope.clips import FRAME_NS, PLACES, clip, resized, texture


def frames(images, **fields):
    return [Frame(seq=k, pts_ns=k * FRAME_NS, image=image, **fields) for k, image in enumerate(images)]


def run(stage, given):
    stage.start()
    return [stage.apply(frame) for frame in given]


def test_sequence_stage_withholds_and_counts_black_frame():
    given = frames(texture(1, 20))
    given[12] = given[12].with_fields(image=given[12].image // 30)
    stage = SequenceStage()
    passed = run(stage, given)
    assert [frame.withheld for frame in passed] == [None] * 12 + ["black"] + [None] * 7
    assert stage.counts() == SequenceCounts(20, {"black": 1})


def test_sequence_stage_keeps_existing_withheld_reason():
    given = frames([image // 30 for image in texture(1, 3)], withheld="out of body")
    stage = SequenceStage()
    assert {frame.withheld for frame in run(stage, given)} == {"out of body"}
    assert stage.counts().found == {"black": 3}


def test_sequence_stage_removes_clock_jump_from_timestamps():
    given = frames(texture(1, 20))
    given[10:] = [frame.with_fields(pts_ns=frame.pts_ns + 10**13) for frame in given[10:]]
    stage = SequenceStage()
    assert [frame.pts_ns for frame in run(stage, given)] == [k * FRAME_NS for k in range(20)]
    assert stage.counts().found == {"clock jump": 1}


def test_sequence_stage_withholds_late_frame_and_ignores_it_for_comparison():
    given = frames(texture(1, 20))
    late = given[11].with_fields(pts_ns=given[8].pts_ns, image=given[8].image)
    passed = run(SequenceStage(), [*given[:11], late, *given[12:]])
    assert [frame.withheld for frame in passed] == [None] * 11 + ["out of order"] + [None] * 8
    assert passed[11].pts_ns == given[10].pts_ns


def test_stages_pass_damaged_frame_unchanged():
    given = frames(texture(1, 9))
    given[5] = given[5].with_fields(status=FrameStatus.DAMAGED, image=given[4].image)
    stages = (SequenceStage(), CutStage())
    for stage in stages:
        assert run(stage, given)[5] is given[5]
        assert stage.counts().found == {}


def test_mask_and_depth_stage_removes_bad_depth_and_withholds_empty_mask():
    given = frames(texture(1, 6))
    depth = np.full(given[0].image.shape[:2], 60, np.float32)
    given[2] = given[2].with_fields(depth=depth * np.nan, mask=np.zeros(depth.shape, np.uint8))
    stage = MaskAndDepthStage()
    passed = run(stage, given)
    assert passed[2].depth is None and passed[2].withheld == "no tissue"
    assert all(after is before for after, before in zip(passed[3:], given[3:], strict=True))
    assert stage.counts() == MaskAndDepthCounts(6, {"depth not usable": 1, "no tissue": 1})


def test_cut_stage_marks_cut_on_second_frame_of_new_scene():
    stage = CutStage()
    passed = run(stage, frames([*texture(1, 10), *texture(40, 10)]))
    assert [(k, frame.withheld) for k, frame in enumerate(passed) if frame.withheld] == [(10, "cut in doubt")]
    assert [(k, frame.new_scene) for k, frame in enumerate(passed) if frame.new_scene] == [(11, "cut")]
    assert stage.counts() == CutCounts(20, {"cut": 1, "cut in doubt": 1})


def test_cut_stage_ignores_withheld_frames():
    given = frames([*texture(1, 10), *texture(40, 10), *texture(1, 20)[10:]])
    given[10:20] = [frame.with_fields(withheld="out of body") for frame in given[10:20]]
    assert [frame.new_scene for frame in run(CutStage(), given)] == [None] * 30


def all_stages():
    return [*picture_stages(), MaskAndDepthStage()]


def run_all(given):
    passed = given
    for stage in all_stages():
        passed = run(stage, passed)
    return passed


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart"])
def test_stages_change_only_loss_mask_of_good_video(recordings_dir, name, compute):
    operator = StageOp(None, stages=all_stages())
    operator.start()
    for frame in frames(clip(recordings_dir, name)):
        (passed,) = compute(operator, frame=frame)
        assert dataclasses.replace(passed, loss_mask=None) == frame
        assert passed.image is frame.image
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    found = {what for part in outcome.parts.values() for what in part.found}
    assert found <= {"strip or text"} and len(outcome.parts) == 7


@pytest.mark.recordings
@pytest.mark.parametrize("name", sorted(PLACES.keys() - {"cutting", "heart"}))
def test_stages_withhold_no_frame_and_find_no_cut_in_good_recordings(recordings_dir, name):
    for frame in run_all(frames(clip(recordings_dir, name))):
        assert (frame.withheld, frame.new_scene) == (None, None)


@pytest.mark.recordings
def test_stages_find_each_of_many_faults_in_one_stream(recordings_dir):
    images = list(clip(recordings_dir, "cutting"))
    other = resized(clip(recordings_dir, "heart")[:20], images[0])
    given = frames([*images[:20], images[20] // 30, *[images[20]] * 10, *images[20:50], *other, *images[50:70]])
    given[15] = given[15].with_fields(pts_ns=given[11].pts_ns)
    given[35:] = [frame.with_fields(pts_ns=frame.pts_ns + 10**15) for frame in given[35:]]
    passed = run_all(given)
    reasons = [frame.withheld for frame in passed]
    assert (reasons[15], reasons[20], reasons[22], reasons[30]) == ("out of order", "black", "duplicate", "frozen")
    assert [(k, frame.new_scene) for k, frame in enumerate(passed) if frame.new_scene] == [
        (62, "cut"),
        (82, "cut"),
    ]
    assert sum(reason is not None for reason in reasons) == 1 + 1 + 10 + 2
    times = [frame.pts_ns for frame in passed]
    assert times == sorted(times) and times[-1] < 4 * 10**9


def test_stage_op_restart_resets_stages(compute):
    operator = StageOp(None, stages=all_stages())
    for _ in range(2):
        operator.start()
        for frame in frames(texture(1, 12)):
            (passed,) = compute(operator, frame=frame)
            assert passed is frame
    assert {stage.counts().frames for stage in operator.stages} == {12}


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 50), st.integers(1, 50), st.integers(0, 2**32))
def test_no_frame_of_any_content_raises_in_any_stage(height, width, seed):
    rng = np.random.default_rng(seed)
    operator_stages = all_stages()
    for k in range(10):
        size = (height, width) if k < 7 else (width, height)
        with np.errstate(all="ignore"):
            depth = np.array(10.0 ** rng.uniform(-50, 50, size), np.float32)
        depth[rng.random(size) < 0.3] = rng.choice([np.nan, np.inf, -1.0])
        frame = Frame(
            seq=k,
            pts_ns=int(rng.integers(-(2**62), 2**62)),
            arrived_ns=int(rng.integers(0, 2**62)) if rng.random() < 0.5 else None,
            image=rng.integers(0, rng.integers(1, 257), (*size, 3), np.uint8),
            depth=depth if rng.random() < 0.5 else None,
            mask=rng.integers(0, 2, size, np.uint8) if rng.random() < 0.5 else None,
            status=FrameStatus.DAMAGED if rng.random() < 0.1 else FrameStatus.LIVE,
        )
        for stage in operator_stages:
            frame = stage.apply(frame)
        assert frame.loss_mask is None or set(np.unique(frame.loss_mask)) <= {0, 1}


def test_frame_excluding_combines_loss_masks():
    (frame,) = frames(texture(1, 1))
    one, other = (np.ones(frame.image.shape[:2], np.uint8) for _ in range(2))
    one[:10], other[-10:] = 0, 0
    both = frame.excluding(one).excluding(other)
    assert np.array_equal(both.loss_mask, one & other)
    assert frame.tissue is None and both.tissue is both.loss_mask
    masked = dataclasses.replace(both, mask=other)
    assert np.array_equal(masked.tissue, one & other)
    assert dataclasses.replace(masked, loss_mask=None).tissue is other


@pytest.mark.recordings
@pytest.mark.parametrize(
    "stage, name, what",
    [
        (FieldOfViewStage, "sinus", "limited"),
        (StripStage, "cutting", "strip or text"),
    ],
)
def test_stage_adds_excluded_pixels_to_existing_loss_mask(recordings_dir, stage, name, what):
    images = clip(recordings_dir, name)
    before = np.ones(images[0].shape[:2], np.uint8)
    before[:9] = 0
    made = stage()
    passed = run(made, frames(images, loss_mask=before))
    assert not passed[-1].loss_mask[:9].any() and passed[-1].loss_mask.sum() < before.sum()
    assert made.counts().found[what] > 0


def test_sharpness_stage_withholds_blur_relative_to_scene():
    soft = [cv2.GaussianBlur(image, (0, 0), 3) for image in texture(1, 40)]
    given = frames([*texture(1, 20), *soft[20:30], *texture(1, 40)[30:]])
    assert {frame.withheld for frame in run(SharpnessStage(), given)[20:30]} == {"blur"}
    given[20] = given[20].with_fields(new_scene="cut")
    assert {frame.withheld for frame in run(SharpnessStage(), given)[:30]} == {None}


def test_interlacing_stage_repairs_both_eyes():
    images = [np.roll(image, 6 * k, axis=1) for k, image in enumerate(texture(1, 20, 320, 256))]
    for image, later in itertools.pairwise(images):
        image[1::2] = later[1::2]
    stage = InterlacingStage()
    passed = run(stage, [frame.with_fields(right_image=frame.image) for frame in frames(images)])
    assert np.array_equal(passed[15].image, passed[15].right_image) and not np.array_equal(passed[15].image, images[15])
    assert stage.counts().found["de-interlaced"] > 10


def test_sharpness_stage_does_not_report_deinterlaced_frames_as_blur():
    """Deinterlaced pictures are compared with each other, not with the sharper ones before deinterlacing."""
    images = [np.roll(image, 6 * k, axis=1) for k, image in enumerate(texture(1, 30, 320, 256))]
    for image, later in itertools.pairwise(images):
        image[1::2] = later[1::2]
    # The first frames are at rest, as combs are found late in a stream that begins so.
    given = frames([images[0]] * 8 + images[:-1])
    repaired = run(InterlacingStage(), given)
    assert [frame.deinterlaced for frame in repaired].count(True) > 10
    assert {frame.withheld for frame in run(SharpnessStage(), repaired)} == {None}
    unmarked = [frame.with_fields(deinterlaced=False) for frame in repaired]
    assert "blur" in {frame.withheld for frame in run(SharpnessStage(), unmarked)}
