"""The frame path without a GPU: its oracle against the parts it is made of, its checks, and its fake kernel."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from gsplat_core import InvalidInput, reference
from gsplat_core.ops.frame import Frame, FrameMode, View, render_frame

WIDTH, HEIGHT = 40, 30


def raw_gaussians(count: int = 40, dtype: torch.dtype = torch.float64, degree: int = 1) -> list[Tensor]:
    """Means, rotations, log-scales, opacity logits, coefficients, deltas, view matrix, K and background."""
    g = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=dtype)

    means = random(count, 3) + torch.tensor([0.0, 0.0, 5.0], dtype=dtype)
    K = torch.tensor([[40.0, 0, 20], [0, 42, 15], [0, 0, 1]], dtype=dtype)
    return [
        means, random(count, 4), 0.3 * random(count, 3) - 1.5, random(count), 0.3 * random(count, (degree + 1) ** 2, 3),
        0.05 * random(count, 16), torch.eye(4, dtype=dtype), K, torch.rand(3, generator=g, dtype=dtype),
    ]  # fmt: skip


def view_of(inputs: list[Tensor], **options: Any) -> View:
    viewmat, K, background = inputs[6:]
    sizes = {"width": WIDTH, "height": HEIGHT} | options
    return View(viewmat, K, background=background, **sizes)


def rendered(inputs: list[Tensor], capacity: int = 100, mode: FrameMode = FrameMode.SHARED, **view: Any) -> Frame:
    """`render_frame` of what `raw_gaussians` gives."""
    return render_frame(inputs[:5], inputs[5], view_of(inputs, **view), capacity, mode)


def by_reference(inputs: list[Tensor], **options: Any) -> tuple[Tensor, Tensor]:
    """Image and alphas of what `raw_gaussians` gives, by `reference.render_frame`."""
    return reference.render_frame(inputs[:5], inputs[5], view_of(inputs), **options)


@pytest.mark.parametrize("expected_depth", [False, True])
def test_frame_reference_equals_rasterization_of_deformed_gaussians(assert_near, expected_depth):
    means, quats, log_scales, logits, sh, d, viewmat, K, background = inputs = raw_gaussians()
    image, alphas = by_reference(inputs, expected_depth=expected_depth)
    colored = torch.cat([sh[:, :1] + d[:, None, 10:13], sh[:, 1:]], 1)
    wanted, wanted_alphas, _ = reference.rasterization(
        means + d[:, :3], quats + d[:, 3:7], (log_scales + d[:, 7:10]).exp(), torch.sigmoid(logits + d[:, 13]), colored,
        viewmat[None], K[None], WIDTH, HEIGHT, sh_degree=1, backgrounds=background[None],
        render_mode="RGB+ED" if expected_depth else "RGB+D",
    )  # fmt: skip
    assert alphas.max() > 0.5
    assert_near(image, wanted[0], of_largest=1e-12)
    assert_near(alphas, wanted_alphas[0, ..., 0], of_largest=1e-12)


def test_frame_reference_omits_non_finite_gaussians_without_gradient():
    inputs = raw_gaussians()
    with torch.no_grad():
        inputs[0][0, 1] = inputs[5][1, 13] = math.nan
        inputs[4][2, 0, 1] = math.inf
        inputs[3][3] = math.inf  # this and the next are finite again after the activation
        inputs[2][4, 2] = -math.inf
    leaves = [t.requires_grad_() for t in inputs[:6]]
    image, alphas = by_reference(inputs)
    assert image.isfinite().all()
    (image.sum() + alphas.sum()).backward()
    for leaf in leaves:
        assert leaf.grad.isfinite().all()
        assert not leaf.grad[:5].any()
        assert leaf.grad[5:].any()


def test_frame_reference_rejects_invalid_shapes():
    for index, name in ((1, "quats"), (2, "log_scales"), (3, "logit_opacities"), (4, "sh"), (5, "deltas")):
        inputs = raw_gaussians()
        inputs[index] = inputs[index][1:]
        with pytest.raises(InvalidInput, match=name):
            by_reference(inputs)


def test_render_frame_rejects_cpu_and_float64_with_alternative():
    with pytest.raises(InvalidInput, match=r"runs on CUDA only .* gsplat_core.render"):
        rendered(raw_gaussians(dtype=torch.float32))
    with pytest.raises(InvalidInput, match=r"must be float32, got torch.float64.*gsplat_core.reference"):
        rendered(raw_gaussians())


@pytest.mark.parametrize(
    ("index", "name"),
    [(0, "means"), (1, "quats"), (2, "log_scales"), (3, "logit_opacities"), (4, "sh"), (5, "deltas"), (6, "viewmat"),
     (7, "K"), (8, "background")],
)  # fmt: skip
def test_render_frame_names_invalid_shapes(index, name):
    inputs = raw_gaussians(dtype=torch.float32)
    inputs[index] = inputs[index][..., :-1] if name != "logit_opacities" else inputs[index][:, None]
    with pytest.raises(InvalidInput, match=f"^{name} must be"):
        rendered(inputs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "at least 1x1"),
        ({"capacity": 0}, "capacity"),
        ({"camera_model": "ftheta"}, "camera_model"),
        ({"mode": FrameMode.SEGMENTS, "capacity": 1025}, "at most 1024"),
    ],
)
def test_render_frame_rejects_invalid_options(options, message):
    with pytest.raises(InvalidInput, match=message):
        rendered(raw_gaussians(dtype=torch.float32), **options)


def test_render_frame_requires_five_gaussian_tensors():
    inputs = raw_gaussians(dtype=torch.float32)
    view = View(*inputs[6:8], WIDTH, HEIGHT)
    with pytest.raises(InvalidInput, match=r"means, quats, log_scales, logit_opacities, sh, got 4 tensors"):
        render_frame(inputs[:4], None, view, 100)


@pytest.mark.parametrize("mode", FrameMode)
def test_render_frame_fake_kernel_has_frame_shapes(mode):
    training = mode == FrameMode.TRAINING
    with FakeTensorMode():
        inputs = [torch.empty_like(t, device="cpu") for t in raw_gaussians(dtype=torch.float32)]
        frame = Frame(
            *torch.ops.gsplat_core.render_frame(inputs[:5], *inputs[5:], WIDTH, HEIGHT, 0.3, 0.01, 1e10, 0, 100, mode)
        )
    assert frame.image.shape == (HEIGHT, WIDTH, 4)
    assert frame.alphas.shape == (HEIGHT, WIDTH)
    assert frame.last.shape == ((HEIGHT, WIDTH) if training else (0, 0))
    assert frame.records.shape == (40, 12)
    assert frame.tile_offsets.shape == ((0,) if mode == FrameMode.SEGMENTS else (3 * 2 + 1,))
    assert frame.sorted.shape == frame.instance_splats.shape == ((100,) if training else (0,))
    assert frame.splat_starts.shape == ((41,) if training else (0,))
    assert frame.status.shape == (4,)
    assert {t.dtype for t in frame} == {torch.float32, torch.int32}
