"""Projection and blending in separate steps of plain torch."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import (
    InvalidInput,
    accumulate,
    fully_fused_projection,
    proj,
    quat_scale_to_covar_preci,
    rasterization,
    rasterize_to_indices_in_range,
    world_to_cam,
)

WIDTH, HEIGHT, N = 40, 24, 60


def scene(batch: tuple[int, ...] = (2,)):
    generator = torch.Generator().manual_seed(5)
    random = lambda *shape: torch.rand(*batch, *shape, generator=generator)
    viewmats = torch.eye(4).repeat(*batch, 2, 1, 1)
    viewmats[..., 1, :3, 3] = torch.tensor([0.2, -0.1, 0.3])
    K = torch.tensor([[30.0, 0, 20], [0, 32, 12], [0, 0, 1]]).repeat(*batch, 2, 1, 1)
    means = random(N, 3) * torch.tensor([3.0, 2, 2]) + torch.tensor([-1.5, -1, 2])
    return means, random(N, 4) - 0.5, 0.05 + 0.2 * random(N, 3), random(N), random(N, 3), viewmats, K


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_separate_projection_steps_equal_fused_projection(model: str):
    means, quats, scales, _, _, viewmats, K = scene()
    covars, _ = quat_scale_to_covar_preci(quats, scales)
    found, spread = proj(*world_to_cam(means, covars, viewmats), K, WIDTH, HEIGHT, model)
    radii, means2d, _, conics, _ = fully_fused_projection(
        means, None, quats, scales, viewmats, K, WIDTH, HEIGHT, camera_model=model
    )
    seen = (radii > 0).all(-1)
    assert seen.any()
    torch.testing.assert_close(found[seen], means2d[seen], rtol=1e-4, atol=1e-4)
    inverse = torch.linalg.inv(spread + 0.3 * torch.eye(2))
    triangles = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    torch.testing.assert_close(triangles[seen], conics[seen], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_separate_projection_steps_pass_gradcheck(model: str):
    means, quats, scales, _, _, viewmats, K = (
        each[..., :3, :] if each.shape[-2:-1] == (N,) else each for each in scene(())
    )
    covars, _ = quat_scale_to_covar_preci(quats, scales)
    inputs = [each.double().requires_grad_() for each in (means, covars, viewmats, K)]
    function = lambda m, c, v, k: proj(*world_to_cam(m, c, v), k, WIDTH, HEIGHT, model)
    assert torch.autograd.gradcheck(function, inputs)


@pytest.mark.parametrize("ranges", [[(0, 10**10)], [(0, 1), (1, 10**10)]])
def test_accumulated_pairs_equal_rasterization(ranges: list[tuple[int, int]]):
    means, quats, scales, opacities, colors, viewmats, K = scene()
    tile = 4  # so that a tile's list has several batches
    expected, covered, meta = rasterization(
        means, quats, scales, opacities, colors, viewmats, K, WIDTH, HEIGHT, packed=False, tile_size=tile
    )
    splats = meta["means2d"], meta["conics"], opacities[:, None].expand(2, 2, N)
    per_camera = colors[:, None].expand(2, 2, N, 3)
    image, alphas = torch.zeros(2, 2, HEIGHT, WIDTH, 3), torch.zeros(2, 2, HEIGHT, WIDTH, 1)
    for start, end in ranges:
        through = 1 - alphas
        pairs = rasterize_to_indices_in_range(
            start, end, through[..., 0], *splats, WIDTH, HEIGHT, tile, meta["isect_offsets"], meta["flatten_ids"]
        )
        assert all(ids.dtype == torch.int64 and len(ids) == len(pairs[0]) > 0 for ids in pairs)
        part, opaque = accumulate(*splats, per_camera, *pairs, WIDTH, HEIGHT)
        image, alphas = image + through * part, alphas + through * opaque
    torch.testing.assert_close(image, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alphas, covered, rtol=1e-4, atol=1e-5)


def test_accumulated_gradients_equal_compositing():
    means, quats, scales, opacities, colors, viewmats, K = scene(())
    leaves = [each.requires_grad_() for each in (means, quats, scales, opacities, colors)]
    weights = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    image, _, meta = rasterization(*leaves, viewmats, K, WIDTH, HEIGHT, packed=False)
    expected = torch.autograd.grad((image * weights).sum(), leaves)
    _, means2d, _, conics, _ = fully_fused_projection(
        means, None, quats, scales, viewmats, K, WIDTH, HEIGHT, opacities=opacities
    )
    splats = means2d, conics, opacities.expand(2, N)
    pairs = rasterize_to_indices_in_range(
        0, 10**9, torch.ones(2, HEIGHT, WIDTH), *splats, WIDTH, HEIGHT, 16, meta["isect_offsets"], meta["flatten_ids"]
    )
    blended, _ = accumulate(*splats, colors.expand(2, N, 3), *pairs, WIDTH, HEIGHT)
    for found, wanted in zip(torch.autograd.grad((blended * weights).sum(), leaves), expected, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3 * float(wanted.abs().max()))


def test_accumulate_without_pairs_gives_black_image():
    nothing = torch.zeros(1, 0, 2), torch.zeros(1, 0, 3), torch.zeros(1, 0)
    starts, ids = torch.zeros(1, 1, 1, dtype=torch.int32), torch.zeros(0, dtype=torch.int32)
    pairs = rasterize_to_indices_in_range(0, 1, torch.ones(1, 8, 8), *nothing, 8, 8, 16, starts, ids)
    image, alphas = accumulate(*nothing, torch.zeros(1, 0, 3), *pairs, 8, 8)
    assert image.shape == (1, 8, 8, 3) and not image.any() and not alphas.any()


def test_separate_steps_reject_invalid_shapes():
    means, _, _, _, _, viewmats, K = scene(())
    covars = torch.eye(3).expand(N, 3, 3)
    with pytest.raises(InvalidInput, match=r"covars must be \[..., N, 3, 3\]"):
        world_to_cam(means, covars[:-1], viewmats)
    with pytest.raises(InvalidInput, match=r"viewmats must be \[..., C, 4, 4\]"):
        world_to_cam(means, covars, viewmats[0])
    with pytest.raises(InvalidInput, match="no camera model 'ftheta'"):
        proj(means[None], covars[None], K[:1], WIDTH, HEIGHT, "ftheta")
    with pytest.raises(InvalidInput, match="do not cover"):
        rasterize_to_indices_in_range(
            0, 1, torch.ones(1, 8, 20), torch.zeros(1, 1, 2), torch.ones(1, 1, 3), torch.ones(1, 1), 20, 8, 16,
            torch.zeros(1, 1, 1, dtype=torch.int32), torch.zeros(0, dtype=torch.int32),
        )  # fmt: skip
