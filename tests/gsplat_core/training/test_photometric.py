"""The hand-written training gradient equals render, loss and autograd, and the float64 reference."""

import numpy as np
import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.photometric import LossWeights, loss_and_gradients

WIDTH_PX, HEIGHT_PX = 53, 37
MOVED = np.array(
    [[0.9950042, 0, 0.0998334, 1.5], [0, 1, 0, -2.0], [-0.0998334, 0, 0.9950042, 4.0], [0, 0, 0, 1]], dtype=np.float64
)


def observation(model="pinhole", pose=None, depth=True, tool=True, seed=0, width=WIDTH_PX, height=HEIGHT_PX):
    random = np.random.default_rng(seed)
    K = np.array([[90.0, 0, width / 2 + 1], [0, 95.0, height / 2 - 2], [0, 0, 1]])
    camera = Camera(K, width, height, model=model)
    mask = np.ones((height, width), np.uint8)
    if tool:
        mask[: height // 2, : width // 3] = 0
    z = random.uniform(50, 70, (height, width)).astype(np.float32)
    z[random.random(z.shape) < 0.2] = 0
    frame = Frame(
        0,
        0,
        random.integers(0, 256, (height, width, 3), dtype=np.uint8),
        depth=z if depth else None,
        mask=mask,
        pose=pose,
    )
    return Observation.of(frame, camera)


def by_autograd(gaussians, seen, weights):
    """Loss and gradients from the public, differentiable functions."""
    leaves = gaussians.detach().clone().requires_grad_()
    use_depth = weights.depth > 0 and seen.depth is not None
    image, _, depth = render(leaves, seen.camera, depth=use_depth)
    loss = image_loss(
        image,
        seen.image,
        seen.mask,
        depth if use_depth else None,
        seen.depth if use_depth else None,
        weights.ssim,
        weights.depth,
        weights.squared,
    ).loss
    loss.backward()
    return float(loss.detach()), {name: tensor.grad for name, tensor in leaves.tensors().items()}


@pytest.mark.parametrize("sh_degree", [0, 3])
@pytest.mark.parametrize(
    "weights",
    [LossWeights(), LossWeights(ssim=0.3), LossWeights(depth=5.0), LossWeights(0.2, 5.0), LossWeights(squared=True)],
)
@pytest.mark.parametrize(("model", "pose"), [("pinhole", None), ("pinhole", MOVED), ("fisheye", MOVED)])
def test_loss_and_gradients_equal_render_and_autograd(make_gaussians, assert_near, sh_degree, weights, model, pose):
    gaussians, seen = make_gaussians(150, sh_degree), observation(model, pose)
    loss, gradients, *_ = loss_and_gradients(gaussians, seen, weights)
    expected_loss, expected = by_autograd(gaussians, seen, weights)
    assert loss == pytest.approx(expected_loss, rel=1e-6)
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        assert gradient.shape == expected[name].shape
        assert float(expected[name].abs().max()) > 0
        assert_near(gradient, expected[name], relative=1e-4, of_largest=1e-5)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_loss_and_gradients_equal_float64_reference(make_gaussians, assert_near, sh_degree):
    seen, weights = observation(pose=MOVED, width=21, height=18), LossWeights(0.2, 5.0)
    gaussians = make_gaussians(25, sh_degree)
    loss, gradients, *_ = loss_and_gradients(gaussians, seen, weights)
    exact = gaussians.to(dtype=torch.float64).requires_grad_()
    colors, _, _ = reference.rasterization(
        exact.means,
        exact.quats,
        exact.scales,
        exact.opacities,
        exact.sh,
        torch.tensor(seen.camera.world_to_camera)[None],
        torch.tensor(seen.camera.K)[None],
        seen.camera.width_px,
        seen.camera.height_px,
        sh_degree=sh_degree,
        packed=False,
        render_mode="RGB+ED",
    )
    expected = reference.image_loss(
        colors[0, ..., :3], seen.image, seen.mask, colors[0, ..., 3], seen.depth.double(), weights.ssim, weights.depth
    ).loss
    expected.backward()
    assert loss == pytest.approx(float(expected.detach()), rel=1e-5)
    for name, tensor in exact.tensors().items():
        assert_near(gradients[name], tensor.grad, of_largest=1e-4)


def test_depth_weight_has_no_effect_without_depth(make_gaussians):
    gaussians, seen = make_gaussians(80), observation(depth=False)
    loss, gradients, *_ = loss_and_gradients(gaussians, seen, LossWeights(depth=3.0))
    plain_loss, plain, *_ = loss_and_gradients(gaussians, seen, LossWeights())
    assert loss == plain_loss
    assert all(torch.equal(gradients[name], plain[name]) for name in plain)


def test_loss_and_gradients_ignore_masked_pixels(make_gaussians):
    gaussians, seen = make_gaussians(80), observation()
    other = seen.image.clone()
    other[seen.mask == 0] = 255 - other[seen.mask == 0]
    loss, gradients, *_ = loss_and_gradients(gaussians, seen, LossWeights(0.2))
    changed = Observation(seen.seq, seen.time_s, seen.camera, other, seen.mask, seen.depth)
    other_loss, other_gradients, *_ = loss_and_gradients(gaussians, changed, LossWeights(0.2))
    assert loss == other_loss
    assert all(torch.equal(gradients[name], other_gradients[name]) for name in gradients)


@pytest.mark.parametrize("weights", [LossWeights(), LossWeights(0.2, 0.1)])
def test_loss_without_gaussians_is_loss_of_black_picture(make_gaussians, weights):
    seen = observation(tool=False)
    loss, gradients, *_ = loss_and_gradients(make_gaussians(0), seen, weights)
    black = torch.zeros(HEIGHT_PX, WIDTH_PX, 3)
    assert loss == pytest.approx(float(image_loss(black, seen.image, ssim_weight=weights.ssim).loss))
    assert all(gradient.shape[0] == 0 for gradient in gradients.values())


@pytest.mark.parametrize(
    ("name", "bad"),
    [(name, float("nan")) for name in ("means", "quats", "log_scales", "logit_opacities", "sh")]
    + [(name, float("inf")) for name in ("means", "quats", "log_scales", "sh")],
)
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_non_finite_gaussian_does_not_change_other_gradients(make_gaussians, name, sh_degree, bad):
    gaussians, seen = make_gaussians(40, sh_degree), observation()
    gaussians.means[7] = torch.tensor([1.0, 2.0, 50.0])  # in the middle of the picture
    others = torch.arange(40) != 7
    broken = gaussians.clone()
    broken.tensors()[name][7, ...] = bad
    loss, gradients, *_ = loss_and_gradients(broken, seen, LossWeights(0.2, 0.1))
    expected_loss, expected, *_ = loss_and_gradients(gaussians.select(others), seen, LossWeights(0.2, 0.1))
    assert loss == expected_loss
    for key, gradient in gradients.items():
        torch.testing.assert_close(gradient[others], expected[key], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (16, 16)])
def test_loss_and_gradients_at_odd_picture_sizes(make_gaussians, assert_near, size):
    gaussians, seen = make_gaussians(30), observation(tool=False, width=size[0], height=size[1])
    loss, gradients, *_ = loss_and_gradients(gaussians, seen, LossWeights(0.2, 1.0))
    expected_loss, expected = by_autograd(gaussians, seen, LossWeights(0.2, 1.0))
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    for name, gradient in gradients.items():
        assert_near(gradient, expected[name], relative=1e-3, of_largest=1e-4)


def test_loss_and_gradients_are_identical_for_any_thread_count(make_gaussians):
    # More than 32768 Gaussians: from there on torch splits elementwise work among its threads.
    gaussians, seen = make_gaussians(50_016), observation()
    gaussians.logit_opacities.mul_(3)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            loss, gradients, *_ = loss_and_gradients(gaussians, seen, LossWeights(0.2, 0.1))
            results.append((loss, gradients | {"opacities": gaussians.opacities}))
    finally:
        torch.set_num_threads(before)
    for loss, gradients in results[1:]:
        assert loss == results[0][0]
        assert all(torch.equal(gradient, results[0][1][name]) for name, gradient in gradients.items())
