"""Adam over the HexPlane's planes on CUDA, with and without penalties, against float64 autograd of the reference."""

import pytest
import torch

from gsplat_core.ops.frame import STATUS_OVERFLOW
from gsplat_core.ops.hexplane_training import AdamOnDevice, Penalties, hexplane_planes_adam_
from gsplat_core.reference import training
from gsplat_core.reference.training import adam_step
from tests.gsplat_core.cuda.hexplane_cases import Case

PENALTIES = {
    "none": Penalties(),
    "smoothness": Penalties(plane_smoothness=30.0),
    "in time": Penalties(time_smoothness=20.0, time_sparsity=5.0),
    "all": Penalties(10.0, 20.0, 5.0),
}


@pytest.mark.parametrize("penalties", PENALTIES.values(), ids=PENALTIES.keys())
@pytest.mark.parametrize(
    "shape",
    [{}, {"channels": 64, "levels": 1, "sizes": (70, 37, 40, 3)}, {"sizes": (2, 2, 2, 2)}, {"sizes": (1, 2, 1, 1)}],
)
def test_hexplane_planes_adam_equals_reference(gpu, shape, penalties):
    case = Case(n=90, **shape)
    ours = case.on(gpu)
    first, second = ([torch.zeros_like(p) for p in ours.planes] for _ in range(2))
    wanted = [
        [p.double() for p in case.planes],
        *([torch.zeros_like(p).double() for p in case.planes] for _ in range(2)),
    ]
    rate, step = torch.tensor([0.01], device=gpu), torch.zeros(1, dtype=torch.int64, device=gpu)
    for count in range(1, 4):
        step += 1
        state = ours.forward()
        gradient = ours.backward(state, ours.v_raw.clone())
        case.planes = [p.cpu() for p in ours.planes]
        gradients = case.exact()[2]
        leaves = [p.double().requires_grad_() for p in case.planes]
        space, time = ([p for i, p in enumerate(leaves) if (i % 6 < 3) == is_space] for is_space in (True, False))
        loss = penalties.time_smoothness * training.mean_over_planes(training.second_difference_in_time, time)
        loss = loss + penalties.time_sparsity * training.mean_over_planes(training.distance_from_one, time)
        loss = loss + penalties.plane_smoothness * training.mean_over_planes(training.total_variation, space)
        extra = torch.autograd.grad(loss, leaves, allow_unused=True)
        hexplane_planes_adam_(ours.planes, first, second, ours.time, gradient, AdamOnDevice(rate, step), penalties)
        for p, m, v, g, e in zip(*wanted, gradients, extra, strict=True):
            adam_step(p, g if e is None else g + e, m, v, count, 0.01)
        for actual, expected in zip((ours.planes, first, second), wanted, strict=True):
            for a, e in zip(actual, expected, strict=True):
                # A gradient near zero may have another sign, and Adam's first step is as long for it as for any other.
                close = (a.cpu().double() - e).abs() <= 1e-5 + 1e-3 * e.abs()
                assert close.double().mean() > 0.999


def test_hexplane_planes_adam_overflowed_frame_changes_nothing(gpu):
    case = Case(n=50).on(gpu)
    state = case.forward()
    gradient = case.backward(state, case.v_raw)
    first, second = ([torch.rand_like(p) for p in case.planes] for _ in range(2))
    before = [t.clone() for t in (*case.planes, *first, *second)]
    rate, step = torch.tensor([0.01], device=gpu), torch.ones(1, dtype=torch.int64, device=gpu)
    for penalties in (Penalties(), Penalties(1.0, 1.0, 1.0)):
        status = torch.tensor([9, 9, 1, 0], dtype=torch.int32, device=gpu)
        args = (case.planes, first, second, case.time, gradient, AdamOnDevice(rate, step, status))
        hexplane_planes_adam_(*args, penalties)
        assert all(torch.equal(a, b) for a, b in zip(before, (*case.planes, *first, *second), strict=True))
    status[STATUS_OVERFLOW] = 0
    hexplane_planes_adam_(*args)
    assert not any(torch.equal(a, b) for a, b in zip(before, (*case.planes, *first, *second), strict=True))


def test_hexplane_planes_adam_in_graph_follows_time_and_rate(gpu):
    case = Case(n=300).on(gpu)
    start = [p.clone() for p in case.planes]
    first, second = ([torch.zeros_like(p) for p in case.planes] for _ in range(2))
    controls, step = torch.zeros(3, device=gpu), torch.zeros(1, dtype=torch.int64, device=gpu)
    case.time, rate = controls[1:2], controls[2:3]

    def train():
        state, v_raw = case.forward(), case.v_raw.clone()
        gradient = case.backward(state, v_raw)
        hexplane_planes_adam_(case.planes, first, second, case.time, gradient, AdamOnDevice(rate, step))
        step.add_(1)

    def run(step_of):
        for tensors in (first, second):
            [t.zero_() for t in tensors]
        [p.copy_(s) for p, s in zip(case.planes, start, strict=True)]
        step.fill_(1)
        for time, speed in ((-0.5, 0.01), (0.8, 0.02)):
            controls.copy_(torch.tensor([0.0, time, speed]))
            step_of()
        return [p.clone() for p in case.planes]

    wanted = run(train)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        train()
    assert all(torch.equal(a, b) for a, b in zip(wanted, run(graph.replay), strict=True))
