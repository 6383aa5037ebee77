"""Hollow organs seen through a flexible endoscope, and accessories that come out of its working channel.

The light is strong and near, so walls and tools next to the lens are overexposed, in yellow and orange. Accessories are wide at the border
of the picture and taper quickly. Many are translucent or take the colour of the tissue around them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.bodies import Canvas, Material, body, cap, curved, entry, material, rotated, straight
from benchmarks.tool_network.tissue import Picture, Plane, colour_of, detail, lit, noise, smooth, spots, vessels

WALLS = np.array(
    [
        # Colours of walls in strong light, sRGB, 0..1.
        [0.85, 0.42, 0.15],
        [0.85, 0.50, 0.40],
        [0.72, 0.25, 0.17],
        [0.62, 0.38, 0.15],
        [0.90, 0.70, 0.52],
        [0.80, 0.55, 0.20],
        [0.55, 0.25, 0.18],
        [0.88, 0.58, 0.55],
    ],
    np.float32,
)
SHEATHS = np.array(
    [
        # Plastic sheaths: blue, light blue, teal, green, yellow, orange, white, grey, violet, pink.
        [0.10, 0.25, 0.75],
        [0.45, 0.70, 0.95],
        [0.05, 0.55, 0.55],
        [0.15, 0.60, 0.25],
        [0.95, 0.82, 0.25],
        [0.95, 0.50, 0.12],
        [0.95, 0.93, 0.90],
        [0.55, 0.55, 0.57],
        [0.45, 0.30, 0.65],
        [0.95, 0.60, 0.68],
    ],
    np.float32,
)


def hollow_organ(rng: Generator, height: int, width: int) -> Picture:
    """Return a hollow organ seen along its axis, float32 RGB [h, w, 3], not clipped."""
    image, relief = colour_of(rng, height, width)
    if rng.random() < 0.85:
        mean = image.reshape(-1, 3).mean(0) + 0.02
        wall = WALLS[rng.integers(len(WALLS))] * np.exp(rng.normal(0, 0.08, 3)).astype(np.float32)
        image = image * (wall / mean) ** np.float32(rng.uniform(0.6, 1))
    if rng.random() < 0.5:
        vessels(rng, image, int(rng.integers(3, 12)))
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    cx, cy = width * rng.uniform(0.1, 0.9), height * rng.uniform(0.1, 0.9)
    dx, dy = (x - cx) / width, (y - cy) / height * rng.uniform(0.7, 1.3)
    radius = np.maximum(np.sqrt(dx * dx + dy * dy) + rng.uniform(0.02, 0.07) * noise(rng, height, width, 2, 3), 0.01)
    phase = np.log(radius) * rng.uniform(2, 9) + rng.uniform(0.2, 1) * noise(rng, height, width, 2, 2)
    saw = np.asarray(phase / (2 * np.pi) % 1, np.float32)
    relief = rng.uniform(0.2, 0.7) * relief + rng.uniform(0.2, 1.4) * np.cos(phase)
    if rng.random() < 0.3:
        relief, image = polyp(rng, image, np.asarray(relief, np.float32))
    image = lit(rng, image, np.asarray(relief, np.float32))
    image = image * (1 - rng.uniform(0, 0.5) * smooth(saw, 0.6, 1.0))[..., None]
    rim = np.exp(-(((saw - 0.55) / rng.uniform(0.05, 0.15)) ** 2)) * rng.uniform(0, 0.6)
    image = image * (1 + rim)[..., None]
    depth = smooth(radius, rng.uniform(0, 0.08), rng.uniform(0.2, 0.9))
    image = np.asarray(image * (rng.uniform(0, 0.35) + depth)[..., None], np.float32)
    for _ in range(int(rng.choice([0, 1, 2, 3], p=[0.35, 0.35, 0.2, 0.1]))):
        image = fold(rng, image)
    if rng.random() < 0.3:
        image = residue(rng, image)
    if rng.random() < 0.15:
        image = liquid(rng, image)
    if rng.random() < 0.6:
        image = detail(rng, image, 0.2)
    if rng.random() < 0.15:
        bubbles(rng, image)
    if rng.random() < 0.12:
        image = pit(rng, image)
    if rng.random() < 0.7:
        for _ in range(int(rng.integers(1, 5))):
            spots(rng, image)
    return image


def fold(rng: Generator, image: Picture) -> Picture:
    """Return the picture with a fold of the wall that enters from the border, next to the lens and often overexposed."""
    height, width = image.shape[:2]
    other, relief = colour_of(rng, height, width)
    near_colour = image.reshape(-1, 3).max(0) * rng.uniform(0.6, 1.1)
    other = other * (near_colour / (other.reshape(-1, 3).mean(0) + 0.02)) ** np.float32(rng.uniform(0.5, 1))
    if rng.random() < 0.5:
        # Strong light turns the rim yellow.
        other = other * np.array([1.2, rng.uniform(1.0, 1.5), rng.uniform(0.4, 1.0)], np.float32)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    size = height * rng.uniform(0.3, 1.6)
    inwards = height * rng.uniform(0.05, 0.4)
    middle = np.array([width, height]) / 2
    direction = np.array([np.cos(angle), np.sin(angle)])
    border = min(width / 2 / max(1e-3, abs(float(direction[0]))), height / 2 / max(1e-3, abs(float(direction[1]))))
    centre = middle + direction * (border + size - inwards)
    away = np.sqrt((x - centre[0]) ** 2 + ((y - centre[1]) * rng.uniform(0.7, 1.3)) ** 2)
    away = away + size * 0.06 * noise(rng, height, width, 2, 3)
    inside = np.asarray((size - away) / (0.25 * height), np.float32)
    high = np.sqrt(np.clip(inside * rng.uniform(0.7, 3), 0, 1))
    shaded = lit(rng, np.asarray(other, np.float32), np.asarray(0.3 * relief + high * rng.uniform(0.5, 3), np.float32))
    shaded = shaded * (rng.uniform(0.3, 0.9) + rng.uniform(0.2, 1.2) * high)[..., None]
    mask = smooth(inside, 0.0, rng.uniform(0.02, 0.15))[..., None]
    shade = np.exp(-np.clip(-inside, 0, None) * rng.uniform(3, 15)) * rng.uniform(0, 0.6)
    image = image * (1 - shade)[..., None]
    return np.asarray(image + mask * (shaded - image), np.float32)


def polyp(rng: Generator, image: Picture, relief: Plane) -> tuple[Plane, Picture]:
    """Return the relief and colour with a round polyp, which is no tool."""
    height, width = relief.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    size = height * rng.uniform(0.05, 0.25)
    cx, cy = width * rng.uniform(0, 1), height * rng.uniform(0, 1)
    away = (
        ((x - cx) / size) ** 2 + ((y - cy) / size / rng.uniform(0.6, 1.2)) ** 2 + 0.2 * noise(rng, height, width, 4, 2)
    )
    bump = np.sqrt(np.clip(1 - away, 0, 1))
    tinted = image * np.exp(rng.normal(0, 0.15, 3)).astype(np.float32) * np.float32(rng.uniform(0.8, 1.3))
    return (
        np.asarray(relief + bump * rng.uniform(1, 5), np.float32),
        np.asarray(image + smooth(bump, 0, 0.3)[..., None] * (tinted - image), np.float32),
    )


def residue(rng: Generator, image: Picture) -> Picture:
    """Return the picture with stool or mucus on the wall: yellow, brown, green or white, partly thick."""
    height, width = image.shape[:2]
    colours = np.array([[0.75, 0.6, 0.2], [0.4, 0.27, 0.1], [0.5, 0.5, 0.2], [0.85, 0.8, 0.7], [0.7, 0.45, 0.12]])
    colour = (colours[rng.integers(len(colours))] * rng.uniform(0.7, 1.3) * max(0.4, float(image.mean()) * 2)).astype(
        np.float32
    )
    field = noise(rng, height, width, int(rng.integers(2, 14)), 4, rng.uniform(0.5, 0.8))
    where = smooth(field, rng.uniform(0.8, 2), rng.uniform(2.1, 3)) * rng.uniform(0.3, 1)
    flat = np.broadcast_to(colour, image.shape).astype(np.float32)
    thick = lit(rng, flat, field * np.float32(rng.uniform(0.2, 1)))
    return np.asarray(image + where[..., None] * (thick - image), np.float32)


def liquid(rng: Generator, image: Picture) -> Picture:
    """Return the picture with a pool of liquid."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    across = (x - width / 2) * np.cos(angle) + (y - height / 2) * np.sin(angle)
    field = across / height - rng.uniform(0.1, 0.45) + 0.06 * noise(rng, height, width, 2, 3)
    where = smooth(np.asarray(field, np.float32), 0, rng.uniform(0.02, 0.1)) * rng.uniform(0.4, 0.95)
    colour = np.array([0.65, 0.45, 0.2]) * rng.uniform(0.4, 1.4) * np.exp(rng.normal(0, 0.2, 3))
    still = 0.7 + 0.15 * noise(rng, height, width, 2, 2)
    return np.asarray(image + where[..., None] * (still[..., None] * colour - image), np.float32)


