"""The second eye in training: its camera, its mask, what it is good for."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import BothEyes, right_tissue
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from gsplat_core.training.strategies import streaming
from tests.gsplat_core.training.two_eyes import HEIGHT, LEFT, RIGHT, THIRD, WIDTH, seen, stereo_frame

CONFIG = ReconstructorConfig(
    eyes="both", gaussians=700, max_gaussians=1400, default_depth_mm=56.0, first_frame_steps=80, steps_per_frame=20
)
DISPARITY_PX = 60 * 5 / 56


def psnr(a, b):
    return float(-10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2))


def inner(picture):
    return picture[8:-8, 12:-12]


def test_right_observation_camera_is_relative_to_left_pose():
    pose = np.eye(4)
    pose[:3, 3] = [1, -2, 3]
    left = BothEyes("both").observation(stereo_frame(pose=pose), LEFT)
    right = left.right
    assert right is not None and right.right is None
    assert np.allclose(right.camera.world_to_camera, RIGHT.world_to_camera @ pose)
    assert (right.seq, right.time_s, right.depth) == (left.seq, left.time_s, None)
    assert np.array_equal(right.image.numpy(), seen(RIGHT)[0]), "the eyes have the same colours: nothing is changed"
    assert left.by_turns(0) is left and left.by_turns(1) is right and left.by_turns(2) is left


def test_right_observation_has_own_intrinsics():
    K = RIGHT.K.copy()
    K[1, 2] += 0.5
    own = dataclasses.replace(RIGHT, K=K)
    right = BothEyes("both").observation(stereo_frame(right_camera=own), LEFT).right
    assert right is not None and np.array_equal(right.camera.K, K)


@pytest.mark.parametrize("missing", ["right_image", "right_camera"])
def test_observation_without_right_eye_always_returns_left(missing):
    eyes = BothEyes("both")
    left = eyes.observation(stereo_frame(**{missing: None}), LEFT)
    assert left.right is None and left.by_turns(1) is left
    assert eyes.trained == "left"


def test_right_observation_is_none_for_left_eyes_or_untrained_frame():
    assert BothEyes("left").observation(stereo_frame(), LEFT).right is None
    eyes = BothEyes("both")
    assert eyes.observation(stereo_frame(), LEFT, trains=False).right is None
    assert eyes.trained == "left"
    assert eyes.observation(stereo_frame(), LEFT).right is not None
    assert eyes.trained == "both"


def test_both_eyes_refuses_different_camera_models():
    with pytest.raises(InvalidInput, match="right camera is fisheye, the left one pinhole"):
        BothEyes("both").observation(stereo_frame(right_camera=dataclasses.replace(RIGHT, model="fisheye")), LEFT)


def tool_mask():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[16:32, 28:40] = 0
    return mask


def test_right_tissue_excludes_tool_at_its_disparity():
    mask = tool_mask()
    depth = np.full((HEIGHT, WIDTH), 56.0, np.float32)
    depth[mask == 0] = 20.0  # 15 px of disparity
    found = right_tissue(stereo_frame(mask=mask, depth=depth), LEFT, RIGHT, 0.0)
    assert not found[16:32, 13:25].any(), "there it is"
    assert found[:, 34:].all() and found[:8].all() and found[40:].all()
    assert found[16:32, 29:].all(), "where the left eye sees it the right one sees tissue"


def test_right_tissue_excludes_range_of_tool_of_unknown_depth():
    mask = tool_mask()
    depth = np.where(mask == 1, np.float32(56), np.float32(0))
    found = right_tissue(stereo_frame(mask=mask, depth=depth), LEFT, RIGHT, 0.0)
    for nearer in (0.75, 1.0, 2.0):
        begin, end = round(28 - nearer * DISPARITY_PX), round(40 - nearer * DISPARITY_PX)
        assert not found[16:32, begin:end].any()
    assert found[:, 44:].all() and found[:, :8].all()
    without_any = right_tissue(stereo_frame(mask=mask), LEFT, RIGHT, DISPARITY_PX)
    assert np.array_equal(without_any, found), "the shift of the whole picture says as much"


def test_right_tissue_treats_unconfident_tool_depth_as_unknown():
    mask = tool_mask()
    depth = np.full((HEIGHT, WIDTH), 56.0, np.float32)
    depth[mask == 0] = 20.0
    confidence = mask.astype(np.float32)
    doubted = right_tissue(stereo_frame(mask=mask, depth=depth, depth_confidence=confidence), LEFT, RIGHT, 0.0)
    unknown = np.where(mask == 1, depth, np.float32(0))
    assert np.array_equal(doubted, right_tissue(stereo_frame(mask=mask, depth=unknown), LEFT, RIGHT, 0.0))


@pytest.mark.parametrize("mask", [None, np.ones((HEIGHT, WIDTH), np.uint8)])
def test_right_tissue_is_complete_without_tool(mask):
    assert right_tissue(stereo_frame(mask=mask), LEFT, RIGHT, 5.0).all()


def test_right_tissue_is_empty_if_left_is_all_tool():
    nothing = right_tissue(stereo_frame(mask=np.zeros((HEIGHT, WIDTH), np.uint8)), LEFT, RIGHT, 5.0)
    assert not nothing[:, : WIDTH - 16].any()


def test_right_tissue_ignores_tool_outside_right_picture():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :6] = 0
    depth = np.full((HEIGHT, WIDTH), 15.0, np.float32)
    assert right_tissue(stereo_frame(mask=mask, depth=depth), LEFT, RIGHT, 0.0).all()


def trained(eyes, frames=2, **fields):
    learning = Reconstructor(dataclasses.replace(CONFIG, eyes=eyes), LEFT)
    for seq in range(frames):
        learning.observe(stereo_frame(seq, **fields))
    return learning


@pytest.mark.slow
def test_training_on_both_eyes_improves_depth_and_third_view():
    """Stereo is the only cue to the surface distance: the third view and depth improve with both eyes."""
    views, depths = {}, {}
    for eyes in ("left", "both"):
        learning = trained(eyes, frames=4)
        assert learning.eyes.trained == eyes
        model = learning.snapshot()
        scene = model.at(0.0)
        views[eyes] = psnr(inner(seen(THIRD, scene)[0]), inner(seen(THIRD)[0]))
        depths[eyes] = np.abs(inner(seen(LEFT, scene)[1]) - inner(seen(LEFT)[1])).mean()
        assert psnr(inner(seen(LEFT, scene)[0]), inner(seen(LEFT)[0])) > 25
    assert views["both"] > views["left"] + 1.5
    assert depths["both"] < 0.7 * depths["left"]


def test_tissue_seen_only_by_right_eye_gets_gaussians():
    covered = trained("both", frames=1, with_depth=True).snapshot().at(0.0)
    picture, _ = seen(RIGHT, covered)
    alone = trained("left", frames=1, with_depth=True).snapshot().at(0.0)
    strip = np.s_[8:-8, -4:]
    assert psnr(picture[strip], seen(RIGHT)[0][strip]) > psnr(seen(RIGHT, alone)[0][strip], seen(RIGHT)[0][strip]) + 5


@pytest.mark.slow
def test_offline_fit_trains_on_both_eyes(monkeypatch):
    monkeypatch.setattr(streaming, "DENSIFY_ROUNDS", 1)
    config = dataclasses.replace(CONFIG, depth_of_recording=None)
    views = {}
    for eyes in ("left", "both"):
        learning = Reconstructor(dataclasses.replace(config, eyes=eyes), LEFT)
        learning.fit([stereo_frame(seq) for seq in range(3)], 200)
        views[eyes] = psnr(inner(seen(RIGHT, learning.snapshot().at(0.0))[0]), inner(seen(RIGHT)[0]))
    assert views["both"] > views["left"] + 1.5  # 2.8 dB or more with every instruction set


@pytest.mark.slow
def test_stereo_training_is_deterministic():
    first, second = (trained("both", frames=3).snapshot() for _ in range(2))
    assert first.sha256() == second.sha256()
    assert first.sha256() != trained("left", frames=3).snapshot().sha256()


@pytest.mark.slow
def test_both_eyes_without_right_image_equals_left_training():
    alone = trained("both", frames=3, right_image=None).snapshot()
    assert alone.sha256() == trained("left", frames=3, right_image=None).snapshot().sha256()


def tinted(seq: int) -> Frame:
    """A frame whose right picture has highlights, and is darker in places, where the left one is not."""
    frame = stereo_frame(seq, with_depth=True)
    right = frame.right_image.astype(np.int64)
    right[10:20, 20:30] += 90
    right[30:40, 34:50] //= 2
    return frame.with_fields(right_image=right.clip(0, 255).astype(np.uint8))


@pytest.mark.slow
@pytest.mark.parametrize(("way", "better_db"), [("online", 0.1), ("offline", 0.2), ("live", 4)])
def test_training_keeps_separate_colours_per_eye(way, better_db, monkeypatch):
    """A tint of one eye appears in its own rendered picture and not in that of the other eye."""
    monkeypatch.setattr(streaming, "DENSIFY_ROUNDS", 1)
    frames = [tinted(seq) for seq in range(4)]
    if way == "live":
        config = dataclasses.replace(CONFIG, squared_error=True, history_s=2.0, preallocate=True)
        learning = Reconstructor(config, LEFT, live=LiveTraining(colour_relaxation=1.5))
        for frame in frames:
            learning.observe(frame, steps=20)
            learning.grow(frame)
            learning.rehearse(10)
    else:
        learning = Reconstructor(dataclasses.replace(CONFIG, depth_of_recording=None), LEFT)
        if way == "offline":
            learning.fit(frames, 300)
        else:
            for frame in frames:
                learning.observe(frame)
    model = learning.snapshot()
    left, right = model.at(0.1), model.seen_by_right().at(0.1)
    bright, dark = np.s_[12:18, 22:28], np.s_[32:38, 37:47]
    true = BothEyes("both").observation(frames[-1], LEFT).right.image.numpy()
    for place in (bright, dark):
        assert psnr(seen(LEFT, left)[0][place], frames[-1].image[place]) > 18
        own = psnr(seen(RIGHT, right)[0][place], true[place])
        assert own > psnr(seen(RIGHT, left)[0][place], true[place]) + better_db
    assert model.at(0.1).right_sh is not None and right.right_sh is None


def test_right_sh_is_none_for_monocular_training():
    assert trained("left", frames=1).snapshot().gaussians.right_sh is None
    assert trained("both", frames=1, right_image=None).snapshot().gaussians.right_sh is None


def test_live_training_alternates_eyes_starting_with_left(monkeypatch):
    learning = Reconstructor(
        dataclasses.replace(CONFIG, squared_error=True), LEFT, live=LiveTraining(colour_relaxation=1.0)
    )
    learning.observe(stereo_frame(), steps=2)
    taken = []
    step = learning._step
    monkeypatch.setattr(type(step), "__call__", lambda self, one, *rest: taken.append(one.camera) or torch.zeros(()))
    learning.observe(stereo_frame(1), steps=4)
    learning.rehearse(4)
    left, right = LEFT, RIGHT
    assert taken == [left, left, right, left, right, left, right, left]


def test_live_training_improves_both_eyes():
    learning = Reconstructor(
        dataclasses.replace(CONFIG, squared_error=True, history_s=2.0, preallocate=True),
        LEFT,
        live=LiveTraining(colour_relaxation=1.5),
    )
    for seq in range(4):
        learning.observe(stereo_frame(seq, with_depth=True), steps=20)
        learning.grow(stereo_frame(seq, with_depth=True))
        learning.rehearse(10)
    scene = learning.snapshot().at(0.1)
    for camera in (LEFT, RIGHT):
        assert psnr(inner(seen(camera, scene)[0]), inner(seen(camera)[0])) > 24, camera
