"""The fused frame path's forward pass: against plain torch in float64, against `rasterization`, and in CUDA graphs."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput, rasterization, reference
from gsplat_core.ops.frame.frame import MOST_IN_TILE, STATUS_CUT, STATUS_MOST, STATUS_NEEDED, Frame, render_frame

pytestmark = pytest.mark.cuda


@dataclass(frozen=True)
class Scene:
    """Raw Gaussians in front of a camera, on the CPU."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor
    deltas: Tensor | None
    viewmat: Tensor
    K: Tensor
    background: Tensor | None
    width: int
    height: int
    camera_model: str = "pinhole"

    def tensors(self, device: str, dtype: torch.dtype) -> list[Tensor | None]:
        """The arguments of `render_frame` that are tensors, in order."""
        values = [getattr(self, field.name) for field in fields(self)[:9]]
        return [None if value is None else value.to(device, dtype) for value in values]

    def render(self, capacity: int = 1 << 16, training: bool = False, **options: object) -> Frame:
        return render_frame(
            *self.tensors("cuda", torch.float32), self.width, self.height, capacity,
            camera_model=self.camera_model, training=training, **options,
        )  # fmt: skip

    def exact(self, training: bool = False) -> tuple[Tensor, Tensor]:
        return reference.render_frame(
            *self.tensors("cpu", torch.float64), self.width, self.height,
            camera_model=self.camera_model, expected_depth=not training,
        )  # fmt: skip


def scene(
    count: int, width: int = 70, height: int = 45, degree: int = 1, model: str = "pinhole", seed: int = 0,
    deltas: bool = True, background: bool = True, size: float = 0.06,
) -> Scene:  # fmt: skip
    g = torch.Generator().manual_seed(seed)
    z = 1.5 + 2 * torch.rand(count, generator=g)
    means = torch.stack([*((torch.rand(2, count, generator=g) - 0.5) * torch.tensor([[2.0], [1.4]]) * z), z], -1)
    log_scales = math.log(size) + 0.6 * torch.randn(count, 3, generator=g)
    sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    rotation = torch.linalg.qr(torch.eye(3) + 0.1 * torch.randn(3, 3, generator=g)).Q
    viewmat = torch.eye(4)
    viewmat[:3, :3] = rotation * torch.sign(torch.linalg.det(rotation))
    viewmat[:3, 3] = torch.tensor([0.05, -0.1, 0.3])
    viewmat[:3, :3] *= torch.sign(viewmat[2, 2])
    f = width * (0.3 if model == "ortho" else 0.6)
    K = torch.tensor([[f, 0, width / 2 + 1], [0, f * 1.1, height / 2 - 1], [0, 0, 1]])
    return Scene(
        means=(means - viewmat[:3, 3]) @ viewmat[:3, :3],
        quats=torch.randn(count, 4, generator=g),
        log_scales=log_scales,
        logit_opacities=1 + 2 * torch.randn(count, generator=g),
        sh=sh,
        deltas=0.03 * torch.randn(count, 16, generator=g) if deltas else None,
        viewmat=viewmat,
        K=K,
        background=torch.rand(3, generator=g) if background else None,
        width=width,
        height=height,
        camera_model=model,
    )


def assert_near(frame: Frame, exact: tuple[Tensor, Tensor]) -> None:
    """Pixels within 2e-4 of their scale away from the cut-offs, PSNR at least 60 dB of the largest value."""
    for seen, wanted in ((frame.image, exact[0]), (frame.alphas[..., None], exact[1][..., None])):
        assert seen.shape == wanted.shape
        assert seen.isfinite().all()
        error = (seen.double().cpu() - wanted).abs()
        scale = wanted.abs().flatten(0, -2).amax(0).clamp(min=1.0)
        # A splat within rounding of a cut-off may fall on either side of it, in a few pixels and by a few 1/255.
        off = (error > 2e-4 * scale).any(-1)
        assert off.sum() <= 1 + 5e-4 * off.numel(), int(off.sum())
        assert (error / scale).square().mean() <= 1e-6


