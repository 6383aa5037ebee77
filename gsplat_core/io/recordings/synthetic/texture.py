"""Colour of tissue: multi-octave noise, islands of fat, branching vessels, fine relief, wetness.

The texture is defined in millimetres of the undeformed sheet, so finer texels show the same tissue in more detail.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

HALF_EXTENT_MM = 84.0
# Linear RGB reflectances.
_PINK = np.array([0.62, 0.175, 0.115], np.float32)
_PALE = np.array([0.76, 0.315, 0.215], np.float32)
_DEEP = np.array([0.40, 0.072, 0.055], np.float32)
_FAT = np.array([0.86, 0.420, 0.150], np.float32)
_VEIN = np.array([0.130, 0.022, 0.040], np.float32)
_ARTERY = np.array([0.300, 0.014, 0.012], np.float32)


class TissueTexture:
    """Reflectance, wetness and the gradient of the fine relief over the undeformed sheet."""

    def __init__(self, rng: np.random.Generator, texel_mm: float) -> None:
        self.size = 2 * int(np.ceil(HALF_EXTENT_MM / texel_mm))
        self.texel_mm = 2 * HALF_EXTENT_MM / self.size
        cloud = self._noise(rng, (46.0, 21.0, 9.0, 4.2, 2.0, 0.9), 0.62)
        grain = self._noise(rng, (3.4, 1.7, 0.85, 0.45), 0.75)
        fat_cloud = self._noise(rng, (38.0, 17.0, 7.0, 3.0), 0.5)
        folds = 1 - np.abs(self._noise(rng, (23.0, 11.0), 0.45))  # ridged: long soft creases
        lobules = np.abs(self._noise(rng, (4.6, 2.3), 0.5))

        colour = _mix(_PINK, _PALE, _smoothstep(0.1, 1.3, cloud))
        colour = _mix(colour, _DEEP, _smoothstep(0.0, 1.5, -cloud))
        fat = _smoothstep(0.75, 1.25, fat_cloud)
        colour = _mix(colour, _FAT * (0.86 + 0.14 * _smoothstep(0.0, 0.5, lobules))[..., None], 0.85 * fat)
        crease = _smoothstep(0.72, 1.0, folds) * (1 - fat)
        colour *= (1 - 0.20 * crease)[..., None]
        veins, vein_relief = self._vessels(rng, count=7, width_mm=2.1, blur_mm=0.42)
        arteries, artery_relief = self._vessels(rng, count=16, width_mm=0.85, blur_mm=0.12)
        colour = _mix(colour, _VEIN, 0.66 * veins * (1 - 0.5 * fat))
        colour = _mix(colour, _ARTERY, 0.80 * arteries)
        colour *= (1 + 0.10 * grain)[..., None]

        relief_mm = 0.040 * grain + 0.22 * cloud - 0.20 * crease + 0.34 * fat * lobules + 0.25 * fat
        relief_mm += 0.30 * vein_relief + 0.14 * artery_relief
        relief_mm = cv2.GaussianBlur(relief_mm.astype(np.float32), (0, 0), 0.22 / self.texel_mm)
        wetness = 0.12 + 0.88 * _smoothstep(-0.3, 1.2, self._noise(rng, (16.0, 6.0, 2.5), 0.6))
        self.reflectance = np.ascontiguousarray(np.clip(np.dstack([colour, wetness]), 0.004, 0.95), np.float32)
        """[S, S, 4]: linear RGB, wetness."""
        slope_v, slope_u = np.gradient(relief_mm, np.float32(self.texel_mm))
        self.slope = np.ascontiguousarray(np.dstack([slope_u, slope_v]), np.float32)
        """[S, S, 2]: the relief's derivatives by u and v."""

    def sample(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Reflectance and wetness [H, W, 4] and relief slopes [H, W, 2] of material points [H, W]."""
        column = (u + np.float32(HALF_EXTENT_MM)) / np.float32(self.texel_mm) - np.float32(0.5)
        row = (v + np.float32(HALF_EXTENT_MM)) / np.float32(self.texel_mm) - np.float32(0.5)
        reflectance = cv2.remap(self.reflectance, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        slope = cv2.remap(self.slope, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(reflectance, np.float32), np.asarray(slope, np.float32)

    def _noise(self, rng: np.random.Generator, cells_mm: tuple[float, ...], gain: float) -> Array:
        """Sum value noises of the cell sizes, each weaker by `gain`; mean 0, standard deviation about 1."""
        total = np.zeros((self.size, self.size), np.float32)
        power, weight = 0.0, 1.0
        for cell_mm in cells_mm:
            count = int(np.ceil(2 * HALF_EXTENT_MM / cell_mm)) + 3
            grid = rng.standard_normal((count, count), dtype=np.float32)
            # The grid's node (1, 1) coincides with the sheet's corner for every texel size.
            scale, shift = self.texel_mm / cell_mm, 1 + 0.5 * self.texel_mm / cell_mm
            affine = np.array([[scale, 0, shift], [0, scale, shift]])
            total += np.float32(weight) * cv2.warpAffine(
                grid, affine, (self.size, self.size), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            )
            power += 0.5 * weight**2  # interpolation halves the variance, roughly
            weight *= gain
        return total / np.float32(np.sqrt(power))

    def _vessels(self, rng: np.random.Generator, count: int, width_mm: float, blur_mm: float) -> tuple[Array, Array]:
        """Draw branching vessel trees; return their cover 0..1 and a raised relief."""
        canvas = np.zeros((self.size, self.size), np.uint8)
        stack = []
        for _ in range(count):
            start = rng.uniform(-HALF_EXTENT_MM, HALF_EXTENT_MM, 2)
            stack.append((start, rng.uniform(0, 2 * np.pi), width_mm * rng.uniform(0.6, 1.0), 0))
        while stack:
            point, heading, width, depth = stack.pop()
            bend = rng.normal(0, 0.02)
            for _ in range(int(rng.uniform(16, 40))):
                bend = 0.9 * bend + rng.normal(0, 0.045)
                heading += bend
                towards = point + 1.3 * np.array([np.cos(heading), np.sin(heading)])
                ends = [np.round((p + HALF_EXTENT_MM) / self.texel_mm * 16).astype(int) for p in (point, towards)]
                thickness = max(1, round(width / self.texel_mm))
                cv2.line(canvas, ends[0].tolist(), ends[1].tolist(), 255, thickness, cv2.LINE_AA, shift=4)
                point, width = towards, width * 0.988
            if depth < 4 and width > 0.2:
                for side in (-1, 1):
                    if rng.random() < 0.88:
                        stack.append(
                            (point, heading + side * rng.uniform(0.25, 0.8), width * rng.uniform(0.55, 0.85), depth + 1)
                        )
        cover = canvas.astype(np.float32) / 255
        soft = cv2.GaussianBlur(cover, (0, 0), blur_mm / self.texel_mm)
        raised = cv2.GaussianBlur(cover, (0, 0), (blur_mm + 0.3) / self.texel_mm)
        return np.asarray(soft, np.float32), np.asarray(raised, np.float32)


def _smoothstep(low: float, high: float, value: Array) -> Array:
    x = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(x * x * (3 - 2 * x), np.float32)


def _mix(a: Array, b: Array, weight: Array) -> Array:
    weight = weight[..., None]
    return np.asarray(a * (1 - weight) + b * weight, np.float32)
