"""Training of a static scene, and gsplat's HexPlane field, on the GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.contrib import HexPlaneField
from gsplat_core.training.static import StaticConfig, StaticTrainer
from tests.gsplat_core.training.posed_pictures import posed_pictures


def trained(strategy, device, steps=20):
    trainer = StaticTrainer(
        *posed_pictures(), StaticConfig(steps, strategy, max_gaussians=66, sh_degree=1), device=device
    )
    for _ in range(steps):
        trainer.step()
    return trainer


def test_static_training_on_gpu_equals_cpu():
    own, other = (trained("none", device) for device in ("cuda", "cpu"))
    assert own.gaussians().device.type == "cuda"
    assert np.abs([own.psnr_db(k) - other.psnr_db(k) for k in range(5)]).max() < 0.05


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_static_training_with_same_seed_is_deterministic(strategy):
    first, second = (trained(strategy, "cuda").gaussians() for _ in range(2))
    assert first.count == second.count and torch.equal(first.means, second.means) and torch.equal(first.sh, second.sh)


def test_gsplat_hexplane_features_and_gradients_equal_cpu():
    torch.manual_seed(0)
    field = HexPlaneField(1.3, {"output_coordinate_dim": 5, "resolution": [6, 7, 8, 4]}, (1, 2))
    xyzt, weights = torch.rand(50, 4) * 3 - 1.5, torch.rand(50, 10)
    found = {}
    for device in ("cpu", "cuda"):
        field.to(device).zero_grad()
        features = field(xyzt.to(device))
        (features * weights.to(device)).sum().backward()
        planes = [*field.spatial_planes(), *field.temporal_planes()]
        found[device] = [value.detach().cpu().clone() for value in (features, *(plane.grad for plane in planes))]
    for own, other in zip(found["cuda"], found["cpu"], strict=True):
        assert (own - other).abs().max() < 1e-4 * max(1, float(other.abs().max()))
