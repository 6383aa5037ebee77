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


def test_observation_of_frame_has_equal_fields(make_frame, camera):
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
def test_observation_drops_single_picture_depth(make_frame, camera, origin):
    frame = make_frame(depth=np.full((40, 48), 55.0), depth_origin=origin)
    assert Observation.of(frame, camera).depth is None
    assert Observation.of(frame.with_fields(depth_origin=DEPTH_ORIGINS["parallax"]), camera).depth is not None


@pytest.mark.cuda
def test_observation_on_cuda_equals_cpu(gpu, make_frame, camera):
    frame = make_frame(depth=np.full((40, 48), 55.0), mask=np.eye(40, 48, dtype=np.uint8))
    here, there = Observation.of(frame, camera), Observation.of(frame, camera, gpu)
    for name in ("image", "mask", "depth"):
        tensor = getattr(there, name)
        assert tensor.device == gpu
        assert torch.equal(tensor.cpu(), getattr(here, name))


def test_observation_without_mask_and_depth_is_all_tissue(make_frame, camera):
    seen = Observation.of(make_frame(), camera)
    assert seen.mask.shape == (40, 48)
    assert bool((seen.mask == 1).all())
    assert seen.depth is None


def test_observation_sets_invalid_depth_to_zero(make_frame, camera):
    depth = np.full((40, 48), 55.0, np.float32)
    depth[0, :4] = [np.nan, np.inf, -np.inf, -3.0]
    seen = Observation.of(make_frame(depth=depth), camera)
    assert seen.depth[0, :5].tolist() == [0, 0, 0, 0, 55]
    assert np.isnan(depth[0, 0])  # the frame itself is left as it is


def test_observation_uses_pose_of_frame(make_frame, camera):
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    assert Observation.of(make_frame(pose=pose), camera).camera == camera.with_pose(pose)


def test_observation_copies_read_only_image(make_frame, camera):
    frame = make_frame()
    frame.image.setflags(write=False)
    seen = Observation.of(frame, camera)
    seen.image.zero_()
    assert frame.image.any()


def test_observation_refuses_camera_of_other_size(make_frame):
    with pytest.raises(InvalidInput, match="48x40, its camera 24x20"):
        Observation.of(make_frame(7), Camera.from_focal(25.0, 24, 20))


@pytest.mark.parametrize("steps", [1, 2, 7, 8, 20])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 10])
def test_window_schedule_length_newest_share_and_last_step(make_frame, camera, steps, share, frames, monkeypatch):
    monkeypatch.setattr(observations, "NEWEST_SHARE", share)
    schedule = window(make_frame, camera, frames).schedule(steps)
    assert len(schedule) == steps
    assert schedule[-1].seq == frames - 1
    newest = sum(seen.seq == frames - 1 for seen in schedule)
    assert newest == (steps if frames == 1 else max(1, round(steps * share)))


def test_window_schedule_spreads_steps_of_newest_frame(make_frame, camera, monkeypatch):
    monkeypatch.setattr(observations, "NEWEST_SHARE", 0.5)
    turns = [seen.seq == 4 for seen in window(make_frame, camera, 5).schedule(8)]
    assert turns == [False, True] * 4


def test_window_schedule_draws_from_whole_window(make_frame, camera):
    filled = window(make_frame, camera, 20, capacity=6)
    assert len(filled) == 6
    assert {seen.seq for seen in filled.schedule(400)} == {14, 15, 16, 17, 18, 19}


def test_window_schedule_depends_on_seed(make_frame, camera):
    draw = lambda seed: [seen.seq for seen in window(make_frame, camera, 20, seed=seed).schedule(40)]
    assert draw(3) == draw(3)
    assert draw(3) != draw(4)


def test_window_schedule_of_zero_or_negative_steps(make_frame, camera):
    filled = window(make_frame, camera, 3)
    assert filled.schedule(0) == []
    with pytest.raises(InvalidInput, match="steps is -1"):
        filled.schedule(-1)


def test_window_find_and_replace_by_frame_number(make_frame, camera):
    frames = window(make_frame, camera, 8, capacity=5)
    assert [frames.find(seq, among=3) is not None for seq in range(9)] == [False] * 5 + [True] * 3 + [False]
    assert frames.find(2, among=99) is None and frames.find(3, among=99).seq == 3
    changed = replace(frames.find(6, among=3), depth=torch.full((40, 48), 55.0))
    frames.replace(changed)
    assert frames.find(6, among=3) is changed and frames.newest.seq == 7
    with pytest.raises(InvalidInput, match="frame 2 is not in the window of 5 frames"):
        frames.replace(Observation.of(make_frame(2), camera))
