"""Frames for the tests of the fused path: scenes of raw Gaussians, their reference, and a forward pass made of the plain ops."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from gsplat_core import fully_fused_projection, spherical_harmonics
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.frame import Frame, FrameMode, View, render_frame
from gsplat_core.ops.frame_gradients import RawGradients, render_frame_backward
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.reference.rendering import render_frame as reference_frame
from gsplat_core.rendering.settings import FAR_PLANE, NEAR_PLANE
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")
TILE = 16
COLUMNS = {"means": POSITION, "quats": ROTATION, "log_scales": LOG_SCALE, "logit_opacities": OPACITY.start}


@dataclass(frozen=True)
class FrameScene:
    """Raw Gaussians, what a field adds to them, and a camera."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    deltas: Tensor | None = None
    background: Tensor | None = None
    camera_model: str = "pinhole"

    @property
    def gaussians(self) -> list[Tensor]:
        return [getattr(self, name) for name in NAMES]

    @property
    def view(self) -> View:
        return View(self.viewmat, self.K, self.width, self.height, self.background, self.camera_model)

    def to(self, *kind: torch.device | torch.dtype | str) -> FrameScene:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: v.to(*kind) for name, v in values.items() if isinstance(v, Tensor)})

    def select(self, rows: Tensor) -> FrameScene:
        deltas = None if self.deltas is None else self.deltas[rows]
        return replace(self, deltas=deltas, **{name: getattr(self, name)[rows] for name in NAMES})

    def picture_gradients(self, with_alphas: bool = True) -> tuple[Tensor, Tensor | None]:
        """A fixed random linear function of the picture; depths weigh less, as they are larger."""
        g = torch.Generator().manual_seed(11)
        v_image = torch.randn(self.height, self.width, 4, generator=g) * torch.tensor([1, 1, 1, 0.05])
        return v_image, torch.randn(self.height, self.width, generator=g) if with_alphas else None

    def reference_gradients(self, with_alphas: bool = True) -> dict[str, Tensor]:
        """Return float64 CPU autograd gradients of the raw parameters, and of the deltas if present."""
        scene = self.to("cpu").to(torch.float64)
        leaves = {name: getattr(scene, name).clone().requires_grad_() for name in NAMES}
        if scene.deltas is not None:
            leaves["deltas"] = scene.deltas.clone().requires_grad_()
        image, alphas = reference_frame([leaves[name] for name in NAMES], leaves.get("deltas"), scene.view)
        v_image, v_alphas = self.picture_gradients(with_alphas)
        total = (image * v_image).sum() + (0 if v_alphas is None else (alphas * v_alphas).sum())
        total.backward()
        return {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}


def frame_scene(
    count: int,
    width: int = 70,
    height: int = 45,
    degree: int = 1,
    camera_model: str = "pinhole",
    median_px: float = 3.0,
    deltas: bool = False,
    background: bool = True,
    seed: int = 0,
) -> FrameScene:
    """Gaussians of about `median_px` all over the picture, 3 to 9 units in front of a turned and shifted camera, float32."""
    g = torch.Generator().manual_seed(seed)
    focal = 0.8 * width
    z = 3 + 6 * torch.rand(count, generator=g)
    pixels = torch.rand(count, 2, generator=g) * torch.tensor([width + 10.0, height + 10.0]) - 5
    offset = pixels - torch.tensor([width / 2, height / 2])
    distance = torch.full_like(z, 6.0) if camera_model == "ortho" else z
    if camera_model == "ortho":
        focal /= 6.0
        x, y = (offset / focal).unbind(-1)
        distance = torch.ones_like(z)
    elif camera_model == "fisheye":
        angle = offset.norm(dim=-1) / focal
        radius = angle.clamp(max=1.2).tan() * z
        x, y = (offset / offset.norm(dim=-1, keepdim=True).clamp(min=1e-6) * radius[:, None]).unbind(-1)
    else:
        x, y = (offset / focal * z[:, None]).unbind(-1)
    in_camera = torch.stack([x, y, z], -1)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.1], [-0.2, 0.1, 0.0]]))
    shift = torch.tensor([0.4, -0.7, 1.1])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, shift
    size = median_px * torch.exp(0.5 * torch.randn(count, 3, generator=g)) / focal * distance[:, None]
    sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    sh[:, 0] += 0.5
    return FrameScene(
        means=(in_camera - shift) @ turn,
        quats=torch.randn(count, 4, generator=g) * 2,
        log_scales=size.log(),
        logit_opacities=1 + 2 * torch.randn(count, generator=g),
        sh=sh,
        viewmat=viewmat,
        K=torch.tensor([[focal, 0.0, width / 2], [0.0, 1.1 * focal, height / 2], [0.0, 0.0, 1.0]]),
        width=width,
        height=height,
        deltas=0.05 * torch.randn(count, 16, generator=g) if deltas else None,
        background=torch.rand(3, generator=g) if background else None,
        camera_model=camera_model,
    )


