"""Random instruments drawn over pictures of tissue, with exact masks. An instrument is a chain of swept bodies."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.tool_network.bodies import Canvas, Points, body, cap, curved, entry, material, rotated, straight
from benchmarks.tool_network.flexible import accessory
from benchmarks.tool_network.recorded import RecordedTools
from benchmarks.tool_network.tissue import Picture, Plane, noise, smooth


def instrument(rng: Generator, canvas: Canvas, accessories: float) -> None:
    """Draw one random instrument that enters from the border; with chance `accessories` one of a flexible endoscope."""
    if rng.random() < accessories:
        accessory(rng, canvas)
        return
    height, width = canvas.mask.shape
    start = entry(rng, height, width)
    target = np.array([width, height]) * rng.uniform(0.15, 0.85, 2)
    reach = rng.beta(2.5, 1.6)
    tip = start + (target - start) * np.clip(reach * 1.3, 0.35, 1.25)
    direction = (tip - start) / max(1e-6, np.linalg.norm(tip - start))
    half = height * float(np.exp(rng.uniform(np.log(0.035), np.log(0.3))))
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


RECORDED = 0.15
"""Share of recorded instruments."""


def with_instruments(
    rng: Generator, image: Picture, count: int, accessories: float, recorded: RecordedTools | None
) -> tuple[Picture, Plane]:
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
        if recorded is not None and rng.random() < RECORDED:
            recorded.draw(rng, layer)
        else:
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
