"""Points, distances and lengths on a surface that is given in arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry import measure
from gsplat_core.geometry.measure import Measurement
from gsplat_core.scene.cameras import Camera

WIDTH, HEIGHT = 40, 30


def measurement(depth: Any = 50.0, median: Any = 50.0, pose: np.ndarray | None = None, **changed: Any) -> Measurement:
    made = object.__new__(Measurement)
    camera = Camera.from_focal(50.0, WIDTH, HEIGHT)
    made.camera = camera if pose is None else camera.with_pose(pose)
    whole = lambda value: np.broadcast_to(np.asarray(value, np.float64), (HEIGHT, WIDTH)).copy()
    values = {"alpha": 1.0, "ray_depth": depth, "median_depth": median, "spread": 7.0, "confidence": 0.8, **changed}
    made._surface = {name: whole(value) for name, value in values.items()}
    made._relative_error, made._splat_px = 0.02, 4.0
    return made


@pytest.mark.parametrize(
    ("x", "y", "is_inside"),
    [(0, 0, True), (39.99, 29.99, True), (-0.01, 5, False), (5, -0.01, False), (40, 5, False), (5, 30, False)],
)
def test_point_refuses_positions_outside_picture(x: float, y: float, is_inside: bool) -> None:
    if not is_inside:
        with pytest.raises(InvalidSetting, match="outside of the picture of 40x30 px"):
            measurement().point(x, y)
        return
    point = measurement().point(x, y)
    assert point.pixel == (int(x) + 0.5, int(y) + 0.5)
    assert point.position == pytest.approx(((point.pixel[0] - 20) * 50 / 50, (point.pixel[1] - 15) * 50 / 50, 50))


@pytest.mark.parametrize(
    ("changed", "is_observed"),
    [({"alpha": measure.COVERED}, True), ({"alpha": measure.COVERED - 1e-6}, False), ({"depth": 0.0}, False), ({"depth": -1.0}, False)],
)  # fmt: skip
def test_point_refuses_unobserved_pixel(changed: dict[str, float], is_observed: bool) -> None:
    if is_observed:
        assert measurement(**changed).point(5, 5).depth == 50
    else:
        with pytest.raises(InvalidSetting, match=r"nothing was observed at \(5, 5\): the opacity there is"):
            measurement(**changed).point(5, 5)


@pytest.mark.parametrize(("median", "split"), [(50.0, 0.0), (47.0, 3.0), (54.0, 4.0), (0.0, 7.0)])
def test_depth_error_combines_source_and_surface_split(median: float, split: float) -> None:
    """A pixel without a median depth has the spread of its depths."""
    point = measurement(median=median).point(5, 5)
    assert point.source_error == pytest.approx(1.0) and point.depth_error == pytest.approx(math.hypot(split, 1.0))
    assert (point.opacity, point.confidence) == (1.0, 0.8)


def test_point_position_and_ray_are_in_world_coordinates() -> None:
    pose = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 7], [0, 0, 0, 1]])
    point = measurement(pose=pose).point(30, 15)
    local = pose[:3, :3] @ np.array(point.position) + pose[:3, 3]
    np.testing.assert_allclose(local, [10.5, 0.5, 50])
    np.testing.assert_allclose(pose[:3, :3] @ np.array(point.along_ray), [10.5 / 50, 0.5 / 50, 1])


def test_distance_error_has_common_and_end_parts() -> None:
    """Half of the variance of the source is common to the scene and grows with the distance; the rest is of each end."""
    made = measurement(median=np.where(np.arange(WIDTH) < 20, 50, 53))
    first, second = made.point(5, 15), made.point(35, 15)
    found = made.distance(first, second)
    assert found.value == pytest.approx(30)
    along = [abs(point.along_ray[0]) for point in (first, second)]
    own = [math.sqrt(0.5), math.sqrt(0.5 + 9)]
    assert found.error == pytest.approx(math.hypot(own[0] * along[0], own[1] * along[1], math.sqrt(0.5) * 0.02 * 30))
    same = made.distance(first, first)
    assert (same.value, same.error) == (0, 0)


@pytest.mark.parametrize(("apart_px", "steps"), [(0, 1), (1, 1), (2, 1), (3, 2), (10, 5), (25, 12)])
def test_path_steps_are_two_pixels(apart_px: int, steps: int) -> None:
    made = measurement()
    assert made._steps(made.point(3, 5), made.point(3 + apart_px, 5)) == steps


def test_length_along_plane_equals_distance() -> None:
    x = np.arange(WIDTH) + 0.5
    made = measurement(depth=1 / (1 / 50 + 2e-4 * (x - 20)))
    first, second = made.point(5, 5), made.point(35, 25)
    along, straight = made.length_along(first, second), made.distance(first, second)
    assert along.value == pytest.approx(straight.value, rel=1e-3)
    assert along.error == pytest.approx(straight.error, rel=0.02)
    assert made.length_along(first, first).value == 0


def test_length_error_grows_with_detour_and_smoothing() -> None:
    x = np.arange(WIDTH) + 0.5
    hill = measurement(depth=50 - 15 * np.exp(-(((x - 20) / 6) ** 2)))
    hill._splat_px = 0.1  # no smoothing
    ends = hill.point(2, 15), hill.point(37, 15)
    along, straight = hill.length_along(*ends), hill.distance(*ends)
    assert along.value > 1.1 * straight.value
    assert along.error == pytest.approx(straight.error * along.value / straight.value)
    rough = measurement(depth=50 + 2.0 * (np.arange(WIDTH) % 4 < 2))
    ends = rough.point(2, 15), rough.point(34, 15)
    found, raw = rough.length_along(*ends), 0.0
    rough._splat_px = 1e-3
    raw = rough.length_along(*ends).value
    assert raw > found.value + 1
    straight = rough.distance(*ends)
    detour = max(1.0, found.value / straight.value)
    assert found.error == pytest.approx(math.hypot(straight.error * detour, 0.2 * (raw - found.value)), rel=1e-3)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 4.0, 50.0])
def test_smoothed_line_keeps_slope_and_ends(sigma: float) -> None:
    line = 3 + 0.5 * np.arange(20.0)
    np.testing.assert_allclose(measure._smoothed(line, sigma), line)
    bent = line + np.random.default_rng(0).normal(size=20)
    found = measure._smoothed(bent, sigma)
    assert found.shape == bent.shape
    np.testing.assert_allclose(found[[0, -1]], bent[[0, -1]])
    assert measure._smoothed(bent[:1], sigma).tolist() == bent[:1].tolist()


def test_smoothed_kernel_is_gaussian_of_three_standard_deviations() -> None:
    one = np.zeros(41)
    one[20] = 1
    found = measure._smoothed(one, 2.0)
    taps = np.exp(-0.5 * (np.arange(-6, 7) / 2) ** 2)
    np.testing.assert_allclose(found[14:27], taps / taps.sum())
    assert not found[:14].any() and not found[27:].any()
