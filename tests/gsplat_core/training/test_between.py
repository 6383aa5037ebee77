"""State of an offline reconstruction between its frames and beyond its ends."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
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
def test_between_frames_the_scene_is_between_its_states_at_the_frames(moved, value):
    fps, model = moved
    at = lambda number: getattr(model.at(number / fps), value).flatten(1)
    changed = (at(11) - at(0)).norm(dim=1).median()
    for number in range(1, 10):
        off = (at(number + 0.5) - (at(number) + at(number + 1)) / 2).norm(dim=1).median()
        assert off < 0.1 * changed


def test_before_the_first_and_after_the_last_frame_the_scene_holds(moved):
    fps, model = moved
    assert torch.equal(model.at(-5.0).means, model.at(0.0).means)
    assert torch.equal(model.at(60.0).means, model.at(11 / fps).means)


def test_motion_is_resolved_no_finer_than_the_frames(moved):
    fps, model = moved
    finest_s = ReconstructorConfig.offline().motion_spacing_s
    # Columns are placed so that a whole number of them covers the recording.
    assert model.field.spacing_s == pytest.approx(max(SPACING_INTERVALS / fps, finest_s), rel=0.1)
    assert (model.field.spacing_s > 2 * finest_s) == (fps == 5)
