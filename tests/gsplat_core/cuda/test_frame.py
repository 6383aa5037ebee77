"""The fused frame path's forward pass: against plain torch in float64, against `rasterization`, and in CUDA graphs."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch

from gsplat_core.ops.frame import MAX_SEGMENT, STATUS_NEEDED, Frame, FrameMode
from tests.gsplat_core.cuda.frame_checks import assert_near, check, plain, scene


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_frame_of_every_degree_and_camera_model_equals_reference(degree: int, model: str) -> None:
    assert check(scene(400, degree=degree, model=model)).alphas.max() > 0.5


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (200, 131)])
def test_frame_of_any_size_equals_reference(size: tuple[int, int]) -> None:
    check(scene(300, *size, seed=1, background=False))


@pytest.mark.parametrize("count", [0, 1, 2, 127, 128, 129, 1000])
def test_frame_of_any_number_of_gaussians_equals_reference(count: int) -> None:
    check(scene(count, deltas=count % 2 == 0, seed=2))


@pytest.mark.parametrize("deltas", [False, True])
def test_frame_equals_rasterization(deltas: bool) -> None:
    s = scene(3000, 320, 240, degree=3, deltas=deltas, seed=3)
    assert_near(s.render(), plain(s))


def test_frame_deltas_added_to_raw_parameters() -> None:
    s = scene(500, seed=4)
    d = s.deltas
    sh = s.sh.clone()
    sh[:, 0] += d[:, 10:13]
    moved = replace(
        s, means=s.means + d[:, :3], quats=s.quats + d[:, 3:7], log_scales=s.log_scales + d[:, 7:10], sh=sh,
        logit_opacities=s.logit_opacities + d[:, 13], deltas=None,
    )  # fmt: skip
    torch.testing.assert_close(s.render().image, moved.render().image, atol=1e-4, rtol=1e-4)
    unused = d.clone()
    unused[:, 14:] = math.nan
    assert torch.equal(replace(s, deltas=unused).render().image, s.render().image)


def test_frame_hides_gaussians_behind_camera() -> None:
    s = scene(200, seed=5)
    s.viewmat[2, 3] -= 100
    frame = check(s)
    assert not frame.alphas.any()
    assert torch.equal(frame.image[..., :3].cpu(), s.background.expand(45, 70, 3))
    assert frame.status.tolist() == [0, 0, 0, 0]


def test_frame_of_screen_covering_gaussians_equals_reference() -> None:
    s = scene(300, 700, 600, seed=6)
    s.log_scales[::20] = 1.5
    s.log_scales[1::20] = torch.tensor([1.0, -4.0, -4.0])  # longer ones lose digits in any float32
    s.logit_opacities[::20] = -1.0
    frame = check(s)
    assert frame.splat_starts.diff().max() == 44 * 38


def test_frame_of_medium_splats_equals_reference() -> None:
    check(scene(2000, 500, 300, seed=7, size=0.2), capacity=1 << 20)


def test_frame_omits_gaussians_with_non_finite_values() -> None:
    s = scene(200, degree=2, seed=9)
    row = 0
    for value in (math.nan, math.inf, -math.inf):
        for tensor in (s.means, s.quats, s.log_scales, s.logit_opacities[:, None], s.sh.flatten(1), s.deltas[:, :14]):
            for column in {0, tensor.shape[1] // 2, tensor.shape[1] - 1}:
                tensor[row, column] = value
                row += 1
    s.quats[row] = 0
    s.deltas[row, 3:7] = 0
    frame = check(s)
    assert not frame.splat_starts.diff()[: row + 1].any()
    good = {field.name: getattr(s, field.name)[row + 1 :] for field in fields(s)[:6]}
    assert torch.equal(replace(s, **good).render(mode=FrameMode.TRAINING).image, frame.image)


def test_frame_is_deterministic() -> None:
    s = scene(20_000, 320, 240, degree=3, seed=10, size=0.1)
    first, *others = (s.render(1 << 20, FrameMode.TRAINING) for _ in range(3))
    needed = int(first.status[STATUS_NEEDED])
    assert needed > 50_000
    for other in others:
        for name in ("image", "alphas", "last", "tile_offsets", "splat_starts", "status"):
            assert torch.equal(getattr(first, name), getattr(other, name)), name
        for name in ("sorted", "instance_splats"):
            assert torch.equal(getattr(first, name)[:needed], getattr(other, name)[:needed]), name


@pytest.mark.parametrize("mode", FrameMode)
def test_captured_frame_follows_camera_and_deltas(mode: FrameMode) -> None:
    s = scene(2000, 160, 120, degree=3, seed=12)
    tensors = s.tensors("cuda", torch.float32)
    controls = torch.empty(1 + 16 + 9 + 3, device="cuda")  # views that begin anywhere
    viewmat, K, background = controls[1:17].view(4, 4), controls[17:26].view(3, 3), controls[26:]
    for view, value in zip((viewmat, K, background), tensors[6:], strict=True):
        view.copy_(value)
    deltas = tensors[5]

    def render() -> Frame:
        capacity = MAX_SEGMENT if mode == FrameMode.SEGMENTS else 1 << 16
        return s.render_tensors([*tensors[:6], viewmat, K, background], capacity, mode)

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        render()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = render()
    for step in range(3):
        viewmat[0, 3] += 0.1 * step
        K[0, 0] *= 1 + 0.1 * step
        background += 0.1
        deltas.mul_(1 + step)
        graph.replay()
        now = render()
        for name in ("image", "alphas", "last", "status"):
            assert torch.equal(getattr(captured, name), getattr(now, name)), name


def test_frame_with_strided_and_misaligned_inputs_on_side_stream() -> None:
    s = scene(700, 160, 120, degree=3, seed=13)
    tensors = s.tensors("cuda", torch.float32)
    wanted = s.render(mode=FrameMode.TRAINING)
    shifted = [torch.cat([t.new_zeros(1), t.flatten()])[1:].view(t.shape) for t in tensors]
    strided = [torch.stack([t, t], -1)[..., 0] for t in tensors]
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        frames = [s.render_tensors(t, 1 << 16, FrameMode.TRAINING) for t in (shifted, strided)]
    side.synchronize()
    for frame in frames:
        assert torch.equal(frame.image, wanted.image)
        assert torch.equal(frame.last, wanted.last)


@pytest.mark.parametrize(
    ("mode", "half"),
    [(FrameMode.SHARED, False), (FrameMode.TRAINING, False), (FrameMode.SHARED, True), (FrameMode.SEGMENTS, False)],
)
@pytest.mark.parametrize("optional", [False, True])
def test_render_frame_op_passes_opcheck(mode: FrameMode, half: bool, optional: bool) -> None:
    s = scene(30, 20, 18, deltas=optional, background=optional)
    tensors = s.tensors("cuda", torch.float32)
    if half:
        tensors[4] = tensors[4].half()
    arguments = (tensors[:5], *tensors[5:], 20, 18, 0.3, 0.01, 1e10, 0, 1000, int(mode))
    # What is not written (rows of culled Gaussians, unused capacity of the lists) differs from call to call.
    torch.library.opcheck(
        torch.ops.gsplat_core.render_frame.default, arguments, test_utils=["test_schema", "test_faketensor"]
    )
