"""The gradient of the fused frame path on CUDA against autograd through the reference in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput
from gsplat_core.ops.frame import STATUS_OVERFLOW
from gsplat_core.ops.frame_gradients import RawGradients, render_frame_backward
from gsplat_core.scene.gaussians import COLOUR
from tests.gsplat_core.cuda.frame_scenes import (
    NAMES,
    FrameScene,
    backward,
    by_name,
    forward_of_plain_ops,
    frame_scene,
    on_gpu,
    rendered,
)

MODELS = ("pinhole", "ortho", "fisheye")


def assert_near(seen: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Within 1e-3 of the norm, and value by value but for the few Gaussians that have a pixel within rounding of a cut-off."""
    for name in NAMES:
        s, w = seen[name], wanted[name]
        assert s.shape == w.shape
        assert s.isfinite().all(), name
        error = s - w
        assert error.norm() <= 1e-3 * w.norm(), (name, float(error.norm() / w.norm()))
        if w.numel():
            scale = w.abs() + 0.05 * w.square().mean().sqrt()
            off = (error.abs() > 5e-3 * scale).reshape(len(w), -1).any(1)
            assert off.sum() <= 1 + 0.01 * len(w), (name, int(off.sum()))


def check(scene: FrameScene, with_alphas: bool = True) -> RawGradients:
    gradients = backward(on_gpu(scene), with_alphas=with_alphas)
    bases = scene.sh.shape[1]
    wanted = scene.reference_gradients(with_alphas)
    assert_near(by_name(gradients, bases), wanted)
    assert not gradients.raw[:, 14:].any()
    if bases > 1:
        assert torch.equal(gradients.raw[:, COLOUR], gradients.sh[:, 0])
    if scene.deltas is not None:
        w = wanted["deltas"]
        assert (gradients.raw.cpu().double() - w).norm() <= 1e-3 * w.norm()
    return gradients


@pytest.mark.parametrize("deltas", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_frame_gradients_of_every_degree_equal_reference(degree: int, deltas: bool) -> None:
    check(frame_scene(300, degree=degree, deltas=deltas))


@pytest.mark.parametrize("camera_model", MODELS)
@pytest.mark.parametrize("with_alphas", [True, False])
def test_frame_gradients_of_every_camera_model_equal_reference(camera_model: str, with_alphas: bool) -> None:
    check(frame_scene(400, degree=2, camera_model=camera_model, background=with_alphas), with_alphas)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (33, 50), (130, 17)])
def test_frame_gradients_of_any_image_size_equal_reference(size: tuple[int, int]) -> None:
    check(frame_scene(200, *size))


@pytest.mark.parametrize("count", [1, 31, 33, 129])
def test_frame_gradients_of_any_number_of_gaussians_equal_reference(count: int) -> None:
    check(frame_scene(count, degree=3, median_px=6.0, deltas=True))


def test_frame_gradients_accept_tile_lists_of_plain_ops() -> None:
    scene = on_gpu(frame_scene(400, degree=2, deltas=True))
    seen, wanted = backward(scene, forward_of_plain_ops(scene)), backward(scene)
    for s, w in zip(seen, wanted, strict=True):  # the two forward passes round differently, next to cut-offs too
        assert (s - w).norm() <= 1e-3 * w.norm()


def test_frame_gradients_without_gaussians() -> None:
    gradients = backward(on_gpu(frame_scene(0, degree=1)))
    assert gradients.raw.shape == (0, 16)
    assert gradients.sh.shape == (0, 4, 3)


def test_frame_gradients_zero_for_gaussians_behind_camera() -> None:
    scene = frame_scene(100)
    behind = scene.viewmat.clone()
    behind[2, 3] -= 20
    gradients = backward(on_gpu(replace(scene, viewmat=behind)))
    assert not gradients.raw.any()
    assert not gradients.sh.any()


def test_frame_gradients_of_faint_opaque_and_dark_gaussians_equal_reference() -> None:
    scene = frame_scene(400, degree=1)
    scene.logit_opacities[::4] = 12.0
    scene.logit_opacities[1::4] = math.log(1.5 / 253.5)
    scene.logit_opacities[2::8] = -9.0
    scene.sh[::3, 0] = -8.0  # black, and held there by the clamp
    scene.sh[1::3, 0, 1] = -8.0
    gradients = check(scene)
    assert not gradients.sh[::3].any()
    assert not gradients.raw[1::3, 11].any()


def test_frame_gradients_of_huge_thin_and_tiny_splats_equal_reference() -> None:
    scene = frame_scene(300, 200, 150, degree=1, median_px=2.0)
    scene.log_scales[7] = 4.0
    scene.logit_opacities[7] = -1.0
    scene.log_scales[1::5] = torch.tensor([0.5, -4.0, -4.0])
    scene.log_scales[2::5] = -8.0
    check(scene)


def test_frame_gradients_of_very_many_splats_in_one_tile_equal_reference() -> None:
    scene = frame_scene(100_000, 16, 16, degree=0)
    scene.logit_opacities[:] = math.log(0.0045 / 0.9955)  # about 2,000 are blended before a pixel ends
    scene.log_scales[:] = 6.0  # over the whole tile: no pixel is near the cut-off of 1/255
    wanted = scene.reference_gradients()
    seen = by_name(backward(on_gpu(scene)), 1)
    for name in ("logit_opacities", "sh"):  # the others are next to nothing
        assert (seen[name] - wanted[name]).norm() <= 1e-3 * wanted[name].norm(), name


