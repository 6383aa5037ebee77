"""Swept bodies with materials, of which instruments and accessories are made, and the canvas that they are drawn into.

A body has a centre line, a width along it and a material, which gives its colour from the position along and across the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.tissue import Picture, Plane

Points = NDArray[np.float32]


@dataclass
class Canvas:
    """Picture that instruments are drawn into."""

    image: Picture
    mask: Plane
    """Coverage by tools, 0..1."""
    surround: NDArray[np.float32]
    """Mean colour of the tissue, which metal reflects."""
    light: float
    """Brightness of tools relative to tissue."""


@dataclass
class Material:
    """Surface of a body: colour profile across the body, rings along it, texture and stains."""

    profile: NDArray[np.float32]
    """Colour across the body, [32, 3]."""
    rings: NDArray[np.float32]
    """Factor along the body, [64]."""
    grain: float
    opacity: float = 1.0
    ramp: tuple[float, float] = (1.0, 1.0)
    """Brightness at the start and at the end."""
    sparkle: float = 0.0
    """Strength of small highlights."""


def material(rng: Generator, canvas: Canvas, kind: str | None = None) -> Material:
    """Draw a surface: metal, plastic in a colour, or the colour of tissue."""
    kinds = ["metal", "chrome", "black", "grey", "white", "colour", "tissue", "matt"]
    shares = np.array([0.22, 0.16, 0.14, 0.17, 0.15, 0.05, 0.05, 0.06])
    if kind is None:
        kind = str(rng.choice(kinds, p=shares / shares.sum()))
    v = np.linspace(-1, 1, 32, dtype=np.float32)
    lit_from = rng.uniform(-0.8, 0.8)
    normal = np.sqrt(np.clip(1 - v * v, 0, 1))
    diffuse = np.clip(v * lit_from + normal * np.sqrt(1 - lit_from**2), 0, 1)
    ambient = rng.uniform(0.1, 0.5)
    shade = ambient + (1 - ambient) * diffuse
    gloss = np.exp(-(((v - lit_from * rng.uniform(0.5, 1)) / rng.uniform(0.06, 0.35)) ** 2)) * rng.uniform(0, 1.4)
    tint = 1 + rng.normal(0, 0.05, 3)
    if rng.random() < 0.3:
        tint = tint * (1 + rng.uniform(0, 0.14) * np.array([1, 0.4, -1]))
    opacity = 1.0
    if kind == "metal":
        albedo = rng.uniform(0.2, 0.75) * tint
        colour = shade[:, None] * albedo + gloss[:, None]
        reflected = rng.uniform(0, 0.3)
        edge = np.abs(v)[:, None] ** rng.uniform(1, 5)
        colour = colour + edge * reflected * (canvas.surround - colour)
    elif kind == "chrome":
        knots = np.sort(rng.uniform(-1, 1, int(rng.integers(3, 9))))
        level = rng.uniform(0, 1, len(knots)) ** 1.5
        level[rng.integers(len(knots))] = rng.uniform(0.9, 1.4)
        grey = np.interp(v, knots, level)[:, None] * tint
        red = np.interp(
            v,
            [-1, rng.uniform(-0.9, 0.9), 1],
            rng.uniform(0.4, 1.0, 3) if rng.random() < 0.15 else rng.uniform(0, 0.5, 3),
        )[:, None]
        colour = grey * (1 - red) + red * canvas.surround * np.interp(v, knots, level)[:, None] * 2
    elif kind == "black":
        colour = shade[:, None] * rng.uniform(0.02, 0.2) * tint + gloss[:, None] * rng.uniform(0, 0.6)
        edge = np.abs(v)[:, None] ** rng.uniform(2, 6)
        colour = colour + edge * rng.uniform(0, 0.35) * (canvas.surround - colour)
    elif kind == "grey":
        albedo = rng.uniform(0.2, 0.65) * tint * (1, 1, 1 + rng.uniform(-0.02, 0.12))
        colour = shade[:, None] * albedo + 0.3 * gloss[:, None]
    elif kind == "white":
        colour = (
            shade[:, None] * rng.uniform(0.75, 1.25) * tint * (1, rng.uniform(0.92, 1), rng.uniform(0.8, 1))
            + 0.2 * gloss[:, None]
        )
    elif kind == "colour":
        hue = cv2.cvtColor(
            np.float32([[[rng.uniform(40, 280), rng.uniform(0.3, 1), rng.uniform(0.2, 0.9)]]]), cv2.COLOR_HSV2RGB
        )[0, 0]
        colour = shade[:, None] * hue + 0.5 * gloss[:, None]
    elif kind == "tissue":
        if rng.random() < 0.5:
            hue = canvas.surround / max(0.05, float(canvas.surround.max())) * rng.uniform(0.6, 1.1) + rng.normal(
                0, 0.07, 3
            )
        else:
            degrees = rng.uniform(-30, 55) % 360
            hue = cv2.cvtColor(
                np.float32([[[degrees, rng.uniform(0.2, 0.9), rng.uniform(0.5, 1.1)]]]), cv2.COLOR_HSV2RGB
            )[0, 0]
        colour = shade[:, None] * hue + 0.6 * gloss[:, None]
        opacity = rng.uniform(0.75, 1)
    else:
        colour = np.ones((32, 1)) * rng.uniform(0.1, 0.8) * tint
    count = int(rng.integers(0, 9))
    rings = np.ones(64)
    if rng.random() < 0.4:
        for _ in range(count):
            at, wide = rng.integers(0, 64), int(rng.integers(1, 10))
            rings[at : at + wide] *= rng.uniform(0.3, 1.8)
    if rng.random() < 0.12:
        rings *= 1 + 0.5 * np.sign(np.sin(np.arange(64) * rng.uniform(0.5, 2.5)))
    return Material(
        np.asarray(colour, np.float32),
        np.asarray(rings, np.float32),
        float(rng.uniform(0, 0.3) if rng.random() < 0.65 else 0.02),
        opacity,
    )


def body(
    rng: Generator, canvas: Canvas, line: Points, width: NDArray[np.float64], surface: Material, tone: float
) -> None:
    """Draw a swept body: `line` [n, 2] in pixels, half widths [n], a surface and a brightness factor."""
    height, picture_width = canvas.mask.shape
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(1e-6, np.linalg.norm(tangent, axis=1, keepdims=True))
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    left, right = line - across * width[:, None], line + across * width[:, None]
    outline = np.concatenate([left, right[::-1]])
    low = np.maximum(0, np.floor(outline.min(0)).astype(int) - 1)
    high = np.minimum((picture_width, height), np.ceil(outline.max(0)).astype(int) + 2)
    if (high <= low).any():
        return
    box = slice(low[1], high[1]), slice(low[0], high[0])
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    cover = np.zeros(x.shape, np.float32)
    cv2.fillPoly(cover, [np.round((outline - low) * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
    cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), 0.7), np.float32)
    # Position along and across of the nearest segment.
    u, v = np.zeros_like(x), np.zeros_like(x)
    nearest = np.full(x.shape, np.inf, np.float32)
    count = len(line) - 1
    for i in range(count):
        a, b = line[i], line[i + 1]
        d = b - a
        squared = max(1e-6, float(d @ d))
        t = ((x - a[0]) * d[0] + (y - a[1]) * d[1]) / squared
        inside = np.clip(t, 0, 1)
        away = (x - a[0] - inside * d[0]) ** 2 + (y - a[1] - inside * d[1]) ** 2
        side = (-(x - a[0]) * d[1] + (y - a[1]) * d[0]) / np.sqrt(squared) * -1
        half = width[i] + (width[i + 1] - width[i]) * inside
        closer = away < nearest
        nearest = np.where(closer, away, nearest)
        u = np.where(closer, (i + inside) / count, u)
        v = np.where(closer, side / np.maximum(half, 0.3), v)
    across_at = np.clip((v + 1) * 15.5, 0, 31).astype(np.intp)
    along_at = np.clip(u * 63, 0, 63).astype(np.intp)
    colour = surface.profile[across_at] * surface.rings[along_at][..., None]
    tone_along = tone * (1 + rng.uniform(-0.35, 0.35) * (u - 0.5))
    tone_along = tone_along * (surface.ramp[0] + (surface.ramp[1] - surface.ramp[0]) * u)
    length = float(np.linalg.norm(line[-1] - line[0]))
    if surface.grain > 0.02:
        tone_along = tone_along * (1 + surface.grain * rough(rng, u, v, length, float(width.mean())))
    colour = colour * tone_along[..., None]
    if surface.sparkle:
        shine = np.clip(rough(rng, u, v, length, float(width.mean())) - 1, 0, 1.5) * surface.sparkle
        colour = colour + shine[..., None]
    colour = np.clip(colour, 0, 1.6)
    alpha = cover * surface.opacity
    canvas.image[box] += alpha[..., None] * (colour - canvas.image[box])
    canvas.mask[box] = np.maximum(canvas.mask[box], cover)


def rough(rng: Generator, u: Plane, v: Plane, length: float, half: float) -> Plane:
    """Return texture on a body, mean near 0: grain, or streaks along or across it. `u` and `v` are positions on it."""
    cell_u, cell_v = np.exp(rng.uniform(np.log(1.5), np.log(25), 2))
    texture = rng.standard_normal((64, 64), np.float32)
    texture = np.asarray(cv2.GaussianBlur(texture, (0, 0), 0.8), np.float32)
    texture /= texture.std()
    along = (u * np.float32(length / cell_u)) % 63
    across = ((v + 1) * np.float32(half / cell_v) + rng.uniform(0, 60)) % 63
    return np.asarray(cv2.remap(texture, along, np.asarray(across, np.float32), cv2.INTER_LINEAR), np.float32)


def straight(start: NDArray, end: NDArray, first: float, last: float) -> tuple[Points, NDArray[np.float64]]:
    return np.array([start, end], np.float32), np.array([first, last], np.float64)


def curved(
    rng: Generator, start: NDArray, end: NDArray, first: float, last: float, bend: float
) -> tuple[Points, NDArray[np.float64]]:
    t = np.linspace(0, 1, 9)[:, None]
    d = end - start
    side = np.array([-d[1], d[0]]) * bend
    line = start + t * d + 4 * t * (1 - t) * side + np.sin(2 * np.pi * t) * side * rng.uniform(-0.5, 0.5)
    return np.asarray(line, np.float32), np.linspace(first, last, 9)


def entry(rng: Generator, height: int, width: int) -> NDArray[np.float64]:
    """Return a point outside of the picture from which an instrument enters."""
    side = rng.choice(4, p=[0.32, 0.32, 0.26, 0.10])
    along = rng.uniform(-0.1, 1.1)
    if side == 0:
        point = (-0.1, along)
    elif side == 1:
        point = (1.1, along)
    elif side == 2:
        point = (along, 1.12)
    else:
        point = (along, -0.12)
    return np.array(point) * (width, height)


def rotated(direction: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * direction[0] - s * direction[1], s * direction[0] + c * direction[1]])


def cap(
    rng: Generator,
    canvas: Canvas,
    tip: NDArray[np.float64],
    direction: NDArray[np.float64],
    half: float,
    surface: Material,
    tone: float,
) -> None:
    """Draw a rounded or flat end."""
    if half < 1.5:
        return
    depth = half * rng.uniform(0.1, 1)
    t = np.linspace(0, 0.98, 6)
    line = (tip + direction * depth * t[:, None]).astype(np.float32)
    body(rng, canvas, line, half * np.sqrt(1 - t * t), surface, tone * rng.uniform(0.5, 1.2))
