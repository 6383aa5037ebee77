"""The C++ HexPlane ops against their definition in plain torch."""

import itertools

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane import hexplane_decode, hexplane_features, hexplane_modulate, hexplane_space


def level(channels=32, sizes=(9, 7, 8, 5), dtype=torch.float32, seed=0):
    random = torch.Generator().manual_seed(seed)
    axes = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
    return [(0.5 + torch.rand(sizes[v], sizes[u], channels, generator=random)).to(dtype) for u, v in axes]


def points(n, dtype=torch.float32, reach=1.2, seed=1):
    random = torch.Generator().manual_seed(seed)
    return (reach * (2 * torch.rand(n, 4, generator=random) - 1)).to(dtype)


@pytest.mark.parametrize("n", [0, 1, 1300])
@pytest.mark.parametrize("channels", [1, 5, 16, 32, 40])
def test_hexplane_features_and_gradients_equal_reference(n, channels):
    seen = [t.requires_grad_() for t in (points(n), *level(channels))]
    wanted = [t.detach().clone().requires_grad_() for t in seen]
    ours, theirs = hexplane_features(*seen), reference.hexplane_features(*wanted)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    gradient = torch.randn(n, channels, generator=torch.Generator().manual_seed(2))
    ours.backward(gradient)
    theirs.backward(gradient)
    for s, w in zip(seen, wanted, strict=True):
        scale = 1.0 if w.grad.numel() == 0 else max(1.0, float(w.grad.abs().max()))
        torch.testing.assert_close(s.grad / scale, w.grad / scale, rtol=1e-4, atol=1e-5)


def test_hexplane_features_clamp_points_to_border():
    planes = level(4)
    for corner in (-1.0, 1.0):
        inside = torch.full((1, 4), corner)
        torch.testing.assert_close(hexplane_features(inside, *planes), hexplane_features(3 * inside, *planes))
        value = torch.ones(4)
        for plane in planes:
            value = value * (plane[0, 0] if corner < 0 else plane[-1, -1])
        torch.testing.assert_close(hexplane_features(inside, *planes)[0], value)


def test_hexplane_reference_passes_gradcheck():
    inputs = [points(3, torch.float64, reach=0.9), *level(2, (3, 4, 3, 2), torch.float64)]
    assert torch.autograd.gradcheck(reference.hexplane_features, [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("n", [0, 1, 700])
def test_hexplane_space_and_modulate_equal_features(n):
    planes, time = level(), 0.37
    x = points(n)
    x[:, 3] = time
    row = (time + 1) / 2 * (planes[3].shape[0] - 1)
    lines = [torch.lerp(plane[int(row)], plane[int(row) + 1], row - int(row)) for plane in planes[3:]]
    space = hexplane_space(x, *planes[:3])
    torch.testing.assert_close(space, reference.hexplane_space(x, *planes[:3]), rtol=1e-5, atol=1e-6)
    seen = hexplane_modulate(space, x, *lines)
    torch.testing.assert_close(seen, reference.hexplane_modulate(space, x, *lines), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(seen, hexplane_features(x, *planes), rtol=1e-5, atol=1e-5)


def network(*sizes):
    random = torch.Generator().manual_seed(4)
    pairs = list(itertools.pairwise(sizes))
    weights = [torch.randn(b, a, generator=random) / a**0.5 for a, b in pairs]
    return weights, [0.1 * torch.randn(b, generator=random) for _, b in pairs]


@pytest.mark.parametrize("n", [0, 1, 5, 48, 1001])
@pytest.mark.parametrize("sizes", [(64, 64, 64, 64, 11), (10, 3), (10, 100, 7), (35, 48, 17)])
def test_hexplane_decode_equals_reference(n, sizes):
    x, channels = points(n), sizes[0] // 2
    spaces = [torch.rand(n, c, generator=torch.Generator().manual_seed(c)) for c in (channels, sizes[0] - channels)]
    lines = [
        torch.rand(4 + i, s.shape[1], generator=torch.Generator().manual_seed(i)) for s in spaces for i in range(3)
    ]
    for given in (lines, []):
        seen = hexplane_decode(spaces, x, given, *network(*sizes))
        wanted = reference.hexplane_decode(spaces, x, given, *network(*sizes))
        torch.testing.assert_close(seen, wanted, rtol=1e-5, atol=1e-5)


def test_hexplane_decode_propagates_nan_feature():
    space = torch.rand(7, 16)
    space[4, 3] = float("nan")
    out = hexplane_decode([space], points(7), [], *network(16, 32, 5))
    assert out[4].isnan().all() and out[[0, 1, 2, 3, 5, 6]].isfinite().all()


def test_hexplane_decode_rejects_mismatched_layers():
    with pytest.raises(RuntimeError, match="layer 0 must take 16 inputs"):
        hexplane_decode([torch.rand(7, 16)], points(7), [], *network(8, 3))


def test_hexplane_gradients_independent_of_thread_count():
    inputs = (points(4000), *level())
    gradient = torch.randn(4000, 32, generator=torch.Generator().manual_seed(3))
    results = []
    old = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(torch.ops.gsplat_core.hexplane_features_backward(gradient, *inputs))
    torch.set_num_threads(old)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_hexplane_features_of_nan_position_are_nan():
    x = points(5)
    x[2, 0], x[3, 1] = float("nan"), float("inf")
    features = hexplane_features(x, *level())
    assert features[2].isnan().all()
    assert features[[0, 1, 3, 4]].isfinite().all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_hexplane_ops_pass_opcheck():
    ops, planes = torch.ops.gsplat_core, level(3)
    inputs = [t.requires_grad_() for t in (points(4), *level(3))]
    torch.library.opcheck(ops.hexplane_features.default, inputs)
    torch.library.opcheck(ops.hexplane_features_backward.default, (torch.rand(4, 3), points(4), *planes))
    torch.library.opcheck(ops.hexplane_space.default, (points(4), *planes[:3]))
    lines = [plane[0] for plane in planes[3:]]
    torch.library.opcheck(ops.hexplane_decode.default, ([torch.rand(4, 3)], points(4), lines, *network(3, 5, 2)))
    torch.library.opcheck(ops.hexplane_modulate.default, (torch.rand(4, 3), points(4), *lines))


def test_hexplane_ops_reject_invalid_inputs():
    planes = level(4)
    with pytest.raises(InvalidInput, match=r"\[6, 3\]"):
        hexplane_features(points(6)[:, :3], *planes)
    with pytest.raises(InvalidInput, match=r"float64.*gsplat_core\.reference"):
        hexplane_features(points(6, torch.float64), *planes)
    with pytest.raises(InvalidInput, match=r"one C"):
        hexplane_features(points(6), *planes[:5], planes[5][..., :2])
    with pytest.raises(InvalidInput, match=r"\[6, 4\], got \[5, 4\]"):
        hexplane_modulate(torch.rand(5, 4), points(6), *(plane[0] for plane in planes[3:]))
