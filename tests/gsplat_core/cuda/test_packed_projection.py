"""Packed projection on CUDA: the CPU's rows and gradients, the same bits twice."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import fully_fused_projection, rasterization
from gsplat_core.ops.arguments import Pairs
from gsplat_core.ops.packed_projection import values_of_rows, visible_harmonics

LEAVES = ("means", "quats", "scales", "viewmats")
OUTPUTS = ("means2d", "depths", "conics", "compensations")


def project(scene, device, **options):
    leaves = {name: getattr(scene, name).detach().to(device, copy=True).requires_grad_() for name in LEAVES}
    rows = fully_fused_projection(
        leaves["means"], None, leaves["quats"], leaves["scales"], leaves["viewmats"], scene.Ks.to(device), scene.width,
        scene.height, opacities=scene.opacities.to(device), calc_compensations=True, packed=True, **options,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(6)
    values = [getattr(rows, name) for name in OUTPUTS]
    sum((value * torch.rand(value.shape, generator=generator).to(device)).sum() for value in values).backward()
    return rows, {name: leaf.grad for name, leaf in leaves.items()}


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize(("count", "batch", "cameras"), [(1500, (2,), 3), (257, (), 1), (0, (), 2), (5, (), 0)])
def test_packed_projection_equals_cpu(gpu, make_scene, assert_near, model, count, batch, cameras):
    scene = make_scene(count, batch, cameras, model).to(torch.float32)
    wanted, expected = project(scene, "cpu", camera_model=model)
    rows, gradients = project(scene, gpu, camera_model=model)
    for name in ("batch_ids", "camera_ids", "gaussian_ids", "radii"):
        assert torch.equal(getattr(rows, name).cpu(), getattr(wanted, name))
    for name in OUTPUTS:
        assert_near(getattr(rows, name).cpu(), getattr(wanted, name))
    for name in LEAVES:
        assert_near(gradients[name].cpu(), expected[name], relative=5e-3, of_largest=1e-4)


@pytest.mark.parametrize("sparse", [False, True])
def test_packed_projection_is_deterministic(gpu, make_scene, sparse):
    scene = make_scene(2000, (), 3).to(torch.float32)
    (_, first), (_, second) = (project(scene, gpu, sparse_grad=sparse) for _ in range(2))
    for name in LEAVES:
        a, b = (gradients[name] for gradients in (first, second))
        assert a.is_sparse == (sparse and name != "viewmats")
        assert torch.equal(a._values(), b._values()) if a.is_sparse else torch.equal(a, b)


def test_packed_rows_values_and_colours_equal_cpu(gpu, assert_near):
    generator = torch.Generator().manual_seed(0)
    pairs = Pairs(1, 2, 300)
    ids = (torch.rand(600, generator=generator) < 0.4).nonzero()[:, 0]
    dirs = torch.randn(len(ids), 3, generator=generator)
    coefficients, values = torch.randn(300, 16, 3, generator=generator), torch.randn(300, 5, generator=generator)

    def run(device):
        leaves = [tensor.to(device, copy=True).requires_grad_() for tensor in (dirs, coefficients, values)]
        colors = visible_harmonics(2, leaves[0], leaves[1], ids.to(device), pairs)
        rows = values_of_rows(leaves[2], ids.to(device), pairs)
        (colors.square().sum() + rows.square().sum()).backward()
        return [colors, rows, *(leaf.grad for leaf in leaves)]

    for found, wanted in zip(run(gpu), run("cpu"), strict=True):
        assert_near(found.cpu(), wanted)


def test_packed_sparse_image_gradients_equal_cpu(gpu, make_scene, assert_near):
    scene = make_scene(200, (), 2).to(torch.float32)

    def run(device):
        names = ("means", "quats", "scales", "opacities")
        leaves = {name: getattr(scene, name).to(device, copy=True).requires_grad_() for name in names}
        colors = scene.sh.to(device, copy=True).requires_grad_()
        image, _, _ = rasterization(
            **leaves, colors=colors, viewmats=scene.viewmats.to(device), Ks=scene.Ks.to(device), width=scene.width,
            height=scene.height, sh_degree=3, packed=True, sparse_grad="all",
        )  # fmt: skip
        image.square().sum().backward()
        return [image, *(leaf.grad.to_dense() for leaf in (*leaves.values(), colors))]

    for found, wanted in zip(run(gpu), run("cpu"), strict=True):
        assert_near(found.cpu(), wanted, relative=5e-3, of_largest=1e-3)
