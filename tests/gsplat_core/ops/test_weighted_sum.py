"""Weighted sums: the compiled op against the reference in float64, the reference against first principles."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.ops.weighted_sum import weighted_sums

NAMES = ("means2d", "conics", "channels", "opacities", "weights")


def splats(count, width, height, channels=4, seed=1):
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(count, 2, generator=g) * torch.tensor([width + 8.0, height + 8.0]) - 4
    root = torch.randn(count, 2, 2, generator=g) * 2
    covariance = root @ root.transpose(1, 2) + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    opacities = torch.rand(count, generator=g) * 3 - 0.7
    return means2d, conics, torch.randn(count, channels, generator=g), opacities, torch.randn(count, generator=g)


def lists_of(means2d, conics, opacities, width, height):
    """Tile lists, with radii that hold every pixel above the cutoff."""
    spread = (conics[:, 0] * conics[:, 2] - conics[:, 1].square()).clamp(min=1e-12)
    radii = 3.34 * torch.stack([conics[:, 2] / spread, conics[:, 0] / spread], 1).clamp(min=0).sqrt()
    radii = radii.nan_to_num(0, 0, 0).clamp(max=1e6).ceil().int()
    grid = TileGrid(16, -(-width // 16), -(-height // 16))
    _, ids, offsets = bin_splats(
        means2d[None], radii[None], torch.ones(1, len(means2d)), grid,
        conics=conics[None], opacities=opacities.abs().clamp(max=1)[None],
    )  # fmt: skip
    return offsets[0], ids


def compiled(inputs, width, height):
    means2d, conics, _, opacities, _ = (t.detach() for t in inputs)
    return weighted_sums(*inputs, width, height, *lists_of(means2d, conics, opacities, width, height))


def evaluate(function, inputs, width, height):
    leaves = [t.clone().requires_grad_() for t in inputs]
    sums = function(leaves, width, height)
    g = torch.Generator().manual_seed(2)
    (sums * torch.randn(sums.shape, generator=g).to(sums.dtype)).sum().backward()
    return [sums.detach(), *(leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("size", [(40, 33), (1, 1), (16, 16), (70, 5)])
@pytest.mark.parametrize(("count", "channels"), [(60, 4), (60, 3), (30, 1), (30, 7), (1, 4), (0, 4)])
def test_weighted_sums_match_reference(assert_near, count, channels, size):
    inputs = splats(count, *size, channels)
    ours = evaluate(compiled, inputs, *size)
    exact = evaluate(lambda leaves, *size: reference.weighted_sums(*leaves, *size), [t.double() for t in inputs], *size)
    for actual, expected in zip(ours, exact, strict=True):
        assert_near(actual, expected, of_largest=2e-5)


def test_weighted_sums_reference_of_one_splat_in_closed_form():
    inputs = [torch.tensor([v]) for v in ([5.5, 4.5], [0.25, 0.0, 1.0], [2.0, -1.0])]
    sums = reference.weighted_sums(*inputs, torch.tensor([3.0]), torch.tensor([-0.5]), 12, 9)
    term = -0.5 * 3.0 * torch.exp(torch.tensor(-0.5 * 0.25 * 4))
    torch.testing.assert_close(sums[:, 4, 7], term * torch.tensor([2.0, -1.0, 1.0]))
    assert sums[2, 4, 5] == -1.5
    assert sums[2, 8, 5] == 0  # exp(-8) is below 1/255


@pytest.mark.parametrize("seed", range(5))
def test_weighted_sums_independent_of_order(seed):
    width, height = 64, 48
    inputs = splats(500, width, height, seed=seed)
    wanted = compiled(inputs, width, height)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(seed))
    assert torch.equal(compiled([t[order] for t in inputs], width, height), wanted)


def test_weighted_sums_keep_small_terms():
    # In float32, 1 + 2^-26 is 1.
    count, width, height = 1025, 16, 16
    means2d, conics = torch.full((count, 2), 8.5), torch.tensor([[0.01, 0.0, 0.01]]).expand(count, 3).contiguous()
    weights = torch.full((count,), 2.0**-26)
    weights[0] = 1.0
    inputs = (means2d, conics, torch.ones(count, 1), torch.ones(count), weights)
    assert compiled(inputs, width, height)[1, 8, 8] == 1 + 1024 * 2.0**-26


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38])
def test_weighted_sums_invalid_splat_does_not_affect_others(assert_near, name, value):
    width, height = 40, 33
    inputs = dict(zip(NAMES, splats(60, width, height), strict=True))
    others = {key: t[1:] for key, t in inputs.items()}
    spoilt = {key: t.clone() for key, t in inputs.items()}
    spoilt[name][0] = value
    lists = lists_of(*(inputs[key] for key in ("means2d", "conics", "opacities")), width, height)
    leaves = [t.requires_grad_() for t in spoilt.values()]
    sums = weighted_sums(*leaves, width, height, *lists)
    sums.sum().backward()
    assert sums.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)
    if not math.isfinite(value):
        assert all((leaf.grad[0] == 0).all() for leaf in leaves)
        assert_near(sums.detach(), compiled(tuple(others.values()), width, height), of_largest=1e-6)


def test_weighted_sums_ignore_invalid_conics():
    inputs = list(splats(3, 32, 32))
    lists = lists_of(inputs[0], inputs[1], inputs[3], 32, 32)
    inputs[1] = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 0.0, 1.0], [1.0, 2.0, 1.0]])
    assert not weighted_sums(*inputs, 32, 32, *lists).any()


def test_weighted_sums_limit_large_terms_and_channels():
    inputs = [torch.tensor([v]) for v in ([8.5, 8.5], [0.02, 0.0, 0.02], [1e6])]
    leaves = [*inputs, torch.tensor([1000.0]), torch.tensor([5.0])]
    leaves = [t.requires_grad_() for t in leaves]
    lists = lists_of(*(leaves[k].detach() for k in (0, 1, 3)), 16, 16)
    sums = weighted_sums(*leaves, 16, 16, *lists)
    assert sums[1, 8, 8] == 128
    assert sums[0, 8, 8] == 128 * 2048
    sums.sum().backward()
    assert all(leaf.grad.abs().max() == 0 for leaf in leaves)


def test_weighted_sums_reference_passes_gradcheck():
    inputs = [t.double().requires_grad_() for t in splats(6, 8, 7, channels=2, seed=3)]
    assert torch.autograd.gradcheck(lambda *leaves: reference.weighted_sums(*leaves, 8, 7), inputs, eps=1e-7)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_weighted_sums_ops_pass_opcheck():
    inputs = splats(20, 40, 33)
    lists = lists_of(inputs[0], inputs[1], inputs[3], 40, 33)
    leaves = [t.requires_grad_() for t in inputs]
    torch.library.opcheck(torch.ops.gsplat_core.weighted_sums, (*leaves, *lists, 40, 33))
    plain = [t.detach() for t in leaves]
    torch.library.opcheck(torch.ops.gsplat_core.weighted_sums_backward, (*plain, *lists, 40, 33, torch.rand(5, 33, 40)))


def test_weighted_sums_reject_invalid_arguments():
    inputs = list(splats(5, 32, 32))
    offsets, ids = lists_of(inputs[0], inputs[1], inputs[3], 32, 32)
    for at, wrong, message in [
        (0, inputs[0][:4], r"means2d must be \[N, 2\]"),
        (2, torch.rand(5, 33), "D from 1 to 32"),
        (4, inputs[4].double(), r"gsplat_core\.reference"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            weighted_sums(*inputs[:at], wrong, *inputs[at + 1 :], 32, 32, offsets, ids)
    with pytest.raises(InvalidInput, match="do not cover the image"):
        weighted_sums(*inputs, 40, 32, offsets, ids)
    with pytest.raises(RuntimeError, match=r"flatten_ids must be in \[0, 5\)"):
        weighted_sums(*inputs, 32, 32, torch.zeros_like(offsets), torch.full((1,), 5, dtype=torch.int32))
