"""Random pictures of tissue without tools, as backgrounds of training pictures.

All pictures are float32 RGB [h, w, 3] in 0..1. They are drawn, not rendered: a palette over noise, a relief with diffuse and wet
light, vessels, fat, folds, a lumen, blood, highlights and loops of bowel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Picture = NDArray[np.float32]
Plane = NDArray[np.float32]

PALETTES = np.array(
    [
        # Base, second colour and highlights of wetness; sRGB, 0..1.
        [[0.55, 0.14, 0.12], [0.75, 0.30, 0.25], [0.30, 0.05, 0.05]],
        [[0.80, 0.45, 0.42], [0.92, 0.62, 0.58], [0.60, 0.22, 0.22]],
        [[0.85, 0.68, 0.62], [0.95, 0.82, 0.76], [0.70, 0.42, 0.40]],
        [[0.86, 0.62, 0.25], [0.95, 0.80, 0.45], [0.70, 0.38, 0.12]],
        [[0.90, 0.48, 0.14], [0.95, 0.62, 0.25], [0.62, 0.22, 0.05]],
        [[0.32, 0.08, 0.07], [0.45, 0.14, 0.11], [0.15, 0.02, 0.02]],
        [[0.42, 0.24, 0.16], [0.55, 0.36, 0.26], [0.22, 0.10, 0.06]],
        [[0.55, 0.30, 0.38], [0.70, 0.45, 0.52], [0.35, 0.12, 0.18]],
        [[0.78, 0.70, 0.50], [0.88, 0.82, 0.62], [0.60, 0.48, 0.30]],
        [[0.72, 0.36, 0.26], [0.86, 0.52, 0.38], [0.42, 0.14, 0.09]],
        [[0.80, 0.76, 0.74], [0.90, 0.85, 0.83], [0.62, 0.42, 0.42]],
        [[0.45, 0.35, 0.38], [0.60, 0.48, 0.50], [0.28, 0.18, 0.20]],
    ],
    np.float32,
)


LIKELY = np.array([1.5, 1.5, 0.8, 1.2, 1.0, 1.0, 0.8, 0.6, 0.35, 1.5, 0.15, 0.12])
"""Relative frequency of the palettes."""
LIKELY /= LIKELY.sum()
COLOURED = LIKELY * (PALETTES[:, 0].max(1) > 1.3 * PALETTES[:, 0].min(1))
COLOURED /= COLOURED.sum()
"""Frequency of the palettes for round shapes from the border, which would look like tools in a grey one."""


PALE, DARKENED, GLARING = 0.22, 0.15, 0.2
"""Share of pictures with tissue as pale as tools, with black regions, and with large highlights."""


def noise(rng: Generator, height: int, width: int, coarse: int, octaves: int, gain: float = 0.55) -> Plane:
    """Return smooth noise [h, w] with a mean near 0 and a standard deviation near 1; `coarse` cells along the height."""
    total = np.zeros((height, width), np.float32)
    amplitude, cells = 1.0, coarse
    for _ in range(octaves):
        if cells > height:
            break
        small = rng.standard_normal((cells + 2, round(cells * width / height) + 2), np.float32)
        total += amplitude * np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC))
        amplitude *= gain
        cells *= 2
    return total / max(1e-6, float(total.std()))


def smooth(plane: Plane, low: float, high: float) -> Plane:
    """Return 0 below `low`, 1 above `high`, with a smooth step between them."""
    t = np.clip((plane - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def colour_of(rng: Generator, height: int, width: int, likely: NDArray[np.float64] = LIKELY) -> tuple[Picture, Plane]:
    """Return the colour of one kind of tissue and its relief [h, w]. `likely` are the frequencies of the palettes."""
    base, second, deep = PALETTES[rng.choice(len(PALETTES), p=likely)] * rng.uniform(0.85, 1.15, (3, 1)).astype(
        np.float32
    )
    base = base + rng.normal(0, 0.025, 3).astype(np.float32)
    field = noise(rng, height, width, int(rng.integers(2, 7)), int(rng.integers(3, 6)), rng.uniform(0.4, 0.75))
    contrast = rng.uniform(0.2, 1.0)
    share = smooth(field, -1.2, 1.2)[..., None] * contrast
    image = base + share * (second - base)
    dark = smooth(noise(rng, height, width, int(rng.integers(3, 12)), 3), 0.6, 2.2)[..., None] * rng.uniform(0, 0.9)
    image = image + dark * (deep - image)
    relief = noise(rng, height, width, int(rng.integers(2, 6)), int(rng.integers(2, 6)), rng.uniform(0.3, 0.6))
    if rng.random() < 0.3:
        lobes = lobules(rng, height, width)
        relief = 0.4 * relief + lobes * rng.uniform(0.8, 2.0)
        image = image * (0.75 + 0.25 * smooth(lobes, -1.5, 0.3)[..., None])
    if rng.random() < 0.6:
        vessels(rng, image, int(rng.integers(1, 9)))
    return np.asarray(image, np.float32), np.asarray(relief, np.float32)


def detail(rng: Generator, image: Picture, most: float) -> Picture:
    """Return the picture with structure down to single pixels, which real tissue has: grain, fibres and mottled colour.

    Args:
        most: largest standard deviation of the logarithm of brightness.
    """
    height, width = image.shape[:2]
    strength = most * rng.uniform(0.1, 1) ** 1.5
    fine = noise(rng, height, width, int(height * rng.uniform(0.12, 0.45)), 2, 0.7)
    if rng.random() < 0.5:
        fine = rng.uniform(0.2, 1) * fine + rng.uniform(0.1, 0.8) * fibres(rng, height, width)
    where = smooth(noise(rng, height, width, int(rng.integers(2, 7)), 3), rng.uniform(-3, 0), rng.uniform(0.5, 2))
    mottled = noise(rng, height, width, int(height * rng.uniform(0.08, 0.3)), 2, 0.7) * where
    hue = rng.normal(0, 1, 3).astype(np.float32) * np.array([0.3, 1, 1], np.float32)
    logs = np.float32(strength) * ((where * fine)[..., None] + rng.uniform(0, 0.8) * mottled[..., None] * hue)
    return np.asarray(image * np.exp(logs.clip(-0.8, 0.7)), np.float32)


def fibres(rng: Generator, height: int, width: int) -> Plane:
    """Return noise [h, w] that is stretched along curved lines; standard deviation near 1."""
    long, thin = rng.uniform(6, 30), rng.uniform(1.2, 4)
    side = int(1.5 * max(height, width))
    small = rng.standard_normal((int(side / thin) + 2, int(side / long) + 2), np.float32)
    angle = rng.uniform(0, np.pi)
    c, s = float(np.cos(angle)), float(np.sin(angle))
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    y = y - height / 2 + rng.uniform(2, 14) * noise(rng, height, width, 2, 3)
    x = x - width / 2
    along, across = x * c + y * s + side / 2, y * c - x * s + side / 2
    bent = cv2.remap(
        small,
        np.asarray(along / np.float32(long), np.float32),
        np.asarray(across / np.float32(thin), np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return np.asarray(bent / max(1e-6, float(bent.std())), np.float32)


def lobules(rng: Generator, height: int, width: int) -> Plane:
    """Return the relief of fat lobules: rounded cells with dark gaps, mean near 0."""
    seeds = np.ones((height, width), np.uint8)
    count = int(rng.integers(15, 120))
    seeds[rng.integers(0, height, count), rng.integers(0, width, count)] = 0
    distance = np.asarray(cv2.distanceTransform(seeds, cv2.DIST_L2, 3), np.float32)
    bumps = -((distance / distance.mean()) ** 2)
    return np.asarray(cv2.GaussianBlur((bumps - bumps.mean()) / bumps.std(), (0, 0), rng.uniform(0.5, 2)), np.float32)


def vessels(rng: Generator, image: Picture, count: int) -> None:
    """Draw branching vessels into a picture."""
    height, width = image.shape[:2]
    drawn = np.zeros((height, width), np.float32)
    for _ in range(count):
        point = rng.uniform(0, 1, 2) * (width, height)
        angle, thickness = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 4)
        walks = [(point, angle, thickness)]
        for _ in range(5):
            if not walks:
                break
            point, angle, thickness = walks.pop()
            points = [point]
            for step in range(int(rng.integers(5, 25))):
                angle += rng.normal(0, 0.25)
                point = point + 8 * np.array([np.cos(angle), np.sin(angle)])
                points.append(point)
                if step % 5 == 4 and rng.random() < 0.5:
                    walks.append((point, angle + rng.choice([-1, 1]) * rng.uniform(0.4, 1), 0.7 * thickness))
            cv2.polylines(
                drawn,
                [np.round(np.array(points) * 8).astype(np.int32)],
                False,
                1.0,
                max(1, round(thickness)),
                cv2.LINE_AA,
                3,
            )
    drawn = np.asarray(cv2.GaussianBlur(drawn, (0, 0), rng.uniform(0.5, 1.5)), np.float32)[..., None]
    colour = (
        np.array([0.45, 0.05, 0.08]) * rng.uniform(0.6, 1.4)
        if rng.random() < 0.75
        else rng.uniform(0.2, 0.5, 3) * (0.8, 0.8, 1.1)
    )
    image += rng.uniform(0.2, 0.8) * drawn * (colour.astype(np.float32) - image)


def lit(rng: Generator, image: Picture, relief: Plane) -> Picture:
    """Return the tissue lit from near the scope: diffuse light by the relief, and wet highlights."""
    height, width = relief.shape
    relief = np.asarray(relief, np.float32)
    if rng.random() < 0.6:
        rough = noise(rng, height, width, int(height * rng.uniform(0.08, 0.3)), 2, 0.6)
        relief = relief + rough * rng.uniform(0, 0.12) * smooth(noise(rng, height, width, 3, 2), -1, 1.5)
    depth = rng.uniform(2, 14)
    dx = np.asarray(cv2.Sobel(relief, cv2.CV_32F, 1, 0, scale=depth / 8))
    dy = np.asarray(cv2.Sobel(relief, cv2.CV_32F, 0, 1, scale=depth / 8))
    light = rng.normal(0, 0.35, 2).astype(np.float32)
    length = np.sqrt(dx * dx + dy * dy + 1)
    facing = (1 - light[0] * dx - light[1] * dy) / length / np.float32(np.sqrt(1 + light @ light))
    out = image * (0.35 + 0.65 * np.clip(facing, 0, 1))[..., None]
    if rng.random() < 0.85:
        fine = noise(rng, height, width, int(rng.integers(6, 50)), 3, 0.7)
        fx, fy = cv2.Sobel(fine, cv2.CV_32F, 1, 0, scale=0.1), cv2.Sobel(fine, cv2.CV_32F, 0, 1, scale=0.1)
        nx, ny = dx * 0.6 + fx * rng.uniform(0.2, 2), dy * 0.6 + fy * rng.uniform(0.2, 2)
        away = (nx - rng.normal(0, 0.4)) ** 2 + (ny - rng.normal(0, 0.4)) ** 2
        where = smooth(noise(rng, height, width, 3, 2), rng.uniform(-0.8, 1.4), 2.2)
        shine = np.exp(-away * rng.uniform(3, 40)) * where * rng.uniform(0.3, 1.8)
        out = out + shine[..., None] * rng.uniform(0.85, 1.0, 3).astype(np.float32)
    return out


def falloff(rng: Generator, height: int, width: int) -> Plane:
    """Return the scope's light [h, w]: bright near a centre, darker away from it."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    cx, cy = width * rng.uniform(0.2, 0.8), height * rng.uniform(0.2, 0.8)
    r2 = ((x - cx) ** 2 + (y - cy) ** 2) / (width * rng.uniform(0.45, 1.6)) ** 2
    plane = 1 / (1 + r2) ** rng.uniform(0.5, 2)
    return plane * (1 + 0.25 * rng.uniform(0, 1) * noise(rng, height, width, 2, 2))


