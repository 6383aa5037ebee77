"""Work on the second GPU while the first one is current: identical results, without allocations on the first."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gsplat_core import Camera, render
from gsplat_core.deformation import BasisField, DeformationField, HexPlaneField
from gsplat_core.rendering.alpha import FrameRenderer
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a second GPU"),
]

CAMERA = Camera.from_focal(90.0, 130, 90)


def basis(gaussians) -> DeformationField:
    field = BasisField(gaussians.count, (0.0, 1.0), bumps=6)
    torch.nn.init.normal_(field.weights, std=0.3)
    return field


def hexplane(gaussians) -> DeformationField:
    field = HexPlaneField(gaussians, (0.0, 1.0), channels=16, resolution=(6, 7, 5, 9), levels=(1, 2), width=32, depth=2)
    torch.nn.init.normal_(field.head.weight, std=0.3)
    return field


def on_both(work: Callable[[str], dict[str, Tensor]]) -> None:
    """`work` gives the same tensors on either device and leaves the first one current."""
    torch.cuda.set_device(0)
    wanted, seen = (work(device) for device in ("cuda:0", "cuda:1"))
    assert torch.cuda.current_device() == 0
    for name, tensor in seen.items():
        assert tensor.device.index == 1, name
        assert torch.equal(tensor.cpu(), wanted[name].cpu()), name


@pytest.mark.parametrize("make_field", [None, basis, hexplane])
@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_frames_on_second_device_equal_first_device(make_gaussians, make_field, precision):
    def frames(device: str) -> dict[str, Tensor]:
        torch.manual_seed(0)
        scene = make_gaussians(3000, sh_degree=2)
        # Large ones, so that the lists have to grow, too.
        scene.log_scales.add_(1.5)
        field = None if make_field is None else make_field(scene).to(device)
        renderer = FrameRenderer(scene.to(device), CAMERA, field, precision=precision)
        pictures = {}
        for time_s in (0.1, 0.9):
            for name, value in renderer.render(time_s=time_s).result()._asdict().items():
                pictures[f"{name} at {time_s}"] = value.clone()
        return pictures

    on_both(frames)


@pytest.mark.parametrize("make_field", [basis, hexplane])
def test_training_on_second_device_equals_first_device(make_gaussians, make_field):
    with torch.no_grad():
        seen = render(make_gaussians(600, seed=4), CAMERA)
    image = (seen.image.clamp(0, 1) * 255).round().to(torch.uint8)
    mask = torch.ones(CAMERA.height_px, CAMERA.width_px, dtype=torch.uint8)
    observation = Observation(seq=0, time_s=0.5, camera=CAMERA, image=image, mask=mask, depth=seen.depth)
    config = ReconstructorConfig(ssim_weight=0.2, depth_weight=0.1)

    def trained(device: str) -> dict[str, Tensor]:
        torch.manual_seed(0)
        scene = make_gaussians(2000, sh_degree=1)
        step = TrainingStep(scene.to(device), make_field(scene).to(device), config, CAMERA)
        losses = [step(observation) for _ in range(5)]
        step.settle(observation)
        field = {name: value.detach() for name, value in step.field.named_parameters()}
        return {"losses": torch.stack(losses), **step.gaussians.tensors(), **field}

    on_both(trained)
