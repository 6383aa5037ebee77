"""The compiled blending of flow, forward and backward, against plain torch in float64."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core import Camera, InvalidInput, reference
from gsplat_core.ops.flow_blending import blend_flow, intrinsics_of
from tests.gsplat_core.ops.flow_scenes import AFTER, BEFORE, FlowScene, flow_scene


def evaluated(function, scene: FlowScene, dtype: torch.dtype, before: Camera = BEFORE) -> tuple[Tensor, Tensor]:
    """Return the blended flow, and the gradient of a fixed linear function of it by the planes."""
    given = scene.converted(dtype)
    offsets, ids = scene.lists(before)
    blended = function(*given, before, AFTER, offsets, ids)
    weights = torch.randn(blended.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights[..., 3] = 0  # the sum of the weights has no gradient
    (blended * weights.to(dtype)).sum().backward()
    return blended.detach(), given.planes.grad


def assert_equal_to_the_oracle(assert_near, scene: FlowScene, before: Camera = BEFORE) -> Tensor:
    blended, gradient = evaluated(blend_flow, scene, torch.float32, before)
    wanted, wanted_gradient = evaluated(reference.blend_flow, scene, torch.float64, before)
    for channel in range(4):
        assert_near(blended[..., channel], wanted[..., channel], of_largest=2e-5)
    assert_near(gradient, wanted_gradient, of_largest=2e-5)
    return blended


@pytest.mark.parametrize("count", [0, 1, 5, 400])
@pytest.mark.parametrize("size", [(70, 45), (1, 1), (16, 16), (33, 18)])
def test_blend_flow_of_any_size_equals_reference(assert_near, count, size):
    camera = Camera.from_focal(60.0, *size)
    assert_equal_to_the_oracle(assert_near, flow_scene(count, camera), camera)


def test_blend_flow_of_opaque_thin_and_huge_splats(assert_near):
    scene = flow_scene(300, median_px=6.0)
    scene.opacities[::2] = 1.0
    direction = torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2)
    thin = direction.T @ torch.diag(torch.tensor([1 / 80.0**2, 1 / 0.6**2])) @ direction
    scene.conics[::5] = thin.flatten()[[0, 1, 3]]
    scene.conics[1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    blended = assert_equal_to_the_oracle(assert_near, scene)
    assert float(blended[..., 3].max()) > 0.99


def test_blend_flow_limits_depth_to_reach_of_splat():
    scene = flow_scene(1)
    scene.means2d[:], scene.conics[:], scene.opacities[:] = 20.0, torch.tensor([1e-3, 0, 1e-3]), 0.9
    scene.rays[:] = torch.tensor([10.0, 3.0, 0, 0, 0, 0, 0, 0, 2.0, 0])
    scene.planes[:] = torch.tensor([0, 0, 0, 1.0, 0, 0, 0, 1, 0, 0, 0, 1])
    depth = blend_flow(*scene, BEFORE, BEFORE, *scene.lists(BEFORE))
    depth = depth[20, :, 2] / depth[20, :, 3].clamp(min=1e-6)
    torch.testing.assert_close(depth[19:21], torch.tensor([8.5, 11.5]))
    assert float(depth[18]) == 8.0 and float(depth[22]) == 12.0


def test_blend_flow_ignores_points_behind_second_camera(assert_near):
    scene = flow_scene(200)
    scene.planes[::3, 2] = -40.0
    front = FlowScene(*(tensor[torch.arange(200) % 3 != 0] for tensor in scene))
    blended = assert_equal_to_the_oracle(assert_near, scene)
    assert float(blended[..., 3].sum()) < float(blend_flow(*front, BEFORE, AFTER, *front.lists(BEFORE))[..., 3].sum())
    assert torch.isfinite(blended).all()


def test_blend_flow_skips_non_finite_splats():
    scene = flow_scene(120)
    bad = torch.zeros(120, dtype=torch.bool)
    places = [(tensor, column) for tensor in scene if tensor.ndim == 2 for column in range(tensor.shape[1])]
    for number, (tensor, column) in enumerate(places):
        tensor[3 * number, column] = (math.nan, math.inf, -math.inf)[number % 3]
        bad[3 * number] = True
    scene.opacities[118], bad[118] = math.nan, True
    good = FlowScene(*(tensor[~bad] for tensor in scene))
    blended, gradient = evaluated(blend_flow, scene, torch.float32)
    wanted, wanted_gradient = evaluated(blend_flow, good, torch.float32)
    assert torch.equal(blended, wanted) and torch.equal(gradient[~bad], wanted_gradient)
    assert not gradient[bad].any()


@pytest.mark.slow
def test_blend_flow_reference_passes_gradcheck():
    scene = flow_scene(12, Camera.from_focal(60.0, 18, 17)).converted(torch.float64)
    camera = Camera.from_focal(60.0, 18, 17)
    offsets, ids = FlowScene(*(tensor.detach().float() for tensor in scene)).lists(camera)
    blend = lambda planes: reference.blend_flow(*scene[:4], planes, camera, AFTER, offsets, ids)
    assert torch.autograd.gradcheck(blend, (scene.planes,), fast_mode=True)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_blend_flow_ops_pass_opcheck():
    scene = flow_scene(30)
    offsets, ids = scene.lists(BEFORE)
    rest = (offsets, ids, intrinsics_of(BEFORE, AFTER), BEFORE.width_px, BEFORE.height_px)
    planes = scene.planes.requires_grad_()
    torch.library.opcheck(torch.ops.gsplat_core.blend_flow.default, (*scene[:4], planes, *rest))
    v = torch.ones(BEFORE.height_px, BEFORE.width_px, 4)
    torch.library.opcheck(torch.ops.gsplat_core.blend_flow_backward.default, (*scene[:4], planes.detach(), *rest, v))


def test_blend_flow_rejects_invalid_arguments():
    scene = flow_scene(5)
    offsets, ids = scene.lists(BEFORE)
    cases = [
        ((*scene[:3], scene.rays[:, :9], scene.planes, BEFORE, AFTER, offsets, ids), r"rays must be \[N, 10\]"),
        ((*scene[:4], scene.planes[:4], BEFORE, AFTER, offsets, ids), r"planes must be \[N, 12\]"),
        ((*scene[:4], scene.planes.double(), BEFORE, AFTER, offsets, ids), "planes must be float32"),
        ((*scene, BEFORE, AFTER, offsets.long(), ids), "isect_offsets must be int32"),
        ((*scene, Camera(BEFORE.K, 70, 45, model="fisheye"), AFTER, offsets, ids), "pinhole cameras, got 'fisheye'"),
    ]
    for arguments, message in cases:
        with pytest.raises(InvalidInput, match=message):
            blend_flow(*arguments)
    with pytest.raises(InvalidInput, match="do not cover the image"):
        blend_flow(*scene, BEFORE, AFTER, offsets[:1].contiguous(), ids)
    with pytest.raises(RuntimeError, match="flatten_ids must be in"):
        blend_flow(*scene, BEFORE, AFTER, offsets, torch.full_like(ids, 5))
