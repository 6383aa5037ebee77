"""`ExpectedPicture`: prediction of the next picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.experimental.learned_prior import ExpectedPicture, moved, origin
from gsplat_core.training.image_motion import CELL_PX

SIZE = 48, 64
CELLS = SIZE[0] // CELL_PX, SIZE[1] // CELL_PX
STILL = np.zeros((*CELLS, 2), np.float32)


def texture(seed: int = 0) -> NDArray[np.float32]:
    field = np.random.default_rng(seed).uniform(0, 255, (*SIZE, 3)).astype(np.float32)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(field, (0, 0), 2.0), np.empty(0), 40, 220, cv2.NORM_MINMAX))


def as_bytes(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def error(picture: NDArray[np.float32] | None, came: NDArray[np.float32]) -> float:
    assert picture is not None
    return float(np.square(picture - came)[8:-8, 8:-8].mean())


def test_moved_shifts_image_by_motion() -> None:
    picture, motion = texture(), STILL + np.float32([3, -2])
    np.testing.assert_allclose(moved(picture, motion)[4:-4, 4:-4], picture[6:-2, 1:-7], atol=1e-3)


def test_origin_inverts_motion() -> None:
    rows, columns = np.mgrid[: CELLS[0], : CELLS[1]].astype(np.float32)
    motion = np.stack([2 * np.sin(columns / 5), 1.5 * np.cos(rows / 4)], axis=2)
    came = origin(motion)
    starts = columns - came[..., 0] / CELL_PX, rows - came[..., 1] / CELL_PX
    there = cv2.remap(motion, *starts, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    assert np.abs(there - came).max() < 0.05


def test_expected_picture_of_still_scene_is_unchanged() -> None:
    expected = ExpectedPicture()
    for _ in range(4):
        expected.take(as_bytes(texture()), None, STILL)
        picture = expected.after(STILL)
    np.testing.assert_allclose(picture, as_bytes(texture()), atol=0.01)


def test_expected_picture_reduces_noise() -> None:
    expected, clean = ExpectedPicture(), texture()
    noise = np.random.default_rng(1)
    for _ in range(40):
        newest = clean + noise.normal(0, 8, clean.shape).astype(np.float32)
        expected.take(as_bytes(newest), None, STILL)
        picture = expected.after(STILL)
    assert error(picture, clean) < 0.4 * error(newest, clean)


def test_expected_picture_local_flicker_does_not_affect_other_places() -> None:
    expected, clean, flicker = ExpectedPicture(), texture(), np.random.default_rng(1)
    for _ in range(40):
        newest = clean.copy()
        newest[:, :24] += flicker.normal(0, 25)
        expected.take(as_bytes(newest), None, STILL)
        picture = expected.after(STILL)
    assert picture is not None
    assert np.abs(picture - newest)[8:-8, 48:-4].mean() < 1.0
    assert np.square(picture - clean)[:, 4:20].mean() < 0.6 * np.square(newest - clean)[:, 4:20].mean()


def test_expected_picture_without_motion_restarts_and_keeps_learned_shares() -> None:
    expected = ExpectedPicture()
    assert expected.after(STILL) is None
    expected.take(as_bytes(texture(0)), None, STILL)
    expected.take(as_bytes(texture(1)), None, None)
    np.testing.assert_allclose(expected.after(STILL), as_bytes(texture(1)), atol=0.01)


def test_expected_picture_learns_mean_of_two_alternative_motions() -> None:
    """The continuation is ambiguous: the mean of both pictures is closer to the next frame than either of them."""
    expected, chance, errors = ExpectedPicture(), np.random.default_rng(0), []
    ahead, back = STILL + np.float32([3, 0]), STILL - np.float32([3, 0])
    for _ in range(40):
        expected.take(as_bytes(texture()), None, STILL)
        picture = expected.after(ahead, [(0.5, ahead), (0.5, back)])
        came = moved(texture(), ahead if chance.random() < 0.5 else back)
        errors.append((error(picture, came), error(moved(texture(), ahead), came)))
        expected.take(as_bytes(came), None, STILL)
        expected.take(as_bytes(texture()), None, STILL)
    of_mean, of_one = np.mean(errors[20:], axis=0)
    assert of_mean < 0.7 * of_one


def test_expected_picture_does_not_learn_from_masked_pixels() -> None:
    """The right side is noise. Without a mask, its low shares are learned for the whole picture."""
    changed = []
    for masked in (True, False):
        expected, mask, noise = ExpectedPicture(), np.ones(SIZE, np.uint8), np.random.default_rng(0)
        mask[:, 32:] = 0
        for _ in range(20):
            newest = texture(0)
            newest[:, 32:] = noise.uniform(0, 255, (SIZE[0], 32, 3))
            expected.take(as_bytes(newest), mask if masked else None, STILL)
            picture = expected.after(STILL)
        assert picture is not None
        changed.append(np.abs(picture - newest)[:, 40:].mean())
    assert changed[0] < 0.2 * changed[1]
