"""The out-of-body gate withholds pictures with evidence of the outside, not those without evidence of the inside."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import out_of_body
from gsplat_core.endoscope.out_of_body import (
    COLD_BESIDE_LIGHT,
    COOL_BESIDE_STRAIGHT,
    FRAMES_TO_CLOSE,
    FRAMES_TO_RETURN,
    FRAMES_WITHOUT_EVIDENCE,
    LITTLE_COOL,
    RECENT_FRAMES,
    REDNESS,
    ROOM_LIGHT,
    STRAIGHT,
    BodyGate,
    Evidence,
    evidence_of,
)
from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import open_recording
from tests.gsplat_core.endoscope.outside import OUTSIDE, SIZE, WITHOUT_EVIDENCE, cloth, plain, room, tissue
from tests.gsplat_core.endoscope.unusual import HARD, HARD_TISSUE, UNUSUAL, gains, round_view, softened

SEEDS = range(6)
VIDEOS = {
    "cutting": "cutting/video.mp4",
    "heart": "heart/left.mp4",
    "colon": "colon/video.mp4",
    **{name: f"others/{name}/video.mp4" for name in ("laparoscopy", "stereomis_like", "resting_bowel")},
}
STILLS = {
    "sinus": "sinus/images/*.jpg",
    "colonoscopy_a": "others/colonoscopy_a/images/*",
    "colonoscopy_b": "others/colonoscopy_b/images/*",
    "organ_still": "others/organ_still/images/*",
    "pelvis_stills": "others/pelvis_stills/*.jpg",
    "hamlyn_pair": "hamlyn_pair/f7_dynamic_deint_?_0100.png",
    "scared_pair": "scared_pair/[lr]*t.png",
    "scared_raw": "scared_raw/Left_Image.png",
    "inside": "out_of_body/000[17].png",
}


def read(path):
    return np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])


def recorded(folder, name, every=1):
    """Pictures of a recording, at most 640 px wide."""
    if name in VIDEOS:
        images = [frame.image for frame in open_recording(folder / VIDEOS[name])][::every]
    else:
        images = [read(path) for path in sorted(folder.glob(STILLS[name]))[::every]]
    assert images
    scale = min(1.0, 640 / images[0].shape[1])
    return [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in images]


def outside_of(image):
    evidence = evidence_of(image)
    return None if evidence is None else evidence.outside


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTSIDE)
def test_body_gate_withholds_every_outside_image_at_once(name):
    for seed in SEEDS:
        image = OUTSIDE[name](np.random.default_rng(seed))
        assert BodyGate().judge(image) is not None, seed
        gate = BodyGate()
        assert gate.judge(tissue(np.random.default_rng(seed))) is None
        assert gate.judge(image) is not None, seed
        assert not gate.inside


@pytest.mark.parametrize("name", sorted({*OUTSIDE} - {"bars"}))
def test_outside_found_at_any_brightness_size_and_view_shape(name):
    """A round view replaces much of the wall by face and cuts half of the screen's windows."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        image = OUTSIDE[name](rng)
        for picture in (
            gains(0.6, 0.6, 0.6)(image, rng),
            cv2.resize(image, None, fx=2.5, fy=2.5, interpolation=cv2.INTER_LINEAR),
            np.ascontiguousarray(np.flip(image, (0, 1))),
            *([] if name in ("face", "dark face", "screen") else [round_view(image, rng)]),
        ):
            assert outside_of(picture) is not None, seed


@pytest.mark.parametrize("name", WITHOUT_EVIDENCE)
def test_body_gate_passes_images_without_evidence(rng, name):
    gate = BodyGate()
    assert gate.judge(WITHOUT_EVIDENCE[name](rng)) is None and gate.inside


@pytest.mark.slow
@pytest.mark.parametrize("change", [*UNUSUAL, *HARD_TISSUE])
def test_body_gate_passes_unusual_tissue(change):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        # Tissue has a structure that the drawn patches lack: vessels, folds and wet highlights.
        height, width = SIZE
        y, x = np.mgrid[:height, :width]
        vessels = 1 - 0.25 * (np.sin(0.35 * x + 3 * np.sin(0.05 * y) + seed) > 0.9)
        fall = np.exp(-(((x - width / 2) / (0.5 * width)) ** 2 + ((y - height / 2) / (0.5 * height)) ** 2))
        folds = 0.75 + 0.25 * np.sin(0.12 * y + 2 * np.sin(0.04 * x))
        image = np.clip(tissue(rng) * (vessels * folds * (0.25 + 0.9 * fall))[..., None], 0, 255).astype(np.uint8)
        for _ in range(12):
            cv2.circle(image, (int(rng.integers(width)), int(rng.integers(height))), 2, (255, 255, 255), -1)
        assert outside_of({**UNUSUAL, **HARD}[change](image, rng)) is None, seed