def lumen(rng: Generator, height: int, width: int) -> Picture:
    """Return a hollow organ seen along its axis: folds around a dark lumen."""
    image, relief = colour_of(rng, height, width)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    cx, cy = width * rng.uniform(0.2, 0.8), height * rng.uniform(0.2, 0.8)
    dx, dy = (x - cx) / width, (y - cy) / height * rng.uniform(0.7, 1.3)
    radius = np.sqrt(dx * dx + dy * dy) + 0.04 * noise(rng, height, width, 3, 2)
    radius = np.maximum(radius, 0.01)
    phase = np.log(radius) * rng.uniform(3, 9) + 0.5 * noise(rng, height, width, 2, 2)
    saw = phase / (2 * np.pi) % 1
    relief = 0.5 * relief + rng.uniform(0.2, 1) * np.cos(phase)
    image = lit(rng, image, relief)
    image = image * (1 - rng.uniform(0.1, 0.5) * smooth(np.asarray(saw, np.float32), 0.6, 1.0))[..., None]
    depth = smooth(radius, rng.uniform(0, 0.08), rng.uniform(0.25, 0.9))
    return np.asarray(image * (rng.uniform(0, 0.2) + depth)[..., None], np.float32)


def organs(rng: Generator, height: int, width: int) -> Picture:
    """Return one to four kinds of tissue next to each other, with crevices between them."""
    image = lit(rng, *colour_of(rng, height, width))
    for _ in range(int(rng.integers(0, 4))):
        other = lit(rng, *colour_of(rng, height, width)) * rng.uniform(0.7, 1.2)
        border = noise(rng, height, width, int(rng.integers(1, 4)), int(rng.integers(1, 5)), rng.uniform(0.3, 0.6))
        border += rng.normal(0, 0.7)
        sharp = rng.uniform(0.03, 0.6)
        image = image + smooth(border, -sharp, sharp)[..., None] * (other - image)
        if rng.random() < 0.6:
            side = border if rng.random() < 0.5 else -border
            shade = np.exp(np.minimum(-side * rng.uniform(2, 12), np.minimum(side * 25, 0))).astype(np.float32)
            image = image * (1 - rng.uniform(0.2, 0.9) * shade)[..., None]
    return np.asarray(image, np.float32)


