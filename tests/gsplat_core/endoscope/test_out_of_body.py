"""The gate opens for tissue under a scope's light, and for nothing else that is tried here."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope.out_of_body import FRAMES_TO_RETURN, TO_ENTER, TO_STAY, BodyGate, doubt, evidence_of
from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import open_recording

SIZE = (240, 320)


def plain(*colour: int) -> np.ndarray:
    return np.full((*SIZE, 3), colour, np.uint8)


def cloth(rng: np.random.Generator, *colour: int) -> np.ndarray:
    """Folded fabric, or skin: one colour, uneven light, a weave and noise."""
    folds = cv2.GaussianBlur(rng.normal(0, 1, SIZE).astype(np.float32), (0, 0), 20)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    light = 1 + 0.35 * folds / np.abs(folds).max() + 0.04 * np.sin(1.9 * x) * np.sin(1.9 * y)
    return np.clip(np.array(colour) * light[..., None] + rng.normal(0, 4, (*SIZE, 3)), 0, 255).astype(np.uint8)


def tissue(rng: np.random.Generator) -> np.ndarray:
    """Patches of several reds, under uneven light."""
    colours = np.array([[190, 95, 80], [215, 150, 120], [150, 55, 45], [170, 80, 70]], np.float32)
    weights = np.stack([cv2.GaussianBlur(rng.normal(0, 1, SIZE).astype(np.float32), (0, 0), 15) for _ in colours], -1)
    weights = np.exp(8 * weights / np.abs(weights).max())
    return ((weights / weights.sum(-1, keepdims=True)) @ colours).astype(np.uint8)


def face(rng: np.random.Generator, skin: tuple[int, int, int], *, close: bool) -> np.ndarray:
    """Somebody in front of a wall, or so near that the face fills the picture."""
    picture = cloth(rng, 120, 130, 140)
    cv2.ellipse(picture, (160, 125), (65, 90), 0, 0, 360, skin, -1)
    cv2.ellipse(picture, (160, 55), (70, 40), 0, 180, 360, (60, 40, 30), -1)
    for x in (135, 185):
        cv2.ellipse(picture, (x, 110), (11, 5), 0, 0, 360, (250, 250, 250), -1)
        cv2.circle(picture, (x, 110), 4, (70, 50, 30), -1)
        cv2.line(picture, (x - 14, 98), (x + 14, 96), (70, 45, 30), 3)
    cv2.ellipse(picture, (160, 170), (22, 7), 0, 0, 360, (180, 80, 80), -1)
    return cv2.resize(picture[45:205, 100:220], SIZE[::-1]) if close else picture


def room(rng: np.random.Generator) -> np.ndarray:
    picture = cloth(rng, 190, 185, 175)
    cv2.rectangle(picture, (0, 165), (320, 240), (110, 100, 90), -1)
    cv2.rectangle(picture, (30, 50), (110, 120), (60, 110, 190), -1)
    cv2.rectangle(picture, (175, 110), (300, 200), (40, 110, 120), -1)
    cv2.circle(picture, (240, 30), 25, (255, 255, 250), -1)
    return picture


def lamps(rng: np.random.Generator) -> np.ndarray:
    picture = cloth(rng, 150, 150, 150)
    for x in (60, 160, 260):
        cv2.rectangle(picture, (x - 30, 75), (x + 30, 165), (255, 255, 255), -1)
    return picture


def monitor(rng: np.random.Generator) -> np.ndarray:
    """A screen with a picture from inside, seen across a dark room."""
    picture = plain(15, 15, 18)
    picture[70:150, 100:200] = cv2.resize(tissue(rng), (100, 80))
    return picture


def bars(rng: np.random.Generator) -> np.ndarray:
    on = [255 * np.array([k >> 2 & 1, k >> 1 & 1, k & 1], np.uint8) for k in range(7, -1, -1)]
    return np.repeat(np.repeat(np.array([on], np.uint8), SIZE[0], 0), SIZE[1] // 8, 1)


OUTSIDE: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "black": lambda rng: plain(0, 0, 0),
    "white": lambda rng: plain(255, 255, 255),
    "grey": lambda rng: plain(128, 128, 128),
    "red": lambda rng: plain(180, 70, 60),
    "red noise": lambda rng: np.clip(rng.normal((180, 80, 70), 15, (*SIZE, 3)), 0, 255).astype(np.uint8),
    "noise": lambda rng: rng.integers(0, 256, (*SIZE, 3), np.uint8),
    "grey noise": lambda rng: np.repeat(rng.integers(0, 256, (*SIZE, 1), np.uint8), 3, 2),
    "bars": bars,
    "skin": lambda rng: cloth(rng, 222, 170, 140),
    "tanned skin": lambda rng: cloth(rng, 150, 100, 75),
    "dark skin": lambda rng: cloth(rng, 90, 58, 42),
    "blue drape": lambda rng: cloth(rng, 60, 110, 160),
    "green drape": lambda rng: cloth(rng, 50, 130, 110),
    "white cloth": lambda rng: cloth(rng, 220, 220, 215),
    "red cloth": lambda rng: cloth(rng, 170, 50, 45),
    "face": lambda rng: face(rng, (222, 170, 140), close=False),
    "near face": lambda rng: face(rng, (222, 170, 140), close=True),
    "dark face": lambda rng: face(rng, (110, 70, 50), close=False),
    "room": room,
    "lamps": lamps,
    "monitor": monitor,
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_what_is_outside_is_not_taken_for_inside(rng, name):
    image = OUTSIDE[name](rng)
    assert BodyGate().judge(image) is not None
    gate = BodyGate()
    assert gate.judge(tissue(rng)) is None
    assert gate.judge(image) is not None, "a stream that was inside goes on with it"


@pytest.mark.parametrize("seed", range(5))
def test_one_clear_picture_begins_a_stream(seed):
    gate = BodyGate()
    assert not gate.inside
    assert gate.judge(tissue(np.random.default_rng(seed))) is None and gate.inside


def test_one_picture_from_outside_is_enough_to_end_and_many_from_inside_are_needed_to_return(rng):
    gate, inside = BodyGate(), tissue(rng)
    assert gate.judge(inside) is None
    assert gate.judge(room(rng)) is not None
    for _ in range(FRAMES_TO_RETURN - 1):
        assert gate.judge(inside) == "not yet certain again"
    assert gate.judge(plain(0, 0, 0)) == "too dark"
    answers = [gate.judge(inside) for _ in range(FRAMES_TO_RETURN)]
    assert answers == ["not yet certain again"] * (FRAMES_TO_RETURN - 1) + [None]


def test_a_stream_that_begins_outside_needs_as_many(rng):
    gate = BodyGate()
    gate.judge(room(rng))
    assert [gate.judge(tissue(rng)) for _ in range(FRAMES_TO_RETURN)].count(None) == 1
    gate.reset()
    assert gate.judge(tissue(rng)) is None


def test_less_evidence_is_needed_to_stay_than_to_enter(rng):
    smoke = (0.65 * tissue(rng) + 0.35 * 170).astype(np.uint8)
    assert doubt(evidence_of(smoke), TO_ENTER) == "one colour everywhere"
    assert doubt(evidence_of(smoke), TO_STAY) is None
    for name in ("lit", "tissue", "redness", "spread"):
        assert getattr(TO_STAY, name) <= getattr(TO_ENTER, name)
    assert TO_STAY.cool >= TO_ENTER.cool


@pytest.mark.parametrize("scale", [0.25, 1, 3])
def test_brightness_size_and_a_round_view_do_not_matter(rng, scale):
    image = cv2.resize(tissue(rng), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = image.shape[:2]
    inside = np.zeros((height, width, 1), np.uint8)
    cv2.circle(inside, (width // 2, height // 2), int(0.48 * height), 1, -1)
    for picture in (image, (0.4 * image).astype(np.uint8), image * inside, np.flip(image, (0, 1))):
        assert BodyGate().judge(picture) is None


@pytest.mark.parametrize("size", [(1, 1), (8, 400), (0, 10), (15, 15)])
def test_a_picture_too_small_to_judge_counts_as_outside(size):
    assert BodyGate().judge(np.full((*size, 3), 120, np.uint8)) is not None


@pytest.mark.parametrize(
    "image", [np.zeros((40, 40), np.uint8), np.zeros((40, 40, 3), np.float32), np.zeros((40, 40, 4), np.uint8)]
)
def test_other_arrays_are_refused_and_close_the_gate(rng, image):
    gate = BodyGate()
    assert gate.judge(tissue(rng)) is None
    with pytest.raises(InvalidInput, match=r"image must be RGB uint8 \[H, W, 3\], got"):
        gate.judge(image)
    assert not gate.inside and gate.judge(tissue(rng)) == "not yet certain again"


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "sinus", "colon"])
def test_no_frame_of_a_recording_is_withheld(recordings_dir, name):
    folder = recordings_dir / name
    gate = BodyGate()
    source = folder / "left.mp4" if name == "heart" else folder
    assert [frame.seq for frame in open_recording(source) if gate.judge(frame.image) is not None] == []


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("picture", "inside"),
    [
        *((f"out_of_body/{name}.png", name in ("0001", "0007")) for name in ("0001", "0007", "0008", "0009", "0010")),
        ("hamlyn_pair/f7_dynamic_deint_L_0100.png", True),
        ("hamlyn_pair/f7_dynamic_deint_R_0100.png", True),
        ("scared_pair/left.png", True),
        ("scared_pair/right.png", True),
        ("scared_raw/Left_Image.png", True),
    ],
)
def test_single_pictures_are_told_apart(recordings_dir, picture, inside):
    image = np.ascontiguousarray(cv2.imread(str(recordings_dir / picture))[..., ::-1])
    assert (BodyGate().judge(image) is None) == inside
    began = BodyGate()
    began.judge(tissue(np.random.default_rng(0)))
    assert (began.judge(image) is None) == inside
