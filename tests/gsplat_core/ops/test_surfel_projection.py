"""The compiled projection of surfels, forward and backward, against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.surfel_projection import fully_fused_projection_2dgs
from gsplat_core.reference import surfels as reference
from tests.gsplat_core.ops.surfel_scenes import PROJECTED, SurfelScene, close, surfel_scene


def assert_close(scene: SurfelScene, **options: float) -> dict[str, torch.Tensor]:
    rounded = replace(scene, **{n: getattr(scene, n).float().double() for n in ("means", "quats", "scales")})
    seen, wanted = rounded.project(torch.float32, **options), rounded.project(**options)
    torch.testing.assert_close(seen.pop("radii"), wanted.pop("radii"), rtol=0, atol=1)
    close(seen, wanted, 1e-5)
    return seen


@pytest.mark.parametrize(("batch", "cameras"), [((), 1), ((2,), 3), ((1, 2), 2), ((0,), 2)])
def test_surfel_projection_of_batches_and_cameras_equals_reference(batch: tuple[int, ...], cameras: int) -> None:
    seen = assert_close(surfel_scene(70, batch=batch, cameras=cameras))
    assert seen["ray_transforms"].shape == (*batch, cameras, 70, 3, 3)


def test_surfel_projection_without_surfels_or_cameras() -> None:
    assert_close(surfel_scene(0))
    assert_close(surfel_scene(5, cameras=0))


def test_surfel_ray_transform_maps_surfel_points_to_pixels() -> None:
    s = surfel_scene(20)
    out = fully_fused_projection_2dgs(
        *(t.float() for t in (s.means, s.quats, s.scales, s.viewmats, s.Ks)), s.width, s.height
    )
    w, x, y, z = torch.nn.functional.normalize(s.quats, dim=-1).unbind(-1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    points = s.means + 0.7 * s.scales[:, :1] * first
    expected = (s.Ks[0] @ (s.viewmats[0, :3, :3] @ points.T + s.viewmats[0, :3, 3:])).T
    seen = out.ray_transforms[0].double() @ torch.tensor([0.7, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(seen, expected, rtol=1e-5, atol=1e-4)


def test_surfel_projection_of_facing_surfel_has_bounding_box_of_disc() -> None:
    # At z = 2 and a focal length of 100 px, a standard deviation of 0.1 is 5 px, and its outline is that of a circle.
    one = torch.tensor([[0.0, 0.0, 2.0]])
    K = torch.tensor([[[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]])
    out = fully_fused_projection_2dgs(
        one, torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.1, 0.1, 1.0]]), torch.eye(4)[None], K, 100, 80
    )
    torch.testing.assert_close(out.means2d, torch.tensor([[[50.0, 40.0]]]))
    assert out.radii.tolist() == [[[math.ceil(3.33 * 5)] * 2]]
    torch.testing.assert_close(out.normals, torch.tensor([[[0.0, 0.0, -1.0]]]))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_surfel_projection_culls_invisible_surfels_without_gradient() -> None:
    s = surfel_scene(24)
    for i, bad in enumerate((math.nan, math.inf, -math.inf, 1e38)):
        s.means[i, 2] = bad
        s.quats[4 + i, 1] = bad
        s.scales[8 + i, 0] = bad
    s.quats[12] = 0
    s.means[13] = torch.tensor([0.0, 0.0, -2.0])  # behind the camera
    s.means[14] = torch.tensor([0.0, 0.0, 0.005])  # in front of the near plane
    s.means[15] = torch.tensor([50.0, 0.0, 2.0])  # outside of the image
    seen = s.project(torch.float32)
    assert not seen["radii"][0, :16].any()
    assert seen["radii"][0, 16:].all()
    for name in PROJECTED:
        assert not seen[name][0, :16].any(), name
    for name in ("v_means", "v_quats", "v_scales"):
        assert not seen[name][:16].any(), name
        assert seen[name].isfinite().all()
    assert seen["v_viewmats"].isfinite().all()


def test_surfel_projection_of_edge_on_surfels_and_surfels_behind_camera() -> None:
    s = surfel_scene(40)
    s.quats[::2] = torch.tensor([math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 1e-3])  # normal along x
    s.scales[1::2] = 5.0
    seen = s.project(torch.float32)
    assert all(value.isfinite().all() for value in seen.values())
    assert_close(replace(s, means=s.means[1::2], quats=s.quats[1::2], scales=s.scales[1::2]))


def test_surfel_projection_clips_near_far_and_radius() -> None:
    assert_close(surfel_scene(60), near_plane=2.4, far_plane=2.8)
    assert_close(surfel_scene(60), radius_clip=12.0)


def test_surfel_projection_packed_rows_are_visible_surfels() -> None:
    s = surfel_scene(80, batch=(2,), cameras=2, scale=0.05)
    s.means[..., :40, 2] -= 3
    tensors = [t.float() for t in (s.means, s.quats, s.scales, s.viewmats, s.Ks)]
    dense = fully_fused_projection_2dgs(*tensors, s.width, s.height)
    packed = fully_fused_projection_2dgs(*tensors, s.width, s.height, packed=True)
    at = packed.batch_ids, packed.camera_ids, packed.gaussian_ids
    assert len(at[0]) == (dense.radii[..., 0] > 0).sum() < dense.depths.numel()
    for name in ("radii", *PROJECTED):
        assert torch.equal(getattr(packed, name), getattr(dense, name)[at]), name


def test_surfel_projection_reference_passes_gradcheck() -> None:
    s = surfel_scene(3)

    def function(means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, viewmats: torch.Tensor) -> tuple:
        out = reference.fully_fused_projection_2dgs(means, quats, scales, viewmats, s.Ks, s.width, s.height)
        return tuple(getattr(out, name) for name in PROJECTED)

    inputs = [t.clone().requires_grad_() for t in (s.means, s.quats, s.scales, s.viewmats)]
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # read by opcheck itself
def test_surfel_projection_ops_pass_opcheck() -> None:
    s = surfel_scene(5, batch=(2,))
    tensors = [t.float() for t in (s.means, s.quats, s.scales, s.viewmats, s.Ks)]
    leaves = [t.requires_grad_() for t in tensors[:4]]
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.project_surfels, (*leaves, tensors[4], s.width, s.height, 0.01, 1e10, 0.0))
    plain = [t.detach() for t in tensors]
    means2d, _, transforms, normals, radii = ops.project_surfels(*plain, s.width, s.height, 0.01, 1e10, 0.0)
    gradients = (means2d, None, transforms, normals)
    for needs_viewmats in (False, True):
        torch.library.opcheck(ops.project_surfels_backward, (*plain, radii, *gradients, needs_viewmats))


def test_surfel_projection_rejects_invalid_arguments() -> None:
    s = surfel_scene(5)
    tensors = [t.float() for t in (s.means, s.quats, s.scales, s.viewmats, s.Ks)]
    for position, value, message in (
        (0, tensors[0][:, :2], r"means must be \[..., N, 3\]"),
        (1, tensors[1][:4], r"quats must be \[..., N, 4\] = \[5, 4\], got \[4, 4\]"),
        (2, tensors[2].double(), r"one floating-point dtype"),
        (3, tensors[3][0], r"viewmats must be"),
    ):
        wrong = list(tensors)
        wrong[position] = value
        with pytest.raises(InvalidInput, match=message):
            fully_fused_projection_2dgs(*wrong, s.width, s.height)
    with pytest.raises(InvalidInput, match="width=0"):
        fully_fused_projection_2dgs(*tensors, 0, 5)
    with pytest.raises(InvalidInput, match="packed=True"):
        fully_fused_projection_2dgs(*tensors, 5, 5, sparse_grad=True)
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        fully_fused_projection_2dgs(*(t.double() for t in tensors), 5, 5)
