"""The layout of raw parameters: one description, and the kernels' header says the same."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import gsplat_core
from gsplat_core.ops.plain_torch import BASIS_CHANNELS, HEAD_COLUMNS
from gsplat_core.scene import gaussians

HEADER = Path(gsplat_core.__file__).parent / "native" / "raw_layout.h"


@pytest.fixture(scope="module")
def constants():
    text = HEADER.read_text(encoding="utf-8")
    found = dict(re.findall(r"constexpr int (k\w+) = (\w+);", text))
    return {name: int(found.get(value, value)) for name, value in found.items()}


def test_kernel_header_columns_equal_python(constants):
    assert constants == {
        "kRawColumns": gaussians.RAW_COLUMNS,
        "kRawPosition": gaussians.POSITION.start,
        "kRawRotation": gaussians.ROTATION.start,
        "kRawLogScale": gaussians.LOG_SCALE.start,
        "kRawColor": gaussians.COLOUR.start,
        "kRawOpacity": gaussians.OPACITY.start,
        "kRawUsed": gaussians.OPACITY.stop,
        "kRawBasisChannels": BASIS_CHANNELS,
        "kHeadOutputs": len(HEAD_COLUMNS),
    }


def test_parameter_groups_are_contiguous():
    groups = [gaussians.POSITION, gaussians.ROTATION, gaussians.LOG_SCALE, gaussians.COLOUR, gaussians.OPACITY]
    assert [group.start for group in groups] == [0, *(group.stop for group in groups[:-1])]
    assert [gaussians.width_of(group) for group in groups] == [3, 4, 3, 3, 1]
    assert gaussians.width_of(*groups) <= gaussians.RAW_COLUMNS and gaussians.RAW_COLUMNS % 4 == 0


def test_hexplane_head_column_order():
    assert HEAD_COLUMNS == (0, 1, 2, 7, 8, 9, 3, 4, 5, 6, 13)


def test_kernel_sources_do_not_redeclare_layout_columns():
    """Sources that move raw rows include the header and do not declare the numbers again."""
    native = Path(gsplat_core.__file__).parent
    for path in [*native.rglob("*.h"), *native.rglob("*.cu"), *native.rglob("*.cuh"), *native.rglob("*.cpp")]:
        if path != HEADER:
            assert not re.search(r"constexpr \w+ k(Raw|Delta)Columns\b", path.read_text(encoding="utf-8")), path
