"""Tangents of a surface that bends and turns."""

import numpy as np
import pytest

from gsplat_core.scene.tangents import Tangents


def sheet(count=4000, seed=0):
    """Points on a plane before a camera with a focal length of 100 px, their pixels, and weights."""
    random = np.random.default_rng(seed)
    pixels = random.uniform(0, 100, (count, 2))
    points = np.column_stack([(pixels - 50) * 0.5, np.full(count, 50.0)])
    return pixels, points, random.uniform(0.1, 1, count)


def turned(points, axis, degrees):
    angle = np.radians(degrees)
    a, b = [each for each in range(3) if each != axis]
    rotation = np.eye(3)
    rotation[[a, a, b, b], [a, b, a, b]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return rotation, points @ rotation.T


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_they_turn_with_the_tissue(axis):
    pixels, points, weights = sheet()
    tangents = Tangents(pixels, weights, 100)
    rotation, moved = turned(points, axis, 20)
    np.testing.assert_allclose(tangents(points), np.broadcast_to(np.eye(3)[:2], (len(points), 2, 3)), atol=0.02)
    np.testing.assert_allclose(tangents(moved + (3, -8, 40)), tangents(points) @ rotation.T, atol=1e-6)


def test_they_follow_a_wave_that_is_wider_than_a_few_cells():
    pixels, points, weights = sheet(20_000)
    slope = 0.3 * np.cos(2 * np.pi * points[:, 0] / 40)
    points[:, 2] += 0.3 * 40 / (2 * np.pi) * np.sin(2 * np.pi * points[:, 0] / 40)
    along = Tangents(pixels, weights, 100)(points)[:, 0]
    inside = (np.abs(pixels - 50) < 35).all(axis=1)
    off = np.abs(along[:, 2] / along[:, 0] - slope)[inside]
    assert off.mean() < 0.05 and off.max() < 0.12


def test_single_points_that_are_not_followed_exactly_hardly_matter():
    pixels, points, weights = sheet()
    tangents, noise = Tangents(pixels, weights, 100), np.random.default_rng(1).normal(0, 0.2, points.shape)
    inside = (np.abs(pixels - 50) < 40).all(axis=1)
    assert np.abs(tangents(points + noise) - tangents(points))[inside].max() < 0.05


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_and_points_that_were_never_in_front_of_the_camera_have_finite_ones(count):
    pixels = np.array([[np.nan, np.nan], [1e30, -1e30]])[:count]
    assert np.isfinite(Tangents(pixels, np.ones(count), 100)(np.ones((count, 3)))).all()
