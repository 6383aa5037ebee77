"""Pictures from outside of the body, drawn in many variants, and pictures without evidence of anything."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Draw = Callable[[np.random.Generator], Image]
SIZE = (240, 320)


def plain(*colour: int) -> Image:
    return np.full((*SIZE, 3), colour, np.uint8)


def cloth(rng: np.random.Generator, *colour: int) -> Image:
    """Folded fabric, or skin: one colour, uneven light, a weave and noise."""
    folds = cv2.GaussianBlur(rng.normal(0, 1, SIZE).astype(np.float32), (0, 0), 20)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    light = 1 + 0.35 * folds / np.abs(folds).max() + 0.04 * np.sin(1.9 * x) * np.sin(1.9 * y)
    return np.clip(np.array(colour) * light[..., None] + rng.normal(0, 4, (*SIZE, 3)), 0, 255).astype(np.uint8)


def tissue(rng: np.random.Generator) -> Image:
    """Patches of several reds, under uneven light."""
    colours = np.array([[190, 95, 80], [215, 150, 120], [150, 55, 45], [170, 80, 70]], np.float32)
    weights = np.stack([cv2.GaussianBlur(rng.normal(0, 1, SIZE).astype(np.float32), (0, 0), 15) for _ in colours], -1)
    weights = np.exp(8 * weights / np.abs(weights).max())
    return ((weights / weights.sum(-1, keepdims=True)) @ colours).astype(np.uint8)


def grained(picture: Image, rng: np.random.Generator, sigma: float = 3.0) -> Image:
    """The picture with a camera's noise."""
    return np.clip(picture + rng.normal(0, sigma, picture.shape), 0, 255).astype(np.uint8)


def tinted(rng: np.random.Generator, *colour: float, by: float = 12) -> tuple[int, ...]:
    """A colour near the given one."""
    return tuple(int(np.clip(value + rng.uniform(-by, by), 0, 255)) for value in colour)


def face(rng: np.random.Generator, skin: tuple[int, ...] = (222, 170, 140), *, close: bool = False) -> Image:
    """A person in front of a wall, or so near that the face fills the picture."""
    picture = cloth(rng, *tinted(rng, 120, 130, 140, by=5))
    cv2.ellipse(picture, (160, 125), (65, 90), 0, 0, 360, skin, -1)
    cv2.ellipse(picture, (160, 55), (70, 40), 0, 180, 360, (60, 40, 30), -1)
    for x in (135, 185):
        cv2.ellipse(picture, (x, 110), (11, 5), 0, 0, 360, (250, 250, 250), -1)
        cv2.circle(picture, (x, 110), 4, (70, 50, 30), -1)
        cv2.line(picture, (x - 14, 98), (x + 14, 96), (70, 45, 30), 3)
    cv2.ellipse(picture, (160, 170), (22, 7), 0, 0, 360, (180, 80, 80), -1)
    return cv2.resize(picture[45:205, 100:220], SIZE[::-1]) if close else picture


def team(rng: np.random.Generator) -> Image:
    """People in scrubs and masks in front of a wall."""
    picture = cloth(rng, *tinted(rng, 170, 175, 172))
    scrubs = tinted(rng, 60, 120, 130, by=25)
    for x in (70, 190, 280):
        x += int(rng.integers(-15, 16))
        cv2.ellipse(picture, (x, 235), (60, 130), 0, 0, 360, scrubs, -1)
        cv2.ellipse(picture, (x, 80), (26, 34), 0, 0, 360, tinted(rng, 200, 150, 120, by=30), -1)
        cv2.ellipse(picture, (x, 60), (29, 22), 0, 180, 360, scrubs, -1)
        cv2.ellipse(picture, (x, 98), (22, 16), 0, 0, 360, tinted(rng, 205, 220, 225, by=5), -1)
    return grained(picture, rng)


def room(rng: np.random.Generator) -> Image:
    """Wall, floor, a window, furniture and a lamp."""
    picture = cloth(rng, *tinted(rng, 190, 185, 175, by=6))
    floor = int(rng.integers(150, 180))
    cv2.rectangle(picture, (0, floor), (320, 240), (110, 100, 90), -1)
    x, y = (int(value) for value in rng.integers(10, 60, 2))
    cv2.rectangle(picture, (x, y), (x + 80, y + 70), tinted(rng, 60, 110, 190), -1)
    cv2.rectangle(picture, (175, 110), (300, 200), tinted(rng, 40, 110, 120), -1)
    cv2.circle(picture, (240, 30), 25, (255, 255, 250), -1)
    return grained(picture, rng)


def theatre(rng: np.random.Generator) -> Image:
    """Green or blue drapes, a steel table with instruments, a lamp."""
    green = rng.random() < 0.5
    picture = cloth(rng, *(tinted(rng, 50, 125, 110) if green else tinted(rng, 60, 105, 160)))
    cv2.rectangle(picture, (30, 130), (290, 230), tinted(rng, 165, 170, 176, by=5), -1)
    for k in range(6):
        x = 55 + 38 * k
        cv2.line(picture, (x, 140), (x + int(rng.integers(-6, 7)), 215), (225, 228, 230), 4)
    cv2.circle(picture, (int(rng.integers(60, 260)), 40), 26, (255, 255, 252), -1)
    return grained(picture, rng)


