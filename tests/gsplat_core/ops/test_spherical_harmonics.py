"""Spherical harmonics: the compiled op against the reference in float64, the reference against first principles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsplat_core import InvalidInput, reference, spherical_harmonics
from gsplat_core.reference.projection import spherical_harmonics_bases


def inputs(shape, bases, seed=0, coefficients=None):
    g = torch.Generator().manual_seed(seed)
    dirs = torch.randn(*shape, 3, generator=g) * 3
    coeffs = torch.randn(*(shape if coefficients is None else coefficients), bases, 3, generator=g)
    masks = torch.rand(shape, generator=g) > 0.3
    return dirs, coeffs, masks, torch.rand(*shape, 3, generator=g)


def evaluate(function, degree, dirs, coeffs, masks, weights, dtype):
    dirs, coeffs = dirs.detach().to(dtype).requires_grad_(), coeffs.detach().to(dtype).requires_grad_()
    out = function(degree, dirs, coeffs, masks)
    (out * weights.to(dtype)).sum().backward()
    return out.detach(), dirs.grad if dirs.grad is not None else torch.zeros_like(dirs), coeffs.grad


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    ("shape", "coefficients"),
    [((37,), None), ((2, 3, 21), None), ((4, 19), (19,)), ((2, 3, 5), (2, 1, 5)), ((0,), None), ((0, 7), (7,))],
)
def test_spherical_harmonics_match_reference(assert_near, degree, masked, shape, coefficients):
    # One basis function more than the degree uses: its gradient is zero.
    dirs, coeffs, masks, weights = inputs(shape, (degree + 1) ** 2 + 1, degree, coefficients)
    masks = masks if masked else None
    ours = evaluate(spherical_harmonics, degree, dirs, coeffs, masks, weights, torch.float32)
    exact = evaluate(reference.spherical_harmonics, degree, dirs, coeffs, masks, weights, torch.float64)
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual, wanted, of_largest=1e-5)


def test_spherical_harmonics_bases_are_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    phi = np.arange(24) * math.pi / 12
    z, azimuth = np.meshgrid(nodes, phi, indexing="ij")
    r = np.sqrt(1 - z * z)
    dirs = torch.tensor(np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1).reshape(-1, 3))
    bases = spherical_harmonics_bases(4, dirs)
    area = torch.tensor(np.repeat(weights, 24) * math.pi / 12)
    torch.testing.assert_close(
        bases.T @ (bases * area[:, None]), torch.eye(25, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_spherical_harmonics_order_and_signs_match_published_files():
    """Each function's largest monomial where the published files (INRIA's, gsplat's) have it, with their sign."""
    x, y, z = 0.48, 0.6, 0.64
    bases = spherical_harmonics_bases(4, torch.tensor([x, y, z], dtype=torch.float64)).tolist()
    r = math.sqrt
    expected = {
        1: -r(3 / (4 * math.pi)) * y,
        2: r(3 / (4 * math.pi)) * z,
        3: -r(3 / (4 * math.pi)) * x,
        4: r(15 / (4 * math.pi)) * x * y,
        5: -r(15 / (4 * math.pi)) * y * z,
        6: r(5 / (16 * math.pi)) * (3 * z * z - 1),
        8: r(15 / (16 * math.pi)) * (x * x - y * y),
        10: r(105 / (4 * math.pi)) * x * y * z,
        12: r(7 / (16 * math.pi)) * z * (5 * z * z - 3),
        15: -r(35 / (32 * math.pi)) * x * (x * x - 3 * y * y),
        16: r(315 / (16 * math.pi)) * x * y * (x * x - y * y),
        20: r(9 / (256 * math.pi)) * (35 * z**4 - 30 * z * z + 3),
    }
    for index, value in expected.items():
        assert bases[index] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("function", [spherical_harmonics, reference.spherical_harmonics])