def check(s: Scene, capacity: int = 1 << 16) -> Frame:
    """All modes against the reference; returns the training one."""
    frame = s.render(capacity)
    needed, most, cut = frame.status.tolist()[:3]
    assert needed <= capacity and not cut and most <= needed
    assert_near(frame, s.exact())
    if most <= MOST_IN_TILE:
        apart = s.render(max(most, 1), per_tile=True)
        for name in ("image", "alphas", "status"):
            assert torch.equal(getattr(apart, name), getattr(frame, name)), name
    training = s.render(capacity, training=True)
    assert_near(training, s.exact(training=True))
    assert torch.equal(frame.status, training.status)
    assert torch.equal(frame.alphas, training.alphas)
    check_lists(training)
    return training


def check_lists(frame: Frame) -> None:
    """Every instance is in one tile's list, each list is in the order of depth, and splats are numbered in order."""
    needed, most, _ = frame.status.tolist()[:3]
    starts, offsets = frame.splat_starts.cpu().long(), frame.tile_offsets.cpu().long()
    assert starts[0] == 0 and offsets[0] == 0
    assert starts[-1] == offsets[-1] == needed
    assert most == (offsets.diff().max() if len(offsets) > 1 else 0)
    instances = frame.sorted[:needed].cpu().long()
    assert torch.equal(instances.sort().values, torch.arange(needed))
    owners = frame.instance_splats[:needed].cpu().long()
    assert torch.equal(owners, torch.repeat_interleave(torch.arange(len(starts) - 1), starts.diff()))
    depths = frame.records[
        owners[instances].to(frame.records.device), 10
    ].cpu()  # rows of culled splats are not written
    tiles = torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff())
    same = tiles[1:] == tiles[:-1]
    ordered = (depths[1:] > depths[:-1]) | ((depths[1:] == depths[:-1]) & (instances[1:] > instances[:-1]))
    assert ordered[same].all()
    last = frame.last.cpu().long()
    assert (last < needed).all()
    assert torch.equal(last >= 0, frame.alphas.cpu() > 0)


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_picture_for_every_degree_and_camera_model(degree: int, model: str) -> None:
    assert check(scene(400, degree=degree, model=model)).alphas.max() > 0.5


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (200, 131)])
def test_any_image_size(size: tuple[int, int]) -> None:
    check(scene(300, *size, seed=1, background=False))


@pytest.mark.parametrize("count", [0, 1, 2, 127, 128, 129, 1000])
def test_any_number_of_gaussians(count: int) -> None:
    check(scene(count, deltas=count % 2 == 0, seed=2))


def plain(s: Scene) -> tuple[Tensor, Tensor]:
    """What `rasterization` makes of the scene on the same device, on the CPU."""
    means, quats, log_scales, logits, sh, d, viewmat, K, background = s.tensors("cuda", torch.float32)
    if d is not None:
        means, quats, log_scales, logits = (
            means + d[:, :3],
            quats + d[:, 3:7],
            log_scales + d[:, 7:10],
            logits + d[:, 13],
        )
        sh = torch.cat([sh[:, :1] + d[:, None, 10:13], sh[:, 1:]], 1)
    image, alphas, _ = rasterization(
        means, quats, log_scales.exp(), torch.sigmoid(logits), sh, viewmat[None], K[None], s.width, s.height,
        sh_degree=math.isqrt(sh.shape[1]) - 1, backgrounds=None if background is None else background[None],
        render_mode="RGB+ED", packed=False, camera_model=s.camera_model,
    )  # fmt: skip
    return image[0].double().cpu(), alphas[0, ..., 0].double().cpu()


@pytest.mark.parametrize("deltas", [False, True])
def test_the_picture_is_that_of_rasterization(deltas: bool) -> None:
    s = scene(3000, 320, 240, degree=3, deltas=deltas, seed=3)
    assert_near(s.render(), plain(s))


def test_deltas_are_added_to_the_raw_parameters() -> None:
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


def test_all_behind_the_camera() -> None:
    s = scene(200, seed=5)
    s.viewmat[2, 3] -= 100
    frame = check(s)
    assert not frame.alphas.any()
    assert torch.equal(frame.image[..., :3].cpu(), s.background.expand(45, 70, 3))
    assert frame.status.tolist() == [0, 0, 0, 0]


def test_gaussians_that_cover_the_screen() -> None:
    s = scene(300, 700, 600, seed=6)
    s.log_scales[::20] = 1.5
    s.log_scales[1::20] = torch.tensor([1.0, -4.0, -4.0])  # longer ones lose digits in any float32
    s.logit_opacities[::20] = -1.0
    frame = check(s)
    assert frame.splat_starts.diff().max() == 44 * 38


