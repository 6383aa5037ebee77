"""`FieldOfView`: detection, stability and update of a limited field of view."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import artefacts
from gsplat_core.endoscope.artefacts import FieldOfView, seen_in_recording
from tests.gsplat_core.endoscope.clips import clip, texture
from tests.gsplat_core.endoscope.test_strip import FRAMES, drawn_into, strip_below

HEIGHT, WIDTH = 256, 320


def disc(centre=(160, 128), radius=120, height=HEIGHT, width=WIDTH):
    y, x = np.mgrid[:height, :width]
    return (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2


def seen_through(field, seed=1, count=40, level=5):
    images = []
    for image in texture(seed, count, field.shape[1], field.shape[0]):
        image = image.copy()
        image[~field] = level
        images.append(image)
    return images


def masks(images):
    view = FieldOfView()
    return [view.observe(image) for image in images]


def overlap(mask, field):
    inside = mask.astype(bool)
    return (inside & field).sum() / (inside | field).sum()


FIELDS = {
    "disc": disc(),
    "disc cut off above and below": disc(radius=150),
    "disc at one side": disc((120, 128), 110),
    "octagon": disc(radius=10**6) & (np.add.outer(np.arange(256), np.arange(320)) > 60)
    & (np.add.outer(np.arange(256), -np.arange(320)) > -260) & (np.add.outer(np.arange(256), np.arange(320)) < 514)
    & (np.add.outer(np.arange(256), -np.arange(320)) < 196),
    "between bars": np.outer(np.ones(256, bool), (np.arange(320) > 40) & (np.arange(320) < 280)),
}  # fmt: skip


@pytest.mark.parametrize("shape", FIELDS)
@pytest.mark.parametrize("level", [0, 22])
def test_field_of_view_found_in_first_frame_and_kept(shape, level):
    found = masks(seen_through(FIELDS[shape], count=65, level=level))
    assert overlap(found[0], FIELDS[shape]) > 0.92
    assert (found[0].astype(bool) & ~FIELDS[shape]).mean() < 0.004
    assert found[-1] is found[0]


def test_field_of_view_full_frame_video_has_no_mask():
    assert set(map(type, masks(texture(2, 65, WIDTH, HEIGHT)))) == {type(None)}


def dark_cave(image, centre, radius=50):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    far = np.hypot(x - centre[0], y - centre[1]) / radius
    return (image * np.clip(far - 0.2, 0.02, 1)[..., None]).astype(np.uint8)


@pytest.mark.parametrize("centre", [(160, 128), (200, 60), (260, 128)])
def test_field_of_view_keeps_dark_cavity_inside_round_view(centre):
    found = masks([dark_cave(image, centre) for image in seen_through(disc(), count=65)])
    assert overlap(found[-1], disc()) > 0.91


@pytest.mark.parametrize("centre", [(160, 128), (0, 128), (320, 256)])
def test_field_of_view_ignores_dark_cavity_in_full_frame(centre):
    images = [dark_cave(image, centre, 90) for image in texture(3, 65, WIDTH, HEIGHT)]
    assert masks(images)[-1] is None


@pytest.mark.parametrize("turned", range(4))
@pytest.mark.parametrize("width", [60, 120, 200])
def test_field_of_view_keeps_lit_tissue_beside_black_corner(turned, width):
    """With a straight and a curved black corner, an ellipse through both rims would exclude half of a lit picture."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    black = x / WIDTH - y / HEIGHT > 1 - width / WIDTH
    black |= (x - WIDTH / 2) ** 2 + (y + 900) ** 2 > 1170**2
    black = np.rot90(black, turned)
    images = seen_through(~black, count=31, level=2)
    for mask in masks(images):
        if mask is not None:
            left_out = mask == 0
            assert (left_out & ~black).sum() < 0.3 * left_out.sum()


def rendered_bowel(seed):
    """A full picture with a black corner at a curved rim, bright elsewhere, with a darker band of blobs below."""
    rng = np.random.default_rng(seed)
    image = next(iter(texture(seed, 1, WIDTH, HEIGHT))).copy()
    cv2.ellipse(image, (int(rng.integers(260, 320)), -10), (90, 50), 20, 0, 360, (3, 3, 3), -1)
    cv2.line(image, (0, 150), (120, 140), (8, 8, 8), 6)
    cv2.line(image, (120, 140), (230, 255), (8, 8, 8), 6)
    return image


