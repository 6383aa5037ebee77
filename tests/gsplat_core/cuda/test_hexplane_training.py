"""Training of the HexPlane field on CUDA against float64 autograd of the reference."""

import itertools

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane.plain_torch import PLANE_AXES
from gsplat_core.ops.hexplane.training import (
    Penalties,
    hexplane_planes_adam_,
    hexplane_planes_gradient,
    hexplane_train,
    hexplane_train_backward,
)
from gsplat_core.reference import plane_penalties
from gsplat_core.reference.adam import adam_step
from gsplat_core.scene.layout import HEAD_COLUMNS

pytestmark = pytest.mark.cuda

BOX = torch.tensor([[-2.0, -1.0, 0.5], [2.0, 3.0, 1.5]])


def random(seed):
    return torch.Generator().manual_seed(seed)


class Case:
    """A field on the CPU in float32, Gaussians around its box, and a gradient of the deltas."""

    def __init__(
        self, n=700, channels=32, levels=2, width=32, depth=2, sizes=(9, 7, 8, 5), time=0.37, seed=0, spread=1.1
    ):
        generator = random(seed)
        self.means = BOX.mean(0) + spread * (BOX[1] - BOX[0]) * (torch.rand(n, 3, generator=generator) - 0.5)
        self.time = torch.tensor([time])
        self.planes = [
            0.6 + torch.rand(grid[v], grid[u], channels, generator=generator)
            for grid in ([s * (l + 1) for s in sizes[:3]] + [sizes[3]] for l in range(levels))
            for u, v in PLANE_AXES
        ]
        pairs = list(itertools.pairwise([channels * levels] + [width] * depth + [11]))
        self.weights = [torch.randn(b, a, generator=generator) / a**0.5 for a, b in pairs]
        self.biases = [0.1 * torch.randn(b, generator=generator) for _, b in pairs]
        self.v_raw = torch.randn(n, 16, generator=generator)

    def exact(self):
        """Deltas, and gradients of the means, the planes and the network, in float64."""
        means, planes, weights, biases = (
            [t.double().requires_grad_() for t in group]
            for group in ([self.means], self.planes, self.weights, self.biases)
        )
        low, high = BOX.double()
        space = (2 * (means[0] - low) / (high - low) - 1).clamp(-1, 1)
        x = torch.cat([space, self.time.double().expand(space.shape[0], 1)], dim=1)
        levels = [reference.hexplane_features(x, *planes[i : i + 6]) for i in range(0, len(planes), 6)]
        outputs = reference.hexplane_decode(levels, x, [], weights, biases)
        deltas = outputs.new_zeros(outputs.shape[0], 16)
        deltas[:, HEAD_COLUMNS] = outputs
        deltas.backward(self.v_raw.double())
        network = torch.cat([t.grad.flatten() for pair in zip(weights, biases, strict=True) for t in pair])
        return deltas.detach(), means[0].grad, [p.grad for p in planes], network

    def on(self, device):
        names = ("means", "planes", "weights", "biases", "time", "v_raw")
        out = object.__new__(Case)
        for name in names:
            value = getattr(self, name)
            setattr(
                out, name, [t.to(device) for t in value] if isinstance(value, list) else value.to(device, copy=True)
            )
        out.box = BOX.to(device)
        return out

    def forward(self):
        return hexplane_train(self.means, self.box, self.time, self.planes, self.weights, self.biases)

    def backward(self, state, v_raw):
        return hexplane_train_backward(v_raw, self.box, state, self.planes, self.weights, self.biases)


def relative(actual, wanted):
    return float((actual.cpu().double() - wanted).norm() / wanted.norm().clamp(min=1e-12))


