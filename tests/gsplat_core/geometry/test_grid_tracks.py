"""Grids of points that are followed between pictures whose motion is known."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.geometry import grid_tracks
from gsplat_core.geometry.grid_tracks import LONGEST_PX, TexturedPicture, follow_grids, seen_by
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, FOCAL, HEIGHT, WIDTH, texture


def shifted(by_px: tuple[float, float], gain: float = 1.0) -> Frame:
    """A part of one picture that moves to the right and down, in another light."""
    move = np.array([[1, 0, by_px[0] - 40], [0, 1, by_px[1] - 40]], np.float32)
    picture = cv2.warpAffine(texture(), move, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return Frame(0, 0, np.asarray(np.clip(picture * gain, 0, 255), np.uint8))


def test_follow_grids_tolerates_brightness_change_and_drops_points_outside() -> None:
    ways = [(0.0, 0.0), (3.5, -2.0), (8.0, -4.5), (30.0, 0.0)]
    pictures = [seen_by(shifted(way, 1 - 0.1 * number), FIRST) for number, way in enumerate(ways)]
    tracks = follow_grids(pictures, np.arange(4.0), [0, 2])
    assert tracks.rays.shape[:2] == tracks.seen.shape
    for number, way in enumerate(ways[:3]):
        moved = (tracks.rays[number] - tracks.rays[0]) * FOCAL
        both = tracks.seen[number] & tracks.seen[0]
        assert both.mean() > 0.6
        np.testing.assert_allclose(np.median(moved[both], 0), way, atol=0.05)
        assert np.percentile(np.linalg.norm(moved[both] - way, axis=1), 90) < 0.3
    x = tracks.rays[..., 0] * FOCAL + WIDTH / 2
    assert (x[tracks.seen] < WIDTH).all()
    assert tracks.seen[3].mean() < tracks.seen[1].mean()


def test_follow_grids_excludes_tools_and_outside_field_of_view() -> None:
    mask, field = np.ones((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :60], field[100:] = 0, 0
    frames = [shifted(way).with_fields(mask=mask, loss_mask=field) for way in ((0.0, 0.0), (2.0, 1.0))]
    tracks = follow_grids([seen_by(frame, FIRST) for frame in frames], np.arange(2.0), [0])
    x, y = (tracks.rays[..., axis] * FOCAL + half for axis, half in ((0, WIDTH / 2), (1, HEIGHT / 2)))
    assert tracks.seen.any()
    assert (x[tracks.seen] > 60).all()
    assert (y[tracks.seen] < 100).all()


def test_seen_by_reduces_large_pictures() -> None:
    image = cv2.resize(texture(), (700, 500))
    small = seen_by(Frame(0, 0, np.asarray(image, np.uint8)), Camera.from_focal(600.0, 700, 500))
    assert small.texture.shape[1] == LONGEST_PX == small.camera.width_px
    assert small.usable.shape == small.texture.shape


def test_usable_part_margins_from_field_of_view_and_tools() -> None:
    mask, field = np.ones((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :40], field[80:] = 0, 0
    usable = seen_by(shifted((0.0, 0.0)).with_fields(mask=mask, loss_mask=field), FIRST).usable
    columns, rows = np.flatnonzero(usable[40]), np.flatnonzero(usable[:, 100])
    assert columns[0] == 40 + 5 + 1 and columns[-1] >= WIDTH - 2
    assert rows[-1] == 79 - 1


def test_texture_is_centred_and_independent_of_brightness() -> None:
    bright, dim = (seen_by(shifted((0.0, 0.0), gain), FIRST) for gain in (1.0, 0.5))
    inner = bright.usable[20:-20, 20:-20] > 0
    values = bright.texture[20:-20, 20:-20][inner].astype(float)
    assert abs(values.mean() - 128) < 4 and 30 < values.std() < 60
    again = dim.texture[20:-20, 20:-20][inner].astype(float)
    assert abs(again.std() - values.std()) < 5 and np.corrcoef(values, again)[0, 1] > 0.98


def test_texture_of_flat_picture_is_weak() -> None:
    noise = np.random.default_rng(0).integers(0, 2, (HEIGHT, WIDTH, 1), np.uint8)
    flat = seen_by(Frame(0, 0, np.repeat(120 + noise, 3, 2).astype(np.uint8)), FIRST)
    assert flat.texture.astype(float).std() < 20


def test_follow_grids_spacing_and_minimum_visibility() -> None:
    still = seen_by(shifted((0.0, 0.0)), FIRST)
    hidden = TexturedPicture(still.texture, still.usable.copy(), FIRST)
    hidden.usable[:, : WIDTH // 2] = 0
    rows, columns = range(5, HEIGHT, 10), range(5, WIDTH, 10)
    for visible, expected in ((2, False), (3, True)):
        pictures = [still] * visible + [hidden] * (10 - visible)
        tracks = follow_grids(pictures, np.arange(10.0), [0])
        x = np.unique(np.round(tracks.rays[0, :, 0] * FOCAL + WIDTH / 2 - 0.5).astype(int))
        y = np.unique(np.round(tracks.rays[0, :, 1] * FOCAL + HEIGHT / 2 - 0.5).astype(int))
        inner = [column for column in columns if 6 <= column < WIDTH - 6]
        assert x.tolist() == [column for column in inner if expected or column >= WIDTH // 2]
        assert y.tolist() == [row for row in rows if 6 <= row < HEIGHT - 6]
    assert tracks.extent == (WIDTH / 2 / FOCAL, HEIGHT / 2 / FOCAL) and tracks.focal_px == FOCAL
    part = tracks.of(slice(0, 4), slice(1, 3))
    assert part.rays.shape == (2, 4, 2) and part.seen.shape == (2, 4) and part.poses.shape == (2, 4, 4)
    assert part.times_s.tolist() == [1.0, 2.0]


def test_from_key_compares_outwards_from_key_picture(monkeypatch) -> None:
    """Each flow starts from that of the picture before, so that it is found over large distances."""
    pictures = [seen_by(shifted((0.5 * number, 0.0)), FIRST) for number in range(5)]
    numbers, compared = {id(each.texture): number for number, each in enumerate(pictures)}, []

    class Flow:
        def calc(self, first, second, start):
            compared.append((numbers[id(first)], numbers[id(second)], None if start is None else int(start[0, 0, 0])))
            return np.full((*first.shape, 2), numbers[id(second)], np.float32)

    monkeypatch.setattr(grid_tracks.cv2, "DISOpticalFlow", SimpleNamespace(create=lambda preset: Flow()))
    start = np.array([[50.0, 40.0], [80.0, 60.0]], np.float32)
    pixels, seen = grid_tracks._from_key(pictures, 2, start)
    assert compared == [
        (2, 3, None),
        (3, 2, None),
        (2, 4, 3),
        (4, 2, 2),
        (2, 1, None),
        (1, 2, None),
        (2, 0, 1),
        (0, 2, 2),
    ]
    assert [float((at - start).mean()) for at in pixels] == [0, 1, 0, 3, 4]
    assert seen[2].all()


@pytest.mark.parametrize(
    ("at", "misses_px", "is_found"),
    [
        ((30.0, 20.0), 0.98, True), ((30.0, 20.0), 1.02, False), ((0.0, 20.0), 0, True), ((-0.1, 20.0), 0, False),
        ((30.0, 0.0), 0, True), ((30.0, -0.1), 0, False), ((59.9, 20.0), 0, True), ((60.0, 20.0), 0, False),
        ((30.0, 39.9), 0, True), ((30.0, 40.0), 0, False), ((45.0, 20.0), 0, False),
    ],
)  # fmt: skip
def test_found_requires_border_tissue_and_return_within_one_pixel(at, misses_px, is_found) -> None:
    """Positions are relative to the border that is left out. A tool is at columns 40 to 50."""
    border = grid_tracks.BORDER_PX
    usable = np.ones((40 + 2 * border, 60 + 2 * border), np.uint8)
    usable[:, 40 + border : 50 + border] = 0
    start = np.array([[20.0, 25.0]], np.float32)
    pixels = np.array([at], np.float32) + border
    back = np.broadcast_to(start[0] - pixels[0] + np.float32([misses_px, 0]), (*usable.shape, 2)).astype(np.float32)
    assert grid_tracks._found(start, pixels, back, usable).tolist() == [is_found]
