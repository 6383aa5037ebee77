"""`render`, and the whole image with its gradients against the reference in float64, on every instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, rasterization, reference, render
from gsplat_core.ops.native import instruction_set

ROOT = Path(__file__).resolve().parent.parent.parent


def run(function, scene, seed=5, **options):
    """Image, alpha and the gradients of a random weighting of both."""
    leaves = scene.leaves()
    image, alpha, meta = function(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, scene.Ks,
        scene.width, scene.height, sh_degree=3, **options,
    )  # fmt: skip
    g = torch.Generator().manual_seed(seed)
    total = sum((t * torch.rand(t.shape, generator=g, dtype=torch.float64).to(t.dtype)).sum() for t in (image, alpha))
    # Where nothing is seen the reference's image hangs on no input; the compiled op's gradients are zeros then.
    gradients = torch.autograd.grad(total, leaves, allow_unused=True) if total.requires_grad else [None] * len(leaves)
    zeros = [
        torch.zeros_like(leaf) if gradient is None else gradient
        for leaf, gradient in zip(leaves, gradients, strict=True)
    ]
    return image, alpha, zeros, meta


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize(
    ("count", "batch", "cameras", "options"),
    [
        (60, (), 1, {"packed": False, "render_mode": "RGB+ED"}),
        (60, (), 1, {"packed": True, "render_mode": "RGB+D", "rasterize_mode": "antialiased"}),
        (25, (2,), 2, {"packed": True, "tile_size": 8}),
        (25, (2, 1), 2, {"packed": False, "eps2d": 0.1}),
        (1, (), 1, {}),
        (0, (), 2, {"render_mode": "RGB+ED"}),
    ],
)
def test_rasterization_image_and_gradients_match_reference(
    make_scene, assert_near, model, count, batch, cameras, options
):
    scene = make_scene(count, batch, cameras, model)
    ours = run(rasterization, scene.to(torch.float32), **options)
    exact = run(reference.rasterization, scene.to(torch.float64), **options)
    if count > 1:
        assert exact[1].max() > 0.5
    for actual, wanted in zip(ours[:2], exact[:2], strict=True):
        assert_near(actual, wanted, relative=1e-3, of_largest=1e-4)
    for actual, wanted in zip(ours[2], exact[2], strict=True):
        assert_near(actual, wanted, relative=1e-2, of_largest=1e-3)


def test_reference_gradcheck_end_to_end(make_scene):
    scene = make_scene(6, degree=1, width=12, height=9, seed=2).to(torch.float64)
    scene.opacities.clamp_(0.3, 0.7)

    def function(means, quats, scales, opacities, sh, viewmats):
        return reference.rasterization(
            means, quats, scales, opacities, sh, viewmats, scene.Ks / 5, 12, 9, sh_degree=1, render_mode="RGB+D"
        )[:2]

    assert torch.autograd.gradcheck(function, tuple(scene.leaves()), fast_mode=True, eps=1e-7, atol=1e-4)


@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
@pytest.mark.slow
def test_rasterization_equal_for_other_instruction_sets(tmp_path, make_scene, assert_near, instructions):
    scene = make_scene(80, cameras=2)
    image, alpha, gradients, _ = run(reference.rasterization, scene.to(torch.float64), render_mode="RGB+ED")
    torch.save({name: getattr(scene, name) for name in scene.__dataclass_fields__}, tmp_path / "scene.pt")
    program = (
        "import sys, torch\n"
        "from types import SimpleNamespace\n"
        "from gsplat_core import rasterization\n"
        "from gsplat_core.ops.native import instruction_set\n"
        "s = SimpleNamespace(**torch.load(sys.argv[1] + '/scene.pt'))\n"
        "leaves = [t.float().requires_grad_() for t in (s.means, s.quats, s.scales, s.opacities, s.sh, s.viewmats)]\n"
        "image, alpha, _ = rasterization(*leaves, s.Ks.float(), s.width, s.height, sh_degree=3, render_mode='RGB+ED')\n"
        "g = torch.Generator().manual_seed(5)\n"
        "sum((t * torch.rand(t.shape, generator=g, dtype=torch.float64).float()).sum() for t in (image, alpha)).backward()\n"
        "torch.save([image.detach(), alpha.detach(), [l.grad for l in leaves], instruction_set()], sys.argv[1] + '/out.pt')\n"
    )
    search = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(ROOT)]))
    environment = os.environ | {"INTRASPLAT_ISA": instructions, "PYTHONPATH": search, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=environment, check=True)
    out = torch.load(tmp_path / "out.pt")
    assert out[3] == instructions or instruction_set() == "baseline"
    assert_near(out[0], image, relative=1e-3, of_largest=1e-4)
    assert_near(out[1], alpha, relative=1e-3, of_largest=1e-4)
    for actual, wanted in zip(out[2], gradients, strict=True):
        assert_near(actual, wanted, relative=1e-2, of_largest=1e-3)


def test_rasterization_independent_of_thread_count(make_scene):
    threads = torch.get_num_threads()
    try:
        results = []
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            scene = make_scene(400, cameras=2, width=100, height=70).to(torch.float32)
            image, alpha, gradients, _ = run(rasterization, scene, packed=False)
            results.append([image, alpha, *gradients])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        for actual, wanted in zip(other, results[0], strict=True):
            assert torch.equal(actual, wanted)


CAMERA = Camera(np.array([[60.0, 0, 20.5], [0, 60, 15.5], [0, 0, 1]]), 40, 30)


def ball(opacity_logit=8.0, z=5.0, dtype=torch.float32):
    """Return one red Gaussian on the axis."""
    red = torch.tensor([[[0.5, -0.5, -0.5]]]) / 0.28209479177387814
    tensors = (
        torch.tensor([[0, 0, z]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), -1.5),
        torch.tensor([opacity_logit]),
    )
    return Gaussians(*tensors, red).to(dtype=dtype)


def test_render_single_gaussian():
    out = render(ball(), CAMERA)
    assert out.image.shape == (30, 40, 3) and out.alpha.shape == out.depth.shape == (30, 40)
    # The mean is the middle pixel's centre; alpha is clamped to 0.99.
    torch.testing.assert_close(out.image[15, 20], torch.tensor([0.99, 0, 0]), atol=1e-6, rtol=0)
    assert out.alpha[15, 20] == pytest.approx(0.99, abs=1e-6)
    torch.testing.assert_close(
        out.depth[out.alpha > 0], torch.full_like(out.depth[out.alpha > 0], 5.0), rtol=1e-4, atol=0
    )
    assert (out.depth[out.alpha == 0] == 0).all() and (out.alpha == 0).any()


def test_render_with_background_and_without_depth():
    background = torch.tensor([0.2, 0.4, 0.6])
    out = render(ball(), CAMERA, background, depth=False)
    torch.testing.assert_close(out.image[0, 0], background)
    torch.testing.assert_close(out.image[15, 20], torch.tensor([0.99, 0, 0]) + 0.01 * background, atol=1e-6, rtol=0)
    assert (out.depth == 0).all()
    with pytest.raises(InvalidInput, match=r"background must be \[3\]"):
        render(ball(), CAMERA, torch.zeros(4))


def test_render_follows_pose_and_camera_model():
    moved = np.eye(4)
    moved[:3, 3] = [0.5, 0, 0]  # the world moves right by 0.5: six pixels at z = 5
    left, right = (render(ball(), camera).alpha.sum(0).argmax() for camera in (CAMERA, CAMERA.with_pose(moved)))
    assert right - left == 6
    ortho = Camera(np.array([[6.0, 0, 20], [0, 6, 15], [0, 0, 1]]), 40, 30, model="ortho")
    near, far = (render(ball(z=z), ortho).alpha for z in (2.0, 20.0))
    torch.testing.assert_close(near, far)


def test_render_is_differentiable_and_rejects_float64():
    gaussians = ball(0.0).requires_grad_()
    out = render(gaussians, CAMERA)
    (out.image.sum() + out.depth.sum()).backward()
    for name, tensor in gaussians.tensors().items():
        assert tensor.grad is not None and tensor.grad.isfinite().all(), name
    assert gaussians.logit_opacities.grad > 0 and gaussians.means.grad[0, 2] != 0
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        render(ball(dtype=torch.float64), CAMERA)