def loop(rng: Generator, image: Picture) -> Picture:
    """Return a picture with a rounded loop of bowel or fold of tissue over it, which may enter from the border."""
    height, width = image.shape[:2]
    other, relief = colour_of(rng, height, width, COLOURED)
    if rng.random() < 0.6:
        vessels(rng, other, int(rng.integers(2, 10)))
    if rng.random() < 0.7:
        other = detail(rng, other, 0.3)
    angle = rng.uniform(0, np.pi)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    y, x = y - height * rng.uniform(0, 1), x - width * rng.uniform(0, 1)
    c, s = float(np.cos(angle)), float(np.sin(angle))
    along, across = x * c + y * s, y * c - x * s
    radius = height * rng.uniform(0.08, 0.35)
    bend = noise(rng, height, width, 2, 2) * radius * rng.uniform(0.1, 0.5)
    across = across + along * along * rng.uniform(-1, 1) / width + bend
    inside = 1 - (across / radius) ** 2
    end = rng.uniform(0.2, 1.5) * width
    inside = np.minimum(inside, 1 - (along / end) ** 2)
    high = np.sqrt(np.clip(inside, 0.0, 1))
    shaded = (
        lit(rng, other, 0.3 * relief + high * rng.uniform(1, 4)) * (0.4 + 0.6 * high)[..., None] * rng.uniform(0.7, 1.4)
    )
    mask = smooth(inside.astype(np.float32), 0.0, rng.uniform(0.05, 0.3))[..., None]
    return np.asarray(image + mask * (shaded - image), np.float32)


