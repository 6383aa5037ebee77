"""The fused frame path in half precision on CUDA, against plain torch in float64 and against itself in float32."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput
from gsplat_core.ops.frame import (
    MAX_SEGMENT,
    STATUS_LONGEST,
    STATUS_NEEDED,
    STATUS_OVERFLOW,
    Frame,
    FrameMode,
    render_frame,
)
from gsplat_core.reference.rendering import render_frame as reference_frame
from gsplat_core.rendering.settings import EPS2D
from gsplat_core.scene.gaussians import COLOUR
from tests.gsplat_core.cuda.frame_scenes import FrameScene, frame_scene

STOP = 1e-4


def rendered(scene: FrameScene, half: bool = True, capacity: int = 1 << 20, eps2d: float = EPS2D) -> Frame:
    s = scene.to("cuda")
    sh = s.sh.half() if half else s.sh
    return render_frame([*s.gaussians[:4], sh], s.deltas, s.view._replace(eps2d=eps2d), capacity)


def exact(scene: FrameScene) -> tuple[Tensor, Tensor]:
    s = scene.to(torch.float64)
    return reference_frame(s.gaussians, s.deltas, s.view, expected_depth=True)


def assert_near(frame: Frame, image: Tensor, alphas: Tensor, psnr_db: float = 58.0) -> None:
    """Colours and opacity, and depth where something is seen."""
    image, alphas = image.cpu().double(), alphas.cpu().double()
    seen, seen_alphas = frame.image.cpu().double(), frame.alphas.cpu().double()
    assert seen.isfinite().all()
    assert seen_alphas.isfinite().all()
    for part, wanted in ((seen[..., :3], image[..., :3]), (seen_alphas, alphas)):
        error = (part - wanted).abs() / wanted.abs().amax().clamp(min=1.0)
        assert error.square().mean() <= 10 ** (-psnr_db / 10), float(-10 * error.square().mean().log10())
        assert error.max() <= 0.02  # a few splats within rounding of a cut-off
    dense = alphas > 0.1
    depth, wanted_depth = seen[..., 3][dense], image[..., 3][dense]
    assert ((depth - wanted_depth).abs() > 0.01 * wanted_depth).sum() <= 1 + 1e-3 * len(depth)


def check(scene: FrameScene, capacity: int = 1 << 20, psnr_db: float = 58.0) -> Frame:
    frame = rendered(scene, capacity=capacity)
    assert not frame.status[STATUS_OVERFLOW]
    assert_near(frame, *exact(scene), psnr_db=psnr_db)
    assert torch.equal(rendered(scene, capacity=capacity).image, frame.image)
    return frame


@pytest.mark.parametrize("median_px", [1.0, 3.0, 15.0])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_half_frame_of_every_degree(degree: int, median_px: float) -> None:
    assert check(frame_scene(700, degree=degree, median_px=median_px, deltas=degree % 2 == 0)).alphas.max() > 0.5


@pytest.mark.parametrize("size", [(1, 1), (8, 4), (16, 16), (17, 33), (70, 3), (200, 131)])
@pytest.mark.parametrize("background", [False, True])
def test_half_frame_of_any_image_size(size: tuple[int, int], background: bool) -> None:
    check(frame_scene(400, *size, background=background, seed=1))


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 31, 32, 33, 127, 128, 129, 300])
def test_half_frame_of_any_number_of_splats_per_pixel(count: int) -> None:
    """Counts around the numbers of splats that a warp blends, stages and queues at once."""
    scene = frame_scene(count, 16, 16, median_px=40.0, seed=2)
    scene.logit_opacities[:] -= 3.0
    check(scene)


@pytest.mark.parametrize("seed", range(4))
def test_half_frame_with_adjacent_lists_of_different_lengths(seed: int) -> None:
    """Most splats are in one corner of the tile, so that some of the parts' lists stay short for many batches."""
    scene = frame_scene(1500, 16, 16, median_px=0.5, seed=seed)
    crowd = torch.arange(len(scene.means)) % 7 != 0
    g = torch.Generator().manual_seed(seed)
    pixels = 4 * torch.rand(int(crowd.sum()), 2, generator=g)
    pixels += torch.tensor([[0.0, 0.0], [9.0, 1.0], [2.0, 6.0], [12.0, 11.0]][seed])
    in_camera = scene.means[crowd] @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3]
    focal = torch.stack([scene.K[0, 0], scene.K[1, 1]])
    in_camera[:, :2] = (pixels - scene.K[:2, 2]) / focal * in_camera[:, 2:]
    scene.means[crowd] = (in_camera - scene.viewmat[:3, 3]) @ scene.viewmat[:3, :3]
    scene.logit_opacities[crowd] = -4.0
    check(scene)


@pytest.mark.parametrize("count", [2000, 20_000])
def test_half_frame_of_very_many_splats_in_one_tile(count: int) -> None:
    scene = frame_scene(count, 16, 16, median_px=60.0, seed=3)
    scene.logit_opacities[:] = -5.0 + torch.rand(count, generator=torch.Generator().manual_seed(4))
    assert check(scene, psnr_db=50.0).status[STATUS_LONGEST] == count


def test_half_frame_of_screen_covering_splats() -> None:
    scene = frame_scene(400, 300, 200, seed=5)
    scene.log_scales[::20] = math.log(4.0)
    scene.logit_opacities[::20] = -1.0
    check(scene)


