"""Parts of the start of a scene, in closed form: grid, points and sizes of pixels, colours at tools, filling and blur."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training import initialisation
from gsplat_core.training.initialisation import (
    StartOnDevice,
    blur_sigma_px,
    colours_beside_tools,
    depth_at_pixels,
    filled,
    gaussians_at_pixels,
    jittered_grid,
    tissue_colours,
    tissue_depth,
)
from gsplat_core.training.observations import unprojected

K = np.array([[50.0, 0, 40], [0, 60, 30], [0, 0, 1]])


@pytest.mark.parametrize(("width", "height", "count"), [(120, 80, 96), (80, 120, 96), (33, 17, 40), (5, 300, 3)])
def test_jittered_grid_is_even_with_bounded_jitter(width, height, count):
    pixels, spacing = jittered_grid(width, height, count, 3)
    assert spacing == pytest.approx(np.sqrt(width * height / count))
    columns, rows = max(1, round(width / spacing)), max(1, round(height / spacing))
    assert len(pixels) == columns * rows
    cell = np.array([width / columns, height / rows])
    centres = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), -1).reshape(-1, 2)
    off = pixels / cell - centres
    assert np.abs(off).max() <= 0.15 and (len(pixels) < 30 or np.abs(off).max(0).min() > 0.1)
    assert not np.array_equal(pixels, jittered_grid(width, height, count, 4)[0])


def project(camera, points):
    """Project points [M, 3] by the model's definition."""
    x, y, z = points.T
    if camera.model == "ortho":
        plane = points[:, :2]
    elif camera.model == "fisheye":
        radius = np.hypot(x, y)
        plane = points[:, :2] * (np.arctan2(radius, z) / np.maximum(radius, 1e-12))[:, None]
    else:
        plane = points[:, :2] / z[:, None]
    return plane * np.diag(camera.K)[:2] + camera.K[:2, 2]


@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_unprojected_points_and_pixel_sizes(model):
    camera = Camera(K * [[1], [50 / 60], [1]], 80, 60, model=model)
    pixels = np.random.default_rng(0).uniform([0, 0], [80, 60], (60, 2))
    pixels[0] = camera.K[:2, 2]  # the principal point, whose angle is 0
    z = np.random.default_rng(1).uniform(30, 60, 60)
    points, size = unprojected(pixels, z, camera)
    np.testing.assert_allclose(points[:, 2], z)
    np.testing.assert_allclose(project(camera, points), pixels, atol=1e-8)
    # The area of a pixel on a plane of constant depth, by finite differences.
    step = 1e-4
    right, below = (unprojected(pixels + offset, z, camera)[0] - points for offset in ([step, 0], [0, step]))
    area = np.abs(right[:, 0] * below[:, 1] - right[:, 1] * below[:, 0]) / step**2
    np.testing.assert_allclose(size**2, area, rtol=2e-3)


def test_unprojected_fisheye_angle_is_limited_to_85_degrees():
    camera = Camera(np.array([[20.0, 0, 40], [0, 20, 30], [0, 0, 1]]), 80, 60, model="fisheye")
    angles = np.radians([80.0, 85.0, 90.0, 110.0])
    pixels = np.stack([40 + 20 * angles, np.full(4, 30.0)], 1)
    points, size = unprojected(pixels, np.full(4, 10.0), camera)
    found = np.degrees(np.arctan2(points[:, 0], points[:, 2]))
    np.testing.assert_allclose(found, [80, 85, 85, 85], atol=1e-6)
    assert np.isfinite(size).all()


@pytest.mark.parametrize(("spacing", "sigma"), [(0.5, 0.3), (1.0, 0.3), (2.0, 0.6), (10.0, 3.0)])
def test_blur_sigma_is_three_tenths_of_spacing(spacing, sigma):
    assert blur_sigma_px(spacing) == pytest.approx(sigma)


@pytest.mark.parametrize("spacing", [0.5, 3.1, 12.0])
@pytest.mark.parametrize(
    ("left", "top", "right", "bottom"), [(0, 0, 80, 60), (0, 0, 1, 60), (70, 20, 80, 21), (31, 17, 45, 40)]
)
def test_colours_at_some_pixels_are_those_of_blurred_picture(spacing, left, top, right, bottom):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (60, 80, 3), np.uint8)
    pixels = rng.uniform((left, top), (right, bottom), (25, 2))
    made = gaussians_at_pixels(
        pixels, spacing, image, np.full(25, 50, np.float32), Camera.from_focal(60.0, 80, 60), sh_degree=0
    )
    blurred = cv2.GaussianBlur(image, (0, 0), blur_sigma_px(spacing))
    expected = blurred[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] / 255
    np.testing.assert_allclose(made.sh[:, 0] * initialisation.SH_C0 + 0.5, expected, atol=1e-6)


