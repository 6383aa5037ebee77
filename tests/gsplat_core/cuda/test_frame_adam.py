"""The gradient of the fused frame path with Adam in the same pass, on CUDA, against the gradient and then the reference's Adam."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core.ops.frame import STATUS_OVERFLOW, Frame
from gsplat_core.ops.frame_gradients import GaussianAdam, render_frame_backward_adam_
from gsplat_core.reference.training import adam_step
from gsplat_core.scene.gaussians import OPACITY
from tests.gsplat_core.cuda.frame_scenes import (
    NAMES,
    FrameScene,
    backward,
    by_name,
    frame_scene,
    on_gpu,
    rendered,
)


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
        forward: Frame,
        number: int,
        scale: float = 1.0,
        dtype: torch.dtype = torch.int64,
        needs_raw: bool = True,
        added: Tensor | None = None,
    ) -> Tensor | None:
        s = self.scene
        v_image, v_alphas = s.picture_gradients()
        controls = torch.tensor([0.0, *self.rates], device="cuda")  # a view that starts between 16 bytes
        adam = self.adam(controls[1:], torch.tensor([number], dtype=dtype, device="cuda"))
        return render_frame_backward_adam_(
            s.gaussians,
            adam,
            s.deltas,
            s.view,
            forward,
            scale * v_image.cuda(),
            scale * v_alphas.cuda(),
            added=added,
            needs_raw=needs_raw,
        )

    def adam(self, rates: Tensor, step: Tensor) -> GaussianAdam:
        return GaussianAdam(self.first, self.second, rates, step, self.skipped)


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_frame_adam_equals_gradient_followed_by_adam(degree: int, dtype: torch.dtype) -> None:
    scene = on_gpu(frame_scene(333, degree=degree, deltas=True))
    scene.logit_opacities[5] = math.nan
    state = AdamState(scene)
    for number in (1, 2, 1000):
        forward = rendered(state.scene)
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


def test_frame_adam_skips_rows_with_non_finite_gradient() -> None:
    scene = on_gpu(frame_scene(100, degree=1))
    state = AdamState(scene)
    raw = state.step(rendered(scene), 1, scale=1e30)
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


@pytest.mark.parametrize("degree", [0, 2])
def test_frame_adam_adds_further_gradients_except_colours(degree: int) -> None:
    scene = on_gpu(frame_scene(333, degree=degree, deltas=True))
    added = torch.randn(333, 16, generator=torch.Generator().manual_seed(1)).cuda()
    added[7] = math.nan
    state, forward = AdamState(scene), rendered(scene)
    gradients = backward(scene, forward)
    wanted = gradients.raw + torch.where(torch.arange(16, device="cuda") < 10, added, 0)
    wanted[:, OPACITY] = (gradients.raw + added)[:, OPACITY]
    named = by_name(gradients._replace(raw=wanted), scene.sh.shape[1])
    expected = [[t.double().cpu() for t in group] for group in (scene.gaussians, state.first, state.second)]
    for rate, name, p, m, v in zip(state.rates, NAMES, *expected, strict=True):
        adam_step(p, named[name], m, v, 1, rate, row_size=max(1, p[0].numel()))
    raw = state.step(forward, 1, added=added)
    assert raw is not None
    assert not raw[7].any()
    finite = torch.arange(333, device="cuda") != 7
    torch.testing.assert_close(raw[finite, :14], wanted[finite, :14])
    assert not raw[:, 14:].any()
    assert state.skipped.tolist() == [1, 1, 1, 1, 0]
    for group, exact_group in zip((state.scene.gaussians, state.first, state.second), expected, strict=True):
        for actual, exact in zip(group, exact_group, strict=True):
            torch.testing.assert_close(actual.cpu().double(), exact, rtol=1e-5, atol=2e-6)


def test_frame_adam_same_result_without_raw_gradients() -> None:
    scene = on_gpu(frame_scene(1000, 200, 100, degree=3))
    forward = rendered(scene)
    states = [AdamState(scene) for _ in range(2)]
    for state, needs_raw in zip(states, (True, False), strict=True):
        assert (state.step(forward, 1, needs_raw=needs_raw) is None) != needs_raw
    for a, b in zip(states[0].scene.gaussians, states[1].scene.gaussians, strict=True):
        assert torch.equal(a, b)


def test_frame_adam_in_graph_reads_rates_and_step_from_device() -> None:
    scene = on_gpu(frame_scene(500, 100, 80, degree=3))
    forward = rendered(scene)
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    graphed, plain = AdamState(scene), AdamState(scene)
    rates, number = torch.zeros(5, device="cuda"), torch.ones(1, dtype=torch.int32, device="cuda")
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream):
            adam = graphed.adam(rates, number)
            render_frame_backward_adam_(graphed.scene.gaussians, adam, None, scene.view, forward, v_image, v_alphas)
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


def test_frame_adam_overflowed_frame_changes_nothing() -> None:
    scene = on_gpu(frame_scene(300, degree=1))
    forward = rendered(scene)
    forward.status[STATUS_OVERFLOW] = 1
    state = AdamState(scene)
    raw = state.step(forward, 1, added=torch.ones(300, 16, device="cuda"))
    assert raw is not None
    assert not raw.any()
    assert all(torch.equal(a, b) for a, b in zip(state.scene.gaussians, scene.gaussians, strict=True))
    assert not any(t.any() for t in state.first)


@pytest.mark.parametrize("degree", [0, 1])
def test_frame_adam_op_passes_opcheck(degree: int) -> None:
    scene = on_gpu(frame_scene(30, 20, 18, degree=degree, deltas=degree > 0))
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    state = AdamState(scene)
    without_colours, added = (None, None), torch.ones(30, 16, device="cuda") if degree > 0 else None
    inputs = (scene.deltas, *scene.view.tensors, list(rendered(scene)[1:]), v_image, v_alphas, *without_colours, added)
    rates, step = torch.full((5,), 0.01, device="cuda"), torch.ones(1, dtype=torch.int64, device="cuda")
    adam = (state.scene.gaussians, state.first, state.second, rates, step, state.skipped)
    options = (0.3, 0, 0.9, 0.999, 1e-8, degree > 0, True)
    torch.library.opcheck(torch.ops.gsplat_core.render_frame_backward_adam_.default, (*adam, *inputs, *options))
