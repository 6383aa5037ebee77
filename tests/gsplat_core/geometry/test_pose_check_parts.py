"""Robust depth of followed corners and the warp of a sweep, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import multiview
from gsplat_core.scene.cameras import Camera

FOCAL_PX = 100.0


def sightings(inverse, off_px=0.0):
    """Two views that moved by 1 and 2 to the side, of corners at these inverse depths."""
    inverse = np.asarray(inverse)
    c = np.zeros((2, len(inverse), 2))
    c[0, :, 0], c[1, :, 0] = 1.0, 2.0
    d = c * inverse[:, None]
    d[:, :, 0] += np.asarray(off_px) / FOCAL_PX
    return c, d, np.ones((2, len(inverse)), bool)


def test_agreement_weights_fall_beyond_half_a_pixel():
    c, d, _ = sightings([0.02] * 4, [0.0, 0.5, 1.0, 5.0])
    found = multiview._agreement(c, d, FOCAL_PX, np.full(4, 0.02))
    np.testing.assert_allclose(found, [[1, 1, 0.5, 0.1]] * 2)


def test_plane_is_robust_to_one_moving_corner():
    c, d, seen = sightings([0.02] * 9, [0.0] * 8 + [30.0])
    assert multiview._plane(c, d, seen, FOCAL_PX) == pytest.approx(0.02, abs=4e-4)
    seen[:, -1] = False
    assert multiview._plane(c, d, seen, FOCAL_PX) == pytest.approx(0.02)


def test_relief_is_pulled_to_plane_by_prior():
    """Information 5 * (100 / 0.5)² of both views, against 1 / (0.5 * 0.02)² of the prior."""
    c, d, seen = sightings([0.0215])
    information, prior = 5 * 200.0**2, 1 / 0.01**2
    expected = (information * 0.0215 + prior * 0.02) / (information + prior)
    assert multiview._relief(c, d, seen, FOCAL_PX, 0.02) == pytest.approx([expected])
    assert multiview._relief(c, d, ~seen, FOCAL_PX, 0.02) == pytest.approx([0.02])


@pytest.mark.parametrize(("inverse", "bound"), [(10.0, 0.08), (-10.0, 0.005)])
def test_relief_is_limited_to_factor_four_of_plane(inverse, bound):
    c, d, seen = sightings([inverse])
    assert multiview._relief(1000 * c, 1000 * d, seen, FOCAL_PX, 0.02) == pytest.approx([bound])


def test_medians_use_only_followed_corners():
    found = multiview._medians(np.array([[1.0, 2, 9], [4, 5, 6]]), np.array([[1, 1, 0], [1, 1, 1]], bool))
    assert found.tolist() == [1.5, 5.0]


def moved_camera():
    pose = np.eye(4)
    angle = 0.1
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 2.0, -1.0, 3.0
    return Camera.from_focal(FOCAL_PX, 64, 48).with_pose(pose)


def test_plane_homography_and_terms_equal_projection():
    first, second = Camera.from_focal(FOCAL_PX, 64, 48), moved_camera()
    point = np.array([4.0, -3.0, 50.0])
    pixel = first.K @ point
    there = second.K @ (second.world_to_camera[:3, :3] @ point + second.world_to_camera[:3, 3])
    expected = there[:2] / there[2] - 0.5
    warped = multiview._plane_homographies(first, second, np.array([0.3, 1 / 50]))[1] @ [
        *(pixel[:2] / pixel[2] - 0.5),
        1,
    ]
    np.testing.assert_allclose(warped[:2] / warped[2], expected)
    # The same point by the terms of the check: w c = d.
    corners = np.array([pixel[:2] / pixel[2] - 0.5])
    c, d = multiview._terms(corners, expected[None], first, second)
    np.testing.assert_allclose(c / 50, d, atol=1e-12)


def test_whole_patches_require_seven_tissue_pixels():
    tissue = np.ones((20, 20), np.uint8)
    tissue[10, 10] = 0
    whole = multiview._whole_patches(tissue)
    assert not whole[7:14, 7:14].any() and whole[6, 10] and whole[14, 14] and whole[10, 6]
