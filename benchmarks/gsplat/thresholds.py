"""Differences of blended pictures from float64, in the scene and with the calls of gsplat's `test_rasterize_to_pixels`.

    python benchmarks/gsplat/thresholds.py [--device cpu|cuda] [--points 20000] [--seeds 0 1 2]

Blending omits a splat with an opacity below 1/255 and ends where the transmittance is at most 1e-4. A splat whose value is
closer to a threshold than float32 can represent is decided by rounding. Two correct implementations then differ at this
pixel. The picture is therefore compared with float64 pictures in which the thresholds are changed by the relative amount
MARGIN. A value that differs from the float64 picture by more than the tolerance of gsplat's test, but is within it for
one of the changed pictures, is explained by rounding.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from own_tests import synthetic_scene
from torch import Tensor

import gsplat_core
from gsplat_core.reference import compositing

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log

TILE_SIZE = 16
MARGIN = 1e-5
TOLERANCE = {"rtol": 1.3e-6, "atol": 1e-5}
"""Tolerance of `torch.testing.assert_close` for float32, which gsplat's test uses."""


def scene(points: int, width: int, height: int, seed: int, device: str) -> dict[str, Any]:
    """Return the arguments of `rasterize_to_pixels` as the test makes them."""
    random = torch.Generator().manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.npz"
        synthetic_scene(path, points, width, height)
        data = np.load(path)
    means, viewmats, Ks = (torch.from_numpy(data[name]).float() for name in ("means3d", "viewmats", "Ks"))
    cameras, count = len(viewmats), len(means)
    scales = 0.1 * 0.02 * torch.rand(count, 3, generator=random)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=-1)
    opacities, colors = torch.rand(count, generator=random), torch.rand(cameras, count, 3, generator=random)
    backgrounds = torch.rand(cameras, 3, generator=random)
    means, viewmats, Ks, scales, quats, opacities, colors, backgrounds = (
        each.to(device) for each in (means, viewmats, Ks, scales, quats, opacities, colors, backgrounds)
    )
    covars, _ = gsplat_core.quat_scale_to_covar_preci(quats, scales, compute_preci=False, triu=True)
    radii, means2d, depths, conics, _ = gsplat_core.fully_fused_projection(
        means, covars, None, None, viewmats, Ks, width, height
    )
    tiles = math.ceil(width / TILE_SIZE), math.ceil(height / TILE_SIZE)
    _, isect_ids, flatten_ids = gsplat_core.isect_tiles(means2d, radii, depths, TILE_SIZE, *tiles)
    return {
        "means2d": means2d,
        "conics": conics,
        "colors": colors,
        "opacities": opacities.expand(cameras, count).contiguous(),
        "image_width": width,
        "image_height": height,
        "tile_size": TILE_SIZE,
        "isect_offsets": gsplat_core.isect_offset_encode(isect_ids, cameras, *tiles),
        "flatten_ids": flatten_ids,
        "backgrounds": backgrounds,
    }


def close(found: Tensor, expected: Tensor) -> Tensor:
    """Return where values are within the tolerance of gsplat's test, bool."""
    return torch.isclose(found.double(), expected, rtol=TOLERANCE["rtol"], atol=TOLERANCE["atol"])


def compared(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of values that differ from float64, and of those that rounding at a threshold explains."""
    found = torch.cat(gsplat_core.rasterize_to_pixels(**arguments), -1)
    doubles = {
        name: value.double() if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in arguments.items()
    }
    explained = torch.zeros_like(found, dtype=torch.bool)
    for alpha, stop in itertools.product((0, -1, 1), repeat=2):
        with (
            torch.no_grad(),
            patch.object(compositing, "ALPHA_MIN", compositing.ALPHA_MIN * (1 + alpha * MARGIN)),
            patch.object(compositing, "TRANSMITTANCE_STOP", compositing.TRANSMITTANCE_STOP * (1 + stop * MARGIN)),
        ):
            expected = torch.cat(compositing.rasterize_to_pixels(**doubles), -1)
        if alpha == stop == 0:
            different = ~close(found, expected)
            error = (found - expected).abs()
        explained |= close(found, expected)
    return {
        "values": found.numel(),
        "different": int(different.sum()),
        "explained": int((different & explained).sum()),
        "largest_difference": float(error.max()),
        "largest_difference_within_tolerance": float(error[~different].max()),
    }


def main() -> None:
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    chosen = parser.parse_args()
    runs = [compared(scene(chosen.points, chosen.width, chosen.height, seed, chosen.device)) for seed in chosen.seeds]
    log.write("thresholds", chosen, {"margin": MARGIN, **TOLERANCE, "runs": runs}, "gsplat")


if __name__ == "__main__":
    main()
