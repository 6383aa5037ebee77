"""gsplat's names for deforming Gaussians: HexPlane field, network, strategy and regularisers."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from torch.nn.functional import grid_sample

from gsplat_core import rasterization
from gsplat_core.contrib import (
    DeformNetwork,
    DynamicStrategy,
    HexPlaneField,
    hexplane_regularization,
    plane_smoothness,
    time_l1,
    time_smoothness,
)

SMALL = {
    "grid_dimensions": 2,
    "input_coordinate_dim": 4,
    "output_coordinate_dim": 5,
    "resolution": [6, 7, 8, 4],
}


def small_field(dtype=torch.float32):
    torch.manual_seed(0)
    field = HexPlaneField(1.3, SMALL, (1, 2))
    with torch.no_grad():
        for plane in field.temporal_planes():
            plane.uniform_(0.5, 1.5)
    return field.to(dtype)


def expected_features(field, xyzt):
    """The features by torch alone: each plane [1, C, V, U] is sampled at the coordinates of its axes (u, v)."""
    coordinates = torch.cat([-xyzt[:, :3] / field.aabb[0], xyzt[:, 3:]], 1)
    levels = []
    for level in field.grids:
        product = 1
        for plane, axes in zip(level, combinations(range(4), 2), strict=True):
            grid = coordinates[None, None, :, list(axes)]
            product = product * grid_sample(plane, grid, padding_mode="border", align_corners=True)[0, :, 0].T
        levels.append(product)
    return torch.cat(levels, 1)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-12)])
def test_hexplane_features_and_gradients_equal_sampled_planes(dtype, tolerance):
    field = small_field(dtype)
    xyzt = (torch.rand(40, 4, dtype=dtype) * 3 - 1.5).requires_grad_()  # some are outside
    inputs = [xyzt, *field.spatial_planes(), *field.temporal_planes()]
    weights = torch.rand(40, 10, dtype=dtype)
    found, wanted = field(xyzt), expected_features(field, xyzt)
    assert found.shape == (40, field.feat_dim) and (found - wanted).abs().max() < tolerance
    for own, other in zip(
        torch.autograd.grad((found * weights).sum(), inputs),
        torch.autograd.grad((wanted * weights).sum(), inputs),
        strict=True,
    ):
        assert (own - other).abs().max() < 10 * tolerance * max(1, float(other.abs().max()))


def test_hexplane_parameters_have_names_and_shapes_of_gsplat():
    field = small_field()
    shapes = {name: tuple(tensor.shape) for name, tensor in field.state_dict().items()}
    assert shapes["aabb"] == (2, 3) and field.aabb[0].tolist() == pytest.approx([1.3] * 3)
    assert [shapes[f"grids.1.{k}"] for k in range(6)] == [
        (1, 5, 14, 12), (1, 5, 16, 12), (1, 5, 4, 12), (1, 5, 16, 14), (1, 5, 4, 14), (1, 5, 4, 16),
    ]  # fmt: skip
    other = HexPlaneField(1.3, SMALL, (1, 2))
    xyzt = torch.rand(6, 4)
    assert not torch.equal(other(xyzt), field(xyzt))
    other.load_state_dict({name: tensor.contiguous() for name, tensor in field.state_dict().items()})
    assert torch.equal(other(xyzt), field(xyzt))
    assert HexPlaneField().feat_dim == 64


def test_hexplane_rejects_invalid_inputs():
    with pytest.raises(ValueError, match="last dim"):
        small_field()(torch.rand(3, 3))
    with pytest.raises(ValueError, match="grid_dimensions 2"):
        HexPlaneField(planes_config={**SMALL, "grid_dimensions": 3})


def test_untrained_deform_network_is_identity_and_trainable():
    network = DeformNetwork(10, 8, 2)
    means, quats, opacities, features = torch.rand(4, 3), torch.rand(4, 4), torch.rand(4, 1), torch.rand(4, 10)
    found = network(means, quats, opacities, torch.zeros(4, 1), features)
    assert all(torch.equal(a, b) for a, b in zip(found, (means, quats, opacities), strict=True))
    found[0].sum().backward()
    assert network.pos_head.weight.grad.abs().sum() > 0
    assert {name.split(".")[0] for name in network.state_dict()} == {"trunk", "pos_head", "quat_head", "opacity_head"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"means": torch.rand(3, 3)}, "batch dim mismatch"),
        ({"plane_features": torch.rand(4, 9)}, "feature_dim 10"),
        ({"quats": torch.rand(4, 4, dtype=torch.float64)}, "dtype mismatch"),
    ],
)
def test_deform_network_rejects_mismatched_tensors(change, reason):
    given = {
        "means": torch.rand(4, 3), "quats": torch.rand(4, 4), "opacities": torch.rand(4, 1), "t": torch.zeros(4, 1),
        "plane_features": torch.rand(4, 10),
    }  # fmt: skip
    with pytest.raises(ValueError, match=reason):
        DeformNetwork(10)(**{**given, **change})


@pytest.mark.slow
def test_dynamic_strategy_mask_follows_rows():
    generator = torch.Generator().manual_seed(0)
    n = 12
    values = {
        "means": torch.randn(n, 3, generator=generator) * 0.3,
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.full((n, 3), -2.0),
        "opacities": torch.tensor([-9.0] * 3 + [1.0] * (n - 3)),
        "colors": torch.arange(n).float()[:, None].repeat(1, 3),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    optimizers = {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}
    strategy = DynamicStrategy(refine_start_iter=0, refine_every=1, reset_every=1000, grow_grad2d=1e-8)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0, num_gaussians=n, init_dynamic=False)
    state["dynamic_mask"][torch.arange(n) % 2 == 0] = True
    pose = torch.eye(4)
    pose[2, 3] = 3
    colors, _, info = rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
        pose[None],
        torch.tensor([[[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]]), 32, 24, packed=False,
    )  # fmt: skip
    strategy.step_pre_backward(params, optimizers, state, 1, info)
    colors.square().sum().backward()
    strategy.step_post_backward(params, optimizers, state, 1, info)
    rows = params["colors"].detach()[:, 0].long()  # each row's origin
    assert len(rows) > n - 3 and rows.min() == 3
    assert torch.equal(state["dynamic_mask"], rows % 2 == 0)
    with pytest.raises(RuntimeError, match="initialize_state"):
        strategy.step_post_backward(params, optimizers, {"grad2d": None, "count": None}, 1, info)


def test_hexplane_regularisers_closed_form():
    rows = torch.arange(8.0)
    ramp, square = (values.view(1, 1, 8, 1).expand(1, 4, 8, 6) for values in (rows, rows**2))
    assert plane_smoothness([ramp]) < 1e-10
    assert plane_smoothness([square, ramp, square]) == pytest.approx(8)  # each second difference is 2
    assert plane_smoothness([square[:, :, :2]]) == 0 and plane_smoothness([]) == 0
    with pytest.raises(ValueError, match="4D"):
        plane_smoothness([torch.rand(3, 3)])
    halves = torch.full((1, 1, 4, 4), 0.5, requires_grad=True)
    assert time_l1([halves, 1.2 + 0 * halves]).item() == pytest.approx(0.7)
    assert torch.autograd.grad(time_l1([halves]), halves)[0].allclose(torch.full((1, 1, 4, 4), -1 / 16))
    field = small_field()
    found = hexplane_regularization(field, 2.0, 3.0, 5.0)
    space, time = field.spatial_planes(), field.temporal_planes()
    wanted = 2 * plane_smoothness(space) + 3 * time_smoothness(time) + 5 * time_l1(time)
    assert found.item() == pytest.approx(wanted.item())
