"""The fit of disparities on the GPU against the oracle in float64, and against the CPU."""

from __future__ import annotations

import torch

from gsplat_core.ops.disparity_fit import fit_disparities
from gsplat_core.ops.stereo_matching import UNKNOWN, match_disparities
from tests.gsplat_core.ops.stereo_cases import every_case, pair
from tests.gsplat_core.ops.test_disparity_fit import check_against_reference


@every_case
def test_disparity_fit_equals_reference(gpu, case):
    kind, height, width, lowest, count = case
    left, right = pair(kind, height, width)
    check_against_reference(left, right, match_disparities(left, right, lowest, count).sixteenths, gpu)


def test_disparity_fit_of_usual_image_size_equals_cpu(gpu):
    left, right = pair("steps", 512, 640)
    start = match_disparities(left, right, 0, 32).sixteenths
    assert (start == UNKNOWN).any()
    here, there = fit_disparities(left, right, start), fit_disparities(left.to(gpu), right.to(gpu), start.to(gpu))
    torch.testing.assert_close(there.px.cpu(), here.px, rtol=0, atol=2e-3)
    torch.testing.assert_close(there.error_px.cpu(), here.error_px, rtol=5e-3, atol=1e-4)


def test_disparity_fit_is_deterministic(gpu):
    left, right = (each.to(gpu) for each in pair("noise", 200, 300))
    start = torch.zeros(200, 300, dtype=torch.int32, device=gpu)
    first, second = (fit_disparities(left, right, start) for _ in range(2))
    assert torch.equal(first.px, second.px) and torch.equal(first.error_px, second.error_px)


def test_disparity_fit_without_pixels(gpu):
    nothing = torch.zeros(5, 0, dtype=torch.uint8, device=gpu)
    assert fit_disparities(nothing, nothing, nothing.int()).px.shape == (5, 0)


def test_disparity_fit_passes_opcheck(gpu):
    left, right = (each.to(gpu) for each in pair("texture", 12, 20))
    start = torch.zeros(12, 20, dtype=torch.int32, device=gpu)
    torch.library.opcheck(torch.ops.gsplat_core.fit_disparities, (left, right, start))
