"""Weighted sums on CUDA against the reference in float64: the sums with their gradients, and the whole frame without."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from gsplat_core import Camera, Gaussians, reference
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.frame import STATUS_NEEDED, STATUS_OVERFLOW, View, render_weighted_frame
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.ops.weighted_sum import weighted_sums
from gsplat_core.rendering.weighted_sum import FACTOR, OPACITY, WeightedSumRenderer

WIDTH, HEIGHT = 70, 45


def splats(count, channels=4, seed=1):
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(count, 2, generator=g) * torch.tensor([WIDTH + 8.0, HEIGHT + 8.0]) - 4
    root = torch.randn(count, 2, 2, generator=g) * 2
    inverse = torch.linalg.inv(root @ root.transpose(1, 2) + 0.3 * torch.eye(2))
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    opacities = torch.rand(count, generator=g) * 3 - 0.7
    return means2d, conics, torch.randn(count, channels, generator=g), opacities, torch.randn(count, generator=g)


def lists_of(means2d, conics, opacities):
    spread = conics[:, 0] * conics[:, 2] - conics[:, 1].square()
    radii = (3.34 * torch.stack([conics[:, 2] / spread, conics[:, 0] / spread], 1).sqrt()).ceil().int()
    grid = TileGrid(16, -(-WIDTH // 16), -(-HEIGHT // 16))
    depths = torch.ones(1, len(means2d), device=means2d.device)
    _, ids, offsets = bin_splats(
        means2d[None], radii[None], depths, grid, conics=conics[None], opacities=opacities.abs().clamp(max=1)[None]
    )
    return offsets[0], ids


def evaluate(function, inputs):
    leaves = [t.clone().requires_grad_() for t in inputs]
    sums = function(leaves)
    weights = torch.randn(sums.shape, generator=torch.Generator().manual_seed(2))
    (sums * weights.to(sums)).sum().backward()
    return [sums.detach(), *(leaf.grad for leaf in leaves)]


def on_device(leaves):
    lists = lists_of(*(leaves[k].detach() for k in (0, 1, 3)))
    return weighted_sums(*leaves, WIDTH, HEIGHT, *lists)


@pytest.mark.parametrize("channels", [1, 3, 4, 6, 9])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_weighted_sums_values_and_gradients_equal_reference(gpu, assert_near, count, channels):
    inputs = splats(count, channels)
    ours = evaluate(on_device, [t.to(gpu) for t in inputs])
    exact = evaluate(lambda leaves: reference.weighted_sums(*leaves, WIDTH, HEIGHT), [t.double() for t in inputs])
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), wanted, of_largest=2e-5)


def test_weighted_sums_deterministic_and_independent_of_order(gpu):
    inputs = [t.to(gpu) for t in splats(3000)]
    first, again = evaluate(on_device, inputs), evaluate(on_device, inputs)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(3)).to(gpu)
    turned = evaluate(on_device, [t[order] for t in inputs])
    assert torch.equal(turned[0], first[0])
    assert all(torch.equal(a, b[order]) for a, b in zip(turned[1:], first[1:], strict=True))


def test_weighted_sums_of_splat_larger_than_image(gpu, assert_near):
    inputs = list(splats(40))
    inputs[1][::4] *= 1e-4
    ours = evaluate(on_device, [t.to(gpu) for t in inputs])
    exact = evaluate(lambda leaves: reference.weighted_sums(*leaves, WIDTH, HEIGHT), [t.double() for t in inputs])
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), wanted, of_largest=5e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 3e38])
@pytest.mark.parametrize("at", range(5))
def test_weighted_sums_invalid_splat_does_not_affect_others(gpu, at, value):
    inputs = [t.to(gpu) for t in splats(60)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    inputs[at][0] = value
    leaves = [t.requires_grad_() for t in inputs]
    sums = weighted_sums(*leaves, WIDTH, HEIGHT, *lists)
    sums.sum().backward()
    assert sums.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


def test_weighted_sums_skip_invalid_lists(gpu):
    inputs = [t.to(gpu) for t in splats(5)]
    offsets, ids = lists_of(inputs[0], inputs[1], inputs[3])
    wrong = torch.full_like(ids, 7)
    assert not weighted_sums(*inputs, WIDTH, HEIGHT, offsets, wrong).any()
    assert weighted_sums(*inputs, WIDTH, HEIGHT, offsets - 1000, ids).isfinite().all()


def test_weighted_sums_replayed_graph_equals_eager(gpu):
    inputs = [t.to(gpu) for t in splats(300)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    v_sums = torch.rand(5, HEIGHT, WIDTH, device=gpu)
    ops = torch.ops.gsplat_core

    def run():
        return (
            ops.weighted_sums(*inputs, *lists, WIDTH, HEIGHT),
            *ops.weighted_sums_backward(*inputs, *lists, WIDTH, HEIGHT, v_sums),
        )

    wanted = run()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        seen = run()
    graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(seen, wanted, strict=True))


def test_weighted_sums_pass_opcheck(gpu):
    inputs = [t.to(gpu) for t in splats(20)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    torch.library.opcheck(
        torch.ops.gsplat_core.weighted_sums.default, (*(t.requires_grad_() for t in inputs), *lists, WIDTH, HEIGHT)
    )


LIMITS = {"least_total": 1e-2, "least_share": 1e-4}


def frame_inputs(count, degree=1, model="pinhole", background=True, seed=1, width=WIDTH, height=HEIGHT) -> list[Any]:
    """Gaussians before the camera, opacities of either sign and above 1, factors, scalars, and the view; all float32."""
    g = torch.Generator().manual_seed(seed)
    depths = 4 + 6 * torch.rand(count, generator=g)
    places = 2 * torch.rand(count, 2, generator=g) - 1
    places = places * (6 if model == "ortho" else depths[:, None])
    camera = Camera.from_focal(0.6 * width if model != "ortho" else width / 12, width, height)
    gaussians = [
        torch.cat([places, depths[:, None]], 1), torch.randn(count, 4, generator=g),
        0.4 * torch.randn(count, 3, generator=g) - 1.2, torch.zeros(count),
        0.4 * torch.randn(count, (degree + 1) ** 2, 3, generator=g),
    ]  # fmt: skip
    harmonics = 0.4 * torch.randn(count, 16, generator=g)
    harmonics[:, 0] += 2 * torch.rand(count, generator=g)
    factors = 0.5 + torch.rand(count, generator=g)
    scalars = tuple(torch.tensor(value) for value in (9.0, 6.0, 0.2))
    behind = torch.tensor([0.2, 0.7, 0.4]) if background else None
    viewmat, K = (torch.as_tensor(m, dtype=torch.float32) for m in camera.matrices("cpu", torch.float32))
    viewmat = viewmat.clone()
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    return [gaussians, harmonics, factors, scalars, View(viewmat, K, width, height, behind, model)]


def moved(inputs, to) -> list[Any]:
    gaussians, harmonics, factors, scalars, view = inputs
    tensors = {name: getattr(view, name).to(to) for name in ("viewmat", "K")}
    background = None if view.background is None else view.background.to(to)
    return [
        [t.to(to) for t in gaussians], harmonics.to(to), factors.to(to), tuple(t.to(to) for t in scalars),
        view._replace(**tensors, background=background),
    ]  # fmt: skip


def frame_of(inputs, gpu, capacity=1 << 20):
    frame = render_weighted_frame(*moved(inputs, gpu), capacity, **LIMITS)
    assert not frame.status[STATUS_OVERFLOW]
    return frame


def check_frame(inputs, gpu):
    frame = frame_of(inputs, gpu)
    image, alphas = reference.render_weighted_frame(*moved(inputs, torch.float64), **LIMITS)
    assert frame.image.isfinite().all()
    # Opacities of both signs nearly cancel at some pixels, whose mean depth is not defined to many digits.
    clear = alphas > 0.3
    colours, z = ((one.cpu().double() - other).abs() for one, other in zip(
        (frame.image[..., :3], frame.image[..., 3]), (image[..., :3], image[..., 3]), strict=True
    ))  # fmt: skip
    off = [(frame.alphas.cpu().double() - alphas).abs(), colours.amax(-1), torch.where(clear, z, 0) / 10]
    for each in off:
        # By float rounding a splat may reach a pixel or not where its alpha is 1/255.
        assert each.max() < 2e-2
        assert (each > 2e-4).sum() <= 3 + 2e-3 * each.numel(), (float(each.max()), int((each > 2e-4).sum()))
    return frame


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_weighted_frame_of_every_degree_and_camera_model_equals_reference(gpu, degree, model):
    assert check_frame(frame_inputs(400, degree, model), gpu).alphas.max() > 0.5


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (200, 131)])
@pytest.mark.parametrize("count", [0, 1, 127, 129, 1000])
def test_weighted_frame_of_any_size_equals_reference(gpu, count, size):
    width, height = size
    check_frame(frame_inputs(count, background=count % 2 == 0, seed=count, width=width, height=height), gpu)


def test_weighted_frame_of_tile_exceeding_batch_equals_reference(gpu):
    inputs = frame_inputs(3000, width=20, height=20)
    inputs[0][2] += 1
    check_frame(inputs, gpu)


def test_weighted_frame_independent_of_order(gpu):
    inputs = frame_inputs(3000, degree=2)
    first = frame_of(inputs, gpu)
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(4))
    gaussians, harmonics, factors, *rest = inputs
    turned = frame_of([[t[order] for t in gaussians], harmonics[order], factors[order], *rest], gpu)
    assert first.alphas.max() > 0.5
    assert torch.equal(turned.image, first.image)
    assert torch.equal(turned.alphas, first.alphas)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38])
@pytest.mark.parametrize("at", range(7))
def test_weighted_frame_invalid_splat_does_not_affect_others(gpu, at, value):
    inputs = frame_inputs(60)
    tensors = [*inputs[0], inputs[1], inputs[2]]
    without = [[t[1:] for t in inputs[0]], inputs[1][1:], inputs[2][1:], *inputs[3:]]
    tensors[at][0] = value
    frame = frame_of(inputs, gpu)
    assert frame.image.isfinite().all()
    if value != 3e38:  # finite, so the Gaussian may be seen
        assert torch.equal(frame.image, frame_of(without, gpu).image)


def test_weighted_frame_reports_overflow(gpu):
    inputs = moved(frame_inputs(500), gpu)
    small = render_weighted_frame(*inputs, 10, **LIMITS)
    assert small.status[STATUS_OVERFLOW] == 1
    needed = int(small.status[STATUS_NEEDED])
    assert torch.equal(
        render_weighted_frame(*inputs, needed, **LIMITS).image, render_weighted_frame(*inputs, 1 << 20, **LIMITS).image
    )


@pytest.mark.parametrize("depth", [True, False])
def test_weighted_sum_renderer_same_image_with_and_without_gradients(gpu, depth):
    gaussians, harmonics, factors, _, view = frame_inputs(800, degree=2)
    scene = Gaussians(*gaussians)
    scene = replace(scene, extra={OPACITY: harmonics, FACTOR: factors}).to(gpu)
    camera = Camera(view.K.numpy(), WIDTH, HEIGHT, view.viewmat.numpy())
    values = {name: torch.tensor(v, device=gpu) for name, v in WeightedSumRenderer.first_values(9.0).items()}
    background = torch.rand(3, device=gpu)
    shown = WeightedSumRenderer.picture(scene, camera, background, values, depth)
    trained = WeightedSumRenderer.picture(scene.detach().requires_grad_(), camera, background, values, depth)
    assert trained.image.requires_grad
    assert shown.alpha.max() > 0.5
    for one, other in zip(shown, trained, strict=True):
        off = (one - other).abs() / other.abs().max().clamp(min=1e-6)
        assert (off > 2e-4).double().mean() < 2e-3, (float(off.max()), float((off > 2e-4).double().mean()))


def test_weighted_frame_of_very_many_splats_in_one_tile(gpu):
    count = 400_000
    gaussians, harmonics, factors, scalars, view = frame_inputs(1, degree=0, width=16, height=16)
    gaussians = [t.expand(count, *t.shape[1:]).clone() for t in gaussians]
    gaussians[0][:] = torch.tensor([0.0, 0.0, 5.0])
    gaussians[2][:] = 2.0  # much wider than the picture
    harmonics, factors = torch.zeros(count, 16), torch.full((count,), 20.0)
    harmonics[:, 0] = 1 / 0.28209479177387814
    inputs = [gaussians, harmonics, factors, scalars, view]
    frame = frame_of(inputs, gpu, capacity=count)
    one = [[t[:1] for t in gaussians], harmonics[:1], factors[:1], (*scalars[:2], scalars[2] / count), view]
    image, alphas = reference.render_weighted_frame(*moved(one, torch.float64), **LIMITS)
    torch.testing.assert_close(frame.image.cpu().double(), image, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(frame.alphas.cpu().double(), alphas, rtol=1e-4, atol=1e-4)


def test_weighted_frame_passes_opcheck(gpu):
    gaussians, harmonics, factors, scalars, view = moved(frame_inputs(20), gpu)
    torch.library.opcheck(
        torch.ops.gsplat_core.render_weighted_frame.default,
        (
            gaussians, harmonics, factors, list(scalars), *view.tensors, WIDTH, HEIGHT, 0.3, 0.01, 1e10, 0, 1e-2, 1e-4,
            1 << 14,
        ),
    )  # fmt: skip
