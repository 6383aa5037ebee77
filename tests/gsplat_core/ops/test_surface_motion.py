"""The compiled motion and path of surface points against the same in plain torch (`SurfaceMotion` in float64)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.surface_motion import surface_motion, surface_path
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.image_motion import SurfaceMotion


def pose(angle: float, shift: tuple[float, float, float]) -> NDArray[np.float64]:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0, sin, shift[0]], [0, 1, 0, shift[1]], [-sin, 0, cos, shift[2]], [0, 0, 0, 1]])


BEFORE = Camera.from_focal(70.0, 64, 48)
AFTER = Camera(np.array([[90.0, 0, 30], [0, 80, 25], [0, 0, 1]]), 64, 48, pose(0.1, (2.0, -1.0, 3.0)))


def scene(count: int, cells: tuple[int, int] = (12, 16), dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(count)
    points = torch.rand(count, 3, generator=random, dtype=torch.float64) * 60 - torch.tensor([30.0, 30.0, 0.0])
    points[:, 2] += 20
    flow = torch.randn(*cells, 2, generator=random, dtype=torch.float64)
    return points.to(dtype), flow.to(dtype)


def exact(points: Tensor, flow: Tensor, before: Camera, after: Camera, arrived: bool) -> Tensor:
    motion = SurfaceMotion(flow.double(), before, after)
    return motion.arrived(points.double()) if arrived else motion.ahead(points.double())


@pytest.mark.parametrize("arrived", [False, True])
@pytest.mark.parametrize("count", [0, 1, 15, 17, 5000])
@pytest.mark.parametrize("cells", [(1, 1), (1, 7), (12, 16), (48, 64)])
def test_surface_motion_equals_reference(count: int, cells: tuple[int, int], arrived: bool) -> None:
    points, flow = scene(count, cells, torch.float32)
    seen = surface_motion(points, flow, BEFORE, AFTER, arrived=arrived)
    wanted = exact(points, flow, BEFORE, AFTER, arrived)
    # A point within rounding of the picture's edge may be on either side of it.
    close = torch.isclose(seen.double(), wanted, rtol=1e-4, atol=2e-4).all(dim=1)
    assert int((~close).sum()) <= count // 1000
    assert count < 5000 or 0.2 < float((wanted != 0).any(dim=1).double().mean()) < 0.9


@pytest.mark.parametrize("arrived", [False, True])
def test_surface_motion_zero_for_points_outside_view(arrived: bool) -> None:
    points = torch.tensor(
        [[0, 0, -50], [0, 0, 0], [1e30, 0, 1], [math.nan, 0, 50], [math.inf, 0, 50], [0, 0, math.nan], [900, 0, 50]],
        dtype=torch.float32,
    )
    _, flow = scene(1, dtype=torch.float32)
    assert not surface_motion(points, flow, BEFORE, BEFORE, arrived=arrived).any()


def test_surface_motion_nan_flow_affects_nearby_points_only() -> None:
    points = torch.tensor([[-10.0, -5.0, 50.0], [10.0, 5.0, 50.0]])
    flow = torch.ones(12, 16, 2)
    flow[:, 8:] = math.nan
    motion = surface_motion(points, flow, BEFORE, BEFORE, arrived=False)
    torch.testing.assert_close(motion[0], torch.tensor([50 / 70, 50 / 70, 0.0]))
    assert motion[1].isnan().any()


def test_surface_motion_uses_op_for_cpu_float32_without_gradient_only(monkeypatch: pytest.MonkeyPatch) -> None:
    points, flow = scene(9, dtype=torch.float32)
    calls: list[bool] = []

    def counted(*arguments: object, arrived: bool) -> Tensor:
        calls.append(arrived)
        return torch.zeros(9, 3)

    monkeypatch.setattr("gsplat_core.training.image_motion.surface_motion", counted)
    motion = SurfaceMotion(flow, BEFORE, AFTER)
    motion.ahead(points), motion.arrived(points)
    assert calls == [False, True]
    SurfaceMotion(flow.double(), BEFORE, AFTER).ahead(points.double())
    motion.ahead(points.clone().requires_grad_())
    assert calls == [False, True]


def test_surface_motion_op_passes_opcheck() -> None:
    points, flow = scene(20, dtype=torch.float32)
    view = [*BEFORE.world_to_camera[:3].ravel().tolist(), 70.0, 70.0, 32.0, 24.0, 64.0, 48.0]
    for arrived in (False, True):
        torch.library.opcheck(torch.ops.gsplat_core.surface_motion.default, (points, flow, view, view, arrived))


def test_surface_motion_rejects_invalid_inputs() -> None:
    points, flow = scene(3, dtype=torch.float32)
    ortho = Camera(BEFORE.K, 64, 48, model="ortho")
    with pytest.raises(InvalidInput, match="pinhole"):
        surface_motion(points, flow, ortho, BEFORE, arrived=False)
    with pytest.raises(InvalidInput, match="float32"):
        surface_motion(points.double(), flow, BEFORE, BEFORE, arrived=False)
    for wrong_points, wrong_flow in ((points[:, :2], flow), (points, flow[..., :1]), (points, flow[:0])):
        with pytest.raises(RuntimeError, match="must be"):
            surface_motion(wrong_points, wrong_flow, BEFORE, BEFORE, arrived=False)


def path_scene(steps: int, count: int, cells: tuple[int, int] = (12, 16)) -> tuple[Tensor, Tensor, list[Camera]]:
    points, _ = scene(count, dtype=torch.float32)
    flows = torch.randn(steps, *cells, 2, generator=torch.Generator().manual_seed(steps))
    cameras = [Camera(BEFORE.K, 64, 48, pose(0.02 * k, (0.3 * k, -0.2 * k, 0.1 * k))) for k in range(steps + 1)]
    return points, flows, cameras


def exact_path(points: Tensor, flows: Tensor, cameras: list[Camera]) -> Tensor:
    positions = [points.double()]
    for k, flow in enumerate(flows):
        positions.append(positions[-1] + SurfaceMotion(flow.double(), cameras[k], cameras[k + 1]).ahead(positions[-1]))
    return torch.stack(positions[1:], dim=1) if len(flows) else points.double().new_empty(len(points), 0, 3)


@pytest.mark.parametrize(("steps", "count"), [(0, 5), (1, 0), (1, 1), (3, 17), (20, 3000)])
@pytest.mark.parametrize("cells", [(1, 1), (12, 16)])
def test_surface_path_equals_motion_through_each_image(steps: int, count: int, cells: tuple[int, int]) -> None:
    points, flows, cameras = path_scene(steps, count, cells)
    found, wanted = surface_path(points, flows, cameras), exact_path(points, flows, cameras)
    assert found.shape == (count, steps, 3)
    # A point within rounding of the picture's edge may be on either side of it.
    close = torch.isclose(found.double(), wanted, rtol=1e-4, atol=1e-3).all(dim=2).all(dim=1)
    assert int((~close).sum()) <= count // 100
    assert steps < 20 or (found - points[:, None]).abs().amax(dim=(1, 2)).median() > 0.1


def test_surface_path_keeps_points_outside_view() -> None:
    _, flows, cameras = path_scene(3, 1)
    points = torch.tensor([[0, 0, -50], [math.nan, 0, 50], [900, 0, 50]], dtype=torch.float32)
    found = surface_path(points, flows, cameras)
    torch.testing.assert_close(found, points[:, None].expand(-1, 3, -1), equal_nan=True)


def test_surface_path_passes_opcheck_and_rejects_invalid_inputs() -> None:
    points, flows, cameras = path_scene(2, 20)
    views = torch.rand(3, 18) + 1
    torch.library.opcheck(torch.ops.gsplat_core.surface_path.default, (points, flows, views))
    for wrong in (flows[..., :1], flows[:, :0], flows[0], flows[:1]):
        with pytest.raises(InvalidInput, match="flows"):
            surface_path(points, wrong, cameras)
    with pytest.raises(InvalidInput, match="pinhole"):
        surface_path(points, flows, [*cameras[:2], Camera(BEFORE.K, 64, 48, model="ortho")])
    with pytest.raises(InvalidInput, match="float32"):
        surface_path(points.double(), flows, cameras)
    with pytest.raises(RuntimeError, match="must be"):
        surface_path(points[:, :2], flows, cameras)
