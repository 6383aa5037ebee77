"""`MaskCheck` and `DepthCheck`: implausible masks are reported; invalid depth is removed and the rest is kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope.sequence import SAMPLES, DepthCheck, MaskCheck, _some


def mask(tool_columns, size=40):
    plane = np.ones((size, size), np.uint8)
    plane[:, :tool_columns] = 0
    return plane


def picture(tool_columns, size=40, tissue=150):
    """Grey instrument before tissue."""
    image = np.full((size, size, 3), (tissue, 60, 60), np.uint8)
    image[:, :tool_columns] = 90
    return image


def test_mask_check_reports_no_tissue_for_frame_full_of_tool():
    check = MaskCheck()
    assert [check.fault(mask(columns), picture(columns), 0) for columns in (8, 40, 8)] == [None, "no tissue", None]


@pytest.mark.parametrize(("fps", "lost"), [(60, 5), (30, 5), (25, 4), (5, 0)])
def test_mask_check_reports_lost_mask_for_limited_time(fps, lost):
    check = MaskCheck()
    found = [
        check.fault(mask(columns), picture(12), round(k * 1e9 / fps))
        for k, columns in enumerate((12, 12, *[0] * 12, 12))
    ]
    assert found == [None, None] + ["tool mask lost"] * lost + [None] * (13 - lost)


def test_mask_check_accepts_tool_leaving_gradually():
    check = MaskCheck()
    assert {check.fault(mask(columns, 160), picture(48, 160), 0) for columns in (48, 36, 20, 4, 0, 0)} == {None}


@pytest.mark.parametrize(
    ("before", "after"), [(picture(12), picture(0)), (picture(12), picture(0, tissue=90)[..., ::-1])]
)
def test_mask_check_believes_that_tool_is_gone_if_the_picture_changes_there(before, after):
    check = MaskCheck()
    assert check.fault(mask(12), before, 0) is None
    assert check.fault(mask(0), after, 33_000_000) is None, "withdrawn, or another scene"


def test_mask_check_compares_consecutive_pictures():
    check = MaskCheck()
    shown = [picture(12), picture(12), picture(0), picture(0)]
    masks = [mask(12), *[mask(0)] * 3]
    found = [check.fault(*each, 33_000_000 * k) for k, each in enumerate(zip(masks, shown, strict=True))]
    assert found == [None, "tool mask lost", None, None]
    brightened = [np.minimum(picture(12).astype(int) + 15 * k, 255).astype(np.uint8) for k in range(4)]
    check = MaskCheck()
    found = [check.fault(*each, 33_000_000 * k) for k, each in enumerate(zip(masks, brightened, strict=True))]
    assert found == [None, *["tool mask lost"] * 3], "each picture is like the one before"


def plane(value=60.0):
    return np.full((40, 40), value, np.float32)


def test_depth_check_returns_valid_depth_unchanged():
    depth = plane()
    depth[:10] = 0
    assert DepthCheck().checked(depth).depth is depth


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -5.0, 1e6])
def test_depth_check_sets_some_invalid_values_to_unknown(wrong):
    depth = plane()
    depth[4:8, 4:8] = wrong
    found = DepthCheck().checked(depth)
    assert found.finding == "depth repaired"
    assert (found.depth[4:8, 4:8] == 0).all() and (found.depth[20:] == 60).all() and found.depth.dtype == np.float32


@pytest.mark.parametrize("wrong", [np.nan, -5.0, 1e6])
def test_depth_check_drops_mostly_invalid_depth(wrong):
    assert DepthCheck().checked(plane(wrong)).depth is None


def test_depth_check_drops_changed_scale_until_stable():
    check = DepthCheck()
    found = [check.checked(plane(value)).finding for value in (60, 62, *[0.06] * 12, 60)]
    assert found == [None, None] + ["depth at another scale"] * 10 + [None, None] + ["depth at another scale"]


def test_depth_check_accepts_approaching_scope():
    check = DepthCheck()
    assert {check.checked(plane(value)).finding for value in np.geomspace(80, 5, 60)} == {None}


@settings(deadline=None, max_examples=40)
@given(
    st.integers(1, 20), st.integers(1, 20), st.sampled_from([np.float16, np.float32, np.float64]), st.integers(0, 2**32)
)
def test_depth_and_mask_checks_accept_any_values(height, width, dtype, seed):
    rng = np.random.default_rng(seed)
    with np.errstate(all="ignore"):
        depth = np.array(rng.normal(size=(height, width)) * 10.0 ** rng.integers(-5, 5), dtype)
    depth[rng.random((height, width)) < 0.2] = np.nan
    found = DepthCheck().checked(depth)
    assert found.depth is None or np.isfinite(found.depth).all()
    MaskCheck().fault(rng.integers(0, 2, (height, width), np.uint8), np.zeros((height, width, 3), np.uint8), 0)


@pytest.mark.parametrize("shape", [(1024, 4096), (4096, 1024), (40, 60)])
def test_some_samples_plane_by_shorter_side(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    found = _some(rows * 10_000 + columns)
    assert min(found.shape) == min(SAMPLES, min(shape) // 4)
    step = shape[0] // found.shape[0]
    assert found[1, 2] == step * 10_000 + 2 * step