def cloth(rng: Generator, image: Picture) -> Picture:
    """Return a picture with a patch of gauze or white membrane, which is no tool."""
    height, width = image.shape[:2]
    where = noise(rng, height, width, 2, 4, 0.5) - rng.uniform(0.9, 2.2)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    weave = 0.8 + 0.2 * np.sin(x * rng.uniform(0.5, 2)) * np.sin(y * rng.uniform(0.5, 2))
    white = weave * (0.75 + 0.12 * noise(rng, height, width, 6, 3))
    colour = white[..., None] * (np.array([0.95, 0.85, 0.8]) + rng.normal(0, 0.08, 3)).astype(np.float32)
    return np.asarray(image + smooth(where, 0, 0.3)[..., None] * (colour - image) * rng.uniform(0.4, 1), np.float32)


def spots(rng: Generator, image: Picture) -> None:
    """Draw wet highlights, particles and drops as small bright ellipses."""
    height, width = image.shape[:2]
    plane = np.zeros((height, width), np.float32)
    middle = rng.uniform(0, 1, 2) * (width, height)
    for _ in range(int(rng.integers(3, 50))):
        centre = middle + rng.normal(0, rng.uniform(5, 60), 2)
        axes = rng.uniform(0.4, 1) * rng.uniform(0.6, 5), rng.uniform(0.4, 1.6)
        at = tuple(int(v) for v in np.round(centre * 8))
        cv2.ellipse(
            plane,
            at,
            tuple(int(8 * v) for v in axes),
            float(rng.uniform(0, 180)),
            0,
            360,
            float(rng.uniform(0.4, 1.3)),
            -1,
            cv2.LINE_AA,
            3,
        )
    plane = np.asarray(cv2.GaussianBlur(plane, (0, 0), rng.uniform(0.4, 1.2)), np.float32)
    image += plane[..., None] * rng.uniform(0.85, 1.05, 3).astype(np.float32)


