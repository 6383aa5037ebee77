"""Random training pictures of the tool network: tissue, instruments, and the effects of a scope's camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.flexible import hollow_organ, narrow_band
from benchmarks.tool_network.instruments import clips, with_instruments
from benchmarks.tool_network.recorded import RecordedTools
from benchmarks.tool_network.tissue import Picture, Plane, TissuePool, falloff, noise, smooth

SIZE_PX = (128, 160)
"""Height and width of a training picture."""
DRAWN_PX = (192, 240)
WITHOUT_TOOLS = (0.22, 0.22)
"""Share of pictures without instruments, elsewhere and inside of hollow organs."""
HOLLOW = 0.25
"""Share of pictures by flexible endoscopes from inside a hollow organ."""
ACCESSORIES = (0.08, 0.9)
"""Share of accessories of flexible endoscopes among the instruments, elsewhere and inside of hollow organs."""


def training_picture(
    rng: Generator, pool: TissuePool, recorded: RecordedTools | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return a picture uint8 RGB [128, 160, 3] and the coverage by tools, uint8 [128, 160], 255 = tool."""
    height, width = DRAWN_PX
    hollow = rng.random() < HOLLOW
    image = hollow_organ(rng, height, width) if hollow else pool.draw(rng, height, width)
    light = falloff(rng, height, width)
    if hollow:
        light = np.sqrt(np.maximum(light, 0))
    mask = np.zeros((height, width), np.float32)
    inner_light = rng.random() < 0.5
    if not inner_light:
        image = image * light[..., None]
    if rng.random() < 0.14:
        image = clips(rng, np.asarray(image, np.float32))
    if rng.random() >= WITHOUT_TOOLS[hollow]:
        shares = [0.75, 0.2, 0.05, 0] if hollow else [0.4, 0.33, 0.17, 0.1]
        count = int(rng.choice([1, 2, 3, 4], p=shares))
        image, mask = with_instruments(rng, np.asarray(image, np.float32), count, ACCESSORIES[hollow], recorded)
    if inner_light:
        image = image * light[..., None]
    if rng.random() < 0.18:
        image = smoke(rng, image)
    if hollow and rng.random() < 0.08:
        image = narrow_band(rng, np.asarray(image, np.float32))
    return photographed(rng, image, mask, rng.uniform(0.75, 1.3) if hollow else 0.8, 0.6 if hollow else 0.28)


def smoke(rng: Generator, image: Picture) -> Picture:
    """Return a picture behind smoke or steam."""
    height, width = image.shape[:2]
    where = smooth(noise(rng, height, width, 1, 4, 0.5), rng.uniform(-1.5, 1), 2.5)[..., None] * rng.uniform(0.2, 0.8)
    colour = rng.uniform(0.4, 0.85) * (1 + rng.normal(0, 0.06, 3)).astype(np.float32)
    return np.asarray(image + where * (colour - image), np.float32)


def surround(rng: Generator, height: int, width: int) -> Plane:
    """Return the field of view [h, w]: 1 inside of a round, octagonal or rectangular view, 0 outside."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    cx, cy = width * rng.uniform(0.42, 0.58), height * rng.uniform(0.42, 0.58)
    radius = height * rng.uniform(0.42, 0.75)
    kind = rng.random()
    dx, dy = np.abs(x - cx), np.abs(y - cy)
    if kind < 0.5:
        away = np.sqrt(dx * dx + dy * dy) / radius
    elif kind < 0.8:
        away = np.maximum(np.maximum(dx, dy), (dx + dy) * rng.uniform(0.66, 0.78)) / radius
    else:
        away = np.maximum(dx / (width * rng.uniform(0.3, 0.5)), dy / (height * rng.uniform(0.4, 0.55)))
    soft = rng.choice([0.01, 0.03, 0.25])
    return 1 - smooth(np.asarray(away, np.float32), 1 - soft, 1.0)


def photographed(
    rng: Generator, image: Picture, mask: Plane, exposure: float, framed: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the picture as a scope's camera and a video codec give it.

    Args:
        exposure: value that 90 % of the pixels do not exceed, before random changes of brightness.
        framed: chance of a border around the field of view.
    """
    height, width = mask.shape
    image = np.maximum(image, 0)
    level = float(np.quantile(image[::4, ::4].max(-1), 0.9)) + 1e-3
    image = image * np.float32(np.exp(rng.normal(0, 0.25)) * min(3.0, exposure / level))
    if rng.random() < 0.5:
        image = image ** np.float32(np.exp(rng.normal(0, 0.25)))
    image = image * np.exp(rng.normal(0, 0.07, 3)).astype(np.float32)
    grey = image.mean(-1, keepdims=True)
    image = grey + (image - grey) * np.float32(np.exp(rng.normal(0.15, 0.17)))
    blur = float(rng.choice([0, 0.5, 1, 2], p=[0.45, 0.28, 0.17, 0.1]))
    if blur:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.float32)
    if rng.random() < 0.1:
        length = int(rng.integers(3, 12))
        kernel = np.zeros((length, length), np.float32)
        cv2.line(kernel, (0, int(rng.integers(length))), (length - 1, int(rng.integers(length))), 1.0, 1)
        kernel /= kernel.sum()
        image, mask = cv2.filter2D(image, -1, kernel), cv2.filter2D(mask, -1, kernel)
    if rng.random() < framed:
        view = surround(rng, height, width)
        image = image * view[..., None]
        mask = mask * (view > 0.05)
    small_height, small_width = SIZE_PX
    image = np.asarray(cv2.resize(image, (small_width, small_height), interpolation=cv2.INTER_AREA), np.float32)
    mask = np.asarray(cv2.resize(mask, (small_width, small_height), interpolation=cv2.INTER_AREA), np.float32)
    if rng.random() < 0.5:
        image = image + rng.uniform(0.3, 1.8) * (image - cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 1.5)))
    if rng.random() < 0.6:
        image = image + rng.normal(0, 1, image.shape).astype(np.float32) * np.float32(rng.uniform(0, 0.035))
    out = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    if rng.random() < 0.5:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 95))]
        out = np.asarray(cv2.imdecode(cv2.imencode(".jpg", out, quality)[1], cv2.IMREAD_COLOR), np.uint8)
    return out, (np.clip(mask, 0, 1) * 255 + 0.5).astype(np.uint8)