CASES = {
    "one level": {"levels": 1},
    "four levels of 64 channels": {"channels": 64, "levels": 4},
    "none": {"n": 0},
    "one": {"n": 1},
    "64 wide": {"width": 64, "depth": 3},
    "128 wide": {"width": 128, "depth": 1},
    "odd width": {"width": 27, "depth": 4},
    "48 channels": {"channels": 48, "width": 33},
    "resolution 2": {"sizes": (2, 2, 2, 2)},
    "resolution 1": {"sizes": (1, 2, 1, 1)},
    "at the end of time": {"time": 1.0},
    "beyond the end of time": {"time": 1.5},
    "all in one cell": {"spread": 0.01, "n": 3000},
    "crowded cells": {"sizes": (4, 3, 5, 3), "n": 2000},
    "crowded cells of 48 channels": {"sizes": (4, 3, 5, 3), "n": 1500, "channels": 48},
    "crowded cells of 80 channels": {"sizes": (4, 3, 5, 3), "n": 1500, "channels": 80, "levels": 1},
    "nearly all outside": {"spread": 30.0},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_deltas_and_gradients_equal_the_reference(gpu, case):
    case = Case(**case)
    deltas, v_means, v_planes, network = case.exact()
    ours = case.on(gpu)
    state = ours.forward()
    assert relative(state.deltas, deltas) < 1e-5
    v_raw = ours.v_raw.clone()
    gradient = ours.backward(state, v_raw)
    assert torch.equal(v_raw[:, 3:], ours.v_raw[:, 3:])
    assert relative(gradient.network, network) < 1e-4
    added = v_raw[:, :3].cpu().double() - case.v_raw[:, :3].double()
    assert float((added - v_means).norm()) <= 1e-4 * float(v_means.norm()) + 1e-6 * float(case.v_raw.norm())
    for seen, wanted in zip(hexplane_planes_gradient(ours.time, gradient, ours.planes), v_planes, strict=True):
        assert relative(seen, wanted) < 1e-4


def shifted(tensor):
    """The same values, a float behind what is aligned."""
    return torch.cat([tensor.new_zeros(1), tensor.flatten()])[1:].view(tensor.shape)


@pytest.mark.parametrize("penalties", [Penalties(), Penalties(10.0, 20.0, 5.0)])
def test_planes_may_start_anywhere_in_memory(gpu, penalties):
    case = Case(n=300)
    ours = case.on(gpu)
    ours.planes = [shifted(p) for p in ours.planes]
    deltas, _, v_planes, network = case.exact()
    state = ours.forward()
    gradient = ours.backward(state, ours.v_raw.clone())
    assert relative(state.deltas, deltas) < 1e-5
    assert relative(gradient.network, network) < 1e-4
    for seen, wanted in zip(hexplane_planes_gradient(ours.time, gradient, ours.planes), v_planes, strict=True):
        assert relative(seen, wanted) < 1e-4
    first, second = ([torch.zeros_like(p) for p in ours.planes] for _ in range(2))
    rate, step = torch.tensor([0.01], device=gpu), torch.ones(1, dtype=torch.int64, device=gpu)
    aligned = [p.clone() for p in ours.planes]
    others = [[torch.zeros_like(p) for p in ours.planes] for _ in range(2)]
    elsewhere = gradient._replace(rows=shifted(gradient.rows))
    for seen, wanted in zip(hexplane_planes_gradient(ours.time, elsewhere, ours.planes), v_planes, strict=True):
        assert relative(seen, wanted) < 1e-4
    hexplane_planes_adam_(ours.planes, first, second, ours.time, gradient, rate, step, penalties=penalties)
    hexplane_planes_adam_(aligned, *others, ours.time, gradient, rate, step, penalties=penalties)
    for seen, wanted in zip(ours.planes, aligned, strict=True):
        # A gradient near zero may have another sign, and Adam's first step is as long for it as for any other.
        assert ((seen - wanted).abs() <= 1e-6 + 1e-5 * wanted.abs()).float().mean() > 0.999


def test_the_same_bits_every_time(gpu):
    case = Case(n=5000, channels=64).on(gpu)
    results = []
    for _ in range(2):
        state, v_raw = case.forward(), case.v_raw.clone()
        gradient = case.backward(state, v_raw)
        left = (
            gradient.network,
            gradient.rows,
            gradient.starts,
            gradient.v_lines,
        )  # crowds has places that nobody writes
        results.append([*state, v_raw, *left, *hexplane_planes_gradient(case.time, gradient, case.planes)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_what_is_not_finite_takes_no_part(gpu):
    case = Case(n=60)
    case.means[3, 1] = float("nan")
    case.means[4, 0] = float("inf")
    case.v_raw[[3, 4]] = 0
    case.v_raw[7, 5] = float("nan")
    ours = case.on(gpu)
    state = ours.forward()
    v_raw = ours.v_raw.clone()
    gradient = ours.backward(state, v_raw)
    case.means[[3, 4]] = 0
    case.v_raw[7] = 0
    _, _, v_planes, network = case.exact()
    assert relative(gradient.network, network) < 1e-4
    for seen, wanted in zip(hexplane_planes_gradient(ours.time, gradient, ours.planes), v_planes, strict=True):
        assert relative(seen, wanted) < 1e-4
    assert (v_raw[[3, 4], :3] == 0).all()


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
def test_adam_over_the_planes_equals_the_reference(gpu, shape, penalties):
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
        loss = penalties.time_smoothness * plane_penalties.mean_over_planes(
            plane_penalties.second_difference_in_time, time
        )
        loss = loss + penalties.time_sparsity * plane_penalties.mean_over_planes(
            plane_penalties.distance_from_one, time
        )
        loss = loss + penalties.plane_smoothness * plane_penalties.mean_over_planes(
            plane_penalties.total_variation, space
        )
        extra = torch.autograd.grad(loss, leaves, allow_unused=True)
        hexplane_planes_adam_(ours.planes, first, second, ours.time, gradient, rate, step, penalties=penalties)
        for p, m, v, g, e in zip(*wanted, gradients, extra, strict=True):
            adam_step(p, g if e is None else g + e, m, v, count, 0.01)
        for actual, expected in zip((ours.planes, first, second), wanted, strict=True):
            for a, e in zip(actual, expected, strict=True):
                # A gradient near zero may have another sign, and Adam's first step is as long for it as for any other.
                close = (a.cpu().double() - e).abs() <= 1e-5 + 1e-3 * e.abs()
                assert close.double().mean() > 0.999


def test_a_cut_frame_changes_nothing(gpu):
    case = Case(n=50).on(gpu)
    state = case.forward()
    gradient = case.backward(state, case.v_raw)
    first, second = ([torch.rand_like(p) for p in case.planes] for _ in range(2))
    before = [t.clone() for t in (*case.planes, *first, *second)]
    rate, step = torch.tensor([0.01], device=gpu), torch.ones(1, dtype=torch.int64, device=gpu)
    for penalties in (Penalties(), Penalties(1.0, 1.0, 1.0)):
        status = torch.tensor([9, 9, 1, 0], dtype=torch.int32, device=gpu)
        args = (case.planes, first, second, case.time, gradient, rate, step)
        hexplane_planes_adam_(*args, status=status, penalties=penalties)
        assert all(torch.equal(a, b) for a, b in zip(before, (*case.planes, *first, *second), strict=True))
    status[2] = 0
    hexplane_planes_adam_(*args, status=status)
    assert not any(torch.equal(a, b) for a, b in zip(before, (*case.planes, *first, *second), strict=True))


def test_a_step_in_a_graph_follows_time_and_rate(gpu):
    case = Case(n=300).on(gpu)
    start = [p.clone() for p in case.planes]
    first, second = ([torch.zeros_like(p) for p in case.planes] for _ in range(2))
    controls, step = torch.zeros(3, device=gpu), torch.zeros(1, dtype=torch.int64, device=gpu)
    case.time, rate = controls[1:2], controls[2:3]

    def train():
        state, v_raw = case.forward(), case.v_raw.clone()
        gradient = case.backward(state, v_raw)
        hexplane_planes_adam_(case.planes, first, second, case.time, gradient, rate, step)
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


def test_wrong_input_is_refused(gpu):
    case = Case(n=5).on(gpu)
    with pytest.raises(InvalidInput, match="float64"):
        hexplane_train(case.means.double(), case.box, case.time, case.planes, case.weights, case.biases)
    with pytest.raises(RuntimeError, match="train with autograd"):
        other = Case(n=5, channels=20).on(gpu)
        other.forward()
    with pytest.raises(RuntimeError, match="do not share one grid"):
        hexplane_train(case.means, case.box, case.time, [*case.planes[:5], case.planes[0]], case.weights, case.biases)


def test_ops_pass_opcheck(gpu):
    ops, case = torch.ops.gsplat_core, Case(n=5, levels=1).on(gpu)
    state = case.forward()
    gradient = case.backward(state, case.v_raw.clone())
    network = (case.planes, case.weights, case.biases)
    torch.library.opcheck(ops.hexplane_train.default, (case.means, case.box, case.time, *network))
    # Not all of the crowds' sums are written, so two runs cannot be compared.
    utilities = ("test_schema", "test_autograd_registration", "test_faketensor")
    arguments = (case.v_raw, case.box, *state[1:], *network)
    torch.library.opcheck(ops.hexplane_train_backward.default, arguments, test_utils=utilities)
    factored = (gradient.rows, gradient.shares, gradient.crowds, gradient.starts, gradient.v_lines)
    torch.library.opcheck(ops.hexplane_planes_gradient.default, (case.time, *factored, case.planes))
    first, second = ([torch.zeros_like(p) for p in case.planes] for _ in range(2))
    rate, step = torch.tensor([0.01], device=gpu), torch.ones(1, dtype=torch.int64, device=gpu)
    options = (rate, step, None, 0.9, 0.999, 1e-8, 0.0, 0.0, 0.0)
    torch.library.opcheck(
        ops.hexplane_planes_adam_.default,
        (case.planes, first, second, case.time, *factored, *options),
    )
