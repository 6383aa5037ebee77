"""Measuring on models: walls whose geometry is known, error bars against true errors, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Frame, Gaussians, Model, Reconstructor, ReconstructorConfig
from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.measure import Measurement, SurfacePoint
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthError, DepthSource

CAMERA = Camera.from_focal(60.0, 64, 48)
MEASURED = DepthSource(DEPTH_ORIGINS["measured"], metric=True)


def slope(gradient: float, distance: float = 50.0, source: DepthSource | None = MEASURED) -> Model:
    """Flat Gaussians on z = distance + gradient x."""
    angle = math.atan(gradient)
    a, b = torch.meshgrid(torch.arange(-60.0, 61), torch.arange(-45.0, 46), indexing="xy")
    a, b = a.ravel(), b.ravel()
    means = torch.stack([a * math.cos(angle), b, distance + a * math.sin(angle)], 1)
    count = len(means)
    quats = torch.tensor([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]).repeat(count, 1)
    scales = torch.tensor([1.0, 1.0, 0.02]).log().repeat(count, 1)
    gaussians = Gaussians(means, quats, scales, torch.full((count,), 6.0), torch.zeros(count, 1, 3))
    return Model(1, gaussians, None, CAMERA, (0.0, 1.0), depth_source=source)


def on_slope(x: float, y: float, gradient: float, distance: float = 50.0) -> np.ndarray:
    ray = np.array([(x - 32) / 60, (y - 24) / 60, 1.0])
    return ray * distance / (1 - gradient * ray[0])


@pytest.mark.parametrize("gradient", [0.0, 0.4, -0.6])
def test_measurement_of_points_distances_and_lengths_on_plane(gradient):
    found = Measurement(slope(gradient), 0.5)
    first, second = found.point(10.2, 12.9), found.point(50.0, 30.0)
    exact = [on_slope(10.5, 12.5, gradient), on_slope(50.5, 30.5, gradient)]
    for point, true in zip((first, second), exact, strict=True):
        assert np.linalg.norm(np.subtract(point.position, true)) < min(0.2, 2 * point.position_error)
    distance, along = found.distance(first, second), found.length_along(first, second)
    true_distance = np.linalg.norm(exact[1] - exact[0])
    assert distance.value == pytest.approx(true_distance, abs=min(0.2, 2 * distance.error))
    assert along.value == pytest.approx(true_distance, rel=0.01) and along.value >= distance.value - 1e-6
    assert 0 < distance.error < 0.05 * true_distance and along.error >= distance.error
    assert found.unit == "mm" and found.distance(first, first).value == 0


def test_measurement_distances_are_independent_of_pose():
    model = slope(0.2)
    pose = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 7], [0, 0, 0, 1]])
    turned = torch.tensor(np.linalg.inv(pose), dtype=torch.float32)
    gaussians = model.gaussians
    half = math.sqrt(0.5)  # a quarter turn the other way round z, before each Gaussian's own rotation
    w, x, y, z = gaussians.quats.unbind(1)
    quats = torch.stack([half * w + half * z, half * x + half * y, half * y - half * x, half * z - half * w], 1)
    moved = replace(gaussians, means=gaussians.means @ turned[:3, :3].T + turned[:3, 3], quats=quats)
    there = Measurement(replace(model, gaussians=moved, camera=CAMERA.with_pose(pose)), 0.0)
    here = Measurement(model, 0.0)
    ends = [(20, 20), (45, 31)]
    values = [m.distance(*(m.point(*end) for end in ends)) for m in (here, there)]
    assert values[0].value == pytest.approx(values[1].value, abs=1e-2)
    assert values[0].error == pytest.approx(values[1].error, rel=0.05)
    place = np.array([*there.point(20, 20).position, 1.0])
    assert np.allclose((pose @ place)[:3], here.point(20, 20).position, atol=1e-2)


def test_measurement_unit_and_error_by_depth_source():
    errors = []
    for source in (
        MEASURED,
        DepthSource(DEPTH_ORIGINS["stereo"], True),
        DepthSource(DEPTH_ORIGINS["light"], False),
        None,
    ):
        found = Measurement(slope(0.0, source=source), 0.0)
        assert found.unit == ("mm" if source is not None and source.metric else "relative")
        errors.append(found.point(32, 24).depth_error)
    assert errors == sorted(errors) and errors[-1] > 0.2 * 50


def test_measurement_refuses_unobserved_pixels():
    model = slope(0.0)
    some = replace(model, gaussians=model.gaussians.select(model.gaussians.means[:, 0].abs() > 8))
    found = Measurement(some, 0.0)
    left, right = found.point(10, 24), found.point(54, 24)
    assert found.distance(left, right).value > 30
    with pytest.raises(InvalidSetting, match="nothing was observed at"):
        found.point(32, 24)
    with pytest.raises(InvalidSetting, match="nothing was observed at"):
        found.length_along(left, right)
    with pytest.raises(InvalidSetting, match="outside of the picture of 64x48"):
        found.point(64, 24)
    with pytest.raises(InvalidSetting, match=r"its window is 0.000 to 1.000 s"):
        Measurement(model, 1.5)


def test_measurement_error_is_large_for_two_surfaces_at_pixel():
    near, far = slope(0.0, 40.0), slope(0.0, 50.0)
    veil = replace(near.gaussians, logit_opacities=torch.full_like(near.gaussians.logit_opacities, -3.2))
    both = Measurement(replace(near, gaussians=veil.append(far.gaussians)), 0.0)
    assert both.point(32, 24).depth_error > 8 * Measurement(far, 0.0).point(32, 24).depth_error


def test_measurement_errors_cover_true_errors_of_trained_model():
    """On a model trained on one frame with depth, most true errors are within two standard errors, and the error bars are not much wider."""
    recording = render_recording(RenderSettings(frames=1, width_px=96, height_px=80, fps=30, seed=5))
    frame = next(iter(recording))
    learning = Reconstructor(ReconstructorConfig(gaussians=2000, max_gaussians=2500), recording.camera)
    learning.observe(frame, steps=20)
    model = learning.snapshot()
    assert model.metric and model.depth_source is not None and model.depth_source.origin is DEPTH_ORIGINS["measured"]
    found = Measurement(model, 0.0)
    rng = np.random.default_rng(0)
    places = [(x, y) for x, y in rng.integers((4, 4), (92, 76), (200, 2)) if frame.mask is None or frame.mask[y, x]]
    points = [found.point(x, y) for x, y in places]
    off = np.array([point.depth - frame.depth[y, x] for point, (x, y) in zip(points, places, strict=True)])
    errors = np.array([point.depth_error for point in points])
    assert np.mean(np.abs(off) < 2 * errors) > 0.9
    assert np.median(errors) < 0.02 * np.median(frame.depth)


@pytest.mark.parametrize(
    ("first", "second", "wanted"),
    [
        (DEPTH_ORIGINS["measured"], DEPTH_ORIGINS["measured"], True),
        (DEPTH_ORIGINS["measured"], DEPTH_ORIGINS["light"], False),
        (DEPTH_ORIGINS["parallax"], DEPTH_ORIGINS["measured"], False),
        (None, DEPTH_ORIGINS["measured"], False),
    ],
)
def test_model_is_metric_only_if_all_depth_is_metric(first, second, wanted):
    learning = Reconstructor(ReconstructorConfig(gaussians=60, max_gaussians=80, first_frame_steps=1), CAMERA)
    for seq, origin in enumerate((first, second)):
        depth = None if origin is None else np.full((48, 64), 50.0, np.float32)
        image = np.full((48, 64, 3), 90, np.uint8)
        frame = Frame(seq=seq, pts_ns=seq * 10**8, image=image, depth=depth, depth_origin=origin)
        learning.observe(frame, steps=1)
    assert learning.snapshot().metric is wanted
    assert (learning.snapshot().depth_source is None) == (first is None)


def surface_point(position, depth, depth_error, along_ray) -> SurfacePoint:
    """Point whose error is that of the depth source."""
    return SurfacePoint((0.5, 0.5), position, depth, depth_error, depth_error, 1.0, 1.0, along_ray)


@pytest.mark.parametrize(
    ("second", "error"),
    [
        # Half of the variance is independent, the other half a common scale error of the mean of 3 % and 1 %.
        # Behind each other on one ray: both errors count in full.
        (surface_point((0.0, 0.0, 14.0), 20.0, 0.2, (0.0, 0.0, 1.0)), math.sqrt(0.3**2 + 0.2**2 + (0.02 * 4) ** 2)),
        # Side by side: errors along the rays are of second order, the scale error remains.
        (surface_point((3.0, 4.0, 10.0), 20.0, 0.2, (0.0, 0.0, 1.0)), 0.02 * 5),
        # On an oblique ray: the part of the error along the line between both points.
        (surface_point((5.0, 0.0, 10.0), 20.0, 0.2, (0.5, 0.0, 1.0)), math.hypot(0.1, 0.02 * 5)),
    ],
)
def test_distance_error_combines_end_errors_along_line(second, error):
    first = surface_point((0.0, 0.0, 10.0), 10.0, 0.3, (0.0, 0.0, 1.0))
    found = Measurement(slope(0.0), 0.0)
    assert found.distance(first, second).error == pytest.approx(math.sqrt(0.5) * error, rel=1e-9)
    assert found.distance(second, first).error == pytest.approx(math.sqrt(0.5) * error, rel=1e-9)


def test_point_error_includes_depth_source_error():
    """The published errors are 0.5 % of depth for measured depth, 1.25 % stereo, 5 % parallax, 15 % light, 20 % learned, 30 % unknown."""
    published = {"measured": 0.005, "stereo": 0.0125, "parallax": 0.05, "light": 0.15, "learned": 0.2, None: 0.3}
    points = {
        origin: Measurement(slope(0.0, source=origin and DepthSource(DEPTH_ORIGINS[origin], metric=True)), 0.0).point(
            20, 30
        )
        for origin in published
    }
    without = {
        origin: point.depth_error**2 - (published[origin] * point.depth) ** 2 for origin, point in points.items()
    }
    assert without[None] == pytest.approx(without["measured"], abs=1e-6 * 2500)
    np.testing.assert_allclose(list(without.values()), without["measured"], atol=1e-6 * 2500)
    assert 0 <= without["measured"] < (0.01 * 50) ** 2


def test_depth_source_errors_replace_assumed_error():
    source = replace(MEASURED, errors=(DepthError(0.2, 0.02), DepthError(0.6, 0.04)))
    model, plain = slope(0.0, source=source), Measurement(slope(0.0), 0.0).point(20, 30)
    own = plain.depth_error**2 - plain.source_error**2
    for time_s, relative in ((0.0, 0.02), (0.4, 0.03), (1.0, 0.04)):
        point = Measurement(model, time_s).point(20, 30)
        assert point.source_error == pytest.approx(relative * point.depth)
        assert point.depth_error == pytest.approx(math.sqrt(own + point.source_error**2))


def test_measured_point_is_at_pixel_centre():
    point = Measurement(slope(0.0), 0.0).point(10.9, 30.1)
    assert point.pixel == (10.5, 30.5)
    np.testing.assert_allclose(point.along_ray, [(10.5 - 32) / 60, (30.5 - 24) / 60, 1.0], atol=1e-9)
    np.testing.assert_allclose(point.position, point.depth * np.array(point.along_ray), rtol=1e-9)
    assert point.position_error == pytest.approx(point.depth_error * math.dist(point.along_ray, (0, 0, 0)))


def test_length_along_bent_path_and_error():
    """Two planes that meet in a valley: the path is longer than the straight distance, and smooth sides add no error."""
    left, right = slope(0.5).gaussians, slope(-0.5).gaussians
    model = slope(0.0)
    both = left.select(left.means[:, 0] < 0).append(right.select(right.means[:, 0] >= 0))
    found = Measurement(replace(model, gaussians=both), 0.0)
    first, second = found.point(12, 24), found.point(52, 24)
    ends = [on_slope(12.5, 24.5, 0.5), on_slope(52.5, 24.5, -0.5)]
    valley = on_slope(32.0, 24.5, 0.0)
    wanted = sum(float(np.linalg.norm(end - valley)) for end in ends)
    along, straight = found.length_along(first, second), found.distance(first, second)
    assert along.value == pytest.approx(wanted, rel=0.015) and along.value > 1.05 * straight.value
    assert straight.error <= along.error < straight.error + 0.02 * wanted


def test_length_along_is_not_increased_by_depth_jitter():
    model = slope(0.2)
    jitter = 1.5 * torch.randn(len(model.gaussians.means), generator=torch.Generator().manual_seed(1))
    means = model.gaussians.means + torch.stack([0 * jitter, 0 * jitter, jitter], 1)
    rough = Measurement(replace(model, gaussians=replace(model.gaussians, means=means)), 0.0)
    ends = [(6, 30), (58, 12)]
    true = math.dist(*(on_slope(x + 0.5, y + 0.5, 0.2) for x, y in ends))
    along, smooth = (m.length_along(*(m.point(*end) for end in ends)) for m in (rough, Measurement(model, 0.0)))
    assert smooth.value == pytest.approx(true, rel=2e-3)
    assert along.value == pytest.approx(true, rel=0.015)  # 7 % longer without the filter
    assert along.error > 1.1 * smooth.error
