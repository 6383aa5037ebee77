"""Instruments of recorded pictures whose terms allow training, as layers for training pictures.

The instruments of `out_of_body/0001` and `0007` (Apache-2.0) are painted over in translucent green, so their outlines and their shading are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.bodies import Canvas
from benchmarks.tool_network.tissue import Plane

SAMPLES = ("0001", "0007")
VIEW = (slice(30, 960), slice(340, 1560))
"""Rows and columns of the samples inside of their border."""
GREEN_OVER_RED = 30
LEAST_AREA = 0.012
"""Share of the view from which a painted part counts as an instrument."""
REDUCED = 0.3


@dataclass
class Layer:
    """Instrument that enters from the left."""

    shade: Plane
    """Brightness [h, w], 0..1."""
    cover: Plane
    """Coverage [h, w], 0..1."""
    entry: NDArray[np.float64]
    """Middle of the instrument at the left border, x and y."""


class RecordedTools:
    """Instruments of the samples with outline and shading, without colour."""

    def __init__(self, recordings: Path) -> None:
        """Read the samples. Raises FileNotFoundError if they contain no instrument."""
        self.layers: list[Layer] = []
        for name in SAMPLES:
            read = cv2.imread(str(recordings / f"out_of_body/{name}.png"))
            if read is not None:
                self._add(np.asarray(read[VIEW], np.float32))
        if not self.layers:
            raise FileNotFoundError(f"no painted instrument in {recordings / 'out_of_body'}")

    def _add(self, picture: NDArray[np.float32]) -> None:
        blue, green, red = (picture[..., channel] for channel in range(3))
        painted = ((green > red + GREEN_OVER_RED) & (green > blue + GREEN_OVER_RED)).astype(np.uint8)
        painted = np.asarray(cv2.morphologyEx(painted, cv2.MORPH_CLOSE, np.ones((7, 7))), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(painted)
        width = painted.shape[1]
        for label in range(1, count):
            left, _, wide, _, area = stats[label]
            if area < LEAST_AREA * painted.size or (left > 2 and left + wide < width - 2):
                continue
            part = (labels == label).astype(np.uint8)
            inner = cv2.erode(part, np.ones((9, 9))) > 0
            level = (red + green + blue) / 3
            low, high = np.quantile(level[inner], [0.01, 0.99])
            shade = np.clip((level - low) / (high - low), 0, 1)
            planes = (shade * 255).astype(np.uint8), part * 255, inner.astype(np.uint8) * 255
            small, cover, known = (
                np.asarray(cv2.resize(plane, None, fx=REDUCED, fy=REDUCED, interpolation=cv2.INTER_AREA))
                for plane in planes
            )
            # Outside of the outline the nearest shades continue, so that a warped edge has no rim of tissue.
            rim = np.asarray(cv2.dilate(cover, np.ones((9, 9))), np.uint8) & np.where(known < 255, 255, 0).astype(
                np.uint8
            )
            small = np.asarray(cv2.inpaint(small, rim, 3, cv2.INPAINT_TELEA), np.uint8)
            turned = slice(None, None, -1 if left > 2 else 1)
            brightness, coverage = (
                np.ascontiguousarray(plane[:, turned], np.float32) / np.float32(255) for plane in (small, cover)
            )
            rows = np.flatnonzero(coverage[:, 1] > 0.5)
            self.layers.append(Layer(brightness, coverage, np.array([0.0, rows.mean()])))

    def draw(self, rng: Generator, canvas: Canvas) -> None:
        """Draw an instrument with another size, direction, brightness and colour, which enters from any side."""
        height, width = canvas.mask.shape
        layer = self.layers[rng.integers(len(self.layers))]
        size = layer.cover.shape[0]
        scale = height / size * float(np.exp(rng.uniform(np.log(0.9), np.log(3.0))))
        angle = float(rng.normal(0, 0.35))
        aspect, mirror = float(np.exp(rng.normal(0, 0.15))), float(rng.choice([-1, 1]))
        c, s = np.cos(angle) * scale, np.sin(angle) * scale
        turn = np.array([[c * aspect, -s * mirror], [s * aspect, c * mirror]])
        # From the left first; then mirrored or turned to another side.
        transposed = rng.random() < 0.35
        tall, wide = (width, height) if transposed else (height, width)
        long = float(np.flatnonzero(layer.cover.max(0) > 0.5).max()) * scale * aspect
        out = max(long * rng.uniform(0, 0.5), long - rng.uniform(0.7, 1.2) * wide)
        target = np.array([-out, tall * rng.uniform(0.05, 0.95)])
        warp = np.column_stack([turn, target - turn @ layer.entry])
        planes = [
            np.asarray(cv2.warpAffine(plane, warp, (wide, tall), flags=cv2.INTER_LINEAR, borderMode=border))
            for plane, border in ((layer.shade, cv2.BORDER_REPLICATE), (layer.cover, cv2.BORDER_CONSTANT))
        ]
        # The instrument continues outwards from the border of its own picture.
        across, along = turn[:, 1] / np.linalg.norm(turn[:, 1]), turn[:, 0] / np.linalg.norm(turn[:, 0])
        half = float((layer.cover[:, 1] > 0.5).sum()) / 2 * float(np.linalg.norm(turn[:, 1]))
        ends = np.array([target + across * half, target + across * -half])
        quad = np.concatenate([ends, ends[::-1] - along * 3 * wide])
        cv2.fillPoly(planes[1], [np.round(quad * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
        if transposed:
            planes = [plane.T for plane in planes]
        flips = slice(None, None, int(rng.choice([-1, 1]))), slice(None, None, int(rng.choice([-1, 1])))
        shade, cover = (np.ascontiguousarray(plane[flips]) for plane in planes)
        lowest, highest = rng.uniform(0, 0.3), rng.uniform(0.45, 1.3)
        bright = lowest + (highest - lowest) * shade ** np.float32(np.exp(rng.normal(0, 0.4)))
        tint = (
            1 + rng.normal(0, 0.05, 3) + rng.uniform(0, 0.25) * (canvas.surround / (canvas.surround.mean() + 0.02) - 1)
        )
        colour = (bright * canvas.light)[..., None] * tint.astype(np.float32)
        canvas.image += cover[..., None] * (np.clip(colour, 0, 1.6).astype(np.float32) - canvas.image)
        np.maximum(canvas.mask, cover, out=canvas.mask)