@pytest.mark.parametrize("seed", range(8))
def test_field_of_view_keeps_lit_tissue_beyond_dark_folds(seed):
    mask = masks([rendered_bowel(seed)])[0]
    assert mask is None or mask[180:, :60].all()


def test_field_of_view_dropped_at_first_image_lit_outside():
    found = masks([*seen_through(disc(radius=90), count=12), *texture(4, 2, WIDTH, HEIGHT)])
    assert found[11] is not None and found[12] is None


def test_field_of_view_unchanged_by_text_appearing_in_surround():
    images = seen_through(disc(), count=70)
    for image in images[20:]:
        image[4:60, 4:40] = 220
        image[4:60, 280:316] = 220
        image[200:250, 4:40] = 220
    found = masks(images)
    assert found[-1] is found[0] is not None


@pytest.mark.slow
@pytest.mark.parametrize("colour", [(10, 10, 12), (190, 195, 200)])
def test_field_of_view_unchanged_by_tool_at_rim(colour):
    images = seen_through(disc(), count=95)
    for image in images[20:]:
        tool = np.zeros((HEIGHT, WIDTH), bool)
        tool[110:150, :130] = True
        image[tool & disc()] = colour
    assert overlap(masks(images)[-1], disc()) > 0.91


def test_field_of_view_excludes_text_in_surround():
    images = seen_through(disc(), count=35)
    for image in images:
        cv2.putText(image, "12:34", (4, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    assert overlap(masks(images)[-1], disc()) > 0.92


@pytest.mark.slow
def test_field_of_view_grows_soon_and_shrinks_late():
    small, large = disc(radius=80), disc(radius=120)
    found = masks([*seen_through(small, count=60), *seen_through(large, count=60), *seen_through(small, count=150)])
    assert overlap(found[59], small) > 0.91 and overlap(found[119], large) > 0.92
    assert overlap(found[140], large) > 0.91 and overlap(found[-1], small) > 0.91


@pytest.mark.slow
def test_field_of_view_removed_after_sustained_full_frame_video():
    found = masks([*seen_through(disc(), count=30), *texture(4, 160, WIDTH, HEIGHT)])
    assert found[29] is not None and found[-1] is None


def test_field_of_view_recomputed_after_size_change():
    other = disc((64, 64), 60, 128, 128)
    view = FieldOfView()
    for image in [*seen_through(disc(), count=5), *seen_through(other, count=5)]:
        mask = view.observe(image)
    assert mask.shape == (128, 128) and overlap(mask, other) > 0.91


@pytest.mark.recordings
def test_field_of_view_of_sinus_equals_valid_mask(recordings_dir):
    valid = cv2.imread(str(recordings_dir / "sinus" / "valid_mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    found = masks(clip(recordings_dir, "sinus"))
    assert overlap(found[0], valid) > 0.95 and overlap(found[-1], valid) > 0.95


@pytest.mark.recordings
def test_field_of_view_of_colon_excludes_four_corners(recordings_dir):
    mask = masks(clip(recordings_dir, "colon"))[-1]
    assert 0.85 < mask.mean() < 0.93
    assert not mask[[2, 2, -3, -3], [2, -3, 2, -3]].any() and mask[[0, 223, 223, 445], [223, 0, 445, 223]].all()


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "resting_bowel", "laparoscopy", "stereomis_like"])
def test_field_of_view_of_full_frame_recordings_is_none(recordings_dir, name):
    assert set(map(type, masks(clip(recordings_dir, name)))) == {type(None)}


@pytest.mark.recordings
@pytest.mark.parametrize(
    "name",
    ["hamlyn_pair/f7_dynamic_deint_L_0100.png", "hamlyn_pair/f7_dynamic_deint_R_0100.png", "scared_pair/left.png"],
)
def test_field_of_view_ignores_dark_surroundings_of_tissue(recordings_dir, name):
    image = cv2.imread(str(recordings_dir / name))
    assert masks([image] * 3)[-1] is None


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32))
def test_field_of_view_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    view = FieldOfView()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(artefacts, "WINDOW_FRAMES", 2)
        for _ in range(7):
            image = rng.integers(0, rng.integers(1, 257), (height, width, 3), np.uint8)
            image[:, : rng.integers(0, width)] = 0
            mask = view.observe(image)
            assert mask is None or mask.shape == (height, width)


