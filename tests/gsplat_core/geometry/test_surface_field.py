"""A smooth field of vectors over scattered points."""

from __future__ import annotations

import torch

from gsplat_core.poses.moving_bundle import APART, SurfaceField


def sheet(count: int = 400) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    across = torch.rand(count, 2, generator=random, dtype=torch.float64) - 0.5
    return torch.cat([across, 1 + 0.1 * torch.sin(9 * across[:, :1])], 1)


def test_surface_field_influence_at_nodes_and_points():
    points = sheet()
    field = SurfaceField.over(points)
    own = field.influence(field.nodes)
    assert float(own.diagonal().min()) > 0.9 and bool((own.argmax(1) == torch.arange(len(own))).all())
    torch.testing.assert_close(field.influence(points).sum(1), torch.ones(len(points)).double(), atol=0.01, rtol=0)


def test_surface_field_reproduces_rigid_motion_and_slow_waves():
    points = sheet()
    field = SurfaceField.over(points)
    for motion in (
        lambda p: torch.ones_like(p),
        lambda p: torch.cross(p, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64).expand_as(p), dim=1),
        lambda p: torch.sin(4 * p[:, :1]) * torch.ones_like(p),
    ):
        found = field.influence(points) @ motion(field.nodes)
        off = (found - motion(points)).norm(dim=1)
        assert float(off.max()) < 0.15 and float(off.median()) < 0.01  # the largest are at the border of the sheet


def test_surface_field_stiffness_grows_with_bending():
    field = SurfaceField.over(sheet())
    unlikely = [float(v @ field.stiffness @ v) for v in (torch.sin(bends * field.nodes[:, 0]) for bends in (1, 6, 20))]
    assert unlikely[0] < unlikely[1] < unlikely[2]


def test_surface_field_nodes_are_limited_and_spaced():
    points = torch.cat([sheet(), sheet() + 1e-9])
    field = SurfaceField.over(points, most=25)
    assert len(field.nodes) == 25
    assert float((torch.cdist(field.nodes, field.nodes) + 10 * torch.eye(25)).min()) > 0.5 * APART
    assert len(SurfaceField.over(points[:1].expand(40, 3)).nodes) == 1
