"""The HexPlane field on CUDA: the same Gaussians as on the CPU, and its training without autograd."""

import pytest
import torch

from gsplat_core.deformation import HexPlaneField
from gsplat_core.deformation.hexplane import PLANE_NAMES, HexPlaneTraining
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.steps.optimiser import FusedAdam

WINDOW = (2.0, 4.0)
SIZES = {
    "small": {"channels": 32, "resolution": (6, 7, 5, 9), "levels": (1, 2), "width": 64, "depth": 3},
    "wide": {"channels": 64, "resolution": (6, 7, 5, 9), "levels": (1, 2, 4, 8), "width": 32, "depth": 2},
    "odd": {"channels": 10, "resolution": (2, 3, 2, 2), "levels": (1,), "width": 13, "depth": 1},
}


def gaussians(count):
    random = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(count, 3, generator=random),
        quats=torch.randn(count, 4, generator=random),
        log_scales=torch.randn(count, 3, generator=random),
        logit_opacities=torch.randn(count, generator=random),
        sh=torch.randn(count, 1, 3, generator=random),
    )


def moving_field(scene, sizes):
    torch.manual_seed(3)
    field = HexPlaneField(scene, WINDOW, **sizes)
    with torch.no_grad():
        field.head.weight.normal_(std=0.3)
        for level in field.planes:
            for name in PLANE_NAMES[3:]:
                level[name].add_(0.2 * torch.randn_like(level[name]))
    return field


@pytest.mark.parametrize("count", [0, 1, 500])
@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES.keys())
def test_hexplane_field_gaussians_equal_cpu(gpu, sizes, count):
    scene = gaussians(count)
    field = moving_field(scene, sizes)
    there, on_gpu = scene.to(gpu), field.detached_copy().to(gpu)
    for time_s in (1.0, 2.7, 4.0):
        with torch.no_grad():
            wanted = field(scene, time_s)
            seen = [on_gpu(there, time_s), on_gpu.cached(there)(time_s)]
        for ours in seen:
            for name, tensor in ours.tensors().items():
                torch.testing.assert_close(tensor.cpu(), wanted.tensors()[name], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES.keys())
def test_hexplane_field_frame_deltas_equal_forward_change(gpu, sizes):
    scene = gaussians(700)
    field = moving_field(scene, sizes)
    exact = moving_field(scene, sizes).double()
    on_gpu = field.detached_copy().to(gpu)
    time = torch.full((1,), field.frame_time(2.7))
    wanted = exact.frame_deltas(Gaussians(**{k: t.double() for k, t in scene.tensors().items()}))(time.double())
    limits = {torch.float32: 1e-5, torch.float16: 2e-3}
    for dtype, limit in limits.items():
        ours = on_gpu.frame_deltas(scene.to(gpu), dtype)(time.to(gpu)).cpu().double()
        assert float((ours - wanted).norm() / wanted.norm()) < limit
    here = field.frame_deltas(scene)(time)
    torch.testing.assert_close(here.double(), wanted, rtol=1e-4, atol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(scene.means + here[:, :3], field(scene, 2.7).means)


def test_hexplane_field_created_on_device_of_gaussians(gpu):
    scene = gaussians(20)
    torch.manual_seed(3)
    field = HexPlaneField(scene.to(gpu), WINDOW, **SIZES["small"])
    torch.manual_seed(3)
    same = HexPlaneField(scene, WINDOW, **SIZES["small"])
    for ours, wanted in zip(field.state_dict().values(), same.state_dict().values(), strict=True):
        assert ours.device.type == "cuda"
        torch.testing.assert_close(ours.cpu(), wanted)


@pytest.mark.parametrize("name", ["small", "wide"])
def test_hexplane_training_equals_autograd_and_adam(gpu, name):
    scene = gaussians(400)
    field = moving_field(scene, SIZES[name])
    on_gpu = field.detached_copy().to(gpu)
    there, training = scene.to(gpu), None
    training = HexPlaneTraining(on_gpu)
    adam = FusedAdam(dict(field.named_parameters()), rows=False)
    rates, step = torch.tensor([1e-3, 2e-4], device=gpu), torch.zeros(1, dtype=torch.int64, device=gpu)
    random = torch.Generator().manual_seed(5)
    for time_s in (2.2, 3.9, 2.5):
        v_raw = torch.randn(400, 16, generator=random)
        means = scene.means.clone().requires_grad_()
        canonical = Gaussians(**(scene.tensors() | {"means": means}))
        deformed = field(canonical, time_s)
        columns = {
            "means": v_raw[:, :3],
            "quats": v_raw[:, 3:7],
            "log_scales": v_raw[:, 7:10],
            "logit_opacities": v_raw[:, 13],
        }
        loss = sum((deformed.tensors()[key] * value).sum() for key, value in columns.items())
        loss.backward()
        adam.step(
            dict(field.named_parameters()),
            learning_rates={key: 1e-3 if key.startswith("planes") else 2e-4 for key, _ in field.named_parameters()},
        )
        for parameter in field.parameters():
            parameter.grad = None
        time, seen = torch.full((1,), field.frame_time(time_s), device=gpu), v_raw.to(gpu)
        training.deltas(there, time)
        step += 1
        training.update(seen, time, rates, step)
        torch.testing.assert_close(seen[:, :3].cpu(), means.grad, rtol=1e-2, atol=1e-2)
    for ours, wanted in zip(on_gpu.parameters(), field.parameters(), strict=True):
        # A gradient near zero may have another sign, and Adam's first steps are as long for it as for any other.
        close = (ours.detach().cpu() - wanted.detach()).abs() <= 1e-5
        assert close.double().mean() > 0.98


def test_hexplane_training_overflowed_frame_changes_nothing(gpu):
    scene = gaussians(50).to(gpu)
    field = moving_field(gaussians(50), SIZES["small"]).to(gpu)
    training = HexPlaneTraining(field)
    before = [t.clone() for t in training.tensors()]
    time, rates = torch.zeros(1, device=gpu), torch.full((2,), 0.1, device=gpu)
    training.deltas(scene, time)
    status = torch.tensor([5, 5, 1, 0], dtype=torch.int32, device=gpu)
    training.update(torch.randn(50, 16, device=gpu), time, rates, torch.ones(1, dtype=torch.int64, device=gpu), status)
    assert all(torch.equal(a, b) for a, b in zip(before, training.tensors(), strict=True))


def test_hexplane_training_rejects_unsupported_fields(gpu):
    with pytest.raises(InvalidInput, match="10 channels"):
        HexPlaneTraining(HexPlaneField(gaussians(3).to(gpu), WINDOW, **SIZES["odd"]))
    with pytest.raises(InvalidInput, match="on cpu"):
        HexPlaneTraining(HexPlaneField(gaussians(3), WINDOW, **SIZES["small"]))
    training = HexPlaneTraining(HexPlaneField(gaussians(3).to(gpu), WINDOW, **SIZES["small"]))
    with pytest.raises(InvalidInput, match="call deltas first"):
        training.gradient(torch.zeros(3, 16, device=gpu))