def test_gaussians_at_no_pixels_are_none():
    nothing = np.zeros((0, 2)), 2.0, np.zeros((8, 8, 3), np.uint8), np.zeros(0, np.float32)
    assert gaussians_at_pixels(*nothing, Camera.from_focal(8.0, 8, 8), sh_degree=1).count == 0


def test_gaussians_at_pixels_cover_picture_and_face_camera():
    camera = Camera.from_focal(60.0, 64, 48)
    pixels, spacing = jittered_grid(64, 48, 300, 0)
    image, depth = np.full((48, 64, 3), 120, np.uint8), np.full(len(pixels), 50, np.float32)
    made = gaussians_at_pixels(pixels, spacing, image, depth, camera, sh_degree=1)
    widths = made.log_scales.exp() * 60 / 50 / spacing
    assert torch.allclose(widths[:, :2], torch.tensor(0.7), rtol=1e-4)
    assert torch.allclose(widths[:, 2], torch.tensor(0.21), rtol=1e-4)
    output = render(made, camera)
    inner = output.alpha[4:-4, 4:-4]
    assert float(inner.min()) > 0.95 and float((output.image[4:-4, 4:-4] - 120 / 255).abs().max()) < 0.06
    assert torch.allclose(made.opacities, torch.tensor(0.9)) and made.sh.shape == (len(pixels), 4, 3)


def beside_a_tool(columns=40):
    """Tissue that is red at the left and green from column 20 on, beside a white tool."""
    image = np.zeros((40, 80, 3), np.uint8)
    image[:, :20], image[:, 20:columns], image[:, columns:] = (200, 0, 0), (0, 200, 0), 255
    mask = np.ones((40, 80), np.uint8)
    mask[:, columns:] = 0
    return Frame(0, 0, image, mask=mask)


def test_colours_beside_tools_reach_ten_pixels():
    frame = beside_a_tool()
    found = colours_beside_tools(frame)
    np.testing.assert_array_equal(found[:, :38], frame.image[:, :38])  # two pixels next to a tool belong to it
    assert (found[:, 38:44] == (0, 200, 0)).all()
    reached = np.flatnonzero((found[20] == 255).all(1))[0]
    assert 44 <= reached <= 52, "farther colours of the tool are left, since no tissue is placed there"
    assert (tissue_colours(frame)[:, 42:] < 255).any(1).all(), "all of a tool is filled for a new scene"


@pytest.mark.parametrize("change", [tissue_colours, colours_beside_tools])
@pytest.mark.parametrize("value", [None, 0, 1])
def test_tissue_colours_without_tools_or_tissue_returns_image(change, value):
    frame = beside_a_tool()
    mask = None if value is None else np.full((40, 80), value, np.uint8)
    assert change(frame.with_fields(mask=mask)) is frame.image


def test_tissue_colours_drops_margin_that_would_leave_no_tissue():
    image = np.full((40, 80, 3), 255, np.uint8)
    image[10, 10] = 30, 60, 90
    mask = np.zeros((40, 80), np.uint8)
    mask[10, 10] = 1
    assert np.abs(tissue_colours(Frame(0, 0, image, mask=mask)).astype(int) - (30, 60, 90)).max() <= 1


@pytest.mark.parametrize(("depth", "expected"), [(None, 70.0), (0.0, 70.0), (np.nan, 70.0), (-5.0, 70.0), (50.0, 50.0)])
def test_tissue_depth_uses_default_for_unknown_depth(depth, expected):
    plane = None if depth is None else np.full((40, 80), depth, np.float32)
    found = tissue_depth(beside_a_tool(columns=80).with_fields(depth=plane, mask=None), 70.0)
    assert found.shape == (40, 80) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected)


def with_depth(depth: np.ndarray) -> Frame:
    return Frame(0, 0, np.zeros((*depth.shape, 3), np.uint8), depth=depth.astype(np.float32))


@pytest.mark.parametrize("enlarged", [0.5, 1, 3, 8])
def test_depth_at_pixels_keeps_known_depth_and_continues_plane(enlarged):
    """Inverse depth is linear across the picture and unknown in the left quarter, as where tissue comes into view."""
    rows, columns = np.mgrid[: int(120 * enlarged), : int(160 * enlarged)] / enlarged
    plane = 1 / (0.02 + 4e-5 * columns - 2e-5 * rows)
    frame = with_depth(np.where(columns < 40, 0, plane))
    pixels = np.array([[159.9, 3.5], [100.0, 60.2], [39.0, 100.9], [20.5, 60.5], [0.0, 0.0], [5.9, 119.9]]) * enlarged
    found = depth_at_pixels(pixels, frame, 60.0)
    exact = plane[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found[:2], exact[:2].astype(np.float32))
    np.testing.assert_allclose(found[2:], exact[2:], rtol=0.03)


