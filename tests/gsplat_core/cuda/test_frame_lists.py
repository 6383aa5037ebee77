"""The tiles' lists of the fused frame path: crowded tiles, equal depths, large scenes and overflow."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.frame import STATUS_LONGEST, STATUS_NEEDED, STATUS_OVERFLOW, FrameMode
from tests.gsplat_core.cuda.frame_checks import assert_near, check, check_lists, plain, scene


@pytest.mark.parametrize("count", [2000, 2049, 5000, 100_000])
def test_frame_lists_of_very_many_splats_in_one_tile(count: int) -> None:
    s = scene(count, 32, 16, seed=8, deltas=False)
    s.means[:] = (torch.tensor([-0.5, 0.0, 2.0]) - s.viewmat[:3, 3]) @ s.viewmat[:3, :3]
    s.means[:] += torch.rand(count, 1, generator=torch.Generator().manual_seed(1)) * s.viewmat[2, :3]
    s.means[: count // 3] = s.means[0]  # equal depths keep the order of the splats
    s.log_scales[:] = 0.0  # wide, so that no pixel is near the cut-off of 1/255
    s.logit_opacities[:] = -5.4
    frame = check(s, capacity=4 * count)
    assert frame.status[STATUS_LONGEST] == count


@pytest.mark.parametrize("count", [100, 128, 200, 256, 500, 512, 900, 1024, 1025])
@pytest.mark.parametrize("far", [False, True])
def test_frame_lists_with_equal_and_adjacent_depths(count: int, far: bool) -> None:
    s = scene(count, 16, 16, seed=16, deltas=False)
    g = torch.Generator().manual_seed(2)
    s.viewmat[:] = torch.eye(4)
    s.means[:, :2] = 0.1 * torch.randn(count, 2, generator=g)
    s.means[:, 2] = 2 + torch.randint(0, 40, (count,), generator=g) * 2.0**-22
    s.log_scales[:] = 3.0  # over the whole tile, so that no pixel is near the cut-off of 1/255
    if far:  # relative to this one, the depths of the others fall into one bucket
        s.means[-1] = torch.tensor([0.0, 0.0, 1e8])
        s.log_scales[-1] = math.log(1e9)
    s.logit_opacities[:] = -4.6
    assert check(s).status[STATUS_LONGEST] == count


@pytest.mark.parametrize("clump", [1, 2, 11, 12, 13, 100])
@pytest.mark.parametrize("count", [120, 250, 500, 1000])
def test_frame_lists_with_clustered_depths(count: int, clump: int) -> None:
    """Evenly spread depths use the bucket sort; depths with an overfull bucket use the bitonic sort."""
    s = scene(count, 16, 16, seed=18, deltas=False)
    g = torch.Generator().manual_seed(3)
    s.viewmat[:] = torch.eye(4)
    s.means[:, :2] = 0.1 * torch.randn(count, 2, generator=g)
    at = torch.randperm(count, generator=g) // clump
    s.means[:, 2] = 2 + at * clump / count + 1e-6 * torch.rand(count, generator=g)
    s.log_scales[:] = 3.0  # over the whole tile, so that no pixel is near the cut-off of 1/255
    s.logit_opacities[:] = -4.6
    assert check(s).status[STATUS_LONGEST] == count


def test_frame_lists_of_large_scene() -> None:
    s = scene(140_000, 150, 110, degree=0, seed=14, size=0.006)
    s.log_scales[::5000] = 0.5
    s.log_scales[1::2000] = -1.5
    s.means[2::100] = math.nan
    assert_near(s.render(1 << 19), plain(s))
    frame = s.render(1 << 19, FrameMode.TRAINING)
    check_lists(frame)
    assert frame.splat_starts.diff().max() == 10 * 7
    again = s.render(1 << 19, FrameMode.TRAINING)
    for name in ("image", "last", "tile_offsets", "splat_starts"):
        assert torch.equal(getattr(frame, name), getattr(again, name)), name
    needed = int(frame.status[STATUS_NEEDED])
    assert s.render(needed - 1, FrameMode.TRAINING).status[STATUS_OVERFLOW]
    assert torch.equal(s.render(needed, FrameMode.TRAINING).image, frame.image)


def test_frame_lists_of_large_scene_on_very_many_tiles() -> None:
    s = scene(66_000, 4096, 4100, degree=0, seed=15, size=0.002)
    assert_near(s.render(1 << 20), plain(s))


@pytest.mark.parametrize("mode", [FrameMode.SHARED, FrameMode.TRAINING])
def test_frame_lists_report_overflow_and_succeed_with_larger_capacity(mode: FrameMode) -> None:
    s = scene(3000, 200, 131, seed=11, size=0.2)
    s.log_scales[::50] = 1.0
    wanted = s.render(1 << 20, mode)
    needed = int(wanted.status[STATUS_NEEDED])
    for capacity in (1, 100, needed // 2, needed - 1):
        cut = s.render(capacity, mode)
        assert cut.status.tolist() == [needed, int(wanted.status[STATUS_LONGEST]), 1, 0]
        torch.cuda.synchronize()
    again = s.render(needed, mode)
    assert not again.status[STATUS_OVERFLOW]
    assert torch.equal(again.image, wanted.image)


def test_frame_lists_report_segment_overflow_and_succeed_with_larger_capacity() -> None:
    s = scene(3000, 200, 131, seed=11, size=0.2)
    s.log_scales[::50] = 1.0
    wanted = s.render(1 << 20)
    needed, most = wanted.status.tolist()[:2]
    for capacity in (1, 50, most - 1):
        cut = s.render(capacity, FrameMode.SEGMENTS)
        assert cut.status.tolist() == [needed, most, 1, 0]
        torch.cuda.synchronize()
    again = s.render(most, FrameMode.SEGMENTS)
    assert again.status.tolist() == [needed, most, 0, 0]
    assert torch.equal(again.image, wanted.image)
    with pytest.raises(InvalidInput, match="at most 1024"):
        s.render(1025, FrameMode.SEGMENTS)