def test_a_cloud_of_medium_splats() -> None:
    check(scene(2000, 500, 300, seed=7, size=0.2), capacity=1 << 20)


@pytest.mark.parametrize("count", [2000, 2049, 5000, 100_000])
def test_very_many_splats_in_one_tile(count: int) -> None:
    s = scene(count, 32, 16, seed=8, deltas=False)
    s.means[:] = (torch.tensor([-0.5, 0.0, 2.0]) - s.viewmat[:3, 3]) @ s.viewmat[:3, :3]
    s.means[:] += torch.rand(count, 1, generator=torch.Generator().manual_seed(1)) * s.viewmat[2, :3]
    s.means[: count // 3] = s.means[0]  # equal depths keep the order of the splats
    s.log_scales[:] = 0.0  # wide, so that no pixel is near the cut-off of 1/255
    s.logit_opacities[:] = -5.4
    frame = check(s, capacity=4 * count)
    assert frame.status[STATUS_MOST] == count


@pytest.mark.parametrize("count", [100, 128, 200, 256, 500, 512, 900, 1024, 1025])
@pytest.mark.parametrize("far", [False, True])
def test_depths_that_are_equal_or_next_to_each_other(count: int, far: bool) -> None:
    s = scene(count, 16, 16, seed=16, deltas=False)
    g = torch.Generator().manual_seed(2)
    s.viewmat[:] = torch.eye(4)
    s.means[:, :2] = 0.1 * torch.randn(count, 2, generator=g)
    s.means[:, 2] = 2 + torch.randint(0, 40, (count,), generator=g) * 2.0**-22
    s.log_scales[:] = 3.0  # over the whole tile, so that no pixel is near the cut-off of 1/255
    if far:  # told apart from this one, the others are not told apart at once
        s.means[-1] = torch.tensor([0.0, 0.0, 1e8])
        s.log_scales[-1] = math.log(1e9)
    s.logit_opacities[:] = -4.6
    assert check(s).status[STATUS_MOST] == count


@pytest.mark.parametrize("clump", [1, 2, 11, 12, 13, 100])
@pytest.mark.parametrize("count", [120, 250, 500, 1000])
def test_depths_in_clumps(count: int, clump: int) -> None:
    """Evenly spread depths are sorted by buckets, and others, with too many in one bucket, in the general way."""
    s = scene(count, 16, 16, seed=18, deltas=False)
    g = torch.Generator().manual_seed(3)
    s.viewmat[:] = torch.eye(4)
    s.means[:, :2] = 0.1 * torch.randn(count, 2, generator=g)
    at = torch.randperm(count, generator=g) // clump
    s.means[:, 2] = 2 + at * clump / count + 1e-6 * torch.rand(count, generator=g)
    s.log_scales[:] = 3.0  # over the whole tile, so that no pixel is near the cut-off of 1/255
    s.logit_opacities[:] = -4.6
    assert check(s).status[STATUS_MOST] == count


def test_a_large_scene() -> None:
    s = scene(140_000, 150, 110, degree=0, seed=14, size=0.006)
    s.log_scales[::5000] = 0.5
    s.log_scales[1::2000] = -1.5
    s.means[2::100] = math.nan
    assert_near(s.render(1 << 19), plain(s))
    frame = s.render(1 << 19, training=True)
    check_lists(frame)
    assert frame.splat_starts.diff().max() == 10 * 7
    again = s.render(1 << 19, training=True)
    for name in ("image", "last", "tile_offsets", "splat_starts"):
        assert torch.equal(getattr(frame, name), getattr(again, name)), name
    needed = int(frame.status[STATUS_NEEDED])
    assert s.render(needed - 1, training=True).status[STATUS_CUT]
    assert torch.equal(s.render(needed, training=True).image, frame.image)


def test_a_large_scene_on_very_many_tiles() -> None:
    s = scene(66_000, 4096, 4100, degree=0, seed=15, size=0.002)
    assert_near(s.render(1 << 20), plain(s))


def test_values_that_are_not_finite_leave_their_gaussian_out() -> None:
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
    assert torch.equal(replace(s, **good).render(training=True).image, frame.image)


def test_the_same_bits_every_time() -> None:
    s = scene(20_000, 320, 240, degree=3, seed=10, size=0.1)
    first, *others = (s.render(1 << 20, training=True) for _ in range(3))
    needed = int(first.status[STATUS_NEEDED])
    assert needed > 50_000
    for other in others:
        for name in ("image", "alphas", "last", "tile_offsets", "splat_starts", "status"):
            assert torch.equal(getattr(first, name), getattr(other, name)), name
        for name in ("sorted", "instance_splats"):
            assert torch.equal(getattr(first, name)[:needed], getattr(other, name)[:needed]), name


@pytest.mark.parametrize("training", [False, True])
def test_too_little_room_is_told_and_a_second_go_is_right(training: bool) -> None:
    s = scene(3000, 200, 131, seed=11, size=0.2)
    s.log_scales[::50] = 1.0
    wanted = s.render(1 << 20, training)
    needed = int(wanted.status[STATUS_NEEDED])
    for capacity in (1, 100, needed // 2, needed - 1):
        cut = s.render(capacity, training)
        assert cut.status.tolist() == [needed, int(wanted.status[STATUS_MOST]), 1, 0]
        torch.cuda.synchronize()
    again = s.render(needed, training)
    assert not again.status[STATUS_CUT]
    assert torch.equal(again.image, wanted.image)


def test_a_tile_with_too_little_room_is_told_and_a_second_go_is_right() -> None:
    s = scene(3000, 200, 131, seed=11, size=0.2)
    s.log_scales[::50] = 1.0
    wanted = s.render(1 << 20)
    needed, most = wanted.status.tolist()[:2]
    for capacity in (1, 50, most - 1):
        cut = s.render(capacity, per_tile=True)
        assert cut.status.tolist() == [needed, most, 1, 0]
        torch.cuda.synchronize()
    again = s.render(most, per_tile=True)
    assert again.status.tolist() == [needed, most, 0, 0]
    assert torch.equal(again.image, wanted.image)
    with pytest.raises(InvalidInput, match="at most 1024"):
        s.render(1025, per_tile=True)
    with pytest.raises(InvalidInput, match="per_tile=False"):
        s.render(most, training=True, per_tile=True)


@pytest.mark.parametrize(("training", "per_tile"), [(False, False), (False, True), (True, False)])
def test_a_captured_frame_follows_camera_and_deltas(training: bool, per_tile: bool) -> None:
    s = scene(2000, 160, 120, degree=3, seed=12)
    tensors = s.tensors("cuda", torch.float32)
    controls = torch.empty(1 + 16 + 9 + 3, device="cuda")  # views that begin anywhere
    viewmat, K, background = controls[1:17].view(4, 4), controls[17:26].view(3, 3), controls[26:]
    for view, value in zip((viewmat, K, background), tensors[6:], strict=True):
        view.copy_(value)
    deltas = tensors[5]

    def render() -> Frame:
        capacity = MOST_IN_TILE if per_tile else 1 << 16
        return render_frame(
            *tensors[:6], viewmat, K, background, s.width, s.height, capacity, training=training, per_tile=per_tile
        )

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


def test_strided_and_misaligned_inputs_and_a_side_stream() -> None:
    s = scene(700, 160, 120, degree=3, seed=13)
    tensors = s.tensors("cuda", torch.float32)
    wanted = s.render(training=True)
    shifted = [torch.cat([t.new_zeros(1), t.flatten()])[1:].view(t.shape) for t in tensors]
    strided = [torch.stack([t, t], -1)[..., 0] for t in tensors]
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        frames = [render_frame(*t, s.width, s.height, 1 << 16, training=True) for t in (shifted, strided)]
    side.synchronize()
    for frame in frames:
        assert torch.equal(frame.image, wanted.image)
        assert torch.equal(frame.last, wanted.last)


@pytest.mark.parametrize(
    ("training", "half", "per_tile"),
    [(False, False, False), (True, False, False), (False, True, False), (False, False, True)],
)
@pytest.mark.parametrize("optional", [False, True])
def test_op_passes_opcheck(training: bool, half: bool, per_tile: bool, optional: bool) -> None:
    s = scene(30, 20, 18, deltas=optional, background=optional)
    tensors = s.tensors("cuda", torch.float32)
    if half:
        tensors[4] = tensors[4].half()
    arguments = (*tensors, 20, 18, 0.3, 0.01, 1e10, 0, 1000, per_tile, training)
    # What is not written (rows of culled Gaussians, the room behind the lists) differs from call to call.
    torch.library.opcheck(
        torch.ops.gsplat_core.render_frame.default, arguments, test_utils=["test_schema", "test_faketensor"]
    )
