"""Projection of surfels on CUDA, forward and backward, against plain torch in float64 and against the CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.gsplat_core.ops.surfel_scenes import close, surfel_scene


@pytest.mark.parametrize(
    ("count", "batch", "cameras"), [(0, (), 1), (1, (), 1), (300, (), 3), (300, (2,), 2), (5, (0,), 2)]
)
def test_surfel_projection_of_batches_and_cameras_equals_reference(gpu, count, batch, cameras):
    s = surfel_scene(count, batch=batch, cameras=cameras)
    s = replace(s, **{name: getattr(s, name).float().double() for name in ("means", "quats", "scales")})
    seen, wanted = s.project(torch.float32, gpu), s.project()
    torch.testing.assert_close(seen.pop("radii").cpu(), wanted.pop("radii"), rtol=0, atol=1)
    close(seen, wanted, 1e-5)


def test_surfel_projection_culls_invalid_surfels_without_gradient(gpu):
    s = surfel_scene(40)
    s.means[0, 0] = s.quats[1, 2] = s.scales[2, 1] = float("nan")
    s.means[3, 2] = -1
    s.quats[4] = 0
    seen = s.project(torch.float32, gpu)
    assert not seen["radii"][0, :5].any()
    assert all(bool(value.isfinite().all()) for value in seen.values())
    for name in ("v_means", "v_quats", "v_scales"):
        assert not seen[name][:5].any()


def test_surfel_projection_of_large_scene_equals_cpu_and_is_deterministic(gpu):
    s = surfel_scene(20_000, 640, 512, cameras=2)
    first, second, cpu = s.project(torch.float32, gpu), s.project(torch.float32, gpu), s.project(torch.float32)
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    torch.testing.assert_close(first.pop("radii").cpu(), cpu.pop("radii"), rtol=0, atol=1)
    close(first, {name: value.double() for name, value in cpu.items()}, 1e-4)
