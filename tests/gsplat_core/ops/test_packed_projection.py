"""Packed projection: rows, values and gradients against the dense op, which is tested against the reference."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import InvalidInput, fully_fused_projection, spherical_harmonics
from gsplat_core.ops import packed_projection
from gsplat_core.ops.arguments import DenseProjection, PackedProjection, Pairs
from gsplat_core.ops.packed_projection import values_of_rows, visible_harmonics

OUTPUTS = ("radii", "means2d", "depths", "conics", "compensations")


def project(scene, covars=False, **options):
    """The projection, and the leaves that it depends on."""
    leaves = {
        name: getattr(scene, name).detach().clone().requires_grad_()
        for name in ("means", "quats", "scales", "viewmats", "Ks")
    }
    geometry = (None, leaves["quats"], leaves["scales"])
    if covars:
        generator = torch.Generator().manual_seed(4)
        axes = torch.randn(*scene.quats.shape[:-1], 3, 3, generator=generator) * 0.2
        full = axes @ axes.transpose(-1, -2)
        triangle = torch.stack([full[..., i, j] for i in range(3) for j in range(i, 3)], -1)
        del leaves["quats"], leaves["scales"]
        leaves["covars"] = triangle.requires_grad_()
        geometry = (leaves["covars"], None, None)
    out = fully_fused_projection(
        leaves["means"], *geometry, leaves["viewmats"], leaves["Ks"], scene.width, scene.height,
        opacities=scene.opacities, calc_compensations=True, **options,
    )  # fmt: skip
    return out, leaves


def rows_of(dense: DenseProjection) -> list[torch.Tensor]:
    seen = dense.radii[..., 0] > 0
    return [getattr(dense, name)[seen] for name in OUTPUTS]


def backward(values):
    """Backpropagate a weighting of the rows' values."""
    generator = torch.Generator().manual_seed(6)
    sum((value * torch.rand(value.shape, generator=generator)).sum() for value in values[1:]).backward()


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize(("count", "batch", "cameras"), [(1500, (2,), 3), (60, (), 1), (0, (), 2), (5, (), 0)])
def test_packed_projection_equals_dense(make_scene, assert_near, model, covars, count, batch, cameras):
    scene = make_scene(count, batch, cameras, model).to(torch.float32)
    dense, wanted = project(scene, covars, camera_model=model)
    packed, leaves = project(scene, covars, camera_model=model, packed=True)
    assert isinstance(packed, PackedProjection)
    visible = dense.radii[..., 0] > 0
    places = visible.reshape(math.prod(batch), cameras, count).nonzero()
    for ids, expected in zip(packed[:3], places.unbind(-1), strict=True):
        assert torch.equal(ids, expected)
    rows = [getattr(packed, name) for name in OUTPUTS]
    for actual, expected in zip(rows, rows_of(dense), strict=True):
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)
    backward(rows)
    backward(rows_of(dense))
    for name, leaf in leaves.items():
        assert_near(leaf.grad, wanted[name].grad.double(), of_largest=1e-5)


@pytest.mark.parametrize("cameras", [1, 3])
def test_packed_projection_sparse_gradients_cover_visible_rows_only(make_scene, assert_near, cameras):
    scene = make_scene(300, (), cameras).to(torch.float32)
    rows, leaves = project(scene, packed=True)
    backward([getattr(rows, name) for name in OUTPUTS])
    sparse_rows, sparse = project(scene, packed=True, sparse_grad=True)
    backward([getattr(sparse_rows, name) for name in OUTPUTS])
    visible = len(rows.gaussian_ids)
    assert 0 < visible < 300 * cameras
    for name in ("means", "quats", "scales"):
        gradient = sparse[name].grad
        assert gradient.layout == torch.sparse_coo and gradient._nnz() == visible
        assert_near(gradient.to_dense(), leaves[name].grad.double(), of_largest=1e-6)
    assert torch.equal(sparse["viewmats"].grad, leaves["viewmats"].grad)


def test_packed_projection_gradients_independent_of_thread_count(make_scene):
    scene = make_scene(5000, cameras=2).to(torch.float32)
    found = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            rows, leaves = project(scene, packed=True)
            backward([getattr(rows, name) for name in OUTPUTS])
            found.append([leaf.grad for name, leaf in leaves.items() if name != "Ks"])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_packed_projection_sparse_adam_moves_visible_gaussians_only(make_scene):
    scene = make_scene(200).to(torch.float32)
    rows, leaves = project(scene, packed=True, sparse_grad=True)
    backward([getattr(rows, name) for name in OUTPUTS])
    torch.optim.SparseAdam([leaves["means"]], lr=0.1).step()
    moved = (leaves["means"] != scene.means).any(-1).nonzero()[:, 0]
    assert torch.equal(moved, rows.gaussian_ids)


