"""Offline reconstruction of a pair that stands still: depth that differs from frame to frame without a reason moves nothing far."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.offline import steady_course
from gsplat_core.training.reconstructor import Reconstructor
from tests.gsplat_core.training.two_eyes import LEFT, stereo_frame

NEAREST_MM = 48.0
"""Smallest distance of the surface in millimetres."""


def still_frames(count: int, wrong_in: tuple[int, ...], factor: float) -> list[Frame]:
    """Equal frames; a block of the depth of some of them is wrong, as matched depth is where tissue has no texture."""
    frames = []
    for seq in range(count):
        frame = stereo_frame(seq, with_depth=True)
        if seq in wrong_in:
            depth = frame.depth.copy()
            depth[10:38, 12:50] *= factor
            frame = frame.with_fields(depth=depth)
        frames.append(frame)
    return frames


def fitted(frames: list[Frame], steps: int = 60) -> Reconstructor:
    config = ReconstructorConfig(
        field="basis", gaussians=700, max_gaussians=900, squared_error=True, motion_spacing_s=0.05, eyes="both"
    )
    learning = Reconstructor(config, LEFT)
    learning.fit(frames, steps)
    return learning


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.25, 30.0], ids=["too near", "too far"])
@pytest.mark.parametrize(
    "count, wrong_in",
    [(2, (1,)), (3, (0,)), (3, (1,)), (5, (4,)), (5, (1, 3)), (8, (0,)), (8, (2, 5, 7))],
)
def test_still_pair_with_wrong_depth_keeps_gaussians_in_depth_range(
    count: int, wrong_in: tuple[int, ...], factor: float
) -> None:
    frames = still_frames(count, wrong_in, factor)
    model = fitted(frames).snapshot()
    farthest_mm = 64.0 * max(factor, 1.0)
    for time_s in np.linspace(frames[0].time_s, frames[-1].time_s, 4 * count + 1):
        depth = model.at(float(time_s)).means[:, 2]
        # A wrong depth may be taken for the truth in its own frame, and nothing beyond it.
        assert depth.min() > 0.6 * min(factor, 1.0) * NEAREST_MM
        assert depth.max() < 1.4 * farthest_mm


@pytest.mark.slow
def test_still_pair_looks_same_between_frames() -> None:
    """Depth of one frame of seven is wrong; the frame that was held out, and all times between, show the same picture."""
    frames = still_frames(8, (3,), 0.25)
    held_out = frames.pop(1)
    model = fitted(frames, steps=150).snapshot()
    picture = torch.from_numpy(held_out.image) / 255
    scores = [
        psnr_tissue_db(render(model.at(float(time_s)), LEFT).image.clamp(0, 1).numpy(), picture.numpy())
        for time_s in np.linspace(frames[0].time_s, frames[-1].time_s, 15)
    ]
    assert min(scores) > max(scores) - 3.0 and max(scores) > 24.0


@pytest.mark.slow
def test_pair_moving_in_one_frame_keeps_gaussians_in_depth_range() -> None:
    frames = [stereo_frame(seq, with_depth=True) for seq in range(6)]
    moved = frames[3]
    frames[3] = moved.with_fields(
        image=np.roll(moved.image, 3, axis=1),
        right_image=np.roll(moved.right_image, 3, axis=1),
        depth=moved.depth * 0.8,
    )
    model = fitted(frames).snapshot()
    for time_s in np.linspace(0, frames[-1].time_s, 21):
        depth = model.at(float(time_s)).means[:, 2]
        assert depth.min() > 0.6 * 0.8 * NEAREST_MM and depth.max() < 90


TIMES = torch.arange(16.0) / 30


def test_steady_course_keeps_smooth_motion() -> None:
    course = 60 + 5 * torch.sin(2 * torch.pi * 1.5 * TIMES)[None]
    kept = steady_course(course, TIMES)
    torch.testing.assert_close(kept, course, rtol=0, atol=0.2)


@pytest.mark.parametrize(
    "course",
    [
        [50.0, 900, 50, 900, 50, 900, 50, 900],
        [50.0, 50, 50, 50, 900, 50, 50, 50],
        [50.0, 50],
        [50.0, 900],
        [50.0],
    ],
)
def test_steady_course_replaces_noise_by_median(course: list[float]) -> None:
    kept = steady_course(torch.tensor([course]), TIMES[: len(course)])
    torch.testing.assert_close(kept, torch.full_like(kept, float(torch.tensor(course).median())))


def test_steady_course_stays_within_measured_range() -> None:
    random = torch.Generator().manual_seed(3)
    courses = torch.rand(200, 9, generator=random) ** 6 * 1000 + 1
    times = torch.rand(9, generator=random).cumsum(0)
    kept = steady_course(courses, times)
    assert (kept >= courses.amin(1, keepdim=True) * (1 - 1e-5)).all()
    assert (kept <= courses.amax(1, keepdim=True) * (1 + 1e-5)).all()


@pytest.mark.parametrize("times_s", [(0.0, 0.07, 0.1, 0.13, 0.17, 0.2, 0.23), (0.0, 0.23), (0.1,), (0.0, 0.02, 0.23)])
def test_basis_field_follow_is_bounded_between_and_beyond_frames(times_s: tuple[float, ...]) -> None:
    random = torch.Generator().manual_seed(5)
    field = BasisField(50, (0.0, 0.23), bumps=8)
    offsets = torch.rand(50, len(times_s), 3, generator=random) ** 8 * 2000
    field.follow(slice(0, 50), times_s, offsets)
    low, high = offsets.amin(1), offsets.amax(1)
    beyond = 0.3 * (high - low) + 0.02 * high
    for time_s in np.linspace(-0.1, 0.4, 51):
        added = field.deltas(float(time_s)).detach()[:, :3]
        assert (added <= high + beyond).all()
        assert (added >= torch.minimum(low, torch.zeros_like(low)) - beyond).all()


def test_basis_field_follow_fits_smooth_course() -> None:
    field, times_s = BasisField(1, (0.0, 1.0), bumps=23), np.linspace(0, 1, 31)
    offsets = torch.from_numpy(4 * np.sin(2 * np.pi * 1.5 * times_s)).float()[None, :, None].repeat(1, 1, 3)
    field.follow(slice(0, 1), times_s.tolist(), offsets)
    found = torch.stack([field.deltas(float(t)).detach()[0, :3] for t in times_s])
    assert (found - offsets[0]).abs().max() < 0.3
