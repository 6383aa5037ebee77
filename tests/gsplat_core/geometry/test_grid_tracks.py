"""Grids of points that are followed between pictures whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.geometry.grid_tracks import LONGEST_PX, follow_grids, seen_by
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, FOCAL, HEIGHT, WIDTH, texture


def shifted(by_px: tuple[float, float], gain: float = 1.0) -> Frame:
    """A part of one picture that moves to the right and down, in another light."""
    move = np.array([[1, 0, by_px[0] - 40], [0, 1, by_px[1] - 40]], np.float32)
    picture = cv2.warpAffine(texture(), move, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return Frame(0, 0, np.asarray(np.clip(picture * gain, 0, 255), np.uint8))


def test_points_are_found_in_another_light_and_where_they_leave_the_picture_they_are_not() -> None:
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


def test_nothing_is_followed_on_tools_nor_out_of_the_field_of_view() -> None:
    mask, field = np.ones((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :60], field[100:] = 0, 0
    frames = [shifted(way).with_fields(mask=mask, loss_mask=field) for way in ((0.0, 0.0), (2.0, 1.0))]
    tracks = follow_grids([seen_by(frame, FIRST) for frame in frames], np.arange(2.0), [0])
    x, y = (tracks.rays[..., axis] * FOCAL + half for axis, half in ((0, WIDTH / 2), (1, HEIGHT / 2)))
    assert tracks.seen.any()
    assert (x[tracks.seen] > 60).all()
    assert (y[tracks.seen] < 100).all()


def test_large_pictures_are_made_small() -> None:
    image = cv2.resize(texture(), (700, 500))
    small = seen_by(Frame(0, 0, np.asarray(image, np.uint8)), Camera.from_focal(600.0, 700, 500))
    assert small.texture.shape[1] == LONGEST_PX == small.camera.width_px
    assert small.usable.shape == small.texture.shape
