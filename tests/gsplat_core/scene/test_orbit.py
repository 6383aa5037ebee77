"""A camera that goes round what another one looks at."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera, Orbit

POSE = np.array([[0, -1, 0, 3.0], [1, 0, 0, -2], [0, 0, 1, 5], [0, 0, 0, 1]])
START = Camera.from_focal(100.0, 64, 48, POSE)
DISTANCE = 40.0


def pivot() -> np.ndarray:
    return np.linalg.inv(START.world_to_camera) @ [0, 0, DISTANCE, 1]


def test_orbit_without_turn_and_zoom_equals_start():
    np.testing.assert_allclose(Orbit().camera(START, DISTANCE).world_to_camera, POSE, atol=1e-12)


@pytest.mark.parametrize("orbit", [Orbit(30, 0), Orbit(0, -40), Orbit(-75, 75, 4), Orbit(10, 20, 0.25)])
def test_orbit_keeps_pivot_centred_at_distance(orbit):
    seen = orbit.camera(START, DISTANCE).world_to_camera @ pivot()
    np.testing.assert_allclose(seen[:3], [0, 0, DISTANCE / orbit.zoom], atol=1e-9)
    turn = orbit.camera(START, DISTANCE).world_to_camera[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_orbit_azimuth_moves_right_and_elevation_up():
    """Axes are those of the start camera: x to the right, y down."""

    def moved(orbit: Orbit) -> np.ndarray:
        centre = orbit.camera(START, DISTANCE).position
        return START.world_to_camera[:3, :3] @ centre + START.world_to_camera[:3, 3]

    x, y, z = moved(Orbit(30, 0))
    assert (x, y, z) == pytest.approx((DISTANCE * 0.5, 0, DISTANCE * (1 - np.cos(np.pi / 6))))
    x, y, z = moved(Orbit(0, 30))
    assert (x, y) == pytest.approx((0, -DISTANCE * 0.5), abs=1e-9)


@pytest.mark.parametrize("wrong", [(76, 0, 1), (0, -75.1, 1), (0, 0, 0.2), (0, 0, 5), (float("nan"), 0, 1)])
def test_orbit_rejects_values_out_of_range(wrong):
    with pytest.raises(InvalidSetting, match="must be from"):
        Orbit(*wrong)


@pytest.mark.parametrize("distance", [0.0, -1.0, float("nan"), float("inf")])
def test_orbit_rejects_invalid_distance(distance):
    with pytest.raises(InvalidInput, match="distance"):
        Orbit().camera(START, distance)