def screen(rng: np.random.Generator) -> Image:
    """A monitor with windows and text that fills the view."""
    picture = plain(*tinted(rng, 225, 228, 232, by=8))
    for _ in range(4):
        x, y = int(rng.integers(0, 220)), int(rng.integers(0, 150))
        cv2.rectangle(picture, (x, y), (x + 90, y + 70), tinted(rng, 70, 110, 170, by=40), -1)
    return _written(picture, rng)


def page(rng: np.random.Generator) -> Image:
    """Printed text, turned by some degrees."""
    picture = _written(plain(*tinted(rng, 232, 230, 226, by=4)), rng)
    turn = cv2.getRotationMatrix2D((SIZE[1] / 2, SIZE[0] / 2), float(rng.uniform(-20, 20)), 1.5)
    return grained(cv2.warpAffine(picture, turn, SIZE[::-1], borderMode=cv2.BORDER_REPLICATE), rng)


def _written(picture: Image, rng: np.random.Generator) -> Image:
    words = ("patient", "name", "born", "ward", "theatre 3", "09:41")
    for row in range(15, SIZE[0], 16):
        text = " ".join(words[int(rng.integers(len(words)))] for _ in range(6))
        cv2.putText(picture, text, (int(rng.integers(0, 20)), row), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 45), 1)
    return picture


def lamps(rng: np.random.Generator) -> Image:
    picture = cloth(rng, 150, 150, 150)
    for x in (60, 160, 260):
        cv2.rectangle(picture, (x - 30, 75), (x + 30, 165), (255, 255, 255), -1)
    return picture


def monitor(rng: np.random.Generator) -> Image:
    """A screen with a picture from inside, seen across a dark room."""
    picture = plain(15, 15, 18)
    picture[70:150, 100:200] = cv2.resize(tissue(rng), (100, 80))
    return picture


def bars(rng: np.random.Generator) -> Image:
    on = [255 * np.array([k >> 2 & 1, k >> 1 & 1, k & 1], np.uint8) for k in range(7, -1, -1)]
    return np.repeat(np.repeat(np.array([on], np.uint8), SIZE[0], 0), SIZE[1] // 8, 1)


def corridor(rng: np.random.Generator) -> Image:
    """Lines that meet at a point, doors, a tiled floor and lamps, turned by some degrees as a scope in a hand."""
    picture = plain(*tinted(rng, 200, 203, 205, by=5))
    centre = (160, 110)
    for corners, colour in (
        (((0, 240), (320, 240), centre), (120, 125, 130)),
        (((0, 0), (320, 0), centre), (235, 236, 238)),
    ):
        cv2.fillPoly(picture, [np.array(corners)], tinted(rng, *colour, by=5))
    for x in (20, 250):
        cv2.rectangle(picture, (x, 70), (x + 45, 190), tinted(rng, 120, 130, 150, by=8), -1)
    for y in range(150, 240, 12):
        cv2.line(picture, (0, y), (320, y), (90, 95, 100), 1)
    turn = cv2.getRotationMatrix2D(centre, float(rng.uniform(-15, 15)), 1.35)
    return grained(cv2.warpAffine(picture, turn, SIZE[::-1], borderMode=cv2.BORDER_REPLICATE), rng)


OUTSIDE: dict[str, Draw] = {
    "white": lambda rng: plain(250, 250, 248),
    "grey": lambda rng: plain(128, 128, 128),
    "noise": lambda rng: rng.integers(0, 256, (*SIZE, 3), np.uint8),
    "grey noise": lambda rng: np.repeat(rng.integers(0, 256, (*SIZE, 1), np.uint8), 3, 2),
    "blue drape": lambda rng: cloth(rng, *tinted(rng, 60, 110, 160, by=20)),
    "green drape": lambda rng: cloth(rng, *tinted(rng, 50, 130, 110, by=20)),
    "white cloth": lambda rng: cloth(rng, *tinted(rng, 215, 215, 212, by=2)),
    "face": lambda rng: face(rng, tinted(rng, 222, 170, 140)),
    "dark face": lambda rng: face(rng, tinted(rng, 110, 70, 50)),
    "team": team,
    "room": room,
    "theatre": theatre,
    "screen": screen,
    "page": page,
    "corridor": corridor,
    "lamps": lamps,
    "bars": bars,
}
"""Pictures with evidence of being outside the body, for every seed."""
WITHOUT_EVIDENCE: dict[str, Draw] = {
    "black": lambda rng: plain(0, 0, 0),
    "overexposed": lambda rng: plain(255, 255, 255),
    "red": lambda rng: plain(180, 70, 60),
    "skin": lambda rng: cloth(rng, 222, 170, 140),
    "dark skin": lambda rng: cloth(rng, 90, 58, 42),
    "red cloth": lambda rng: cloth(rng, 170, 50, 45),
    "near face": lambda rng: face(rng, close=True),
    "monitor": monitor,
}
"""Pictures that pass as tissue, since they do not differ from pale, red or overexposed tissue."""