def test_half_frame_of_needles_equals_reference() -> None:
    scene = frame_scene(500, 200, 150, seed=6)
    scene.log_scales[:, 0] += 3.5
    scene.log_scales[:, 1:] -= 3.0
    check(scene)


def test_half_frame_saturated_pixel_ignores_later_splats() -> None:
    """Opaque splats of every width in front of brighter ones, so that pixels saturate at different splats and steps."""
    scene = frame_scene(3000, 70, 45, median_px=6.0, seed=7)
    depth = (scene.means @ scene.viewmat[2, :3] + scene.viewmat[2, 3]).argsort()
    scene.logit_opacities[:] = 3.0
    scene.sh[depth[1500:], 0] += 1.0
    frame = check(scene)
    assert (frame.alphas > 1 - 10 * STOP).float().mean() > 0.9


def test_half_frame_of_opaque_layers_stops_at_limit() -> None:
    """The third layer with alpha 0.982 would exceed the transmittance limit and is not drawn."""
    scene = frame_scene(40, 48, 32, median_px=500.0, seed=8)
    scene.logit_opacities[:] = 4.0
    frame = check(scene)
    assert (frame.alphas - (1 - (1 - torch.tensor(4.0).sigmoid().item()) ** 2)).abs().max() < 1e-3


def test_half_frame_without_visible_gaussians_is_background() -> None:
    scene = frame_scene(100, seed=9)
    scene.viewmat[2, 3] -= 100
    frame = rendered(scene)
    assert not frame.alphas.any()
    assert not frame.image[..., 3].any()
    assert torch.equal(frame.image[..., :3].cpu(), scene.background.expand(45, 70, 3))


def test_half_frame_with_wide_depth_range() -> None:
    scene = frame_scene(300, seed=10)
    scene.means[0] = (torch.tensor([0.0, 0.0, 300.0]) - scene.viewmat[:3, 3]) @ scene.viewmat[:3, :3]
    scene.log_scales[0] = math.log(300.0)
    check(scene)


@pytest.mark.parametrize("eps2d", [0.0, 1e-6, 1e-3])
def test_half_frame_without_minimum_splat_size_close_to_float32(eps2d: float) -> None:
    scene = frame_scene(2000, median_px=0.3, seed=11)
    scene.log_scales[::2, 0] += 5.0
    scene.log_scales[::3, 1:] -= 9.0
    half, full = (rendered(scene, half, eps2d=eps2d) for half in (True, False))
    assert half.image.isfinite().all()
    assert (half.image - full.image)[..., :3].square().mean() <= 1e-4  # the thinnest are not drawn
    assert (half.alphas - full.alphas).square().mean() <= 1e-4


def test_half_frame_clamps_colours_to_largest_half() -> None:
    """A clamped colour is finite within its splat and changes no other pixel."""
    scene = frame_scene(300, deltas=True, seed=12)
    scene.deltas[0, COLOUR] = 1e9
    bright = rendered(scene)
    assert bright.image.isfinite().all()
    assert 1e3 < bright.image[..., :3].max() <= 65504
    elsewhere = rendered(scene.select(torch.tensor([0]))).alphas == 0
    assert 0.5 < elsewhere.float().mean() < 1
    scene.deltas[0, COLOUR] = 0
    assert torch.equal(bright.image[elsewhere], rendered(scene).image[elsewhere])


def test_half_frame_is_deterministic_for_any_memory_alignment() -> None:
    scene = frame_scene(20_000, 320, 240, degree=3, median_px=4.0, seed=13).to("cuda")
    first = rendered(scene)
    half = scene.sh.half()
    shifted = torch.cat([half.new_zeros(1), half.flatten()])[1:].view(half.shape)
    shared, segments = FrameMode.SHARED, FrameMode.SEGMENTS
    for sh, mode in [(half, shared), (shifted, shared), (half, segments), *[(half, shared)] * 20]:
        capacity = MAX_SEGMENT if mode == segments else 1 << 20
        again = render_frame([*scene.gaussians[:4], sh], scene.deltas, scene.view, capacity, mode)
        assert torch.equal(first.image, again.image)
        assert torch.equal(first.alphas, again.alphas)
    full = rendered(scene, half=False)
    assert torch.equal(full.status, first.status)
    assert_near(first, full.image, full.alphas)


def test_half_frame_reports_overflow_and_succeeds_with_larger_capacity() -> None:
    scene = frame_scene(3000, 200, 131, median_px=8.0, seed=14)
    wanted = rendered(scene)
    needed = int(wanted.status[STATUS_NEEDED])
    for capacity in (1, 100, needed // 2, needed - 1):
        assert rendered(scene, capacity=capacity).status.tolist()[:3] == [needed, int(wanted.status[STATUS_LONGEST]), 1]
    torch.cuda.synchronize()
    assert torch.equal(rendered(scene, capacity=needed).image, wanted.image)


def test_half_precision_coefficients_rejected_for_training() -> None:
    s = frame_scene(10).to("cuda")
    with pytest.raises(InvalidInput, match="sh must be float32"):
        render_frame([*s.gaussians[:4], s.sh.half()], s.deltas, s.view, 100, FrameMode.TRAINING)