@pytest.mark.recordings
@pytest.mark.parametrize("name", [*VIDEOS, *STILLS])
def test_body_gate_withholds_no_frame_of_recordings(recordings_dir, name):
    assert {outside_of(image) for image in recorded(recordings_dir, name, every=2 if name in VIDEOS else 1)} == {None}


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("name", [*VIDEOS, *STILLS])
def test_body_gate_withholds_no_frame_of_altered_recordings(recordings_dir, name):
    images = recorded(recordings_dir, name)
    for image in (images[0], images[len(images) // 2]):
        small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for change in UNUSUAL:
            rng = np.random.default_rng(0)
            picture = UNUSUAL[change](small, rng)
            assert outside_of(picture) is None, change
            assert outside_of(softened(picture, rng)) is None, f"{change}, out of focus"
        for change in HARD_TISSUE:
            assert outside_of(HARD[change](small, np.random.default_rng(0))) is None, change


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["0008", "0009", "0010"])
def test_body_gate_withholds_recorded_outside_samples(recordings_dir, name):
    image = read(recordings_dir / f"out_of_body/{name}.png")
    rng = np.random.default_rng(0)
    for picture in (image, gains(0.7, 0.7, 0.7)(image, rng), cv2.resize(image, (960, 540)), round_view(image, rng)):
        assert BodyGate().judge(picture) is not None


NOTHING = {"cool": 0.0, "cold": 0.0, "redness": 0.0, "even": 0.0, "smooth": 0.0, "straight": 0.0}


@pytest.mark.parametrize(
    ("measures", "outside"),
    [
        ({"straight": STRAIGHT, "cool": COOL_BESIDE_STRAIGHT}, "straight edges, little red"),
        ({"even": ROOM_LIGHT, "cold": COLD_BESIDE_LIGHT}, "even light, no red"),
        ({"smooth": ROOM_LIGHT, "cold": COLD_BESIDE_LIGHT}, "even light, no red"),
        ({"even": 0.5, "smooth": ROOM_LIGHT - 0.5 + 1e-9, "cold": COLD_BESIDE_LIGHT}, "even light, no red"),
    ],
)
def test_evidence_outside_requires_all_measures(measures, outside):
    assert Evidence(**NOTHING | measures).outside == outside
    for name, value in measures.items():
        assert Evidence(**NOTHING | measures | {name: value - 0.01}).outside is None


def test_evidence_of_red_image_never_outside():
    assert Evidence(cool=0.39, cold=0.39, redness=1.0, even=1.0, smooth=1.0, straight=1.0).outside is None


def test_evidence_tissue_thresholds_of_cool_share_and_redness():
    clear = NOTHING | {"cool": LITTLE_COOL - 0.01, "redness": REDNESS}
    assert Evidence(**clear).tissue
    assert not Evidence(**clear | {"cool": LITTLE_COOL}).tissue
    assert not Evidence(**clear | {"redness": REDNESS - 0.01}).tissue


def test_evidence_measures_of_known_images():
    grey = evidence_of(plain(120, 120, 120))
    assert (grey.cool, grey.cold, grey.even, grey.smooth, grey.redness) == (1.0, 1.0, 1.0, 1.0, 0.0)
    warm = evidence_of(plain(180, 70, 60))
    assert warm.cool == 0.0 and warm.redness == pytest.approx(np.log(186 / 76), abs=0.01)
    halves = plain(100, 100, 100)
    halves[:, 160:] = (200, 80, 80)
    both = evidence_of(halves)
    assert both.cool == pytest.approx(0.5, abs=0.03) and both.even == pytest.approx(0.5, abs=0.03)
    # Red exceeds green, or blue, by 10 % or by 15 %.
    for red, cool in ((110, 1.0), (117, 0.0)):
        assert evidence_of(plain(red, 100, red)).cool == evidence_of(plain(red, red, 100)).cool == cool
    ramp = np.repeat(np.linspace(60, 240, SIZE[1])[None, :, None], SIZE[0], 0).repeat(3, 2).astype(np.uint8)
    assert evidence_of(ramp).even == pytest.approx(105 / 231, abs=0.02) and evidence_of(ramp).smooth < 0.4


@pytest.mark.parametrize("degrees", [0, 17, 45, 73])
def test_evidence_straight_finds_right_angles_at_any_rotation(degrees):
    picture = plain(140, 145, 150)
    for k in range(-6, 14):
        cv2.line(picture, (30 * k, -200), (30 * k, 500), (40, 42, 45), 4)
        cv2.line(picture, (-200, 35 * k), (600, 35 * k), (40, 42, 45), 4)
    turn = cv2.getRotationMatrix2D((160, 120), degrees, 1.3)
    grid = cv2.warpAffine(picture, turn, SIZE[::-1], borderMode=cv2.BORDER_REFLECT)
    assert evidence_of(grid).straight > 0.75
    rings = plain(140, 145, 150)
    for radius in range(10, 300, 18):
        cv2.circle(rings, (160, 120), radius, (40, 42, 45), 4)
    assert evidence_of(rings).straight < 0.15


def test_evidence_straight_ignores_border_of_square_view():
    """Grey tissue in a square window on black, as a recorder shows it."""
    rng = np.random.default_rng(2)
    soft = cv2.GaussianBlur(rng.normal(0, 1, SIZE).astype(np.float32), (0, 0), 8)
    picture = np.repeat(np.clip(120 + 40 * soft / soft.std(), 0, 255).astype(np.uint8)[..., None], 3, 2)
    picture[:, :60] = picture[:, -60:] = 0
    picture[:25] = picture[-25:] = 0
    assert evidence_of(picture).straight < STRAIGHT


def test_body_gate_closes_at_one_outside_image_and_reopens_after_many_inside(rng):
    gate, inside = BodyGate(), tissue(rng)
    assert gate.judge(inside) is None
    assert gate.judge(room(rng)) == "straight edges, little red"
    for _ in range(FRAMES_TO_RETURN - 1):
        assert gate.judge(inside) == "not yet certain again"
    assert gate.judge(room(rng)) is not None
    answers = [gate.judge(inside) for _ in range(FRAMES_TO_RETURN + 1)]
    assert answers == ["not yet certain again"] * (FRAMES_TO_RETURN - 1) + [None, None]


def test_body_gate_withholds_single_outside_images_and_closes_after_several(rng):
    gate, inside, outside = BodyGate(), cloth(rng, 215, 180, 150), room(rng)
    for _ in range(RECENT_FRAMES):
        assert gate.judge(inside) is None
    for _ in range(FRAMES_TO_CLOSE - 1):
        assert gate.judge(outside) is not None and gate.inside
        assert gate.judge(inside) is None
    for _ in range(RECENT_FRAMES):
        assert gate.judge(inside) is None
    for _ in range(FRAMES_TO_CLOSE):
        assert gate.inside and gate.judge(inside) is None
        assert gate.judge(outside) is not None
    assert not gate.inside and gate.judge(inside) == "not yet certain again"


def test_body_gate_reopens_later_for_unusual_tissue(rng):
    gate, pale = BodyGate(), cloth(rng, 215, 180, 150)
    assert evidence_of(pale).outside is None and not evidence_of(pale).tissue
    gate.judge(room(rng))
    answers = [gate.judge(pale) for _ in range(FRAMES_WITHOUT_EVIDENCE)]
    assert answers == ["not yet certain again"] * (FRAMES_WITHOUT_EVIDENCE - 1) + [None]


def test_body_gate_ignores_unjudgeable_images(rng):
    gate, inside, dark = BodyGate(), tissue(rng), plain(0, 0, 0)
    assert gate.judge(dark) is None
    gate.judge(room(rng))
    for _ in range(FRAMES_WITHOUT_EVIDENCE):
        assert gate.judge(dark) == "not yet certain again"
    for _ in range(FRAMES_TO_RETURN - 1):
        assert gate.judge(inside) is not None
        assert gate.judge(dark) is not None
    assert gate.judge(inside) is None


def test_body_gate_requires_consecutive_tissue_images(rng):
    gate, inside, pale = BodyGate(), tissue(rng), cloth(rng, 215, 180, 150)
    gate.judge(room(rng))
    answers = [gate.judge(inside if k % FRAMES_TO_RETURN else pale) for k in range(FRAMES_WITHOUT_EVIDENCE)]
    assert answers.count(None) == 1 and answers[-1] is None


def test_body_gate_reset_clears_history(rng):
    gate = BodyGate()
    gate.judge(room(rng))
    gate.reset()
    assert gate.judge(tissue(rng)) is None and gate.inside


@pytest.mark.parametrize("size", [(1, 1), (8, 400), (0, 10), (15, 15)])
def test_evidence_of_too_small_image_is_none(size):
    assert evidence_of(np.full((*size, 3), 120, np.uint8)) is None
    assert evidence_of(np.full((16, 16, 3), 120, np.uint8)) is not None


def test_evidence_of_dark_or_overexposed_image_is_none():
    assert evidence_of(plain(24, 24, 24)) is None
    assert evidence_of(plain(39, 39, 39)) is None and evidence_of(plain(41, 41, 41)).outside is not None
    assert evidence_of(plain(255, 252, 240)) is None and evidence_of(plain(251, 251, 251)).outside is not None
    corner = plain(0, 0, 0)
    corner[:40, :60] = 120
    assert evidence_of(corner) is None, "3 % of the picture is lit"
    mostly = plain(255, 255, 255)
    mostly[:, :24] = (120, 120, 120)
    assert evidence_of(mostly) is None, "8 % of the lit pixels are not clipped"


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32))
def test_evidence_of_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, rng.integers(1, 257), (height, width, 3), np.uint8)
    measures = evidence_of(image)
    assert measures is None or all(np.isfinite(value) for value in vars(measures).values())