@pytest.mark.parametrize(("windows", "is_taken"), [(1, False), (2, False), (3, True)])
def test_field_of_view_shrinks_after_three_windows(monkeypatch, windows, is_taken):
    monkeypatch.setattr(artefacts, "WINDOW_FRAMES", 2)
    large, small = disc(radius=120), disc(radius=80)
    # The first frame is a window of its own, and the window after a change still contains frames before it.
    found = masks([*seen_through(large, count=3), *seen_through(small, count=1 + 2 * windows)])
    assert overlap(found[2], large) > 0.92
    assert overlap(found[-1], small if is_taken else large) > 0.9


def test_field_of_view_uses_pixel_extremes_of_thirty_frame_windows(monkeypatch):
    judged = []
    monkeypatch.setattr(artefacts, "find_outline", lambda *levels: judged.append(levels))
    view, levels = FieldOfView(), np.random.default_rng(0).integers(30, 220, (61, 12, 16))
    for each in levels:
        view.observe(np.repeat(each[..., None], 3, 2).astype(np.uint8))
    assert len(judged) == 3
    for found, window in zip(judged, (levels[:1], levels[:30], levels[30:60]), strict=True):
        shown = window.repeat(10, 1).repeat(10, 2)  # enlarged to 160 pixels
        if found[0].shape == (12, 16):
            shown = window
        for each, expected in zip(found, (shown.max(0), shown.min(0)), strict=True):
            assert np.abs(each.astype(int) - expected).max() <= 1


def polygon(corners, radii=(100.0, 90.0), centre=(160.0, 128.0)):
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return np.stack([centre[0] + radii[0] * np.cos(angles), centre[1] + radii[1] * np.sin(angles)], 1)


@pytest.mark.parametrize("radii", [(100.0, 90.0), (90.0, 100.0), (150.0, 140.0)])
def test_as_ellipse_turns_round_outline_into_inscribed_ellipse(radii):
    """The hull of 24 corners is at most 0.9 % of the radius inside of the ellipse."""
    hull = polygon(24, radii)
    hull = np.clip(hull, 0, [WIDTH - 1, HEIGHT - 1])  # a larger field is cut off by the picture
    found = artefacts._as_ellipse(hull, (HEIGHT, WIDTH))
    assert len(found) > len(hull)
    assert (found >= hull.min(0) - 1e-9).all() and (found <= hull.max(0) + 1e-9).all()
    free = found[(found[:, 1] > 0) & (found[:, 1] < HEIGHT - 1)]
    off = np.hypot(*((free - (160, 128)) / radii).T) - 1
    assert np.abs(off).max() < 0.02 and len(free) > 90


@pytest.mark.parametrize(
    "hull",
    [
        np.array([[60.0, 60], [260, 60], [260, 200], [60, 200]]),
        polygon(3),
        polygon(40, (100.0, 50.0)),  # more than 0.6 times as long as wide is no field
        polygon(15, (2.0, 2.0)),  # fewer than twenty points
    ],
    ids=["rectangle", "triangle", "long", "small"],
)
def test_as_ellipse_keeps_other_outlines(hull):
    assert artefacts._as_ellipse(hull, (HEIGHT, WIDTH)) is hull


@pytest.mark.parametrize(("dented", "is_round"), [(0.2, True), (0.5, False)])
def test_as_ellipse_requires_seven_tenths_of_outline(dented, is_round):
    """A straight side cuts off a share of the outline."""
    angles = np.linspace(-np.pi * (1 - dented), np.pi * (1 - dented), 200)
    hull = np.stack([160 + 100 * np.cos(angles), 128 + 100 * np.sin(angles)], 1)
    found = artefacts._as_ellipse(hull, (HEIGHT, WIDTH))
    assert (found is hull) != is_round


def box(left, right, top=0.0, bottom=1.0):
    """Return an outline in shares of the picture."""
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def decided(monkeypatch, outlines):
    """Return the columns of the mask after each window of one frame in which an outline is found."""
    monkeypatch.setattr(artefacts, "WINDOW_FRAMES", 1)
    monkeypatch.setattr(artefacts, "MARGIN_SHARE", 0.0)
    left, view, found = list(outlines), FieldOfView(), []
    monkeypatch.setattr(artefacts, "find_outline", lambda *_: left.pop(0))
    monkeypatch.setattr(view, "_shows_more", lambda grey: False)
    for _ in outlines:
        mask = view.observe(np.full((80, 160, 3), 90, np.uint8))
        columns = np.arange(160) if mask is None else np.flatnonzero(mask[40])
        found.append((columns[0], columns[-1]))
    return found, view


WIDE, NARROW, OTHER = box(0.1, 0.9), box(0.2, 0.8), box(0.3, 0.7)