def test_sparse_gradients_require_packed_rows_without_batches(make_scene):
    scene = make_scene(5).to(torch.float32)
    with pytest.raises(InvalidInput, match="needs packed=True"):
        project(scene, sparse_grad=True)
    with pytest.raises(InvalidInput, match=r"without batch dimensions, got \[2\]"):
        project(make_scene(5, (2,)).to(torch.float32), packed=True, sparse_grad=True)


@pytest.mark.parametrize("bases", [9, 16])
@pytest.mark.parametrize("sparse", [False, True])
def test_visible_harmonics_equal_dense(assert_near, monkeypatch, bases, sparse):
    monkeypatch.setitem(packed_projection.ROWS_AT_ONCE, "cpu", 7)
    generator = torch.Generator().manual_seed(0)
    pairs = Pairs(1, 2, 20)
    ids = (torch.rand(40, generator=generator) < 0.4).nonzero()[:, 0]
    dirs = torch.randn(40, 3, generator=generator)
    coefficients = torch.randn(20, bases, 3, generator=generator)
    weights = torch.rand(len(ids), 3, generator=generator)

    dense = [dirs.clone().requires_grad_(), coefficients.clone().requires_grad_()]
    wanted = spherical_harmonics(2, dense[0].reshape(2, 20, 3), dense[1]).reshape(40, 3)[ids]
    (wanted * weights).sum().backward()
    ours = [dirs[ids].requires_grad_(), coefficients.clone().requires_grad_()]
    colors = visible_harmonics(2, ours[0], ours[1], ids, pairs, sparse_grad=sparse)
    (colors * weights).sum().backward()
    assert torch.equal(colors, wanted)
    assert_near(ours[0].grad, dense[0].grad[ids].double())
    assert ours[1].grad.is_sparse == sparse
    gradient = ours[1].grad.to_dense() if sparse else ours[1].grad
    assert_near(gradient, dense[1].grad.double())


def test_values_of_rows_selects_values_of_gaussians(assert_near):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 5, 4, generator=generator, requires_grad=True)
    ids = torch.tensor([0, 3, 6, 14, 19, 29])  # of 2 batches, 3 cameras and 5 Gaussians
    wanted = values.detach()[[0, 0, 0, 0, 1, 1], [0, 3, 1, 4, 4, 4]]
    weights = torch.rand(6, 4, generator=generator)
    rows = values_of_rows(values, ids, Pairs(2, 3, 5), batch_dims=1)
    assert torch.equal(rows, wanted)
    (rows * weights).sum().backward()
    expected = torch.zeros(2, 5, 4)
    for row, (batch, gaussian) in enumerate([(0, 0), (0, 3), (0, 1), (0, 4), (1, 4), (1, 4)]):
        expected[batch, gaussian] += weights[row]
    assert torch.equal(values.grad, expected)


def test_add_packed_rows_rejects_invalid_row_ids():
    for ids in ([0, 0], [3, 1], [-1, 2], [1, 6]):
        with pytest.raises(RuntimeError, match=r"row ids must ascend from 0 to 5, got"):
            torch.ops.gsplat_core.add_packed_rows_(torch.zeros(1, 3, 2), torch.ones(2, 2), torch.tensor(ids), 2)


def test_packed_projection_ops_pass_opcheck(make_scene):
    scene = make_scene(20, (2,), 2).to(torch.float32)
    inputs = (scene.means, None, scene.quats, scene.scales)
    options = (scene.width, scene.height, 0.3)
    ops = torch.ops.gsplat_core
    arguments = (*inputs, scene.opacities, scene.viewmats, scene.Ks, *options, 0.01, 1e10, 0.0, True, 0, 0.005)
    torch.library.opcheck(ops.project_visible.default, arguments)
    ids, *values = ops.project_visible(*arguments)
    v = [torch.ones_like(value) for value in values[:4]]
    torch.library.opcheck(
        ops.project_visible_backward.default,
        (*inputs, scene.viewmats, scene.Ks, ids, *v, *options, 0, True, 0.005),
    )
    torch.library.opcheck(ops.add_packed_rows_.default, (torch.zeros(2, 20, 2), v[0], ids, 2))
