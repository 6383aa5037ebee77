"""Change of illumination of tracked tissue, independent of pigment and reflections."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.experimental.shading import Follower, shaded_picture
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.geometry.lit_sheet import CAMERA, HEIGHT, WIDTH, facing_and_distance, frame, noise, pigment, rays

PLANE = np.full((HEIGHT, WIDTH), 60.0)


def change(first, second):
    return Follower(shaded_picture(first, CAMERA)).change_to(shaded_picture(second, CAMERA))


def test_light_change_of_tilting_tissue_independent_of_pigment():
    tilted = 60 * np.exp(0.06 * rays()[0])
    found = change(frame(0, PLANE, pigment()), frame(1, tilted, pigment()))
    light = [np.log(facing / distance**2) for facing, distance in map(facing_and_distance, (PLANE, tilted))]
    true = cv2.resize(light[1] - light[0], (40, 32), interpolation=cv2.INTER_AREA)
    assert found.is_followed and found.known.mean() > 0.7
    assert np.abs((found.brighter - true)[found.known]).mean() < 0.2 * np.abs(true[found.known]).mean()


def test_light_change_little_affected_by_glints():
    first, second = (frame(seed, PLANE, pigment(), noise(seed, 3) > 1.6) for seed in (11, 12))
    found = change(first, second)
    blue = [
        cv2.resize(each.image[..., 2].astype(np.float32), (40, 32), interpolation=cv2.INTER_AREA)
        for each in (first, second)
    ]
    assert np.abs(found.brighter[found.known]).mean() < 0.2 * np.abs(2.2 * np.log(blue[1] / blue[0])).mean()


def test_light_change_finds_displacement():
    picture = frame(0, PLANE, pigment()).image
    moved = cv2.warpAffine(picture, np.float32([[1, 0, 3], [0, 1, -2]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    found = change(Frame(0, 0, picture), Frame(1, 1, moved))
    assert np.allclose(np.median(found.moved[found.known], axis=0), [3 * 40 / WIDTH, -2 * 32 / HEIGHT], atol=0.05)


@pytest.mark.parametrize("other", ["unlike", "darker here and there"])
def test_light_change_does_not_follow_different_view(other):
    first = frame(0, PLANE, pigment())
    second = {
        "unlike": frame(1, PLANE, pigment(seed=8)),
        "darker here and there": frame(1, 60 * np.exp(0.8 * np.abs(rays()[0])), pigment()),
    }[other]
    assert not change(first, second).is_followed


def test_light_change_unknown_under_tool():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, 100:] = 0
    found = change(frame(0, PLANE, pigment()), frame(1, PLANE, pigment(), mask=mask))
    assert not found.known[:, 26:].any() and found.known[:, 4:20].all()


def test_light_change_does_not_follow_black_frame():
    assert not change(frame(0, PLANE, pigment()), Frame(1, 1, np.zeros((HEIGHT, WIDTH, 3), np.uint8))).is_followed
