"""A scene for the fused frame path's forward pass, and what a picture of it has to be."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gsplat_core import rasterization, reference
from gsplat_core.ops.frame import MAX_SEGMENT, Frame, FrameMode, View, render_frame
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION


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
        """Gaussians, deltas, viewmat, K, background."""
        values = [getattr(self, field.name) for field in fields(self)[:9]]
        return [None if value is None else value.to(device, dtype) for value in values]

    def render(self, capacity: int = 1 << 16, mode: FrameMode = FrameMode.SHARED) -> Frame:
        return self.render_tensors(self.tensors("cuda", torch.float32), capacity, mode)

    def view(self, viewmat: Tensor, K: Tensor, background: Tensor | None) -> View:
        return View(viewmat, K, self.width, self.height, background, self.camera_model)

    def render_tensors(self, tensors: list[Tensor | None], capacity: int, mode: FrameMode) -> Frame:
        """Render the view with `tensors` in place of the scene's own."""
        return render_frame(tensors[:5], tensors[5], self.view(*tensors[6:]), capacity, mode)

    def exact(self, training: bool = False) -> tuple[Tensor, Tensor]:
        tensors = self.tensors("cpu", torch.float64)
        return reference.render_frame(tensors[:5], tensors[5], self.view(*tensors[6:]), expected_depth=not training)


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
    """Check all modes against the reference and return the training frame."""
    frame = s.render(capacity)
    needed, longest, overflow = frame.status.tolist()[:3]
    assert needed <= capacity and not overflow and longest <= needed
    assert_near(frame, s.exact())
    if longest <= MAX_SEGMENT:
        apart = s.render(max(longest, 1), FrameMode.SEGMENTS)
        for name in ("image", "alphas", "status"):
            assert torch.equal(getattr(apart, name), getattr(frame, name)), name
    training = s.render(capacity, FrameMode.TRAINING)
    assert_near(training, s.exact(training=True))
    assert torch.equal(frame.status, training.status)
    assert torch.equal(frame.alphas, training.alphas)
    check_lists(training)
    return training


def check_lists(frame: Frame) -> None:
    """Every instance is in one tile's list, each list is in the order of depth, and splats are numbered in order."""
    needed, longest, _ = frame.status.tolist()[:3]
    starts, offsets = frame.splat_starts.cpu().long(), frame.tile_offsets.cpu().long()
    assert starts[0] == 0 and offsets[0] == 0
    assert starts[-1] == offsets[-1] == needed
    assert longest == (offsets.diff().max() if len(offsets) > 1 else 0)
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


def plain(s: Scene) -> tuple[Tensor, Tensor]:
    """Return the result of `rasterization` for the scene, on the CPU."""
    means, quats, log_scales, logits, sh, d, viewmat, K, background = s.tensors("cuda", torch.float32)
    if d is not None:
        means, quats, log_scales, logits = (
            means + d[:, POSITION],
            quats + d[:, ROTATION],
            log_scales + d[:, LOG_SCALE],
            logits + d[:, OPACITY.start],
        )
        sh = torch.cat([sh[:, :1] + d[:, None, COLOUR], sh[:, 1:]], 1)
    image, alphas, _ = rasterization(
        means, quats, log_scales.exp(), torch.sigmoid(logits), sh, viewmat[None], K[None], s.width, s.height,
        sh_degree=math.isqrt(sh.shape[1]) - 1, backgrounds=None if background is None else background[None],
        render_mode="RGB+ED", packed=False, camera_model=s.camera_model,
    )  # fmt: skip
    return image[0].double().cpu(), alphas[0, ..., 0].double().cpu()
