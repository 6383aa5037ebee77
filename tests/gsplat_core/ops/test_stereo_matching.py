"""Semi-global matching against the oracle, to the bit: sizes, ranges and pictures of every kind."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.stereo_matching import UNKNOWN, match_disparities
from tests.gsplat_core.ops.stereo_cases import SHIFT_PX, every_case, pair


@every_case
def test_stereo_matching_equals_reference(case):
    kind, height, width, lowest, count = case
    left, right = pair(kind, height, width)
    found = match_disparities(left, right, lowest, count)
    sixteenths, one_surface = reference.match_disparities(left, right, lowest, count)
    assert torch.equal(found.sixteenths, sixteenths)
    assert torch.equal(found.one_surface, one_surface)


def test_stereo_matching_finds_shift_except_in_occluded_columns():
    left, right = pair("texture", 64, 101)
    found = match_disparities(left, right, 0, 16)
    known = found.sixteenths != UNKNOWN
    assert not known[:, :SHIFT_PX].any()
    assert known[:, SHIFT_PX + 8 :].float().mean() > 0.97
    assert (found.sixteenths[known].float() / 16 - SHIFT_PX).abs().median() < 0.1
    assert found.one_surface[10:-10, 30:-10].all()


def test_stereo_matching_marks_disparity_jump_as_not_one_surface():
    left, right = pair("steps", 90, 160)
    found = match_disparities(left, right, 0, 32)
    middle = found.one_surface[60, 70:]
    assert middle.any() and not found.one_surface.all()
    known = found.sixteenths != UNKNOWN
    for disparity in (SHIFT_PX, 3 * SHIFT_PX):
        assert ((found.sixteenths[known].float() / 16 - disparity).abs() < 0.5).float().mean() > 0.1


def test_stereo_matching_of_noise_is_mostly_unknown():
    assert (match_disparities(*pair("noise", 60, 80), -8, 32).sixteenths == UNKNOWN).float().mean() > 0.8


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_stereo_matching_without_pixels(shape):
    nothing = torch.zeros(shape, dtype=torch.uint8)
    found = match_disparities(nothing, nothing, 0, 16)
    assert found.sixteenths.shape == found.one_surface.shape == shape


def test_stereo_matching_accepts_non_contiguous_inputs():
    left, right = pair("texture", 40, 52)
    strided = [torch.stack([each, 255 - each], dim=2)[..., 0] for each in (left, right)]
    assert not strided[0].is_contiguous()
    assert torch.equal(match_disparities(*strided, 0, 16).sixteenths, match_disparities(left, right, 0, 16).sixteenths)


def test_stereo_matching_independent_of_thread_count():
    left, right = pair("steps", 150, 140)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(match_disparities(left, right, 0, 32))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert torch.equal(found[0].sixteenths, other.sixteenths)
        assert torch.equal(found[0].one_surface, other.one_surface)


def test_stereo_matching_passes_opcheck():
    torch.library.opcheck(torch.ops.gsplat_core.match_disparities, (*pair("texture", 12, 20), 0, 16))


def test_stereo_matching_rejects_invalid_inputs():
    left, right = pair("texture", 12, 20)
    with pytest.raises(InvalidInput, match="multiple of 16 up to 256"):
        match_disparities(left, right, 0, 272)
    with pytest.raises(InvalidInput, match="count is 24"):
        match_disparities(left, right, 0, 24)
    with pytest.raises(InvalidInput, match=r"float32 \[12, 20\]"):
        match_disparities(left.float(), right, 0, 16)
    with pytest.raises(InvalidInput, match=r"uint8 \[12, 20\] and torch.uint8 \[11, 20\]"):
        match_disparities(left, right[:11], 0, 16)
    with pytest.raises(RuntimeError, match="lowest must be within"):
        match_disparities(left, right, 1 << 20, 16)
