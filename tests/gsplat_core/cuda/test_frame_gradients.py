"""The gradient of the fused frame path on CUDA, with and without Adam, against autograd through the reference in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput
from gsplat_core.ops.frame.frame_gradients import DC, RawGradients, render_frame_backward, render_frame_backward_adam_
from gsplat_core.reference.adam import adam_step
from tests.gsplat_core.cuda.frame_scenes import NAMES, Forward, FrameScene, forward_of_plain_ops, frame_scene

pytestmark = pytest.mark.cuda
COLUMNS = {"means": slice(0, 3), "quats": slice(3, 7), "log_scales": slice(7, 10), "logit_opacities": 13}
MODELS = ("pinhole", "ortho", "fisheye")


def on_gpu(scene: FrameScene) -> FrameScene:
    return scene.to("cuda")


def backward(scene: FrameScene, forward: Forward | None = None, with_alphas: bool = True) -> RawGradients:
    """The gradients of `scene.picture_gradients`; the scene is on the GPU."""
    v_image, v_alphas = scene.picture_gradients(with_alphas)
    return render_frame_backward(
        scene.gaussians, scene.deltas, scene.viewmat, scene.K, scene.background, forward or forward_of_plain_ops(scene),
        v_image.cuda(), None if v_alphas is None else v_alphas.cuda(), camera_model=scene.camera_model,
    )  # fmt: skip


def by_name(gradients: RawGradients, bases: int) -> dict[str, Tensor]:
    named = {name: gradients.raw[:, columns] for name, columns in COLUMNS.items()}
    named["sh"] = gradients.sh if bases > 1 else gradients.raw[:, None, DC]
    return {name: value.cpu().double() for name, value in named.items()}


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
        assert torch.equal(gradients.raw[:, DC], gradients.sh[:, 0])
    if scene.deltas is not None:
        w = wanted["deltas"]
        assert (gradients.raw.cpu().double() - w).norm() <= 1e-3 * w.norm()
    return gradients


@pytest.mark.parametrize("deltas", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_every_degree_of_spherical_harmonics(degree: int, deltas: bool) -> None:
    check(frame_scene(300, degree=degree, deltas=deltas))


@pytest.mark.parametrize("camera_model", MODELS)
@pytest.mark.parametrize("with_alphas", [True, False])
def test_every_camera_model(camera_model: str, with_alphas: bool) -> None:
    check(frame_scene(400, degree=2, camera_model=camera_model, background=with_alphas), with_alphas)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (33, 50), (130, 17)])
def test_any_image_size(size: tuple[int, int]) -> None:
    check(frame_scene(200, *size))


@pytest.mark.parametrize("count", [1, 31, 33, 129])
def test_any_number_of_gaussians(count: int) -> None:
    check(frame_scene(count, degree=3, median_px=6.0, deltas=True))


def test_no_gaussians_at_all() -> None:
    gradients = backward(on_gpu(frame_scene(0, degree=1)))
    assert gradients.raw.shape == (0, 16)
    assert gradients.sh.shape == (0, 4, 3)


def test_gaussians_behind_the_camera_get_none() -> None:
    scene = frame_scene(100)
    behind = scene.viewmat.clone()
    behind[2, 3] -= 20
    gradients = backward(on_gpu(replace(scene, viewmat=behind)))
    assert not gradients.raw.any()
    assert not gradients.sh.any()


def test_faint_opaque_and_dark_gaussians() -> None:
    scene = frame_scene(400, degree=1)
    scene.logit_opacities[::4] = 12.0
    scene.logit_opacities[1::4] = math.log(1.5 / 253.5)
    scene.logit_opacities[2::8] = -9.0
    scene.sh[::3, 0] = -2.5  # black, and held there by the clamp
    scene.sh[1::3, 0, 1] = -2.5
    gradients = check(scene)
    assert not gradients.sh[::3].any()
    assert not gradients.raw[1::3, 11].any()


def test_one_over_the_whole_screen_among_thin_and_tiny_ones() -> None:
    scene = frame_scene(300, 200, 150, degree=1, median_px=2.0)
    scene.log_scales[7] = 4.0
    scene.logit_opacities[7] = -1.0
    scene.log_scales[1::5] = torch.tensor([0.5, -4.0, -4.0])
    scene.log_scales[2::5] = -8.0
    check(scene)


def test_very_many_in_one_tile() -> None:
    scene = frame_scene(100_000, 16, 16, degree=0)
    scene.logit_opacities[:] = math.log(0.0045 / 0.9955)  # about 2,000 are blended before a pixel ends
    scene.log_scales[:] = 6.0  # over the whole tile: no pixel is near the cut-off of 1/255
    wanted = scene.reference_gradients()
    seen = by_name(backward(on_gpu(scene)), 1)
    for name in ("logit_opacities", "sh"):  # the others are next to nothing
        assert (seen[name] - wanted[name]).norm() <= 1e-3 * wanted[name].norm(), name


@pytest.mark.parametrize("deltas", [True, False])
def test_what_is_not_finite_gets_no_gradient_and_spoils_no_other(deltas: bool) -> None:
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


def test_strided_and_misaligned_inputs_give_the_same_bits() -> None:
    scene = on_gpu(frame_scene(300, degree=3, deltas=True))
    wanted = backward(scene)

    def shifted(t: Tensor) -> Tensor:
        memory = torch.empty(t.numel() + 1, device="cuda")
        return memory[1:].view(t.shape).copy_(t)

    def strided(t: Tensor) -> Tensor:
        return torch.stack([t, torch.full_like(t, math.nan)], -1)[..., 0]

    for change in (shifted, strided):
        values = {name: change(getattr(scene, name)) for name in (*NAMES, "deltas", "viewmat", "K", "background")}
        seen = backward(replace(scene, **values), forward_of_plain_ops(scene))
        assert torch.equal(seen.raw, wanted.raw)
        assert torch.equal(seen.sh, wanted.sh)


def test_the_same_bits_every_time_and_in_a_graph() -> None:
    scene = on_gpu(frame_scene(5000, 300, 200, degree=3, deltas=True))
    forward = forward_of_plain_ops(scene)
    wanted = backward(scene, forward)
    assert torch.equal(backward(scene, forward).raw, wanted.raw)
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    v_image, v_alphas = 3 * v_image, 3 * v_alphas
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            arguments = (scene.deltas, scene.viewmat, scene.K, scene.background, forward, v_image, v_alphas)
            seen = render_frame_backward(scene.gaussians, *arguments)
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


def test_a_frame_whose_lists_were_cut_teaches_nothing() -> None:
    scene = on_gpu(frame_scene(300, degree=1))
    forward = forward_of_plain_ops(scene)
    forward.status[2] = 1
    gradients = backward(scene, forward)
    assert not gradients.raw.any()
    assert not gradients.sh.any()
    state = AdamState(scene)
    raw = state.step(forward, 1)
    assert raw is not None
    assert not raw.any()
    assert all(torch.equal(a, b) for a, b in zip(state.scene.gaussians, scene.gaussians, strict=True))
    assert not any(t.any() for t in state.first)


class AdamState:
    """Gaussians that the fused step updates."""

    rates = (0.01, 0.02, 0.03, 0.04, 0.05)

    def __init__(self, scene: FrameScene) -> None:
        self.scene = replace(scene, **{name: getattr(scene, name).clone() for name in NAMES})
        self.first = [torch.zeros_like(t) for t in scene.gaussians]
        self.second = [torch.zeros_like(t) for t in scene.gaussians]
        self.skipped = torch.zeros(5, dtype=torch.int64, device="cuda")

    def step(
        self,
        forward: Forward,
        number: int,
        scale: float = 1.0,
        dtype: torch.dtype = torch.int64,
        needs_raw: bool = True,
    ) -> Tensor | None:
        s = self.scene
        v_image, v_alphas = s.picture_gradients()
        controls = torch.tensor([0.0, *self.rates], device="cuda")  # a view that starts between 16 bytes
        return render_frame_backward_adam_(
            s.gaussians, self.first, self.second, controls[1:], torch.tensor([number], dtype=dtype, device="cuda"),
            self.skipped, s.deltas, s.viewmat, s.K, s.background, forward, scale * v_image.cuda(), scale * v_alphas.cuda(),
            camera_model=s.camera_model, needs_raw=needs_raw,
        )  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_fused_adam_is_the_gradient_and_then_adam(degree: int, dtype: torch.dtype) -> None:
    scene = on_gpu(frame_scene(333, degree=degree, deltas=True))
    scene.logit_opacities[5] = math.nan
    state = AdamState(scene)
    for number in (1, 2, 1000):
        forward = forward_of_plain_ops(state.scene)
        gradients = backward(state.scene, forward)
        named = by_name(gradients, scene.sh.shape[1])
        expected = [[t.double().cpu() for t in group] for group in (state.scene.gaussians, state.first, state.second)]
        for rate, name, p, m, v in zip(state.rates, NAMES, *expected, strict=True):
            adam_step(p, named[name], m, v, number, rate, row_size=max(1, p[0].numel()))
        raw = state.step(forward, number, dtype=dtype)
        assert raw is not None
        assert torch.equal(raw, gradients.raw)
        for group, wanted in zip((state.scene.gaussians, state.first, state.second), expected, strict=True):
            for actual, exact in zip(group, wanted, strict=True):
                torch.testing.assert_close(actual.cpu().double(), exact, rtol=1e-5, atol=2e-6, equal_nan=True)
    assert not state.skipped.any()


def test_fused_adam_leaves_rows_alone_whose_gradient_is_not_finite() -> None:
    scene = on_gpu(frame_scene(100, degree=1))
    state = AdamState(scene)
    raw = state.step(forward_of_plain_ops(scene), 1, scale=1e30)
    assert raw is not None
    hidden = ~backward(scene).raw.any(1)
    for tensor, before, first in zip(state.scene.gaussians, scene.gaussians, state.first, strict=True):
        changed = (tensor != before).reshape(100, -1).any(1)
        assert tensor.isfinite().all()
        assert torch.equal(first.reshape(100, -1).any(1), changed)
    sh = (state.scene.sh != scene.sh).flatten(1).any(1)
    assert not sh.any()
    assert int(state.skipped[4]) == 100 - int(hidden.sum())
    assert raw.isfinite().all()


def test_fused_adam_without_raw_gradients_and_twice_the_same() -> None:
    scene = on_gpu(frame_scene(1000, 200, 100, degree=3))
    forward = forward_of_plain_ops(scene)
    states = [AdamState(scene) for _ in range(2)]
    for state, needs_raw in zip(states, (True, False), strict=True):
        assert (state.step(forward, 1, needs_raw=needs_raw) is None) != needs_raw
    for a, b in zip(states[0].scene.gaussians, states[1].scene.gaussians, strict=True):
        assert torch.equal(a, b)


def test_fused_adam_reads_rates_and_step_from_the_device_in_a_graph() -> None:
    scene = on_gpu(frame_scene(500, 100, 80, degree=3))
    forward = forward_of_plain_ops(scene)
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    graphed, plain = AdamState(scene), AdamState(scene)
    rates, number = torch.zeros(5, device="cuda"), torch.ones(1, dtype=torch.int32, device="cuda")
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            render_frame_backward_adam_(
                graphed.scene.gaussians, graphed.first, graphed.second, rates, number, graphed.skipped, None, scene.viewmat,
                scene.K, scene.background, forward, v_image, v_alphas,
            )  # fmt: skip
    torch.cuda.synchronize()
    for step in (1, 2, 3):
        rates.copy_(torch.tensor(AdamState.rates))
        number.fill_(step)
        graph.replay()
        torch.cuda.synchronize()
        plain.step(forward, step)
    for group in ("first", "second"):
        assert all(torch.equal(a, b) for a, b in zip(getattr(graphed, group), getattr(plain, group), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(graphed.scene.gaussians, plain.scene.gaussians, strict=True))


def test_wrong_arguments_are_refused() -> None:
    scene = on_gpu(frame_scene(20, 20, 18))
    forward = forward_of_plain_ops(scene)
    v_image = scene.picture_gradients()[0].cuda()
    camera = (scene.viewmat, scene.K, None, forward)
    with pytest.raises(InvalidInput, match="float32"):
        render_frame_backward([t.double() for t in scene.gaussians], None, *camera, v_image)
    with pytest.raises(InvalidInput, match="v_image"):
        render_frame_backward(scene.gaussians, None, *camera, v_image[:5])
    with pytest.raises(InvalidInput, match="deltas"):
        render_frame_backward(scene.gaussians, torch.zeros(20, 13, device="cuda"), *camera, v_image)
    with pytest.raises(InvalidInput, match="CUDA only"):
        on_cpu = scene.to("cpu")
        render_frame_backward(on_cpu.gaussians, None, on_cpu.viewmat, on_cpu.K, None, forward, v_image.cpu())
    with pytest.raises(RuntimeError, match="tile_offsets must have"):
        short = forward._replace(tile_offsets=forward.tile_offsets[:-1])
        render_frame_backward(scene.gaussians, None, *camera[:3], short, v_image)


@pytest.mark.parametrize("degree", [0, 1])
def test_ops_pass_opcheck(degree: int) -> None:
    scene = on_gpu(frame_scene(30, 20, 18, degree=degree, deltas=degree > 0))
    f = forward_of_plain_ops(scene)
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    state = AdamState(scene)
    lists = (f.records, f.tile_offsets, f.sorted, f.splat_starts, f.instance_splats, f.status, f.alphas, f.last)
    inputs = (scene.deltas, scene.viewmat, scene.K, scene.background, *lists, v_image, v_alphas)
    sizes = (scene.width, scene.height, 0.3, 0)
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.render_frame_backward.default, (*scene.gaussians, *inputs, *sizes))
    rates, step = torch.full((5,), 0.01, device="cuda"), torch.ones(1, dtype=torch.int64, device="cuda")
    arguments = (*inputs, *state.first, *state.second, rates, step, state.skipped, *sizes, 0.9, 0.999, 1e-8, degree > 0)
    torch.library.opcheck(ops.render_frame_backward_adam_.default, (*state.scene.gaussians, *arguments))