def test_spherical_harmonics_ignore_masked_values(function):
    dirs, coeffs, _, weights = inputs((20,), 16)
    masks = torch.ones(20, dtype=torch.bool)
    masks[[3, 8]] = False
    dirs[3], coeffs[8] = math.nan, math.inf
    out, v_dirs, v_coeffs = evaluate(function, 3, dirs, coeffs, masks, weights, torch.float32)
    for result in (out, v_dirs, v_coeffs):
        assert result.isfinite().all()
        assert (result[~masks] == 0).all()
        assert (result[masks] != 0).any()


def test_spherical_harmonics_of_degree_zero_accept_zero_direction():
    coeffs = torch.ones(2, 1, 3, requires_grad=True)
    dirs = torch.zeros(2, 3, requires_grad=True)
    out = spherical_harmonics(0, dirs, coeffs)
    out.sum().backward()
    torch.testing.assert_close(out, torch.full((2, 3), 0.5 / math.sqrt(math.pi)))
    assert (dirs.grad == 0).all()


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics_reference_passes_gradcheck(degree):
    dirs, coeffs, masks, _ = inputs((6,), 25)
    dirs, coeffs = dirs.double().requires_grad_(), coeffs.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d, c: reference.spherical_harmonics(degree, d, c, masks), (dirs, coeffs), fast_mode=True
    )


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_spherical_harmonics_ops_pass_opcheck():
    dirs, coeffs, masks, weights = inputs((2, 7), 16, coefficients=(7,))
    arguments = (3, dirs.requires_grad_(), coeffs.requires_grad_(), masks)
    torch.library.opcheck(torch.ops.gsplat_core.spherical_harmonics, arguments)
    arguments = (3, dirs.detach(), coeffs.detach(), None, weights, True)
    torch.library.opcheck(torch.ops.gsplat_core.spherical_harmonics_backward, arguments)


def test_spherical_harmonics_shared_gradient_independent_of_thread_count():
    dirs, coeffs, masks, weights = inputs((3, 4000), 16, coefficients=(4000,))
    threads = torch.get_num_threads()
    try:
        results = []
        for n in (1, 3):
            torch.set_num_threads(n)
            results.append(evaluate(spherical_harmonics, 3, dirs, coeffs, masks, weights, torch.float32))
    finally:
        torch.set_num_threads(threads)
    for one, three in zip(*results, strict=True):
        assert torch.equal(one, three)


def test_spherical_harmonics_reject_gsplat_1_6_arguments_with_equivalent():
    random = torch.Generator().manual_seed(0)
    means, coeffs = (torch.randn(*shape, generator=random) for shape in ((5, 3), (5, 9, 3)))
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[:, :3, 3] = torch.randn(2, 3, generator=random)
    with pytest.raises(InvalidInput, match=r"viewmats of gsplat 1\.6; give the directions"):
        spherical_harmonics(2, means, viewmats, coeffs)
    directions = means - torch.linalg.inv(viewmats)[..., None, :3, 3]
    assert spherical_harmonics(2, directions, coeffs).shape == (2, 5, 3)


def test_spherical_harmonics_reject_invalid_arguments():
    dirs, coeffs, masks, _ = inputs((5,), 16)
    for arguments, message in [
        ((3, dirs[:, :2], coeffs), r"dirs must be \[..., 3\], got \[5, 2\]"),
        ((5, dirs, coeffs), "0 to 4, got 5"),
        ((3, dirs, coeffs[:, :9]), r"K >= 16 for degree 3, got \[5, 9, 3\]"),
        ((3, dirs, coeffs[:4]), r"coeffs .*\[5\].*got \[4\]"),
        ((3, dirs, coeffs, masks[:4]), r"masks .*got \[4\]"),
        ((3, dirs, coeffs, masks.int()), "masks must be bool"),
        ((3, dirs.double(), coeffs), "one floating-point dtype"),
        ((3, dirs.double(), coeffs.double()), r"gsplat_core\.reference"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            spherical_harmonics(*arguments)