@pytest.mark.parametrize(
    "image", [np.zeros((40, 40), np.uint8), np.zeros((40, 40, 3), np.float32), np.zeros((40, 40, 4), np.uint8)]
)
def test_body_gate_rejects_other_arrays_and_closes(rng, image):
    gate = BodyGate()
    assert gate.judge(tissue(rng)) is None
    with pytest.raises(InvalidInput, match=r"image must be RGB uint8 \[H, W, 3\], got"):
        gate.judge(image)
    assert not gate.inside and gate.judge(tissue(rng)) == "not yet certain again"


@pytest.mark.parametrize(
    ("measures", "outside", "tissue"),
    [
        ({"straight": 0.47, "cool": 0.4}, "straight edges, little red", False), ({"straight": 0.469, "cool": 0.4}, None, False),
        ({"straight": 0.47, "cool": 0.399}, None, False), ({"even": 0.5, "smooth": 0.341, "cold": 0.55}, "even light, no red", False),
        ({"even": 0.5, "smooth": 0.339, "cold": 0.55}, None, False), ({"even": 0.5, "smooth": 0.341, "cold": 0.549}, None, False),
        ({"cool": 0.299, "redness": 0.34}, None, True), ({"cool": 0.3, "redness": 0.34}, None, False),
        ({"cool": 0.299, "redness": 0.339}, None, False),
    ],
)  # fmt: skip
def test_evidence_thresholds(measures, outside, tissue):
    found = Evidence(**(dict.fromkeys(("cool", "cold", "redness", "even", "smooth", "straight"), 0.0) | measures))
    assert (found.outside, found.tissue) == (outside, tissue)


