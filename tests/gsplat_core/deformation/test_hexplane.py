"""The HexPlane field: its box, its axes and its network."""

import pytest
import torch

from gsplat_core.deformation import HexPlaneField
from gsplat_core.deformation.hexplane import KIND, MOST_ROWS, PLANE_NAMES, TIME_PLANES
from gsplat_core.deformation.kinds import NewField
from gsplat_core.errors import InvalidInput

WINDOW = (2.0, 4.0)
SMALL = {"channels": 8, "resolution": (6, 7, 5, 9), "levels": (1, 2), "width": 16, "depth": 2}


def small_field(gaussians, window=WINDOW):
    torch.manual_seed(3)
    return HexPlaneField(gaussians, window, **SMALL)


def test_hexplane_planes_have_configured_sizes(make_gaussians):
    field = small_field(make_gaussians(9))
    shapes = [{name: tuple(level[name].shape) for name in PLANE_NAMES} for level in field.planes]
    assert shapes[0] == {
        "xy": (7, 6, 8), "xz": (5, 6, 8), "yz": (5, 7, 8), "xt": (9, 6, 8), "yt": (9, 7, 8), "zt": (9, 5, 8),
    }  # fmt: skip
    assert shapes[1]["xy"] == (14, 12, 8) and shapes[1]["zt"] == (9, 10, 8)


def test_hexplane_default_config(make_gaussians):
    field = HexPlaneField(make_gaussians(2), WINDOW)
    assert field.config() == {
        "kind": "hexplane", "time_window_s": [2.0, 4.0], "channels": 32, "resolution": [64, 64, 64, 25],
        "levels": [1, 2], "width": 64, "depth": 3,
    }  # fmt: skip


def test_hexplane_box_contains_gaussians_and_spans_grid(make_gaussians):
    gaussians = make_gaussians(500)
    field = small_field(gaussians)
    first = field.coordinates(gaussians.means, WINDOW[0])
    last = field.coordinates(gaussians.means, WINDOW[1])
    assert (first[:, 3] == -1).all() and (last[:, 3] == 1).all()
    assert field.coordinates(gaussians.means, 3.0)[0, 3] == 0.0
    for axis in range(3):
        reach = first[:, axis]
        assert -1 < float(reach.min()) < -0.8 and 0.8 < float(reach.max()) < 1
    corners = field.coordinates(field.box, 3.0)[:, :3]
    torch.testing.assert_close(corners, torch.tensor([[-1.0] * 3, [1.0] * 3]))


def test_hexplane_clamps_positions_outside_box(make_gaussians):
    field = small_field(make_gaussians(20))
    outside = field.box.mean(dim=0) + torch.tensor([[1e4, 0.0, 0.0], [0.0, -1e4, 1e4]])
    coordinates = field.coordinates(outside, 3.0)
    assert coordinates[0, 0] == 1 and coordinates[1, 1] == -1 and coordinates[1, 2] == 1


@pytest.mark.parametrize("name", PLANE_NAMES)
def test_hexplane_features_depend_on_every_border_cell(name, make_gaussians):
    """A change of the first or the last row or column of any plane shows in the features: no part of an axis is unused."""
    gaussians = make_gaussians(5)
    field = small_field(gaussians)
    low, high = field.box
    ends = {0: (low, WINDOW[0]), -1: (high, WINDOW[1])}
    with torch.no_grad():
        for end, (corner, time_s) in ends.items():
            coordinates = field.coordinates(corner[None], time_s)
            before = field.features(coordinates)
            field.planes[0][name][end, end] += 1.0
            after = field.features(coordinates)
            assert (after[0] != before[0]).all()
            assert torch.equal(after[1], before[1])


