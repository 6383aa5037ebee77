"""Tissue that a moving camera brings into view is added before training on the frame."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import NewTissue, around_cells, entered, has_moved
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining

WIDTH, HEIGHT, FOCAL, DEPTH_MM = 48, 40, 50.0, 60.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
WALL = cv2.resize(
    np.random.default_rng(3).uniform(40, 215, (8, 60, 3)).astype(np.float32),
    (480, HEIGHT),
    interpolation=cv2.INTER_CUBIC,
)


def seen_from(column):
    pose = np.eye(4)
    pose[0, 3] = -column * DEPTH_MM / FOCAL
    return CAMERA.with_pose(pose)


def frame_at(seq, column, **fields):
    image = np.clip(np.rint(WALL[:, column : column + WIDTH]), 0, 255).astype(np.uint8)
    return Frame(seq, round(seq * 1e9 / 30), image, pose=seen_from(column).world_to_camera, **fields)


def wall_of(columns, rows=range(HEIGHT)):
    """A Gaussian for each pixel of the wall in these columns and rows."""
    u, v = np.meshgrid(np.array(columns) + 0.5, np.array(rows) + 0.5)
    points = np.stack([u.ravel() - WIDTH / 2, v.ravel() - HEIGHT / 2, np.full(u.size, FOCAL)], -1) * DEPTH_MM / FOCAL
    means = torch.tensor(points, dtype=torch.float32)
    one = torch.ones(len(means), 4)
    return Gaussians(means, one, one[:, :3], one[:, 0], torch.zeros(len(means), 1, 3))


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_entered_marks_pixels_outside_previous_view(model):
    before = Camera(CAMERA.K, WIDTH, HEIGHT, model=model)
    after = before.with_pose(seen_from(10).world_to_camera)
    pixels = np.array([[5.5, 20.5], [30.5, 20.5], [36.5, 20.5], [46.5, 20.5]])
    assert entered(pixels, after, before, DEPTH_MM).tolist() == [False, False, False, True]
    assert entered(pixels, after, before, DEPTH_MM, edge_px=4).tolist() == [False, False, True, True]
    assert not entered(pixels, before, before, DEPTH_MM).any()


def test_around_cells_returns_count_and_depth():
    count, depth = around_cells(wall_of(range(WIDTH)), CAMERA, 4.0, (10, 12))
    assert count.shape == depth.shape == (10, 12)
    assert float(count[5, 5]) == 9 * 16
    torch.testing.assert_close(depth, torch.full_like(depth, DEPTH_MM))
    nothing = wall_of(range(WIDTH)).select(slice(0, 0))
    count, depth = around_cells(nothing, CAMERA, 4.0, (10, 12))
    assert not count.any() and not depth.any()


def test_has_moved_from_a_fiftieth_of_picture_width():
    step_mm = 0.02 * CAMERA.width_px * DEPTH_MM / float(CAMERA.K[0, 0])
    for share, expected in ((0.0, False), (0.9, False), (1.1, True)):
        pose = np.eye(4)
        pose[1, 3] = share * step_mm
        assert has_moved(CAMERA.with_pose(pose), CAMERA, DEPTH_MM) is expected


def test_new_tissue_unfilled_cells_are_entered_and_uncovered():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:12] = 0
    observation = Observation.of(frame_at(1, 16, mask=mask), CAMERA)
    new = NewTissue(observation, CAMERA, 4.0, DEPTH_MM)
    assert new
    wanted, depth_mm = new.unfilled(wall_of(range(WIDTH)), observation.mask)
    assert wanted[:, 0].min() > 36 and wanted[:, 1].min() > 12 and len(wanted) == 3 * 7
    assert depth_mm.shape == (HEIGHT, WIDTH) and depth_mm[0, 0] == pytest.approx(DEPTH_MM)
    marks = new.pixels(wall_of(range(WIDTH)))
    assert marks.shape == (HEIGHT, WIDTH) and bool(marks[:, 36:].all()) and not bool(marks[:, :36].any())
    everything = wall_of(range(WIDTH + 20))
    assert len(new.unfilled(everything, observation.mask)[0]) == 0 and not new.pixels(everything).any()


@pytest.mark.slow
@pytest.mark.parametrize(("pixels_a_frame", "frames"), [(1, 60), (4, 60)])
def test_moving_camera_adds_gaussians_and_keeps_score(device, pixels_a_frame, frames):
    config = ReconstructorConfig(
        gaussians=300, max_gaussians=6000, window_frames=20, motion_spacing_s=0.1, history_s=1.0, preallocate=True,
        default_depth_mm=DEPTH_MM,
    )  # fmt: skip
    made = Reconstructor(config, CAMERA, live=LiveTraining(first_rate=1.0, last_rate=1.0), device=device)
    columns = [0] * 15 + [pixels_a_frame * k for k in range(frames)]
    scores = []
    for seq, column in enumerate(columns):
        frame = frame_at(seq, column)
        made.observe(frame, budget=Budget.of_steps(8))
        made.grow(frame)
        image = made.snapshot().render(frame.time_s, CAMERA.with_pose(frame.pose)).image.clamp(0, 1)
        scores.append(psnr_tissue_db((image * 255).round().to(torch.uint8).cpu().numpy(), frame.image))
    pictures = 1 + column / WIDTH
    assert np.mean(scores[-10:]) > 26
    assert 300 * pictures * 0.6 < made.gaussians < 300 * pictures * 1.5