@pytest.mark.parametrize("deltas", [True, False])
def test_frame_gradients_zero_for_non_finite_gaussians_only(deltas: bool) -> None:
    scene = frame_scene(200, degree=1, deltas=deltas)
    tensors = [scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh.view(200, -1)]
    tensors += [] if scene.deltas is None else [scene.deltas[:, :14]]
    bad = 0
    for tensor in tensors:
        for value in (math.nan, math.inf, -math.inf):
            for column in range(0, tensor.shape[1] if tensor.ndim > 1 else 1, 2):
                tensor.view(200, -1)[bad, column] = value
                bad += 1
    scene.quats[bad], bad = 0.0, bad + 1
    if scene.deltas is not None:
        scene.deltas[bad - 1] = 0.0
    gradients = check(scene)
    assert not gradients.raw[:bad].any()
    assert not gradients.sh[:bad].any()
    assert gradients.raw[bad:].any()


def test_frame_gradients_independent_of_memory_layout() -> None:
    scene = on_gpu(frame_scene(300, degree=3, deltas=True))
    wanted = backward(scene)

    def shifted(t: Tensor) -> Tensor:
        memory = torch.empty(t.numel() + 1, device="cuda")
        return memory[1:].view(t.shape).copy_(t)

    def strided(t: Tensor) -> Tensor:
        return torch.stack([t, torch.full_like(t, math.nan)], -1)[..., 0]

    for change in (shifted, strided):
        values = {name: change(getattr(scene, name)) for name in (*NAMES, "deltas", "viewmat", "K", "background")}
        seen = backward(replace(scene, **values), rendered(scene))
        assert torch.equal(seen.raw, wanted.raw)
        assert torch.equal(seen.sh, wanted.sh)


def test_frame_gradients_are_deterministic_and_captured_in_graph() -> None:
    scene = on_gpu(frame_scene(5000, 300, 200, degree=3, deltas=True))
    forward = rendered(scene)
    wanted = backward(scene, forward)
    assert torch.equal(backward(scene, forward).raw, wanted.raw)
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    v_image, v_alphas = 3 * v_image, 3 * v_alphas
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            seen = render_frame_backward(scene.gaussians, scene.deltas, scene.view, forward, v_image, v_alphas)
    v_image /= 3
    v_alphas /= 3
    graph.replay()
    torch.cuda.synchronize()
    torch.testing.assert_close(seen.raw, wanted.raw, rtol=1e-4, atol=1e-5 * float(wanted.raw.abs().max()))
    first = seen.raw.clone(), seen.sh.clone()
    seen.raw.zero_()
    graph.replay()
    torch.cuda.synchronize()
    assert torch.equal(seen.raw, first[0])
    assert torch.equal(seen.sh, first[1])


def test_frame_gradients_with_atomic_sums_differ_by_rounding_only() -> None:
    scene = on_gpu(frame_scene(2000, 200, 150, degree=2))
    wanted, seen = backward(scene), backward(scene, deterministic=False)
    for s, w in zip(seen, wanted, strict=True):
        assert (s - w).norm() <= 1e-5 * w.norm()


def test_frame_gradients_zero_for_overflowed_frame() -> None:
    scene = on_gpu(frame_scene(300, degree=1))
    forward = rendered(scene)
    forward.status[STATUS_OVERFLOW] = 1
    gradients = backward(scene, forward)
    assert not gradients.raw.any()
    assert not gradients.sh.any()


def test_frame_backward_rejects_invalid_arguments() -> None:
    scene = on_gpu(frame_scene(20, 20, 18))
    forward = rendered(scene)
    v_image = scene.picture_gradients()[0].cuda()
    view = scene.view._replace(background=None)
    with pytest.raises(InvalidInput, match="float32"):
        render_frame_backward([t.double() for t in scene.gaussians], None, view, forward, v_image)
    with pytest.raises(InvalidInput, match="v_image"):
        render_frame_backward(scene.gaussians, None, view, forward, v_image[:5])
    with pytest.raises(InvalidInput, match="deltas"):
        render_frame_backward(scene.gaussians, torch.zeros(20, 13, device="cuda"), view, forward, v_image)
    with pytest.raises(InvalidInput, match="CUDA only"):
        on_cpu = scene.to("cpu")
        render_frame_backward(on_cpu.gaussians, None, on_cpu.view, forward, v_image.cpu())
    with pytest.raises(RuntimeError, match="tile_offsets must have"):
        short = forward._replace(tile_offsets=forward.tile_offsets[:-1])
        render_frame_backward(scene.gaussians, None, view, short, v_image)


@pytest.mark.parametrize("degree", [0, 1])
def test_frame_backward_op_passes_opcheck(degree: int) -> None:
    scene = on_gpu(frame_scene(30, 20, 18, degree=degree, deltas=degree > 0))
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    inputs = (scene.gaussians, scene.deltas, *scene.view.tensors, list(rendered(scene)[1:]), v_image, v_alphas)
    torch.library.opcheck(torch.ops.gsplat_core.render_frame_backward.default, (*inputs, 0.3, 0, True))
