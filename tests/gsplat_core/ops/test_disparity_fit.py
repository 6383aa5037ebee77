"""The fit of disparities against the oracle in float64."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.disparity_fit import fit_disparities
from gsplat_core.ops.stereo_matching import UNKNOWN, match_disparities
from tests.gsplat_core.ops.stereo_cases import SHIFT_PX, every_case, pair


def check_against_reference(left, right, sixteenths, device="cpu"):
    """Pixels to 2e-3 px and errors to half a per cent: float32 against float64, three steps of sums over 25 x 25 pixels."""
    found = fit_disparities(left.to(device), right.to(device), sixteenths.to(device))
    px, error_px = reference.fit_disparities(left, right, sixteenths)
    torch.testing.assert_close(found.px.double().cpu(), px, rtol=0, atol=2e-3)
    torch.testing.assert_close(found.error_px.double().cpu(), error_px, rtol=5e-3, atol=1e-4)


@every_case
def test_disparity_fit_equals_reference(case):
    kind, height, width, lowest, count = case
    left, right = pair(kind, height, width)
    check_against_reference(left, right, match_disparities(left, right, lowest, count).sixteenths)


def test_disparity_fit_accepts_any_start(rng):
    left, right = pair("texture", 31, 47)
    wild = torch.from_numpy(rng.integers(-2000, 2000, (31, 47)).astype("int32"))
    wild[::3, ::5] = UNKNOWN
    check_against_reference(left, right, wild)
    nothing = torch.full((31, 47), UNKNOWN, dtype=torch.int32)
    found = fit_disparities(left, right, nothing)
    assert not found.px.any() and found.error_px.isinf().all()


def test_disparity_fit_corrects_start_off_by_half_pixel():
    left, right = pair("texture", 80, 160)
    off = torch.full((80, 160), 16 * SHIFT_PX + 8, dtype=torch.int32)
    found = fit_disparities(left, right, off)
    middle = found.px[20:-20, 40:-20]
    assert (middle - SHIFT_PX).abs().max() < 0.1
    assert found.error_px[20:-20, 40:-20].max() < 0.5


def test_disparity_fit_without_pixels():
    nothing = torch.zeros(0, 5, dtype=torch.uint8)
    assert fit_disparities(nothing, nothing, nothing.int()).px.shape == (0, 5)


def test_disparity_fit_passes_opcheck():
    left, right = pair("texture", 12, 20)
    start = torch.zeros(12, 20, dtype=torch.int32)
    torch.library.opcheck(torch.ops.gsplat_core.fit_disparities, (left, right, start))


def test_disparity_fit_rejects_invalid_inputs():
    left, right = pair("texture", 12, 20)
    with pytest.raises(InvalidInput, match=r"sixteenths must be int32 \[12, 20\], got torch.float32"):
        fit_disparities(left, right, torch.zeros(12, 20))
    with pytest.raises(InvalidInput, match="must both be uint8"):
        fit_disparities(left, right.int(), torch.zeros(12, 20, dtype=torch.int32))