def pale(rng: Generator, image: Picture) -> Picture:
    """Return a picture whose tissue, or a part of it, is as pale as tools: membranes, fat, scars and bloodless tissue."""
    height, width = image.shape[:2]
    level = image.mean(-1, keepdims=True)
    mean = float(level.mean())
    flat = np.maximum(mean + (level - mean) * rng.uniform(0.3, 1.1), 0)
    tint = np.array([1, rng.uniform(0.7, 1), rng.uniform(0.75, 1.08)]) * np.exp(rng.normal(0, 0.05, 3))
    white = flat * (rng.uniform(0.35, 0.85) / (mean + 0.02)) * tint.astype(np.float32)
    share: Plane | float = rng.uniform(0.4, 0.97)
    if rng.random() < 0.5:
        low = rng.uniform(-1.2, 0.8)
        where = noise(rng, height, width, int(rng.integers(1, 4)), int(rng.integers(1, 5)), 0.5)
        share = (share * smooth(where, low, low + rng.uniform(0.05, 2)))[..., None]
    return np.asarray(image + share * (white - image), np.float32)


def dark(rng: Generator, image: Picture) -> Picture:
    """Return a picture with shadows, cavities or clotted blood that are nearly as dark as black tools."""
    height, width = image.shape[:2]
    field = noise(rng, height, width, int(rng.integers(1, 5)), int(rng.integers(1, 6)), rng.uniform(0.3, 0.7))
    low = rng.uniform(0, 1.6)
    where = smooth(field, low, low + rng.uniform(0.05, 1.2))[..., None]
    colour = rng.uniform(0, 0.09) * np.array([1, rng.uniform(0.4, 1), rng.uniform(0.4, 1)], np.float32)
    black = image * np.float32(rng.uniform(0, 0.15)) + colour
    return np.asarray(image + where * rng.uniform(0.75, 1) * (black - image), np.float32)