@pytest.mark.parametrize(("redness", "returns_after"), [(0.5, 10), (0.2, 30)])
def test_body_gate_reopens_after_ten_tissue_or_thirty_neutral_images(monkeypatch, redness, returns_after):
    gate = BodyGate()
    gate.close()
    seen = Evidence(cool=0.0, cold=0.0, redness=redness, even=0.0, smooth=0.0, straight=0.0)
    monkeypatch.setattr(out_of_body, "evidence_of", lambda image: seen)
    said = [gate.judge(None) for _ in range(returns_after)]
    assert all(said[:-1]) and said[-1] is None


@pytest.mark.parametrize(("red", "cold"), [(1.06, 0.0), (1.04, 1.0)])
def test_evidence_cold_red_excess_threshold(red, cold):
    """exp(0.05) = 1.051, of channels with 6 added."""
    image = np.full((64, 80, 3), 100, np.uint8)
    image[..., 0] = round(red * 106 - 6)
    assert evidence_of(image).cold == cold and evidence_of(image).cool == 1.0


@pytest.mark.parametrize(("level", "is_judged"), [(38, False), (42, True)])
def test_evidence_of_requires_brightness_above_forty_levels(level, is_judged):
    assert (evidence_of(np.full((64, 80, 3), level, np.uint8)) is not None) == is_judged


@pytest.mark.parametrize(("side", "is_judged"), [(15, False), (16, True)])
def test_evidence_of_requires_sixteen_pixels_per_side(side, is_judged):
    assert (evidence_of(np.full((side, 80, 3), 120, np.uint8)) is not None) == is_judged


@pytest.mark.parametrize(("red", "cool"), [(1.13, 0.0), (1.11, 1.0)])
def test_evidence_cool_red_excess_threshold(red, cool):
    """exp(0.12) = 1.127, of channels with 6 added."""
    image = np.full((64, 80, 3), 100, np.uint8)
    image[..., 0] = round(red * 106 - 6)
    found = evidence_of(image)
    assert found.cool == cool and found.even == 1.0 and found.smooth == 1.0
    assert found.redness == pytest.approx(np.log((image[0, 0, 0] + 6) / 106), abs=1e-5)
