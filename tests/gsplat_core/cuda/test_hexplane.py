"""The HexPlane ops on CUDA against the reference in float64."""

import itertools

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane import hexplane_decode, hexplane_features, hexplane_modulate, hexplane_space
from gsplat_core.ops.hexplane_deltas import hexplane_deltas, takes_layers

AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))


def random(seed):
    return torch.Generator().manual_seed(seed)


def level(channels=32, sizes=(9, 7, 8, 5), seed=0):
    generator = random(seed)
    return [0.5 + torch.rand(sizes[v], sizes[u], channels, generator=generator) for u, v in AXES]


def points(n, seed=1):
    """Some outside the box, some on its corners."""
    x = 1.2 * (2 * torch.rand(n, 4, generator=random(seed)) - 1)
    x[:2] = torch.tensor([-1.0, 1.0])[:n, None]
    return x


def network(*sizes):
    generator = random(4)
    pairs = list(itertools.pairwise(sizes))
    weights = [torch.randn(b, a, generator=generator) / a**0.5 for a, b in pairs]
    return weights, [0.1 * torch.randn(b, generator=generator) for _, b in pairs]


def on(device, *values):
    return [[t.to(device) for t in v] if isinstance(v, (list, tuple)) else v.to(device) for v in values]


def doubled(*values):
    return [[t.double() for t in v] if isinstance(v, (list, tuple)) else v.double() for v in values]


def relative(actual, wanted):
    return float((actual.cpu().double() - wanted).norm() / wanted.norm().clamp(min=1e-12))


