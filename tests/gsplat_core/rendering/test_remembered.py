"""Share of a picture that shows remembered Gaussians, compared with the reference and with exact cases."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, reference
from gsplat_core.models import Model
from operators.display import share_of

CAMERA = Camera.from_focal(40.0, 37, 29)


def cloud(count: int, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=g)
    means = draw(count, 3) * torch.tensor([12.0, 9.0, 5.0]) + torch.tensor([0.0, 0.0, 40.0])
    return Gaussians(means, draw(count, 4), draw(count, 3) * 0.3 + 0.7, draw(count) + 1, draw(count, 4, 3))


@pytest.mark.parametrize("count", [0, 1, 200])
def test_share_of_equals_reference_image_of_selection_in_white(count):
    gaussians = cloud(count)
    chosen = torch.arange(count) % 3 == 0
    exact = gaussians.to(dtype=torch.float64)
    white = chosen.to(torch.float64)[:, None].expand(-1, 3)
    viewmat, intrinsics = CAMERA.matrices(exact.device, exact.dtype)
    image, alpha, _ = reference.rasterization(
        exact.means, exact.quats, exact.scales, exact.opacities, white, viewmat[None], intrinsics[None], 37, 29
    )
    alpha = alpha[0, ..., 0]
    wanted = torch.where(alpha > 0, image[0, ..., 0] / alpha.clamp(min=1e-6), 0)
    found = share_of(gaussians, chosen, CAMERA)
    there = alpha > 0.01
    assert found.shape == (29, 37)
    assert torch.allclose(found[there].double(), wanted[there], atol=2e-3)


def test_share_of_selection_and_complement_sum_to_one():
    gaussians = cloud(100)
    everyone = torch.ones(100, dtype=torch.bool)
    some = torch.arange(100) < 40
    assert share_of(gaussians, ~everyone, CAMERA).max() < 1e-5
    shown = share_of(gaussians, everyone, CAMERA) > 0
    both = share_of(gaussians, some, CAMERA) + share_of(gaussians, ~some, CAMERA)
    assert shown.float().mean() > 0.5 and torch.allclose(both[shown], torch.ones(()), atol=1e-3)
    with pytest.raises(InvalidInput, match="chosen"):
        share_of(gaussians, some[:5], CAMERA)


def wall(depth: float) -> Gaussians:
    """Opaque tissue across the view at one distance."""
    x, y = torch.meshgrid(torch.arange(-30.0, 31, 2), torch.arange(-30.0, 31, 2), indexing="xy")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), depth)], 1)
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(means, quats, torch.full((count, 3), 0.5), torch.full((count,), 8.0), torch.zeros(count, 1, 3))


def test_share_of_counts_visible_remembered_tissue_only():
    near, far = wall(40.0), wall(60.0)
    near = near.select(near.means[:, 0] < 0)
    scene = near.append(far)
    unseen_s = torch.cat([torch.zeros(near.count), torch.full((far.count,), 3.0)]).double()
    model = Model(1, scene, None, CAMERA, (0.0, 1.0), unseen_s=unseen_s)
    share = share_of(model.at(0.0), model.unseen_s > 0, CAMERA)
    assert share[:, :12].max() < 0.1 and share[:, -12:].min() > 0.99


def test_model_unseen_s_requires_value_per_gaussian():
    with pytest.raises(InvalidInput, match="unseen_s"):
        Model(1, wall(40.0), None, CAMERA, (0.0, 1.0), unseen_s=torch.zeros(3))
    model = Model(1, wall(40.0), None, CAMERA, (0.0, 1.0))
    known = dataclasses.replace(model, unseen_s=torch.ones(model.gaussian_count))
    assert known.sha256() == model.sha256() and known.parameter_count == model.parameter_count
