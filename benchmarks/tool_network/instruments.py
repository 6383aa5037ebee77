"""Random instruments drawn over pictures of tissue, with exact masks.

An instrument is a chain of swept bodies. Each body has a centre line, a width along it and a material, which gives its colour from the
position along and across the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.tissue import Picture, Plane, noise, smooth

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
        reflected = rng.uniform(0, 0.4)
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
            rng.uniform(0.4, 1.0, 3) if rng.random() < 0.3 else rng.uniform(0, 0.7, 3),
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
    if surface.grain > 0.02:
        tone_along = tone_along * (
            1 + surface.grain * rough(rng, u, v, float(np.linalg.norm(line[-1] - line[0])), float(width.mean()))
        )
    colour = np.clip(colour * tone_along[..., None], 0, 1.6)
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


def instrument(rng: Generator, canvas: Canvas, accessories: float) -> None:
    """Draw one random instrument that enters from the border; with chance `accessories` one of a flexible endoscope."""
    if rng.random() < accessories:
        catheter(rng, canvas)
        return
    height, width = canvas.mask.shape
    start = entry(rng, height, width)
    target = np.array([width, height]) * rng.uniform(0.15, 0.85, 2)
    reach = rng.beta(2.5, 1.6)
    tip = start + (target - start) * np.clip(reach * 1.3, 0.35, 1.25)
    direction = (tip - start) / max(1e-6, np.linalg.norm(tip - start))
    half = height * float(np.exp(rng.uniform(np.log(0.025), np.log(0.26))))
    taper = rng.uniform(0.45, 1.0)
    tone = canvas.light * rng.uniform(0.6, 1.3)
    kinds = ["shaft", "wrist", "tube", "plate", "box", "needle", "blob"]
    kind = rng.choice(kinds, p=[0.3, 0.36, 0.11, 0.055, 0.085, 0.045, 0.045])
    if kind == "tube":
        end = tip if rng.random() < 0.5 else entry(rng, height, width)
        line, widths = curved(rng, start, end, half * 0.6, half * 0.6 * rng.uniform(0.7, 1), rng.uniform(-0.35, 0.35))
        body(
            rng,
            canvas,
            line,
            widths,
            material(rng, canvas, str(rng.choice(["white", "tissue", "grey", "colour", "metal", "white"]))),
            tone,
        )
        return
    if kind == "needle":
        line, widths = curved(rng, start, tip, 0.9 + half * 0.12, 0.6 + half * 0.05, rng.uniform(-0.2, 0.2))
        body(rng, canvas, line, widths, material(rng, canvas, str(rng.choice(["metal", "chrome", "black"]))), tone)
        return
    if kind == "plate":
        plate(rng, canvas, tip, half * rng.uniform(1.5, 3), tone)
        if rng.random() < 0.6:
            body(rng, canvas, *straight(start, tip, half, half * taper), material(rng, canvas, "metal"), tone)
        return
    if kind == "blob":
        near(rng, canvas, start, half * rng.uniform(2, 5), tone)
        return
    if kind == "box":
        box(rng, canvas, start, tip, half, taper, tone)
        return
    # Shaft with sections of other materials and widths.
    sections = int(rng.integers(1, 4))
    cuts = np.sort(rng.uniform(0.35, 1, sections - 1)).tolist() if sections > 1 else []
    places = [0.0, *cuts, 1.0]
    surface = material(rng, canvas)
    last = half
    for index, (a, b) in enumerate(pairwise(places)):
        first, last = (half * (1 - t * (1 - taper)) for t in (a, b))
        if index:
            surface = material(rng, canvas)
            factor = rng.uniform(0.7, 1.15)
            first, last = first * factor, last * factor * rng.uniform(0.6, 1.05)
        body(rng, canvas, *straight(start + (tip - start) * a, start + (tip - start) * b, first, last), surface, tone)
    if rng.random() < 0.3:
        marks(rng, canvas, start, tip, half * taper)
    if kind == "shaft":
        cap(rng, canvas, tip, direction, last, surface, tone)
        if rng.random() < 0.35:
            turn = rotated(direction, rng.normal(0, 0.4))
            hook = tip + turn * last * rng.uniform(1.5, 6)
            line, widths = curved(
                rng, tip, hook, last * rng.uniform(0.15, 0.6), last * rng.uniform(0.05, 0.4), rng.uniform(-0.3, 0.3)
            )
            body(
                rng,
                canvas,
                line,
                widths,
                material(rng, canvas, str(rng.choice(["metal", "chrome", "white", "black"]))),
                tone,
            )
        return
    # Wrist and jaws.
    angle = rng.normal(0, 0.35)
    bent = rotated(direction, angle)
    length = last * rng.uniform(1, 4)
    end = tip + bent * length
    cap(rng, canvas, tip, direction, last * 0.9, surface, tone)
    wrist = material(
        rng, canvas, str(rng.choice(["metal", "chrome", "grey", "white", "black"], p=[0.4, 0.3, 0.1, 0.12, 0.08]))
    )
    body(
        rng,
        canvas,
        *straight(tip - direction * last * 0.4, end, last * rng.uniform(0.75, 1), last * rng.uniform(0.5, 0.95)),
        wrist,
        tone,
    )
    clutter(rng, canvas, tip, end, last * 0.85)
    opening = abs(rng.normal(0, 0.35))
    long, wide = last * rng.uniform(1.5, 6), last * rng.uniform(0.2, 0.6)
    jaw = material(rng, canvas, str(rng.choice(["metal", "chrome", "grey", "black"], p=[0.45, 0.35, 0.1, 0.1])))
    lean = rng.normal(0, 0.2)
    for side in (-1, 1) if rng.random() < 0.8 else (1,):
        way = rotated(bent, lean + side * opening)
        line, widths = curved(
            rng,
            end - bent * last * 0.2,
            end + way * long,
            wide,
            wide * rng.uniform(0.15, 0.9),
            side * rng.uniform(-0.12, 0.12),
        )
        before = canvas.image.copy() if wide > 3 else None
        earlier = canvas.mask.copy() if wide > 3 else None
        body(rng, canvas, line, widths, jaw, tone * rng.uniform(0.7, 1.2))
        if before is not None and earlier is not None and rng.random() < 0.3:
            window(rng, canvas, line, widths, before, earlier)


def catheter(rng: Generator, canvas: Canvas) -> None:
    """Draw an accessory of a flexible endoscope: it comes from next to the lens, so it is wide at the border and tapers quickly."""
    height, width = canvas.mask.shape
    start = (
        np.array([width * rng.uniform(0.1, 0.9), height * 1.15]) if rng.random() < 0.7 else entry(rng, height, width)
    )
    tip = np.array([width, height]) * rng.uniform(0.25, 0.75, 2)
    first = height * rng.uniform(0.06, 0.24)
    last = max(1.0, first * rng.uniform(0.08, 0.6))
    kinds = ["tissue", "white", "colour", "grey", "metal", "chrome", "black"]
    surface = material(rng, canvas, str(rng.choice(kinds, p=[0.4, 0.12, 0.14, 0.1, 0.1, 0.09, 0.05])))
    tone = canvas.light * rng.uniform(0.8, 1.8)
    line, widths = curved(rng, start, tip, first, last, rng.uniform(-0.12, 0.12))
    body(rng, canvas, line, widths, surface, tone)
    direction = (tip - start) / np.linalg.norm(tip - start)
    cap(rng, canvas, tip, direction, last, surface, tone)
    if rng.random() < 0.4:
        end = tip + rotated(direction, rng.normal(0, 0.3)) * height * rng.uniform(0.03, 0.2)
        line, widths = curved(
            rng, tip, end, last * rng.uniform(0.2, 0.8), last * rng.uniform(0.1, 0.5), rng.uniform(-0.4, 0.4)
        )
        body(rng, canvas, line, widths, material(rng, canvas), tone)


def clips(rng: Generator, image: Picture) -> Picture:
    """Return the picture with short metal or plastic clips that stay in the body, which are no tools."""
    height, width = image.shape[:2]
    canvas = Canvas(
        image.copy(), np.zeros((height, width), np.float32), image.reshape(-1, 3).mean(0), rng.uniform(0.6, 1.3)
    )
    middle, angle = np.array([width, height]) * rng.uniform(0.1, 0.9, 2), rng.uniform(0, np.pi)
    for _ in range(int(rng.integers(1, 5))):
        turn = angle + rng.normal(0, 0.2)
        half = np.array([np.cos(turn), np.sin(turn)]) * height * rng.uniform(0.03, 0.11)
        at = middle + rng.normal(0, height * 0.04, 2)
        thick = height * rng.uniform(0.005, 0.013)
        surface = material(rng, canvas, str(rng.choice(["metal", "chrome", "white"])))
        body(rng, canvas, *straight(at - half, at + half, thick, thick), surface, canvas.light)
    return canvas.image


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


def window(
    rng: Generator, canvas: Canvas, line: Points, widths: NDArray[np.float64], before: Picture, earlier: Plane
) -> None:
    """Cut an oblong hole into a jaw, through which the picture behind it is seen."""
    hole = np.zeros(canvas.mask.shape, np.float32)
    middle = line[2:-1]
    thickness = max(1, round(float(widths.mean()) * rng.uniform(0.5, 0.9)))
    cv2.polylines(hole, [np.round(middle * 8).astype(np.int32)], False, 1.0, thickness, cv2.LINE_AA, 3)
    canvas.image += hole[..., None] * (before * rng.uniform(0.3, 0.9) - canvas.image)
    if thickness >= 5:
        canvas.mask *= 1 - hole
        canvas.mask += hole * earlier


def clutter(rng: Generator, canvas: Canvas, start: NDArray, end: NDArray, half: float) -> None:
    """Draw screws, slots, cables and gaps over a wrist; only on pixels that are tool already."""
    if half < 3:
        return
    layer = canvas.image.copy()
    for _ in range(int(rng.integers(2, 14))):
        at = start + (end - start) * rng.uniform(-0.2, 1) + rng.normal(0, half * 0.4, 2)
        grey = np.clip(rng.uniform(-0.1, 1.2), 0, 1.2)
        colour = tuple(float(c) for c in grey * (1 + rng.normal(0, 0.05, 3)))
        if rng.random() < 0.1:
            colour = tuple(float(c) for c in rng.uniform(0.7, 1) * np.array([1, 0.85, 0.35]))
        if rng.random() < 0.5:
            size = half * rng.uniform(0.1, 0.4)
            cv2.circle(
                layer,
                tuple(int(v * 8) for v in at),
                max(4, int(8 * size)),
                colour,
                -1 if rng.random() < 0.6 else 1,
                cv2.LINE_AA,
                3,
            )
        else:
            to = at + (end - start) * rng.uniform(-0.6, 0.6) + rng.normal(0, half * 0.2, 2)
            cv2.line(
                layer,
                tuple(int(v * 8) for v in at),
                tuple(int(v * 8) for v in to),
                colour,
                int(rng.integers(1, max(2, int(half * 0.35) + 1))),
                cv2.LINE_AA,
                3,
            )
    canvas.image += (canvas.mask > 0.5)[..., None] * (layer - canvas.image)


def marks(rng: Generator, canvas: Canvas, start: NDArray, tip: NDArray, half: float) -> None:
    """Print text on a shaft."""
    if half < 5:
        return
    printed = np.zeros(canvas.mask.shape, np.uint8)
    at = start + (tip - start) * rng.uniform(0.4, 0.9)
    text = "".join(chr(int(c)) for c in rng.integers(65, 91, int(rng.integers(2, 8))))
    level = float(rng.choice([0.05, 0.9]))
    cv2.putText(
        printed, text, (int(at[0] - half), int(at[1])), cv2.FONT_HERSHEY_SIMPLEX, half / 25, 255, 1, cv2.LINE_AA
    )
    ink = (printed / np.float32(255)) * (canvas.mask > 0.5)
    canvas.image += ink[..., None] * (level - canvas.image)


def plate(rng: Generator, canvas: Canvas, centre: NDArray, size: float, tone: float) -> None:
    """Draw a plate or retractor: a rounded polygon with brushed, perforated or mirror surface."""
    height, width = canvas.mask.shape
    if rng.random() < 0.6:
        centre = centre + (np.array([width, height]) / 2 - centre) * -rng.uniform(0, 0.8)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    power = rng.choice([1, 2, 4])
    radius = (np.abs(np.cos(angles)) ** power + np.abs(np.sin(angles)) ** power) ** (-1 / power) * size
    points = np.stack([radius * np.cos(angles), radius * np.sin(angles) * rng.uniform(0.3, 1)], 1)
    turn = rng.uniform(0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    surface_fill(rng, canvas, points @ np.array([[c, -s], [s, c]]) + centre, tone)


def near(rng: Generator, canvas: Canvas, start: NDArray, size: float, tone: float) -> None:
    """Draw a large irregular part close to the scope, at the border, out of focus."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 10))))
    radius = size * rng.uniform(0.6, 1.4, len(angles))
    points = np.stack([radius * np.cos(angles), radius * np.sin(angles)], 1) + start
    surface_fill(rng, canvas, points, tone, blur=rng.uniform(0.5, 5))