@pytest.mark.parametrize("n", [0, 1, 1300])
@pytest.mark.parametrize("channels", [1, 5, 16, 32, 40, 64, 100])
def test_hexplane_features_equal_reference(gpu, n, channels):
    x, planes = points(n), level(channels)
    seen = hexplane_features(*on(gpu, x, *planes))
    torch.testing.assert_close(
        seen.cpu().double(), reference.hexplane_features(*doubled(x, *planes)), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("n", [0, 1, 1300])
@pytest.mark.parametrize("channels", [1, 5, 32, 40, 64, 100])
def test_hexplane_feature_gradients_equal_reference(gpu, n, channels):
    seen = [t.to(gpu).requires_grad_() for t in (points(n), *level(channels))]
    wanted = [t.double().requires_grad_() for t in (points(n), *level(channels))]
    gradient = torch.randn(n, channels, generator=random(2))
    hexplane_features(*seen).backward(gradient.to(gpu))
    reference.hexplane_features(*wanted).backward(gradient.double())
    for s, w in zip(seen, wanted, strict=True):
        assert relative(s.grad, w.grad) < 1e-4
    again = torch.ops.gsplat_core.hexplane_features_backward(gradient.to(gpu), *(t.detach() for t in seen))
    assert all(torch.equal(s.grad, a) for s, a in zip(seen, again, strict=True))


@pytest.mark.parametrize("sizes", [(2, 2, 2, 2), (1, 1, 1, 1), (1, 3, 2, 1)])
def test_hexplane_features_of_smallest_planes(gpu, sizes):
    x, planes = points(50), level(8, sizes)
    seen = hexplane_features(*on(gpu, x, *planes))
    torch.testing.assert_close(
        seen.cpu().double(), reference.hexplane_features(*doubled(x, *planes)), rtol=1e-5, atol=1e-5
    )


def test_hexplane_features_of_nan_position_are_nan(gpu):
    x = points(5)
    x[2, 0], x[3, 1] = float("nan"), float("inf")
    features = hexplane_features(*on(gpu, x, *level())).cpu()
    assert features[2].isnan().all()
    assert features[[0, 1, 3, 4]].isfinite().all()


@pytest.mark.parametrize("channels", [5, 32, 64])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_hexplane_space_and_modulate_equal_reference(gpu, n, channels):
    x, planes = points(n), level(channels)
    lines = [plane[1] for plane in planes[3:]]
    space = hexplane_space(*on(gpu, x, *planes[:3]))
    wanted = reference.hexplane_space(*doubled(x, *planes[:3]))
    torch.testing.assert_close(space.cpu().double(), wanted, rtol=1e-4, atol=1e-5)
    seen = hexplane_modulate(space, *on(gpu, x, *lines))
    wanted = reference.hexplane_modulate(wanted, *doubled(x, *lines))
    torch.testing.assert_close(seen.cpu().double(), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("n", [0, 1, 5, 1001])
@pytest.mark.parametrize("sizes", [(64, 64, 64, 64, 11), (10, 3), (10, 100, 7), (35, 48, 17)])
def test_hexplane_decode_equals_reference(gpu, n, sizes):
    x, channels = points(n), sizes[0] // 2
    spaces = [torch.rand(n, c, generator=random(c)) for c in (channels, sizes[0] - channels)]
    lines = [torch.rand(4 + i, s.shape[1], generator=random(i)) for s in spaces for i in range(3)]
    for given in (lines, []):
        seen = hexplane_decode(*on(gpu, spaces, x, given, *network(*sizes)))
        wanted = reference.hexplane_decode(*doubled(spaces, x, given, *network(*sizes)))
        torch.testing.assert_close(seen.cpu().double(), wanted, rtol=1e-4, atol=1e-5)


def deltas_case(n, channels=64, levels=2, width=32, depth=2, sizes=(9, 7, 8, 5)):
    x = points(n)
    planes = [level(channels, [s * (l + 1) for s in sizes[:3]] + [sizes[3]], seed=l) for l in range(levels)]
    spaces = [reference.hexplane_space(x, *p[:3]) for p in planes]
    time_planes = [plane for p in planes for plane in p[3:]]
    return spaces, x, time_planes, *network(channels * levels, *[width] * depth, 11)


CASES = {
    "one level": {"levels": 1},
    "four levels": {"levels": 4},
    "32 channels": {"channels": 32},
    "64 wide": {"channels": 32, "width": 64, "depth": 3},
    "64 wide on 64 channels": {"width": 64, "depth": 3},
    "128 wide": {"channels": 32, "width": 128, "depth": 1},
    "128 wide on 96 channels": {"channels": 96, "levels": 1, "width": 128, "depth": 1},
    "128 wide on 64 channels": {"width": 128, "depth": 1},
    "odd width": {"width": 27, "depth": 4},
    "96 channels": {"channels": 96, "levels": 1, "width": 33},
    "resolution 2": {"sizes": (2, 2, 2, 2)},
    "resolution 1": {"sizes": (1, 2, 1, 1)},
}


@pytest.mark.parametrize("time", [-1.0, 0.37, 1.0, 2.5])
@pytest.mark.parametrize("n", [0, 1, 17, 1003])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_hexplane_deltas_equal_reference(gpu, case, n, time):
    spaces, x, planes, weights, biases = deltas_case(n, **case)
    now, order = torch.tensor([time]), torch.randperm(n, generator=random(7)).int()
    wanted = reference.hexplane_deltas(*doubled(spaces, x, now, planes, weights, biases), order)
    args = on(gpu, spaces, x, now, planes, weights, biases, order)
    exact = hexplane_deltas(*args)
    assert exact.shape == (n, 16)
    half = hexplane_deltas([s.half() for s in args[0]], *args[1:])
    if n:
        assert relative(exact, wanted) < 1e-5
        assert relative(half, wanted) < 2e-3
    assert torch.equal(exact, hexplane_deltas(*args))


def test_hexplane_deltas_in_graph_follow_time(gpu):
    args = on(gpu, *deltas_case(300))
    now = torch.zeros(3, device=gpu)[1:2]  # a view that is not aligned, as the frame path's controls are
    call = lambda: hexplane_deltas(args[0], args[1], now, *args[2:])
    call()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        seen = call()
    for time in (-0.9, 0.4):
        now.fill_(time)
        graph.replay()
        assert torch.equal(seen, call())


def test_hexplane_deltas_with_misaligned_inputs(gpu):
    spaces, x, planes, weights, biases = on(gpu, *deltas_case(40))
    shifted = lambda t: torch.cat([t.new_zeros(1), t.flatten()])[1:].view(t.shape)
    now = torch.tensor([0.2], device=gpu)
    wanted = hexplane_deltas(spaces, x, now, planes, weights, biases)
    seen = hexplane_deltas(
        *[[shifted(t) for t in a] for a in (spaces,)],
        shifted(x),
        now,
        *[[shifted(t) for t in a] for a in (planes, weights, biases)],
    )
    assert torch.equal(seen, wanted)


def test_hexplane_deltas_of_nan_position_are_nan(gpu):
    spaces, x, planes, weights, biases = deltas_case(40)
    x[7, 1] = float("nan")
    seen = hexplane_deltas(*on(gpu, spaces, x, torch.tensor([0.1]), planes, weights, biases)).cpu()
    shown = seen[:, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 13]]
    assert shown[7].isnan().all() and seen[torch.arange(40) != 7].isfinite().all()


@pytest.mark.parametrize(
    "sizes", [(64, 4, 32, 2), (32, 2, 64, 3), (32, 2, 128, 9), (20, 1, 32, 1), (16, 2, 129, 1), (512, 1, 128, 1)]
)
def test_hexplane_deltas_reject_unsupported_layers(gpu, sizes):
    channels, levels, width, depth = sizes
    spaces, x, planes, weights, biases = on(gpu, *deltas_case(3, channels, levels, width, depth))
    now = torch.zeros(1, device=gpu)
    for item, dtype in ((2, torch.float16), (4, torch.float32)):
        args = ([s.to(dtype) for s in spaces], x, now, planes, weights, biases)
        if takes_layers(*sizes, item=item):
            hexplane_deltas(*args)
        else:
            with pytest.raises(RuntimeError, match="use hexplane_decode"):
                hexplane_deltas(*args)


def test_hexplane_deltas_reject_invalid_inputs(gpu):
    spaces, x, planes, weights, biases = on(gpu, *deltas_case(3))
    now = torch.zeros(1, device=gpu)
    with pytest.raises(InvalidInput, match="float64"):
        hexplane_deltas(spaces, x.double(), now, planes, weights, biases)
    with pytest.raises(InvalidInput, match="all float32 or all float16"):
        hexplane_deltas([spaces[0].half(), *spaces[1:]], x, now, planes, weights, biases)
    with pytest.raises(InvalidInput, match="on CUDA and got cpu"):
        hexplane_deltas(spaces, x.cpu(), now, planes, weights, biases)
    with pytest.raises(RuntimeError, match="one bias per output"):
        hexplane_deltas(spaces, x, now, planes, weights, [biases[1], *biases[1:]][:2] + [biases[0]])


def test_hexplane_ops_pass_opcheck(gpu):
    ops, planes = torch.ops.gsplat_core, on(gpu, *level(3))
    x = points(4).to(gpu)
    lines = [plane[0] for plane in planes[3:]]
    torch.library.opcheck(ops.hexplane_features.default, (x, *planes))
    torch.library.opcheck(ops.hexplane_features_backward.default, (torch.rand(4, 3, device=gpu), x, *planes))
    torch.library.opcheck(ops.hexplane_space.default, (x, *planes[:3]))
    torch.library.opcheck(ops.hexplane_modulate.default, (torch.rand(4, 3, device=gpu), x, *lines))
    torch.library.opcheck(
        ops.hexplane_decode.default, ([torch.rand(4, 3, device=gpu)], x, lines, *on(gpu, *network(3, 5, 2)))
    )
    spaces, x, planes, weights, biases = on(gpu, *deltas_case(5))
    order, now = torch.arange(5, device=gpu).int(), torch.zeros(1, device=gpu)
    torch.library.opcheck(ops.hexplane_deltas.default, (spaces, x, order, now, planes, weights, biases))
