"""Gaussians are added where tissue is uncovered, and nowhere else."""

import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import uncovered_tissue
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation

CONFIG = ReconstructorConfig(gaussians=400, default_depth_mm=60.0)


def left_part(frame, camera, width_px=30, depth_mm=60.0):
    """Gaussians over the left `width_px` columns only."""
    whole = gaussians_from_frame(frame, camera, 400, sh_degree=0, default_depth_mm=depth_mm)
    column = whole.means[:, 0] / whole.means[:, 2] * 50 + 24
    return whole.select(column < width_px)


def grown(frame, camera, current, room=10_000, config=CONFIG):
    observation = Observation.of(frame, camera, current.device)
    found = uncovered_tissue(observation, current, has_depth=frame.depth is not None)
    return None if found is None else found.gaussians(frame, observation, config, room)


def columns_of(gaussians):
    return gaussians.means[:, 0] / gaussians.means[:, 2] * 50 + 24


def test_growth_adds_nothing_to_covered_frame(make_frame, camera):
    frame = make_frame()
    assert grown(frame, camera, left_part(frame, camera, 48)) is None


def test_growth_covers_uncovered_tissue_at_first_frame_density(make_frame, camera):
    frame = make_frame()
    current = left_part(frame, camera)
    added = grown(frame, camera, current)
    assert float(columns_of(added).min()) > 28
    assert added.count == pytest.approx(400 * 18 / 48, rel=0.2)
    together = render(current.append(added), camera)
    assert float(together.alpha.min()) > 0.5
    assert grown(frame, camera, current.append(added)) is None


def test_growth_ignores_pixels_under_tool(make_frame, camera):
    mask = np.ones((40, 48), np.uint8)
    mask[:20] = 0
    frame = make_frame(mask=mask)
    added = grown(frame, camera, left_part(frame, camera))
    rows = added.means[:, 1] / added.means[:, 2] * 50 + 20
    assert float(rows.min()) >= 20
    mask[:] = 0
    assert grown(make_frame(mask=mask), camera, left_part(frame, camera)) is None


@pytest.mark.parametrize("room", [1, 10, 50])
def test_growth_is_limited_by_room(make_frame, camera, room):
    frame = make_frame()
    added = grown(frame, camera, left_part(frame, camera), room=room)
    assert 0.5 * room <= added.count <= room


def test_growth_ignores_few_uncovered_pixels(make_frame, camera):
    frame = make_frame()
    whole = left_part(frame, camera, 48)
    mask = np.zeros((40, 48), np.uint8)
    mask[5:6, 40:43] = 1  # 3 of 1920 pixels, less than the smallest share
    current = left_part(frame, camera)
    assert grown(make_frame(mask=mask), camera, current) is None
    mask[5:8, 40:43] = 1
    assert grown(make_frame(mask=mask), camera, current) is not None
    assert grown(make_frame(mask=mask), camera, whole) is None


def test_growth_takes_depth_of_neighbours_without_frame_depth(make_frame, camera):
    frame = make_frame()
    added = grown(frame, camera, left_part(frame, camera, depth_mm=85.0))
    torch.testing.assert_close(added.means[:, 2], torch.full((added.count,), 85.0), rtol=0.02, atol=0)


def test_growth_takes_measured_depth(make_frame, camera):
    frame = make_frame(depth=np.full((40, 48), 47.0, np.float32))
    added = grown(frame, camera, left_part(frame, camera))
    torch.testing.assert_close(added.means[:, 2], torch.full((added.count,), 47.0))


def test_growth_of_empty_model_uses_default_plane(make_frame, camera):
    frame = make_frame()
    nothing = left_part(frame, camera, -100)
    assert nothing.count == 0
    added = grown(frame, camera, nothing)
    assert added.count == pytest.approx(400, rel=0.15)
    torch.testing.assert_close(added.means[:, 2], torch.full((added.count,), 60.0))


def test_growth_takes_colours_of_picture(make_frame, camera):
    frame = make_frame()
    current = left_part(frame, camera)
    picture = render(current.append(grown(frame, camera, current)), camera).image[:, 32:]
    target = torch.from_numpy(frame.image[:, 32:]).float() / 255
    assert float((picture - target).abs().mean()) < 0.1


@pytest.mark.cuda
@pytest.mark.parametrize("depth_mm", [None, 47.0])
def test_growth_on_cuda_equals_cpu(gpu, make_frame, camera, depth_mm):
    frame = make_frame(depth=None if depth_mm is None else np.full((40, 48), depth_mm, np.float32))
    current = left_part(frame, camera, depth_mm=85.0)
    expected, added = grown(frame, camera, current), grown(frame, camera, current.to(gpu))
    assert added.device == gpu
    for name, tensor in added.tensors().items():
        torch.testing.assert_close(tensor.cpu(), expected.tensors()[name], rtol=1e-3, atol=1e-3)
    assert grown(frame, camera, current.append(expected).to(gpu)) is None