def glare(rng: Generator, image: Picture) -> Picture:
    """Return a picture with large overexposed patches of wet tissue, with sharp and streaky outlines."""
    height, width = image.shape[:2]
    low = rng.uniform(0.5, 1.6)
    field = noise(rng, height, width, int(rng.integers(2, 5)), int(rng.integers(1, 6)), rng.uniform(0.4, 0.8))
    where = smooth(field, low, low + rng.uniform(0.1, 1))
    if rng.random() < 0.7:
        fine = fibres(rng, height, width) if rng.random() < 0.6 else noise(rng, height, width, height // 6, 2, 0.7)
        where = where * smooth(fine, rng.uniform(-2, 0), rng.uniform(0.8, 2.5))
    return np.asarray(image + where[..., None] * rng.uniform(0.4, 1.6) * rng.uniform(0.88, 1.0, 3), np.float32)


def blood(rng: Generator, image: Picture) -> Picture:
    """Return a picture with pools of blood."""
    height, width = image.shape[:2]
    where = smooth(noise(rng, height, width, 2, 4, 0.5), rng.uniform(0.3, 1.3), 1.8)[..., None] * rng.uniform(0.4, 1)
    colour = np.array([0.42, 0.02, 0.03], np.float32) * rng.uniform(0.3, 1.6)
    return np.asarray(image + where * (colour - image), np.float32)


class Photographs:
    """Crops of recordings whose terms allow training."""

    def __init__(self, recordings: Path, only: Sequence[str] = (), without: Sequence[str] = ()) -> None:
        """Read pictures.

        Args:
            recordings: folder of all recordings.
            only: beginnings of paths in it that are read; all if empty.
            without: beginnings of paths that are not read.
        """

        def wanted(name: str) -> bool:
            return (not only or name.startswith(tuple(only))) and not name.startswith(tuple(without))

        self.pictures: list[NDArray[np.uint8]] = []
        paths = [*(recordings / "others/organ_still").glob("images*/*"), *(recordings / "hamlyn_pair").glob("*.png")]
        for path in sorted(paths):
            if wanted(str(path.relative_to(recordings))):
                self._add(cv2.imread(str(path)))
        if wanted("colon"):
            capture = cv2.VideoCapture(str(recordings / "colon/video.mp4"))
            while self._add(capture.read()[1]):
                pass
        self.pictures = self.pictures[:: 1 + len(self.pictures) // 30]
        for name in ("0001", "0007"):
            read = cv2.imread(str(recordings / f"out_of_body/{name}.png"))
            if read is not None and wanted(f"out_of_body/{name}"):
                # The instruments are painted green in these samples; they are filled with tissue.
                picture = _reduced(np.asarray(read[30:960, 340:1560, ::-1], np.uint8))
                wide = picture.astype(np.int16)
                green = (wide[..., 1] > wide[..., 0] + 8).astype(np.uint8)
                green = np.asarray(cv2.dilate(green, np.ones((9, 9), np.uint8)), np.uint8)
                self.pictures.append(np.asarray(cv2.inpaint(picture, green, 5, cv2.INPAINT_TELEA), np.uint8))
        if not self.pictures:
            raise FileNotFoundError(f"no picture for training in {recordings}; give the folder of all recordings")

    def _add(self, read: NDArray[Any] | None) -> bool:
        """Keep a picture in OpenCV's order of colours. Returns false if it is None."""
        if read is not None:
            self.pictures.append(_reduced(np.asarray(read[..., ::-1], np.uint8)))
        return read is not None

    def draw(self, rng: Generator, height: int, width: int) -> Picture:
        """Return a warped, recoloured crop."""
        picture = self.pictures[rng.integers(len(self.pictures))]
        if rng.random() < 0.5:
            picture = self.pictures[-1 - rng.integers(min(2, len(self.pictures)))]
        h, w = picture.shape[:2]
        scale = max(width / w, height / h) * rng.uniform(1.0, 2.5)
        turn = cv2.getRotationMatrix2D((w / 2, h / 2), float(rng.uniform(-180, 180)), float(scale))
        turn[:, 2] += (width / 2 - w / 2, height / 2 - h / 2) + rng.normal(0, 0.1, 2) * width
        image = np.asarray(
            cv2.warpAffine(picture, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101),
            np.float32,
        )
        image /= 255
        target = PALETTES[rng.choice(len(PALETTES), p=LIKELY), 0]
        if rng.random() < 0.6:
            mean = image.reshape(-1, 3).mean(0) + 0.02
            image = image * ((1 - (mix := rng.uniform(0, 1))) + mix * target / mean).astype(np.float32)
        return np.asarray(np.clip(image, 0, 1.5), np.float32)


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    scale = 360 / picture.shape[1]
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def tissue(
    rng: Generator, height: int, width: int, photographs: Photographs | None = None, photographed: float = 0.3
) -> Picture:
    """Return a random picture of tissue, float32 RGB [h, w, 3], about 0..1, not clipped.

    Args:
        photographs: pictures of which a share of `photographed` is made.
    """
    kind = rng.random()
    if photographs is not None and kind < photographed:
        image = photographs.draw(rng, height, width)
        if rng.random() < 0.3:
            # Photographed and drawn tissue in one picture.
            border = noise(rng, height, width, int(rng.integers(1, 4)), 4, 0.5) + rng.normal(0, 0.7)
            drawn = detail(rng, organs(rng, height, width), 0.35)
            image = image + smooth(border, 0, rng.uniform(0.03, 0.5))[..., None] * (drawn - image)
    elif kind < 0.44:
        image = lumen(rng, height, width)
    else:
        image = organs(rng, height, width)
    if rng.random() < PALE:
        image = pale(rng, image)
        if rng.random() < 0.5:
            vessels(rng, image, int(rng.integers(1, 9)))
    if rng.random() < 0.8:
        image = detail(rng, np.asarray(image, np.float32), 0.35)
    if rng.random() < 0.4:
        for _ in range(int(rng.integers(1, 4))):
            image = loop(rng, image)
    if rng.random() < 0.07:
        image = cloth(rng, image)
    if rng.random() < 0.3:
        image = blood(rng, image)
    if rng.random() < DARKENED:
        image = dark(rng, image)
    if rng.random() < GLARING:
        image = glare(rng, image)
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            spots(rng, image)
    return np.asarray(image, np.float32)


class TissuePool:
    """Pictures of tissue that are used several times, mirrored and recoloured, because drawing them takes most of the time."""

    def __init__(
        self, photographs: Photographs | None = None, size: int = 500, new: float = 0.3, photographed: float = 0.3
    ) -> None:
        self.photographs, self.photographed = photographs, photographed
        self.size, self.new = size, new
        self._pictures: list[NDArray[np.float16]] = []

    def draw(self, rng: Generator, height: int, width: int) -> Picture:
        """Return a random picture, float32 RGB [h, w, 3]."""
        if len(self._pictures) < 100 or rng.random() < self.new:
            image = tissue(rng, height, width, self.photographs, self.photographed)
            if len(self._pictures) < self.size:
                self._pictures.append(image.astype(np.float16))
            else:
                self._pictures[rng.integers(self.size)] = image.astype(np.float16)
            return image
        image = self._pictures[rng.integers(len(self._pictures))].astype(np.float32)
        image = image[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        gains = np.exp(rng.normal(0, 0.08, 3)).astype(np.float32)
        mixed = (np.eye(3) + rng.normal(0, 0.04, (3, 3))).astype(np.float32)
        return np.ascontiguousarray(np.maximum(image * gains @ mixed, 0))
