"""Differences of blended pictures from float64, in the scenes and with the calls of two tests of gsplat.

    python benchmarks/gsplat/thresholds.py [--device cpu|cuda] [--points 20000] [--seeds 0 1 2]

The tests are `test_rasterize_to_pixels` with 3 channels and `test_rasterize_to_pixels_2dgs`. Blending omits a splat with an
opacity below 1/255 and ends where the transmittance is at most 1e-4. A splat whose value is closer to a threshold than
the rounding of float32 is decided by rounding. Two correct implementations then differ at this pixel. The picture is
therefore compared with float64 pictures in which the thresholds are changed by the relative amount `margin`. A value that
differs from the float64 picture by more than the tolerance of gsplat's test, but is within it for one of the changed
pictures, is explained by rounding.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from own_tests import synthetic_scene
from torch import Tensor

import gsplat_core
from gsplat_core.reference import compositing, surfels

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log

TILE_SIZE = 16


@dataclass(frozen=True)
class Test:
    """A test of gsplat: compared function, its float64 reference, margin of thresholds and tolerance."""

    blend: Callable[..., Sequence[Tensor]]
    reference: Callable[..., Sequence[Tensor]]
    module: ModuleType
    margin: float
    rtol: float
    atol: float

    def close(self, found: Tensor, expected: Tensor) -> Tensor:
        """Return where values are within the tolerance of the test, bool."""
        return torch.isclose(found.double(), expected, rtol=self.rtol, atol=self.atol)

    def compared(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Return the numbers of values that differ from float64, and of those that rounding at a threshold explains."""
        found = torch.cat(self.blend(**arguments)[:OUTPUTS], -1)
        doubles = {
            name: value.double() if isinstance(value, Tensor) and value.is_floating_point() else value
            for name, value in arguments.items()
        }
        explained = torch.zeros_like(found, dtype=torch.bool)
        # The first picture has the thresholds as they are.
        for alpha, stop in itertools.product((0, -1, 1), repeat=2):
            with (
                torch.no_grad(),
                patch.object(self.module, "ALPHA_MIN", self.module.ALPHA_MIN * (1 + alpha * self.margin)),
                patch.object(
                    self.module, "TRANSMITTANCE_STOP", self.module.TRANSMITTANCE_STOP * (1 + stop * self.margin)
                ),
            ):
                expected = torch.cat(self.reference(**doubles)[:OUTPUTS], -1)
            if alpha == stop == 0:
                error, different = (found - expected).abs(), ~self.close(found, expected)
            explained |= self.close(found, expected)
        left = error[different & ~explained]
        return {
            "values": found.numel(),
            "different": int(different.sum()),
            "explained": int((different & explained).sum()),
            "largest_difference": float(error.max()),
            "largest_unexplained": float(left.max()) if left.numel() else 0.0,
        }


OUTPUTS = 3
"""Number of outputs that are compared: colours, opacities and normals."""
TESTS = {
    "test_rasterize_to_pixels": Test(
        gsplat_core.rasterize_to_pixels, compositing.rasterize_to_pixels, compositing, 1e-5, 1.3e-6, 1e-5
    ),
    "test_rasterize_to_pixels_2dgs": Test(
        gsplat_core.rasterize_to_pixels_2dgs,
        surfels.rasterize_to_pixels_2dgs,
        surfels,
        1e-3,
        1e-3,
        1e-3,
    ),
}


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


def surfel_scene(count: int, width: int, height: int, seed: int, device: str) -> dict[str, Any]:
    """Return the arguments of `rasterize_to_pixels_2dgs` as the test makes them, for one of its equal cameras."""
    random = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=random)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=-1)
    scales = torch.ones(count, 3)
    scales[:, :2] *= 0.1
    opacities, colors = 0.5 * torch.rand(1, count, generator=random), torch.rand(1, count, 3, generator=random)
    Ks = torch.tensor([[[width, 0.0, width // 2], [0.0, width, height // 2], [0.0, 0.0, 1.0]]])
    means, quats, scales, opacities, colors, Ks = (
        each.to(device) for each in (means, quats, scales, opacities, colors, Ks)
    )
    radii, means2d, depths, transforms, normals = gsplat_core.fully_fused_projection_2dgs(
        means, quats, scales, torch.eye(4, device=device)[None], Ks, width, height
    )
    tiles = math.ceil(width / TILE_SIZE), math.ceil(height / TILE_SIZE)
    _, isect_ids, flatten_ids = gsplat_core.isect_tiles(means2d, radii, depths, TILE_SIZE, *tiles)
    return {
        "means2d": means2d,
        "ray_transforms": transforms,
        "colors": torch.cat([colors, depths[..., None]], -1),
        "opacities": opacities,
        "normals": normals,
        "densify": torch.zeros_like(means2d),
        "image_width": width,
        "image_height": height,
        "tile_size": TILE_SIZE,
        "isect_offsets": gsplat_core.isect_offset_encode(isect_ids, 1, *tiles),
        "flatten_ids": flatten_ids,
        "backgrounds": torch.zeros(1, 4, device=device),
    }


def main() -> None:
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    chosen = parser.parse_args()
    size = chosen.width, chosen.height
    figures: dict[str, Any] = {}
    for name, test in TESTS.items():
        of_surfels = test.module is surfels
        scenes = (
            surfel_scene(chosen.points // 20, 2 * size[0], 2 * size[1], seed, chosen.device)
            if of_surfels
            else scene(chosen.points, *size, seed, chosen.device)
            for seed in chosen.seeds
        )
        stated = {"margin": test.margin, "rtol": test.rtol, "atol": test.atol}
        figures[name] = {**stated, "runs": [test.compared(each) for each in scenes]}
    log.write("thresholds", chosen, figures, "gsplat")


if __name__ == "__main__":
    main()
