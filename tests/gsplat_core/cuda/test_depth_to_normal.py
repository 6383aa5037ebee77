"""Normals of depth maps on CUDA against plain torch in float64, and repeated."""

from __future__ import annotations

import pytest
import torch

from tests.gsplat_core.ops.depth_maps import compared


@pytest.mark.parametrize(
    ("leading", "height", "width"), [((), 37, 45), ((2, 3), 20, 31), ((4,), 2, 9), ((2,), 0, 7), ((), 512, 640)]
)
def test_depth_to_normal_equals_reference_and_is_deterministic(gpu, leading, height, width):
    seen, again = (compared(leading, height, width, gpu, torch.float32) for _ in range(2))
    for name, value in compared(leading, height, width, "cpu", torch.float64).items():
        assert torch.equal(seen[name], again[name]), name
        scale = float(value.abs().max()) if value.numel() else 0.0
        torch.testing.assert_close(seen[name].double(), value, rtol=1e-4, atol=1e-5 * scale, msg=name)
