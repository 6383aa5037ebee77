"""The Gaussians that a first frame becomes: they cover it, look like it, and lie where it says."""

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.initialisation import (
    colours_beside_tools,
    facing,
    gaussians_from_frame,
    tissue_colours,
    tissue_depth,
)
from gsplat_core.training.metrics import psnr_frame_db

TURNED = np.array([[0.0, 0, 1, 5], [0, 1, 0, -3], [-1, 0, 0, 80], [0, 0, 0, 1]])


def start(frame, camera, count=400, sh_degree=0, seed=0):
    return gaussians_from_frame(frame, camera, count, sh_degree=sh_degree, default_depth_mm=60.0, seed=seed)


def rotation_of(q):
    """Rotation matrix of a unit quaternion wxyz, by q v q*."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


@pytest.mark.parametrize(("model", "focal"), [("pinhole", 50.0), ("fisheye", 40.0), ("ortho", 0.8)])
@pytest.mark.parametrize("pose", [np.eye(4), TURNED])
def test_initial_scene_covers_frame_and_matches_picture(make_frame, model, focal, pose):
    frame = make_frame()
    camera = Camera(np.array([[focal, 0, 24], [0, focal, 20], [0, 0, 1]]), 48, 40, pose, model=model)
    picture = render(start(frame, camera), camera)
    assert float(picture.alpha.min()) > 0.7  # in the corners
    assert float(picture.alpha.mean()) > 0.95
    blurred = torch.from_numpy(cv2.GaussianBlur(frame.image, (0, 0), 1.5)).float() / 255
    assert psnr_frame_db(picture.image.clamp(0, 1), blurred, None) > 20
    torch.testing.assert_close(picture.depth, torch.full((40, 48), 60.0), rtol=0.02, atol=0)


@pytest.mark.parametrize("count", [1, 7, 100, 2000])
def test_initial_scene_has_about_requested_count(make_frame, camera, count):
    assert start(make_frame(), camera, count).count == pytest.approx(count, rel=0.15)


def test_initial_scene_follows_recorded_depth(make_frame, camera):
    depth = np.linspace(45, 75, 48, dtype=np.float32)[None].repeat(40, 0)
    with_holes = depth.copy()
    with_holes[np.random.default_rng(0).random(depth.shape) < 0.3] = 0
    with_holes[5:9, 5:9] = [np.nan, np.inf, -np.inf, -1]
    gaussians = start(make_frame(depth=with_holes), camera)
    assert all(bool(tensor.isfinite().all()) for tensor in gaussians.tensors().values())
    error = (render(gaussians, camera).depth - torch.from_numpy(depth)).abs()
    assert float(error.max()) < 4
    assert float(error.mean()) < 1.2


def test_initial_scene_fills_tool_pixels_from_tissue(make_frame, camera):
    mask = np.ones((40, 48), np.uint8)
    mask[12:26, 16:34] = 0
    frame = make_frame(mask=mask, depth=np.where(mask == 1, 60.0, 30.0).astype(np.float32))
    frame.image[:] = [200, 90, 80]
    frame.image[mask == 0] = [0, 255, 255]
    picture = render(start(frame, camera), camera)
    tool = torch.from_numpy(mask == 0)
    expected = torch.tensor([200, 90, 80]) / 255
    assert float((picture.image[tool] / picture.alpha[tool, None] - expected).abs().max()) < 0.03
    assert float((picture.depth[tool] - 60).abs().max()) < 1


def test_tissue_colours_without_holes_returns_image(make_frame):
    for mask in (None, np.ones((40, 48), np.uint8), np.zeros((40, 48), np.uint8)):
        frame = make_frame(mask=mask)
        assert np.array_equal(tissue_colours(frame), frame.image)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (6, 5), (3, 40)])
def test_initial_scene_of_tiny_frames(make_frame, width, height):
    camera = Camera.from_focal(10.0, width, height)
    mask = np.ones((height, width), np.uint8)
    mask[0, 0] = 0  # all of it, in the smallest one
    frame = make_frame(width=width, height=height, mask=mask)
    gaussians = start(frame, camera, 4)
    assert gaussians.count >= 1
    assert bool(render(gaussians, camera).image.isfinite().all())


def test_tissue_colours_fills_large_hole_with_mean(make_frame):
    mask = np.ones((7, 7), np.uint8)
    mask[2:5, 2:5] = 0
    frame = make_frame(width=7, height=7, mask=mask)
    frame.image[:] = [120, 60, 30]
    frame.image[mask == 0] = 255
    assert (tissue_colours(frame) == [120, 60, 30]).all()


def test_tissue_depth_without_known_depth_is_default_plane(make_frame):
    depth = np.full((40, 48), 33.0, np.float32)
    for frame in (
        make_frame(),
        make_frame(depth=depth, mask=np.zeros((40, 48), np.uint8)),
        make_frame(depth=np.zeros((40, 48), np.float32)),
    ):
        assert (tissue_depth(frame, 60.0) == 60).all()


def test_tissue_depth_extrapolates_into_unknown_pixels(make_frame):
    depth = np.zeros((40, 48), np.float32)
    depth[:, :4], depth[:, 44:] = 50, 70
    filled = tissue_depth(make_frame(depth=depth), 60.0)
    assert (filled[:, :4] == 50).all() and (filled[:, 44:] == 70).all(), "as measured where it is known"
    middle = filled[:, 4:44].mean(axis=0)
    assert middle.min() > 48 and middle.max() < 74 and 55 < middle[20] < 65


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_initial_sh_is_zero_above_degree_0(make_frame, camera, sh_degree):
    gaussians, plain = start(make_frame(), camera, sh_degree=sh_degree), start(make_frame(), camera)
    assert gaussians.sh_degree == sh_degree
    assert torch.equal(gaussians.sh[:, :1], plain.sh)
    assert not gaussians.sh[:, 1:].any()


def test_initial_jitter_depends_on_seed(make_frame, camera):
    first, again, other = (start(make_frame(), camera, seed=seed).means for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_facing_quaternion_equals_rotation_in_all_branches():
    random = np.random.default_rng(0)
    branches = set()
    half_turns = [np.diag(signs) for signs in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    drawn = [rotation_of(q / np.linalg.norm(q)) for q in random.normal(size=(200, 4))]
    for rotation in [np.eye(3), *half_turns, *drawn]:
        q = facing(rotation)
        assert np.linalg.norm(q) == pytest.approx(1)
        np.testing.assert_allclose(rotation_of(q), rotation, atol=1e-12)
        branches.add(int(np.argmax([np.trace(rotation), *np.diag(rotation)])))
    assert branches == {0, 1, 2, 3}


def test_colours_beside_tools_replaces_tool_edges_with_tissue():
    """Only tissue and its edge count: the tool's own colours stay where no Gaussian is created."""
    image = np.full((64, 80, 3), (180, 60, 50), np.uint8)
    mask = np.ones((64, 80), np.uint8)
    mask[20:60, 30:70] = 0
    image[mask == 0] = 255
    frame = Frame(0, 0, image, mask=mask)
    found = colours_beside_tools(frame)
    assert np.abs(found[mask > 0].astype(int) - (180, 60, 50)).max() <= 1
    assert np.abs(found[20:22, 40:60].astype(int) - (180, 60, 50)).max() <= 1
    assert (image[mask == 0] == 255).all()
    assert colours_beside_tools(Frame(0, 0, image)) is image