@pytest.mark.parametrize(
    ("outlines", "taken"),
    [
        ([WIDE, NARROW, NARROW, NARROW], [WIDE, WIDE, WIDE, NARROW]),
        ([WIDE, NARROW, NARROW, WIDE, NARROW, NARROW, NARROW], [WIDE] * 6 + [NARROW]),
        ([WIDE, NARROW, OTHER, NARROW, OTHER, OTHER, OTHER], [WIDE] * 6 + [OTHER]),
        ([NARROW, WIDE, NARROW], [NARROW, WIDE, WIDE]),
        ([NARROW, box(0.1, 0.6)], [NARROW, box(0.1, 0.8)]),
        ([WIDE, None, None, None], [WIDE, WIDE, WIDE, None]),
        ([None, WIDE, WIDE, WIDE], [None, None, None, WIDE]),
        ([WIDE, box(0.1, 0.894), box(0.1, 0.888)], [WIDE] * 3),
        ([WIDE, box(0.1, 0.902)], [WIDE] * 2),
    ],
    ids=["smaller", "interrupted", "inconsistent", "larger", "joined", "gone", "appears", "nearly the same", "hardly larger"],
)  # fmt: skip
def test_field_of_view_grows_at_once_and_shrinks_after_three_equal_windows(monkeypatch, outlines, taken):
    found, view = decided(monkeypatch, outlines)
    expected = [(0, 159) if each is None else (round(160 * each[0, 0]), round(160 * each[1, 0]) - 1) for each in taken]
    assert np.abs(np.array(found) - expected).max() <= 1
    changes = 1 + sum(before is not after for before, after in itertools.pairwise(taken))
    assert view.changes == changes


@pytest.mark.parametrize(
    ("level", "share", "is_more"), [(52, 0.5, False), (53, 0.5, True), (200, 0.24, False), (200, 0.26, True)]
)
def test_shows_more_requires_lit_share_outside_field(level, share, is_more):
    view = FieldOfView()
    view._reduced = np.zeros((10, 100), bool)
    view._reduced[5:] = True
    grey = np.full((10, 100), 5, np.uint8)
    grey[:5, : round(100 * share)] = level
    assert view._shows_more(grey) == is_more
    view._reduced[:] = True
    assert not view._shows_more(grey)


@pytest.mark.parametrize(("size", "margin"), [((160, 320), 3), ((40, 45), 0), ((60, 80), 1)])
def test_field_of_view_margin_is_hundredth_of_longer_side_except_at_border(monkeypatch, size, margin):
    view = FieldOfView()
    monkeypatch.setattr(artefacts, "find_outline", lambda *_: box(0.25, 1.0))
    mask = view.observe(np.full((*size, 3), 90, np.uint8))
    expected = np.zeros(size, np.uint8)
    expected[:, round(0.25 * size[1]) + margin :] = 1
    assert np.abs(mask.astype(int) - expected).sum() <= size[0] and mask[:, -1].all() and mask[[0, -1], -5:].all()
    assert not mask[:, : round(0.25 * size[1]) + margin - 1].any()


def test_seen_in_recording_is_union_of_all_windows():
    """A field of view found in the first picture only is ignored once there is a complete window."""
    small, large = disc(radius=80), disc(radius=120)
    pictures = seen_through(small, count=1) + seen_through(large, count=40)
    assert overlap(seen_in_recording(iter(pictures)), large) > 0.92
    later = seen_through(small, seed=2, count=150)
    assert overlap(seen_in_recording(pictures + later), large) > 0.92
    assert overlap(seen_in_recording(later[:5]), small) > 0.9
    whole = seen_through(np.ones((HEIGHT, WIDTH), bool), count=40)
    assert seen_in_recording(whole) is None and seen_in_recording([]) is None
    assert seen_in_recording(later[:35] + whole) is None


def test_seen_in_recording_excludes_strips():
    pictures = drawn_into(seen_through(FIELDS["disc"], count=FRAMES, level=30), strip_below)
    seen = seen_in_recording(pictures).astype(bool)
    assert not (seen & ~FIELDS["disc"]).any() and seen[-14:].mean() < 0.2 * FIELDS["disc"][-14:].mean()
    assert (seen & FIELDS["disc"]).sum() > 0.9 * FIELDS["disc"][:-14].sum()
    assert seen_in_recording(drawn_into(texture(3, FRAMES, WIDTH, HEIGHT), strip_below))[:-20].all()