def surface_fill(rng: Generator, canvas: Canvas, points: NDArray, tone: float, blur: float = 0.0) -> None:
    """Fill a polygon with a flat material, a gradient, scratches or holes."""
    height, width = canvas.mask.shape
    cover = np.zeros((height, width), np.float32)
    cv2.fillPoly(cover, [np.round(points * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
    if blur:
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), blur), np.float32)
    surface = material(rng, canvas, str(rng.choice(["metal", "chrome", "grey", "white", "black", "metal"])))
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    middle, extent = points.mean(0), float(np.ptp(points, axis=0).max()) / 2 + 1
    v = ((x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle)) / extent
    stretch = rng.uniform(0.3, 1)
    colour = surface.profile[np.clip((v * stretch + 1) * 15.5, 0, 31).astype(np.intp)]
    texture = noise(rng, height, width, int(rng.integers(4, 60)), 2) * rng.uniform(0, 0.25)
    if rng.random() < 0.35:
        period = rng.uniform(0.3, 1.2)
        texture = texture - 0.6 * (np.sin(x * period) * np.sin(y * period) > 0.3)
    colour = np.clip(colour * (tone * (1 + texture))[..., None], 0, 1.6)
    canvas.image += cover[..., None] * (colour - canvas.image)
    np.maximum(canvas.mask, cover, out=canvas.mask)


