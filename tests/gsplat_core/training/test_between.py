"""State of a reconstruction between its frames and beyond its ends."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.offline import SPACING_INTERVALS
from gsplat_core.training.reconstructor import Reconstructor

WIDTH, HEIGHT = 96, 64
CAMERA = Camera(K=np.array([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]]), width_px=WIDTH, height_px=HEIGHT)


def pictures(count: int, px_per_frame: float, noise: float) -> list[np.ndarray]:
    """Return smooth texture that moves to the right, with independent noise in each picture."""
    random = np.random.default_rng(3)
    texture = cv2.GaussianBlur(random.uniform(0, 255, (HEIGHT, WIDTH + 200, 3)), (0, 0), 3)
    texture = (texture - texture.mean()) * 6 + 128
    found = []
    for number in range(count):
        x = np.arange(WIDTH, dtype=np.float32)[None] + np.float32(100 - number * px_per_frame)
        y = np.arange(HEIGHT, dtype=np.float32)[:, None]
        moved = cv2.remap(texture.astype(np.float32), *np.broadcast_arrays(x, y), cv2.INTER_LINEAR)
        found.append((moved + noise * random.standard_normal(moved.shape)).clip(0, 255).astype(np.uint8))
    return found


@pytest.fixture(scope="module", params=[5, 30], ids=["5 frames/s", "30 frames/s"])
def moved(request):
    """A model of texture that moves by 1 px per frame and gets brighter: its frame rate, and the model."""
    fps, images = request.param, pictures(12, 1.0, 0.0)
    frames = [
        Frame(n, round(n * 1e9 / fps), (image * (0.5 + 0.04 * n)).astype(np.uint8)) for n, image in enumerate(images)
    ]
    config = replace(ReconstructorConfig.offline(), gaussians=300, max_gaussians=400)
    learning = Reconstructor(config, CAMERA)
    learning.fit(frames, 100)
    return fps, learning.snapshot()


@pytest.mark.parametrize("value", ["means", "sh"])
def test_model_between_frames_interpolates_frame_states(moved, value):
    fps, model = moved
    at = lambda number: getattr(model.at(number / fps), value).flatten(1)
    changed = (at(11) - at(0)).norm(dim=1).median()
    for number in range(1, 10):
        off = (at(number + 0.5) - (at(number) + at(number + 1)) / 2).norm(dim=1).median()
        assert off < 0.1 * changed


def test_model_outside_time_window_holds_end_states(moved):
    fps, model = moved
    assert torch.equal(model.at(-5.0).means, model.at(0.0).means)
    assert torch.equal(model.at(60.0).means, model.at(11 / fps).means)


def test_offline_motion_spacing_is_not_finer_than_frames(moved):
    fps, model = moved
    finest_s = ReconstructorConfig.offline().motion_spacing_s
    # Columns are placed so that a whole number of them covers the recording.
    assert model.field.spacing_s == pytest.approx(max(SPACING_INTERVALS / fps, finest_s), rel=0.1)
    assert (model.field.spacing_s > 2 * finest_s) == (fps == 5)


def irregular_frames(seed: int) -> list[Frame]:
    """Frames with gaps of up to 12 frame intervals, noise, and depth that differs by 6 % from frame to frame."""
    random = np.random.default_rng(seed)
    numbers = np.concatenate([[0], np.cumsum(random.choice([1, 1, 1, 2, 5, 12], 7))])
    images = pictures(int(numbers[-1]) + 1, float(random.uniform(-1.5, 1.5)), float(random.uniform(0, 6)))
    frames = []
    for seq, number in enumerate(numbers.tolist()):
        depth = np.full((HEIGHT, WIDTH), 50 + 8 * np.sin(0.3 * number) + random.normal(0, 3), np.float32)
        frame = Frame(
            seq, round(number * 1e9 / 30), images[number], depth=depth, depth_origin=DEPTH_ORIGINS["measured"]
        )
        frames.append(frame)
    return frames


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("field", "is_offline"), [("basis", True), ("basis", False), ("hexplane", True)])
def test_model_stays_near_frame_states_for_irregular_frames(field, is_offline, seed):
    frames = irregular_frames(seed)
    if is_offline:
        config = replace(ReconstructorConfig.offline(field), gaussians=300, max_gaussians=400)
        learning = Reconstructor(config, CAMERA)
        learning.fit(frames, 80)
    else:
        config = ReconstructorConfig(
            field=field, gaussians=300, max_gaussians=400, first_frame_steps=30, steps_per_frame=8
        )
        learning = Reconstructor(config, CAMERA)
        for frame in frames:
            learning.observe(frame)
    model = learning.snapshot()
    times_s = [frame.time_s for frame in frames]
    between_s = np.concatenate(
        [np.linspace(times_s[0] - 1, times_s[-1] + 1, 20), np.linspace(times_s[0], times_s[-1], 60)]
    )
    for value, margin in (("means", 3.0), ("log_scales", 0.1)):
        seen, shown = (
            torch.stack([getattr(model.at(float(at)), value) for at in each]) for each in (times_s, between_s)
        )
        low, high = seen.amin(0), seen.amax(0)
        beyond = torch.maximum(shown - high, low - shown).amax(0)
        assert (beyond <= 0.5 * (high - low) + margin).all()
