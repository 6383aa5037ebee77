"""Conversion of frames to observations, and the choice of observations for training steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training import observations
from gsplat_core.training.observations import Observation, ObservationWindow


def window(make_frame, camera, frames, capacity=30, seed=0):
    filled = ObservationWindow(capacity, seed)
    for seq in range(frames):
        filled.add(Observation.of(make_frame(seq), camera))
    return filled


def test_an_observation_holds_what_the_frame_holds(make_frame, camera):
    mask = np.ones((40, 48), np.uint8)
    mask[:3] = 0
    depth = np.full((40, 48), 55.0, np.float64)
    frame = make_frame(5, fps=10, mask=mask, depth=depth)
    seen = Observation.of(frame, camera)
    assert (seen.seq, seen.time_s, seen.camera) == (5, 0.5, camera)
    assert seen.image.dtype == torch.uint8
    assert np.array_equal(seen.image.numpy(), frame.image)
    assert seen.mask.dtype == torch.uint8
    assert np.array_equal(seen.mask.numpy(), mask)
    assert seen.depth.dtype == torch.float32
    assert np.array_equal(seen.depth.numpy(), depth)


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["light"], DEPTH_ORIGINS["learned"]])
def test_depth_of_a_single_picture_is_for_the_start_of_a_scene_and_not_for_the_loss(make_frame, camera, origin):
    frame = make_frame(depth=np.full((40, 48), 55.0), depth_origin=origin)
    assert Observation.of(frame, camera).depth is None
    assert Observation.of(frame.with_fields(depth_origin=DEPTH_ORIGINS["parallax"]), camera).depth is not None


@pytest.mark.cuda
def test_a_gpu_holds_the_same(gpu, make_frame, camera):
    frame = make_frame(depth=np.full((40, 48), 55.0), mask=np.eye(40, 48, dtype=np.uint8))
    here, there = Observation.of(frame, camera), Observation.of(frame, camera, gpu)
    for name in ("image", "mask", "depth"):
        tensor = getattr(there, name)
        assert tensor.device == gpu
        assert torch.equal(tensor.cpu(), getattr(here, name))


def test_without_mask_and_depth_all_is_tissue_of_unknown_depth(make_frame, camera):
    seen = Observation.of(make_frame(), camera)
    assert seen.mask.shape == (40, 48)
    assert bool((seen.mask == 1).all())
    assert seen.depth is None


def test_depth_that_is_no_distance_is_unknown(make_frame, camera):
    depth = np.full((40, 48), 55.0, np.float32)
    depth[0, :4] = [np.nan, np.inf, -np.inf, -3.0]
    seen = Observation.of(make_frame(depth=depth), camera)
    assert seen.depth[0, :5].tolist() == [0, 0, 0, 0, 55]
    assert np.isnan(depth[0, 0])  # the frame itself is left as it is


def test_the_frames_pose_wins(make_frame, camera):
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    assert Observation.of(make_frame(pose=pose), camera).camera == camera.with_pose(pose)


def test_a_read_only_image_is_copied_and_not_changed(make_frame, camera):
    frame = make_frame()
    frame.image.setflags(write=False)
    seen = Observation.of(frame, camera)
    seen.image.zero_()
    assert frame.image.any()


def test_a_camera_of_another_size_is_refused(make_frame):
    with pytest.raises(InvalidInput, match="48x40, its camera 24x20"):
        Observation.of(make_frame(7), Camera.from_focal(25.0, 24, 20))


@pytest.mark.parametrize("steps", [1, 2, 7, 8, 20])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 10])
def test_the_schedule_has_its_length_its_share_and_ends_with_the_newest(
    make_frame, camera, steps, share, frames, monkeypatch
):
    monkeypatch.setattr(observations, "NEWEST_SHARE", share)
    schedule = window(make_frame, camera, frames).schedule(steps)
    assert len(schedule) == steps
    assert schedule[-1].seq == frames - 1
    newest = sum(seen.seq == frames - 1 for seen in schedule)
    assert newest == (steps if frames == 1 else max(1, round(steps * share)))


def test_the_newest_frames_turns_are_spread(make_frame, camera, monkeypatch):
    monkeypatch.setattr(observations, "NEWEST_SHARE", 0.5)
    turns = [seen.seq == 4 for seen in window(make_frame, camera, 5).schedule(8)]
    assert turns == [False, True] * 4


def test_older_frames_are_drawn_from_the_whole_window_and_only_from_it(make_frame, camera):
    filled = window(make_frame, camera, 20, capacity=6)
    assert len(filled) == 6
    assert {seen.seq for seen in filled.schedule(400)} == {14, 15, 16, 17, 18, 19}


def test_the_seed_decides_the_draw(make_frame, camera):
    draw = lambda seed: [seen.seq for seen in window(make_frame, camera, 20, seed=seed).schedule(40)]
    assert draw(3) == draw(3)
    assert draw(3) != draw(4)


def test_no_steps_are_an_empty_schedule_and_a_negative_number_is_refused(make_frame, camera):
    filled = window(make_frame, camera, 3)
    assert filled.schedule(0) == []
    with pytest.raises(InvalidInput, match="steps is -1"):
        filled.schedule(-1)


def test_a_frame_is_found_by_its_number_among_the_newest_and_replaced_in_its_place(make_frame, camera):
    frames = window(make_frame, camera, 8, capacity=5)
    assert [frames.find(seq, among=3) is not None for seq in range(9)] == [False] * 5 + [True] * 3 + [False]
    assert frames.find(2, among=99) is None and frames.find(3, among=99).seq == 3
    changed = replace(frames.find(6, among=3), depth=torch.full((40, 48), 55.0))
    frames.replace(changed)
    assert frames.find(6, among=3) is changed and frames.newest.seq == 7
    with pytest.raises(InvalidInput, match="frame 2 is not in the window of 5 frames"):
        frames.replace(Observation.of(make_frame(2), camera))
