"""The constants that the kernels are compiled with are those of the Python side and of the oracles."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path

import pytest

import gsplat_core
from gsplat_core import reference
from gsplat_core.ops import arguments
from gsplat_core.reference import compositing
from gsplat_core.rendering import settings

HEADER = Path(gsplat_core.__file__).parent / "native" / "constants.h"
PYTHON = {
    "kMaxAlpha": compositing.ALPHA_MAX,
    "kLog2MaxAlpha": math.log2(compositing.ALPHA_MAX),
    "kAlphaCutoff": compositing.ALPHA_MIN,
    "kLog2AlphaCutoff": math.log2(compositing.ALPHA_MIN),
    "kMinTransmittance": compositing.TRANSMITTANCE_STOP,
    "kCompensationFloor": arguments.COMPENSATION_FLOOR,
    "kMaxExtentSigmas": arguments.MAX_EXTENT_SIGMAS,
    "kMaxRadiusPx": arguments.MAX_RADIUS_PX,
    "kFieldOfViewMargin": arguments.FOV_MARGIN,
    "kTileSize": settings.TILE_SIZE,
}


def compiled() -> dict[str, float]:
    rows = re.findall(r"constexpr (?:float|int) (\w+) = ([-\d.e]+)f?(?: / ([\d.]+)f)?;", HEADER.read_text())
    return {name: float(value) / float(divisor or 1) for name, value, divisor in rows}


def test_constants_header_and_python_cover_same_names():
    assert compiled().keys() == PYTHON.keys()
    assert HEADER.read_text().count("constexpr") == len(PYTHON)


@pytest.mark.parametrize("name", PYTHON)
def test_compiled_constants_equal_python(name):
    assert compiled()[name] == pytest.approx(PYTHON[name], rel=1e-6)


def test_constants_of_1_6_equal_compiled_values_and_defaults():
    of_1_6 = settings.CONSTANTS["1.6"]
    assert of_1_6 == (compositing.ALPHA_MAX, arguments.COMPENSATION_FLOOR)
    for home in (gsplat_core, reference):
        defaults = inspect.signature(home.rasterize_to_pixels).parameters["max_alpha"].default
        floor = inspect.signature(home.fully_fused_projection).parameters["compensation_floor"].default
        assert (defaults, floor) == of_1_6


def test_alpha_cutoff_equals_alpha_min():
    assert arguments.ALPHA_CUTOFF == compositing.ALPHA_MIN