def rendered(scene: FrameScene) -> Frame:
    """The forward pass of a training step; the scene is on the GPU."""
    tiles = math.ceil(scene.width / TILE) * math.ceil(scene.height / TILE)
    capacity = 1 + tiles * len(scene.means)
    frame = render_frame(scene.gaussians, scene.deltas, scene.view, capacity, FrameMode.TRAINING)
    assert not frame.status[2]
    return frame


def forward_of_plain_ops(scene: FrameScene) -> Frame:
    """The lists and records of a scene on the GPU, composed of projection, harmonics, binning and compositing."""
    raw = torch.cat([*scene.gaussians[:3], scene.sh[:, 0], scene.logit_opacities[:, None]], 1)
    if scene.deltas is not None:
        raw = raw + scene.deltas[:, :14]
    usable = raw.isfinite().all(1) & scene.sh.isfinite().flatten(1).all(1)
    mean, quat, log_scale, dc, logit = torch.where(usable[:, None], raw, 1).split([3, 4, 3, 3, 1], 1)
    opacity = torch.where(usable, torch.sigmoid(logit[:, 0]), 0)
    view, count = scene.viewmat[None], len(raw)
    projected = fully_fused_projection(
        mean.contiguous(), None, quat.contiguous(), log_scale.exp(), view, scene.K[None], scene.width, scene.height,
        opacities=opacity, camera_model=scene.camera_model, near_plane=NEAR_PLANE, far_plane=FAR_PLANE,
    )  # fmt: skip
    means2d, depths, conics = projected.means2d[0], projected.depths[0], projected.conics[0]
    center = -scene.viewmat[:3, :3].T @ scene.viewmat[:3, 3]
    sh = torch.where(usable[:, None, None], torch.cat([dc[:, None], scene.sh[:, 1:]], 1), 0)
    degree = math.isqrt(scene.sh.shape[1]) - 1
    colors = (spherical_harmonics(degree, mean - center, sh) + 0.5).clamp_min(0)
    colors = torch.where((projected.radii[0] > 0).all(-1)[:, None], colors, 0)
    channels = torch.cat([colors, depths[:, None]], 1)
    grid = TileGrid(TILE, math.ceil(scene.width / TILE), math.ceil(scene.height / TILE))
    _, ids, offsets = bin_splats(
        means2d[None], projected.radii, depths[None], grid, conics=conics[None], opacities=opacity[None]
    )
    background = None if scene.background is None else torch.cat([scene.background, scene.background.new_zeros(1)])
    image, alphas, last = torch.ops.gsplat_core.composite(
        means2d, conics, channels, opacity, offsets, ids, None if background is None else background[None], None, None,
        scene.width, scene.height, TILE,
    )  # fmt: skip
    order = torch.argsort(ids, stable=True)
    instances = torch.empty_like(ids)
    instances[order] = torch.arange(len(ids), dtype=ids.dtype, device=ids.device)
    starts = torch.zeros(count + 1, dtype=torch.int32, device=ids.device)
    starts[1:] = torch.bincount(ids.long(), minlength=count).cumsum(0)[:count]
    log2e = math.log2(math.e)
    coefficients = -log2e * torch.stack(
        [0.5 * conics[:, 0], conics[:, 1], 0.5 * conics[:, 2], -opacity.log2() / log2e], 1
    )
    zero = torch.zeros_like(depths)[:, None]
    records = torch.cat([means2d, coefficients, zero + math.inf, channels, zero], 1)
    end = torch.tensor([len(ids)], dtype=torch.int32, device=ids.device)
    status = torch.tensor([len(ids), 0, 0, 0], dtype=torch.int32, device=ids.device)
    return Frame(
        image[0],
        alphas[0, ..., 0],
        last[0],
        records,
        torch.cat([offsets.flatten(), end]),
        instances,
        starts,
        ids[order],
        status,
    )


def on_gpu(scene: FrameScene) -> FrameScene:
    return scene.to("cuda")


def backward(
    scene: FrameScene, forward: Frame | None = None, with_alphas: bool = True, deterministic: bool = True
) -> RawGradients:
    """The gradients of `scene.picture_gradients`; the scene is on the GPU."""
    v_image, v_alphas = scene.picture_gradients(with_alphas)
    return render_frame_backward(
        scene.gaussians, scene.deltas, scene.view, forward or rendered(scene), v_image.cuda(),
        None if v_alphas is None else v_alphas.cuda(), deterministic=deterministic,
    )  # fmt: skip


def by_name(gradients: RawGradients, bases: int) -> dict[str, Tensor]:
    named = {name: gradients.raw[:, columns] for name, columns in COLUMNS.items()}
    named["sh"] = gradients.sh if bases > 1 else gradients.raw[:, None, COLOUR]
    return {name: value.cpu().double() for name, value in named.items()}