def bubbles(rng: Generator, image: Picture) -> None:
    """Draw bubbles of foam with bright rims and highlights."""
    height, width = image.shape[:2]
    middle = rng.uniform(0, 1, 2) * (width, height)
    plane = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(5, 60))):
        at = middle + rng.normal(0, rng.uniform(10, 50), 2)
        size = rng.uniform(1, 7)
        place = tuple(int(v * 8) for v in at)
        cv2.circle(plane, place, int(size * 8), float(rng.uniform(0.1, 0.5)), 1, cv2.LINE_AA, 3)
        shine = tuple(int(v * 8) for v in at - size * 0.4)
        cv2.circle(plane, shine, 8, float(rng.uniform(0.5, 1.2)), -1, cv2.LINE_AA, 3)
    image += plane[..., None]


def pit(rng: Generator, image: Picture) -> Picture:
    """Return the picture with a dark opening of the wall, partly with a bleeding rim."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    size = height * rng.uniform(0.02, 0.08)
    cx, cy = width * rng.uniform(0.1, 0.9), height * rng.uniform(0.1, 0.9)
    away = np.sqrt((x - cx) ** 2 + ((y - cy) * rng.uniform(0.7, 1.3)) ** 2) / size + 0.15 * noise(
        rng, height, width, 8, 2
    )
    if rng.random() < 0.5:
        red = 1 - smooth(np.asarray(away, np.float32), 1, rng.uniform(1.5, 3))
        image = image * (1 - red[..., None] * np.array([0.3, 0.8, 0.8], np.float32) * np.float32(rng.uniform(0.3, 1)))
    return np.asarray(image * (0.05 + 0.95 * smooth(np.asarray(away, np.float32), 0.8, 1.1))[..., None], np.float32)


def narrow_band(rng: Generator, image: Picture) -> Picture:
    """Return the picture in narrow-band light: green is shown as red, and blue as green and blue."""
    gains = np.array([1.3, 1.5, 1.6]) * np.exp(rng.normal(0, 0.15, 3))
    return np.asarray(image[..., [1, 2, 2]] * gains.astype(np.float32), np.float32)


def sheath(rng: Generator, canvas: Canvas) -> Material:
    """Draw a surface of an accessory: translucent, in the colour of the tissue, coloured plastic, or a metal coil."""
    kind = str(rng.choice(["clear", "tinted", "colour", "coil", "any"], p=[0.25, 0.29, 0.25, 0.1, 0.11]))
    if kind == "any":
        surface = material(rng, canvas)
    else:
        reflected = canvas.surround / max(0.05, float(canvas.surround.max()))
        if kind in ("clear", "tinted"):
            white = rng.uniform(0, 1)
            hue = (white + (1 - white) * reflected) * rng.uniform(0.6, 1.1) * np.exp(rng.normal(0, 0.07, 3))
        elif kind == "colour":
            hue = SHEATHS[rng.integers(len(SHEATHS))] * np.exp(rng.normal(0, 0.15, 3)) * rng.uniform(0.6, 1.2)
            hue = hue * (1 - (share := rng.uniform(0, 0.5))) + share * hue * reflected
        else:
            hue = rng.uniform(0.3, 0.8) * np.ones(3)
        v = np.linspace(-1, 1, 32, dtype=np.float32)
        lit_from = rng.uniform(-0.8, 0.8)
        normal = np.sqrt(np.clip(1 - v * v, 0, 1))
        diffuse = np.clip(v * lit_from + normal * np.sqrt(1 - lit_from**2), 0, 1)
        ambient = rng.uniform(0.2, 0.8)
        shade = ambient + (1 - ambient) * diffuse
        if rng.random() < 0.3:
            # Light that passes through the wall of a tube brightens its edges.
            shade = shade + rng.uniform(0, 0.5) * np.abs(v) ** rng.uniform(2, 6)
        gloss = np.zeros(32)
        for _ in range(int(rng.integers(0, 4))):
            gloss += np.exp(-(((v - rng.uniform(-0.9, 0.9)) / rng.uniform(0.04, 0.3)) ** 2)) * rng.uniform(0, 1.0)
        profile = np.asarray(shade[:, None] * hue + gloss[:, None] * (0.5 + 0.5 * reflected), np.float32)
        rings = np.ones(64, np.float32)
        if kind == "coil":
            rings *= 1 + 0.4 * np.sin(np.arange(64) * rng.uniform(1.2, 2.6)).astype(np.float32)
        elif rng.random() < 0.3:
            for _ in range(int(rng.integers(1, 4))):
                at = int(rng.integers(0, 60))
                rings[at : at + int(rng.integers(1, 8))] *= rng.uniform(0.2, 1.6)
        opacity = rng.uniform(0.35, 0.85) if kind == "clear" else rng.uniform(0.85, 1)
        surface = Material(profile, rings, float(rng.uniform(0, 0.3)), opacity)
    surface.sparkle = float(rng.uniform(0, 0.8)) if rng.random() < 0.5 else 0.0
    surface.ramp = (
        (rng.uniform(0.9, 2.2), rng.uniform(0.5, 1.0))
        if rng.random() < 0.7
        else (rng.uniform(0.3, 1), rng.uniform(0.7, 1.2))
    )
    return surface


def accessory(rng: Generator, canvas: Canvas) -> None:
    """Draw a random accessory: a sheath, often with a snare, needle, forceps, clip or wire at its end, or a cap on the scope."""
    height, width = canvas.mask.shape
    size = np.array([width, height])
    kinds = ["sheath", "snare", "needle", "forceps", "clip", "wire", "scope", "cap"]
    kind = str(rng.choice(kinds, p=[0.4, 0.12, 0.11, 0.12, 0.06, 0.07, 0.05, 0.07]))
    if kind == "cap":
        distal_cap(rng, canvas)
        return
    place = rng.random()
    if place < 0.5:
        start = size * (rng.uniform(0.45, 1.05), 1.12)
    elif place < 0.8:
        start = size * (rng.uniform(0.05, 0.95), 1.12)
    else:
        start = entry(rng, height, width)
    tip = size * rng.uniform(0.25, 0.75, 2)
    tip = start + (tip - start) * rng.uniform(0.5, 1.1)
    length = float(np.linalg.norm(tip - start))
    if length < 0.1 * height:
        return
    direction = (tip - start) / length
    tone = canvas.light * rng.uniform(0.7, 1.6)
    if kind == "scope":
        # The scope itself, seen when it is bent backwards.
        line, widths = curved(rng, start, tip, half := height * rng.uniform(0.1, 0.25), half, rng.uniform(-0.4, 0.4))
        body(rng, canvas, line, widths, material(rng, canvas, "black"), tone)
        return
    first = height * rng.uniform(0.03, 0.24)
    last = max(1.0, first * rng.uniform(0.1, 0.75))
    if kind == "wire":
        first, last = height * rng.uniform(0.008, 0.03), height * rng.uniform(0.006, 0.012)
    surface = sheath(rng, canvas)
    line, widths = curved(rng, start, tip, first, last, rng.normal(0, 0.07))
    body(rng, canvas, line, widths, surface, tone)
    if surface.opacity < 0.85 and rng.random() < 0.6:
        # A wire is seen through the sheath.
        inner = material(rng, canvas, str(rng.choice(["metal", "chrome", "black", "white"])))
        inner.opacity = float(rng.uniform(0.3, 0.9))
        body(rng, canvas, line, widths * rng.uniform(0.15, 0.45), inner, tone)
    end_tone = tone * surface.ramp[1]
    cap(rng, canvas, tip, direction, last, surface, end_tone)
    if rng.random() < 0.25:
        band = tip - direction * length * rng.uniform(0.05, 0.2)
        body(rng, canvas, *straight(band, tip, last * 1.15, last), sheath(rng, canvas), end_tone)
    turned = rotated(direction, rng.normal(0, 0.25))
    metal = material(rng, canvas, str(rng.choice(["metal", "chrome", "grey", "black"], p=[0.4, 0.35, 0.15, 0.1])))
    if kind == "snare":
        snare(rng, canvas, tip, turned, metal, end_tone)
    elif kind == "needle":
        end = tip + turned * height * rng.uniform(0.03, 0.2)
        body(rng, canvas, *straight(tip, end, max(0.7, last * rng.uniform(0.1, 0.45)), 0.5), metal, end_tone)
    elif kind in ("forceps", "clip"):
        long, wide = (
            last * rng.uniform(1, 3.5),
            last * (rng.uniform(0.4, 0.9) if kind == "forceps" else rng.uniform(0.12, 0.3)),
        )
        opening = abs(rng.normal(0, 0.5))
        for side in (-1, 1):
            way = rotated(turned, side * opening)
            jaw, jaw_widths = curved(
                rng, tip, tip + way * long, wide, wide * rng.uniform(0.4, 1), side * rng.uniform(-0.3, 0)
            )
            body(rng, canvas, jaw, jaw_widths, metal, end_tone * rng.uniform(0.7, 1.2))
            cap(rng, canvas, jaw[-1].astype(np.float64), way, float(jaw_widths[-1]), metal, end_tone)


def snare(
    rng: Generator,
    canvas: Canvas,
    tip: NDArray[np.float64],
    direction: NDArray[np.float64],
    wire: Material,
    tone: float,
) -> None:
    """Draw the wire loop of a snare."""
    height = canvas.mask.shape[0]
    long, wide = height * rng.uniform(0.08, 0.4), height * rng.uniform(0.03, 0.2)
    t = np.linspace(0, 2 * np.pi, 25)
    along, across = long * (1 - np.cos(t)) / 2, wide * np.sin(t) * np.sin(t / 2) ** rng.uniform(0, 1.5)
    side = np.array([-direction[1], direction[0]])
    line = tip + along[:, None] * direction + across[:, None] * side
    thick = max(0.7, height * rng.uniform(0.003, 0.011))
    body(rng, canvas, line.astype(np.float32), np.full(25, thick), wire, tone)


def distal_cap(rng: Generator, canvas: Canvas) -> None:
    """Draw the rim of a transparent cap on the scope's end: a ring near the border, or a segment of it."""
    height, width = canvas.mask.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    middle = np.array([width, height]) * rng.uniform(0.4, 0.6, 2)
    away = np.sqrt((x - middle[0]) ** 2 + ((y - middle[1]) * rng.uniform(0.9, 1.1)) ** 2)
    inner = height * rng.uniform(0.45, 0.62)
    thick = height * rng.uniform(0.04, 0.4)
    cover = smooth(away - inner, 0, rng.uniform(1, 5)) * (1 - smooth(away - inner - thick, 0, 3))
    if not cover.any():
        return
    surface = sheath(rng, canvas)
    at = np.clip((away - inner) / thick * 31, 0, 31).astype(np.intp)
    colour = surface.profile[at] * canvas.light * (1 + 0.15 * noise(rng, height, width, 3, 3))[..., None]
    turn = np.arctan2(y - middle[1], x - middle[0])
    colour = colour * (1 + rng.uniform(0, 0.6) * np.cos(turn * rng.integers(1, 4) + rng.uniform(0, 6)))[..., None]
    alpha = cover * rng.uniform(0.4, 1)
    canvas.image += alpha[..., None] * (np.clip(colour, 0, 1.6) - canvas.image)
    np.maximum(canvas.mask, cover, out=canvas.mask)
