"""Spherical harmonics on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import reference, spherical_harmonics


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize(("cameras", "count"), [(1, 0), (1, 1), (3, 1003)])
@pytest.mark.parametrize("masked", [False, True])
def test_spherical_harmonics_values_and_gradients_equal_reference(gpu, assert_near, degree, cameras, count, masked):
    generator = torch.Generator().manual_seed(degree)
    dirs = torch.randn(cameras, count, 3, generator=generator)
    coeffs = torch.randn(count, 25, 3, generator=generator)
    weights = torch.rand(cameras, count, 3, generator=generator)
    masks = torch.rand(cameras, count, generator=generator) < 0.7 if masked else None
    if masks is not None:
        dirs[~masks] = torch.nan  # behind a mask nothing is looked at

    def run(function, convert):
        leaves = [convert(t).requires_grad_() for t in (dirs, coeffs)]
        out = function(degree, *leaves, None if masks is None else masks.to(leaves[0].device))
        (convert(weights) * out).sum().backward()
        return [out, *(leaf.grad for leaf in leaves)]

    ours = run(spherical_harmonics, lambda t: t.to(gpu, copy=True))
    exact = run(reference.spherical_harmonics, lambda t: t.double())
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), torch.zeros_like(actual.cpu()).double() if wanted is None else wanted)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("bases", ["all", "more"])
@pytest.mark.parametrize("rows", [1, 3])
def test_spherical_harmonics_of_any_set_count_and_alignment(gpu, assert_near, degree, bases, rows):
    """Partially filled warps and blocks, unused coefficients, and misaligned tensors."""
    generator = torch.Generator().manual_seed(degree)
    count = (degree + 1) ** 2 + (2 if bases == "more" else 0)
    for sets in (31, 33, 128, 130):
        dirs, weights = (torch.randn(rows, sets, 3, generator=generator) for _ in range(2))
        coeffs = torch.randn(sets, count, 3, generator=generator)
        masks = torch.rand(rows, sets, generator=generator) < 0.2
        weights[..., ::5, :] = 0
        results = []
        for function, convert in ((spherical_harmonics, shifted), (reference.spherical_harmonics, torch.Tensor.double)):
            leaves = [convert(t).requires_grad_() for t in (dirs, coeffs)]
            out = function(degree, *leaves, masks.to(leaves[0].device))
            (convert(weights) * out).sum().backward()
            results.append([out, *(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves)])
        for actual, wanted in zip(*results, strict=True):
            assert_near(actual.cpu(), wanted)


def shifted(tensor):
    """A copy on the GPU that starts four bytes behind where its storage does."""
    storage = torch.empty(tensor.numel() + 1, device="cuda")
    return storage[1:].view(tensor.shape).copy_(tensor)


@pytest.mark.parametrize("rows", [1, 2])
def test_spherical_harmonics_non_finite_values_without_upstream_gradient(gpu, rows):
    coeffs = torch.randn(40, 16, 3, device=gpu)
    dirs = torch.randn(rows, 40, 3, device=gpu)
    coeffs[3, 5, 1], coeffs[4, 0, 0], dirs[:, 6, 1], dirs[:, 7] = torch.nan, torch.inf, torch.nan, 0
    weights = torch.ones(rows, 40, 3, device=gpu)
    weights[:, 3:8] = 0
    leaves = [t.requires_grad_() for t in (dirs, coeffs)]
    torch.autograd.backward(spherical_harmonics(3, *leaves), weights)
    for leaf in leaves:
        assert leaf.grad.isfinite().all()
    assert not leaves[0].grad[:, 3:8].any() and not leaves[1].grad[3:8].any()
    assert leaves[0].grad[:, :3].any() and leaves[1].grad[8:].any()


def test_spherical_harmonics_deterministic_and_captured_in_graph(gpu):
    generator = torch.Generator().manual_seed(0)
    dirs, weights = (torch.randn(2, 1000, 3, generator=generator).to(gpu) for _ in range(2))
    coeffs = torch.randn(1000, 16, 3, generator=generator).to(gpu)

    def gradients():
        leaves = [t.detach().requires_grad_() for t in (dirs, coeffs)]
        out = spherical_harmonics(3, *leaves)
        return [out.detach(), *torch.autograd.grad(out, leaves, weights)]

    first, second = gradients(), gradients()
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        replayed = gradients()
    dirs += 0.1
    graph.replay()
    moved = gradients()
    assert not torch.equal(moved[0], first[0])
    assert all(torch.equal(a, b) for a, b in zip(replayed, moved, strict=True))


def test_spherical_harmonics_ops_pass_opcheck(gpu):
    dirs, coeffs = (torch.randn(*shape, device=gpu, requires_grad=True) for shape in ((2, 9, 3), (9, 16, 3)))
    masks = torch.rand(2, 9, device=gpu) < 0.7
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.spherical_harmonics.default, (3, dirs, coeffs, masks))
    plain = [t.detach() for t in (dirs, coeffs)]
    torch.library.opcheck(ops.spherical_harmonics_backward.default, (3, *plain, masks, plain[0], True))


def test_spherical_harmonics_accept_non_contiguous_coefficients(gpu):
    generator = torch.Generator().manual_seed(0)
    coeffs = torch.randn(3, 16, 100, generator=generator).to(gpu).permute(2, 1, 0)
    dirs = torch.randn(3, 100, generator=generator).to(gpu).T
    expected = spherical_harmonics(3, dirs.contiguous(), coeffs.contiguous())
    assert torch.equal(spherical_harmonics(3, dirs, coeffs), expected)
