"""Stages add fields, count by reason, and leave good video as it is; frames that are withheld teach them nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.cuts import CutCounts, CutStage
from operators.endoscope.exposure import ExposureCounts, ExposureStage
from operators.endoscope.sequence import MaskAndDepthCounts, MaskAndDepthStage, SequenceCounts, SequenceStage
from operators.endoscope.stage import StageOp, left_out, tissue_of
from operators.outcome import OutcomeBuilder
from tests.gsplat_core.endoscope.clips import FRAME_NS, PLACES, brightened, clip, texture


def frames(images, **fields):
    return [Frame(seq=k, pts_ns=k * FRAME_NS, image=image, **fields) for k, image in enumerate(images)]


def run(stage, given):
    stage.start()
    return [stage.apply(frame) for frame in given]


def test_a_bad_picture_is_withheld_with_its_reason_and_counted():
    given = frames(texture(1, 20))
    given[12] = given[12].with_fields(image=given[12].image // 30)
    stage = SequenceStage()
    passed = run(stage, given)
    assert [frame.withheld for frame in passed] == [None] * 12 + ["black"] + [None] * 7
    assert stage.counts() == SequenceCounts(20, {"black": 1})


def test_a_reason_that_a_frame_has_already_stays():
    given = frames([image // 30 for image in texture(1, 3)], withheld="out of body")
    stage = SequenceStage()
    assert {frame.withheld for frame in run(stage, given)} == {"out of body"}
    assert stage.counts().found == {"black": 3}


def test_a_clock_jump_does_not_reach_the_model():
    given = frames(texture(1, 20))
    given[10:] = [frame.with_fields(pts_ns=frame.pts_ns + 10**13) for frame in given[10:]]
    stage = SequenceStage()
    assert [frame.pts_ns for frame in run(stage, given)] == [k * FRAME_NS for k in range(20)]
    assert stage.counts().found == {"clock jump": 1}


def test_a_late_frame_is_withheld_and_is_not_what_the_next_one_is_compared_with():
    given = frames(texture(1, 20))
    late = given[11].with_fields(pts_ns=given[8].pts_ns, image=given[8].image)
    passed = run(SequenceStage(), [*given[:11], late, *given[12:]])
    assert [frame.withheld for frame in passed] == [None] * 11 + ["out of order"] + [None] * 8
    assert passed[11].pts_ns == given[10].pts_ns


def test_a_damaged_frame_is_left_to_what_handles_damage():
    given = frames(texture(1, 9))
    given[5] = given[5].with_fields(status=FrameStatus.DAMAGED, image=given[4].image)
    stages = (SequenceStage(), CutStage(), ExposureStage())
    for stage in stages:
        assert run(stage, given)[5] is given[5]
        assert stage.counts().found == {}


def test_mask_and_depth_are_checked_where_there_are_any():
    given = frames(texture(1, 6))
    depth = np.full(given[0].image.shape[:2], 60, np.float32)
    given[2] = given[2].with_fields(depth=depth * np.nan, mask=np.zeros(depth.shape, np.uint8))
    stage = MaskAndDepthStage()
    passed = run(stage, given)
    assert passed[2].depth is None and passed[2].withheld == "no tissue"
    assert all(after is before for after, before in zip(passed[3:], given[3:], strict=True))
    assert stage.counts() == MaskAndDepthCounts(6, {"depth not usable": 1, "no tissue": 1})


def test_a_cut_is_marked_on_the_second_frame_of_the_new_scene():
    stage = CutStage()
    passed = run(stage, frames([*texture(1, 10), *texture(40, 10)]))
    assert [(k, frame.withheld) for k, frame in enumerate(passed) if frame.withheld] == [(10, "cut in doubt")]
    assert [(k, frame.new_scene) for k, frame in enumerate(passed) if frame.new_scene] == [(11, "cut")]
    assert stage.counts() == CutCounts(20, {"cut": 1, "cut in doubt": 1})


def test_withheld_frames_are_no_scene():
    given = frames([*texture(1, 10), *texture(40, 10), *texture(1, 20)[10:]])
    given[10:20] = [frame.with_fields(withheld="out of body") for frame in given[10:20]]
    assert [frame.new_scene for frame in run(CutStage(), given)] == [None] * 30


def test_the_exposure_is_set_where_it_changed_and_starts_anew_with_a_scene():
    images = texture(1, 30)
    given = frames([*images[:10], *(brightened(image, 1.5) for image in images[10:])])
    given[20] = given[20].with_fields(new_scene="cut")
    stage = ExposureStage()
    found = np.array([frame.exposure for frame in run(stage, given)])
    assert (found[:10] == 1).all() and (found[20:] == 1).all()
    assert np.abs(np.log(found[10:20] / 1.5)).max() < 0.02
    assert stage.counts().found["other than the scene's"] == 10 and isinstance(stage.counts(), ExposureCounts)


def test_a_withheld_frame_keeps_the_exposure_of_the_one_before():
    images = texture(1, 30)
    given = frames([*images[:10], *(brightened(image, 1.5) for image in images[10:])])
    given[15] = given[15].with_fields(withheld="torn", image=given[15].image // 9)
    passed = run(ExposureStage(), given)
    assert passed[15].exposure == passed[14].exposure != (1.0, 1.0, 1.0)


def stages():
    return [SequenceStage(), CutStage(), MaskAndDepthStage(), ExposureStage()]


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart"])
def test_good_video_passes_unchanged_through_all_stages(recordings_dir, name, compute):
    operator = StageOp(None, stages=stages())
    operator.start()
    for frame in frames(clip(recordings_dir, name)):
        (passed,) = compute(operator, frame=frame)
        assert passed is frame
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert [part.found for part in outcome.parts.values()] == [{}] * 4


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_no_recording_has_withheld_frames_or_new_scenes(recordings_dir, name):
    operator_stages = stages()
    for stage in operator_stages:
        stage.start()
    for frame in frames(clip(recordings_dir, name)):
        for stage in operator_stages:
            frame = stage.apply(frame)
        assert (frame.withheld, frame.new_scene) == (None, None)


def test_a_restart_forgets_everything(compute):
    operator = StageOp(None, stages=stages())
    for _ in range(2):
        operator.start()
        for frame in frames(texture(1, 12)):
            (passed,) = compute(operator, frame=frame)
            assert passed is frame
    assert [stage.counts().frames for stage in operator.stages] == [12] * 4


def test_masks_of_the_loss_add_up():
    (frame,) = frames(texture(1, 1))
    one, other = (np.ones(frame.image.shape[:2], np.uint8) for _ in range(2))
    one[:10], other[-10:] = 0, 0
    both = left_out(left_out(frame, one), other)
    assert np.array_equal(both.loss_mask, one & other)
    assert tissue_of(frame) is None and tissue_of(both) is both.loss_mask
    masked = dataclasses.replace(both, mask=other)
    assert np.array_equal(tissue_of(masked), one & other)
    assert tissue_of(dataclasses.replace(masked, loss_mask=None)) is other