def test_hexplane_field_varies_in_space_and_time(make_gaussians):
    gaussians = make_gaussians(200)
    field = small_field(gaussians)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
        deltas = torch.stack([field(gaussians, t).means - gaussians.means for t in torch.linspace(*WINDOW, 9).tolist()])
    in_time, in_space = deltas.std(dim=0).mean(), deltas.std(dim=1).mean()
    assert float(in_time) > 0.01 and float(in_space) > 0.01
    # The second half of the window differs from the first: time is not squeezed into half of the axis.
    assert float((deltas[-1] - deltas[4]).abs().mean()) > 0.01
    assert float((deltas[4] - deltas[0]).abs().mean()) > 0.01


def test_hexplane_extend_keeps_learned_motion(make_gaussians):
    gaussians = make_gaussians(50)
    field = small_field(gaussians)
    with torch.no_grad():
        for level in field.planes:
            for name in TIME_PLANES:  # a straight line in time, which interpolation keeps
                level[name].copy_(torch.linspace(0.5, 1.5, 9)[:, None, None].expand_as(level[name]))
        features = lambda time_s: field.features(field.coordinates(gaussians.means, time_s))
        before, end = features(2.5), features(4.0)
        field.extend((2.0, 6.0))
        torch.testing.assert_close(features(2.5), before)
        torch.testing.assert_close(features(6.0), end)
        assert field.time_window_s == (2.0, 6.0)


def test_hexplane_box_ignores_nan_positions(make_gaussians):
    gaussians = make_gaussians(10)
    gaussians.means[3, 1] = float("nan")
    field = small_field(gaussians)
    assert field.box.isfinite().all()
    torch.nn.init.ones_(field.head.weight)
    with torch.no_grad():
        moved = field(gaussians, 3.0).means
    assert moved[3].isnan().any()
    assert moved[[0, 1, 2, 4, 5, 6, 7, 8, 9]].isfinite().all()


@pytest.mark.parametrize(
    "wrong", [{"resolution": (1, 4, 4, 4)}, {"resolution": (4, 4, 4)}, {"levels": ()}, {"channels": 0}, {"depth": 0}]
)
def test_hexplane_rejects_invalid_architectures(wrong, make_gaussians):
    with pytest.raises(InvalidInput):
        HexPlaneField(make_gaussians(2), WINDOW, **(SMALL | wrong))


@pytest.mark.parametrize("count", [0, 1, 30])
def test_hexplane_frame_deltas_equal_forward_change(make_gaussians, count):
    gaussians = make_gaussians(count)
    field = small_field(gaussians)
    with torch.no_grad():
        field.head.weight.normal_(std=0.3)
        field.planes[0]["xt"].add_(0.3 * torch.rand_like(field.planes[0]["xt"]))
        moved = field(gaussians, 3.1)
    deltas = field.frame_deltas(gaussians)(torch.full((1,), field.frame_time(3.1)))
    assert deltas.shape == (count, 16) and not deltas[:, [10, 11, 12, 14, 15]].any()
    columns = {
        "means": deltas[:, :3],
        "quats": deltas[:, 3:7],
        "log_scales": deltas[:, 7:10],
        "logit_opacities": deltas[:, 13],
    }
    for name, added in columns.items():
        torch.testing.assert_close(gaussians.tensors()[name] + added, moved.tensors()[name], rtol=1e-5, atol=1e-5)


def test_hexplane_frame_time_clamped_to_window(make_gaussians):
    field = small_field(make_gaussians(3))
    assert [field.frame_time(t) for t in (1.0, 2.0, 3.0, 4.0, 9.0)] == [-1.0, -1.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize(("end_s", "rows"), [(6.0, 61), (1.0, 2), (1e6, MOST_ROWS)])
def test_hexplane_time_rows_follow_spacing_with_known_end(make_gaussians, end_s, rows):
    field = KIND.made_for(NewField(make_gaussians(5), 1.0, end_s, spacing_s=1 / 12))
    assert field.resolution[3] == rows
    assert field.time_window_s == (1.0, end_s)


def test_hexplane_online_field_has_default_size(make_gaussians):
    field = KIND.made_for(NewField(make_gaussians(5), 1.0, None, spacing_s=0.2))
    assert field.config() == HexPlaneField(make_gaussians(5), (1.0, 1.2)).config()
