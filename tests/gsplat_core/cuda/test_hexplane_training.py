"""Training of the HexPlane field on CUDA against float64 autograd of the reference."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane_training import (
    AdamOnDevice,
    Penalties,
    hexplane_planes_adam_,
    hexplane_planes_gradient,
    hexplane_train,
)
from tests.gsplat_core.cuda.hexplane_cases import Case


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
def test_hexplane_train_deltas_and_gradients_equal_reference(gpu, case):
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
    """Return a copy of the values that is misaligned by one float."""
    return torch.cat([tensor.new_zeros(1), tensor.flatten()])[1:].view(tensor.shape)


@pytest.mark.parametrize("penalties", [Penalties(), Penalties(10.0, 20.0, 5.0)])
def test_hexplane_train_accepts_misaligned_planes(gpu, penalties):
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
    hexplane_planes_adam_(ours.planes, first, second, ours.time, gradient, AdamOnDevice(rate, step), penalties)
    hexplane_planes_adam_(aligned, *others, ours.time, gradient, AdamOnDevice(rate, step), penalties)
    for seen, wanted in zip(ours.planes, aligned, strict=True):
        # A gradient near zero may have another sign, and Adam's first step is as long for it as for any other.
        assert ((seen - wanted).abs() <= 1e-6 + 1e-5 * wanted.abs()).float().mean() > 0.999


def test_hexplane_train_is_deterministic(gpu):
    case = Case(n=5000, channels=64).on(gpu)
    results = []
    for _ in range(2):
        state, v_raw = case.forward(), case.v_raw.clone()
        gradient = case.backward(state, v_raw)
        # Not all of dense_sums is written.
        left = (gradient.network, gradient.rows, gradient.starts, gradient.v_lines)
        results.append([*state, v_raw, *left, *hexplane_planes_gradient(case.time, gradient, case.planes)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_hexplane_train_omits_non_finite_values(gpu):
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


def test_hexplane_train_rejects_invalid_inputs(gpu):
    case = Case(n=5).on(gpu)
    with pytest.raises(InvalidInput, match="float64"):
        hexplane_train(case.means.double(), case.box, case.time, case.planes, case.weights, case.biases)
    with pytest.raises(RuntimeError, match="train with autograd"):
        other = Case(n=5, channels=20).on(gpu)
        other.forward()
    with pytest.raises(RuntimeError, match="do not share one grid"):
        hexplane_train(case.means, case.box, case.time, [*case.planes[:5], case.planes[0]], case.weights, case.biases)


def test_hexplane_train_ops_pass_opcheck(gpu):
    ops, case = torch.ops.gsplat_core, Case(n=5, levels=1).on(gpu)
    state = case.forward()
    gradient = case.backward(state, case.v_raw.clone())
    network = (case.planes, case.weights, case.biases)
    torch.library.opcheck(ops.hexplane_train.default, (case.means, case.box, case.time, *network))
    # Not all of dense_sums is written, so two runs cannot be compared.
    utilities = ("test_schema", "test_autograd_registration", "test_faketensor")
    arguments = (case.v_raw, case.box, list(state[1:]), *network)
    torch.library.opcheck(ops.hexplane_train_backward.default, arguments, test_utils=utilities)
    torch.library.opcheck(ops.hexplane_planes_gradient.default, (case.time, gradient.of_planes, case.planes))
    first, second = ([torch.zeros_like(p) for p in case.planes] for _ in range(2))
    rate, step = torch.tensor([0.01], device=gpu), torch.ones(1, dtype=torch.int64, device=gpu)
    options = (rate, step, None, 0.9, 0.999, 1e-8, 0.0, 0.0, 0.0)
    torch.library.opcheck(
        ops.hexplane_planes_adam_.default,
        (case.planes, first, second, case.time, gradient.of_planes, *options),
    )