def box(rng: Generator, canvas: Canvas, start: NDArray, tip: NDArray, half: float, taper: float, tone: float) -> None:
    """Draw a probe: a flat-faced head on a thinner shaft or cable."""
    share = rng.uniform(0.3, 0.75)
    neck = start + (tip - start) * share
    direction = (tip - start) / max(1e-6, np.linalg.norm(tip - start))
    side = np.array([-direction[1], direction[0]])
    line, widths = curved(
        rng, start, neck, half * rng.uniform(0.4, 0.8), half * rng.uniform(0.4, 0.8), rng.uniform(-0.1, 0.1)
    )
    body(rng, canvas, line, widths, material(rng, canvas, str(rng.choice(["white", "grey", "black", "metal"]))), tone)
    wide = half * taper
    corners = np.array(
        [
            neck - side * wide,
            neck + side * wide,
            tip + side * wide * rng.uniform(0.7, 1),
            tip - side * wide * rng.uniform(0.7, 1),
        ]
    )
    surface_fill(rng, canvas, corners, tone)
    if rng.random() < 0.5:
        inner = corners * 0.85 + corners.mean(0) * 0.15
        surface_fill(rng, canvas, inner + side * wide * rng.uniform(-0.2, 0.2), tone)


def with_instruments(rng: Generator, image: Picture, count: int, accessories: float) -> tuple[Picture, Plane]:
    """Return the picture with instruments and their coverage [h, w], 0..1."""
    height, width = image.shape[:2]
    surround = image.reshape(-1, 3).mean(0)
    level = float(surround.mean())
    canvas = Canvas(
        image.copy(), np.zeros((height, width), np.float32), surround, rng.uniform(0.7, 1.5) * (0.5 + 0.6 * level)
    )
    total = np.zeros((height, width), np.float32)
    for _ in range(count):
        layer = Canvas(canvas.image.copy(), np.zeros((height, width), np.float32), canvas.surround, canvas.light)
        instrument(rng, layer, accessories)
        if rng.random() < 0.6:
            move = np.float32([[1, 0, rng.normal(0, 6)], [0, 1, rng.uniform(1, 12)]])
            cast = cv2.warpAffine(layer.mask, move, (width, height))
            cast = np.asarray(cv2.GaussianBlur(cast, (0, 0), rng.uniform(1, 7)), np.float32) * (1 - layer.mask)
            layer.image *= (1 - rng.uniform(0.2, 0.8) * cast)[..., None]
        if rng.random() < 0.3:
            stain(rng, layer)
        if rng.random() < 0.25:
            hidden(rng, layer, canvas.image)
        soft = float(rng.choice([0.0, 0.6, 1.2, 2.5], p=[0.5, 0.25, 0.15, 0.1]))
        if soft:
            layer.mask = np.asarray(cv2.GaussianBlur(layer.mask, (0, 0), soft), np.float32)
            blurred = cv2.GaussianBlur(layer.image, (0, 0), soft)
            layer.image += layer.mask[..., None] * (blurred - layer.image)
        canvas.image = layer.image
        total = np.maximum(total, layer.mask)
    return canvas.image, total


def stain(rng: Generator, layer: Canvas) -> None:
    """Put blood or fluid on an instrument."""
    height, width = layer.mask.shape
    where = smooth(noise(rng, height, width, int(rng.integers(3, 20)), 3), rng.uniform(0.3, 1.5), 1.9)
    where = where * layer.mask * rng.uniform(0.3, 1)
    colour = layer.image * np.array([0.75, 0.12, 0.12], np.float32)
    layer.image += where[..., None] * (colour - layer.image)


def hidden(rng: Generator, layer: Canvas, before: Picture) -> None:
    """Let tissue cover a part of an instrument."""
    height, width = layer.mask.shape
    where = smooth(noise(rng, height, width, int(rng.integers(1, 4)), 3, 0.4) - rng.uniform(0.2, 1.5), 0, 0.15)
    layer.image += where[..., None] * (before - layer.image)
    layer.mask *= 1 - where