@pytest.mark.parametrize(("depth", "expected"), [(None, 70.0), (0.0, 70.0), (np.nan, 70.0), (-5.0, 70.0), (50.0, 50.0)])
def test_depth_at_pixels_uses_default_for_unknown_depth(depth, expected):
    frame = Frame(0, 0, np.zeros((8, 9, 3), np.uint8))
    frame = frame if depth is None else with_depth(np.full((8, 9), depth))
    np.testing.assert_array_equal(depth_at_pixels(np.array([[0.0, 0.0], [8.5, 7.5]]), frame, 70.0), expected)


def test_depth_at_pixels_finds_known_pixels_between_samples():
    depth = np.zeros((40, 640))
    depth[3, 5] = 80.0
    found = depth_at_pixels(np.array([[5.5, 3.5], [300.0, 30.0]]), with_depth(depth), 60.0)
    assert found[0] == 80 and 40 <= found[1] <= 160


def test_depth_at_pixels_uses_depth_in_lines_between_samples():
    """A wrong depth at the only sampled pixel has no more weight than the other pixels."""
    depth = np.zeros((60, 640))
    depth[::4] = 80.0
    depth[2, 2] = 20.0
    found = depth_at_pixels(np.array([[300.0, 30.0], [630.0, 50.5], [200.0, 2.0]]), with_depth(depth), 60.0)
    np.testing.assert_allclose(found, 80, rtol=0.02)


@pytest.mark.parametrize("coarse", [1, 2, 4])
def test_filled_averages_cells_and_extrapolates_into_holes(coarse):
    values = torch.arange(64.0).repeat(48, 1)[None]
    known = torch.ones(1, 48, 64)
    known[:, :, 32:] = 0
    found = filled(values, known, coarse)
    cells = torch.nn.functional.avg_pool2d(values, coarse)
    expected = torch.nn.functional.interpolate(cells[None], size=(48, 64), mode="bilinear", align_corners=False)[0]
    inner = slice(0, 32 - 2 * coarse)
    torch.testing.assert_close(found[:, :, inner], expected[:, :, inner], rtol=1e-4, atol=1e-3)
    assert 15 < float(found[0, 24, 63]) < 32 and float(found.max()) <= 31.01


def test_filled_without_known_pixels_is_zero():
    assert torch.equal(filled(torch.ones(3, 12, 20), torch.zeros(1, 12, 20)), torch.zeros(3, 12, 20))


def test_filled_handles_sizes_that_are_not_multiples():
    assert torch.allclose(filled(torch.full((1, 13, 21), 7.0), torch.ones(1, 13, 21)), torch.tensor(7.0))


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.3])
def test_blurred_tensor_equals_opencv(sigma):
    picture = np.random.default_rng(0).uniform(size=(40, 60, 3)).astype(np.float32)
    found = initialisation._blurred(torch.from_numpy(picture).permute(2, 0, 1), sigma).permute(1, 2, 0).numpy()
    side = 2 * max(1, int(np.ceil(3 * sigma))) + 1
    expected = cv2.GaussianBlur(picture, (side, side), sigma, borderType=cv2.BORDER_REFLECT_101)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("side", "is_blurred"), [(3, False), (4, True)])
def test_blurred_keeps_picture_smaller_than_kernel(side, is_blurred):
    picture = torch.rand(1, side, 9, generator=torch.Generator().manual_seed(0))
    assert torch.equal(initialisation._blurred(picture, 1.0), picture) != is_blurred


@pytest.mark.parametrize(
    ("changed", "fits"),
    [({}, True), ({"pose": True}, True), ({"width": 66}, False), ({"height": 50}, False), ({"focal": 61.0}, False), ({"model": "fisheye"}, False)],
)  # fmt: skip
def test_start_on_device_fits_cameras_of_same_size_and_lens(changed, fits):
    start = StartOnDevice(Camera.from_focal(60.0, 64, 48), 100, torch.device("cpu"))
    camera = Camera.from_focal(changed.get("focal", 60.0), changed.get("width", 64), changed.get("height", 48))
    if "width" in changed or "height" in changed:
        camera = Camera(start.camera.K, camera.width_px, camera.height_px)
    if "model" in changed:
        camera = Camera(camera.K, 64, 48, model=changed["model"])
    if "pose" in changed:
        camera = camera.with_pose(np.diag([-1.0, -1, 1, 1]))
    assert start.fits(camera) == fits
