"""Rasterizer with fixed options, for repeated pictures of Gaussians, and a function with the arguments of gsplat's wrapper of
the INRIA trainer's renderer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import require_shape
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.rendering.alpha import FrameRenderer, TileListCapacity
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.rendering.settings import (
    EPS2D,
    FAR_PLANE,
    NEAR_PLANE,
    TILE_SIZE,
    GsplatVersion,
    RasterizeMode,
    RenderMode,
    RenderSettings,
    SparseGradients,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

_CAPTURED_MODES = ("RGB", "ED", "RGB+ED")


class RasterizedPicture(NamedTuple):
    """Picture of one camera, as `rasterization` gives it."""

    colors: Tensor
    """Colours and depth [H, W, X], as the render mode says."""
    alphas: Tensor
    """Accumulated opacity [H, W, 1]."""
    meta: dict[str, Any] | None
    """Intermediate results of `rasterization`; None for a picture from a CUDA graph."""


class Rasterizer:
    """Options of `rasterization` as an object that is called with Gaussians and a camera.

    The picture is that of `rasterization` with the same options, with gradients if a tensor requires them. On a GPU,
    pictures without gradients come from a CUDA graph where the options allow it: float32, tiles of 16 px, the render
    modes RGB, ED and RGB+ED, and defaults for ranges, blur, order and constants. The graph is kept for the tensors and
    the camera size of the last call. Other tensors or sizes need a new one, and in-place changes of tensors do not.

    Which one to use:
        `rasterization`: programs with gsplat's arguments, batches, several cameras, plain colours.
        `render`: one picture of `Gaussians` with depth.
        `Rasterizer`: many pictures with the same options, with or without gradients, on any device.
        `FrameRenderer`: frames of a deforming scene on a GPU that are launched without waiting. `Rasterizer` waits for
            each picture and returns a copy; it uses `FrameRenderer` for its graphs.
        `new_renderer`: published models, chosen by the name of the renderer.

        rasterizer = Rasterizer(render_mode="RGB+ED", background=torch.ones(3))
        picture = rasterizer(gaussians, camera)
    """

    def __init__(
        self,
        *,
        tile_size: int = TILE_SIZE,
        near_plane: float = NEAR_PLANE,
        far_plane: float = FAR_PLANE,
        radius_clip: float = 0.0,
        eps2d: float = EPS2D,
        packed: bool = False,
        render_mode: RenderMode = "RGB",
        sparse_grad: SparseGradients = False,
        absgrad: bool = False,
        rasterize_mode: RasterizeMode = "classic",
        global_z_order: bool = True,
        constants: GsplatVersion = "1.6",
        background: Tensor | None = None,
        capture: bool = True,
        capacity: TileListCapacity | None = None,
    ) -> None:
        """Check and keep the options.

        Args:
            tile_size, near_plane, far_plane, radius_clip, eps2d, packed, render_mode, sparse_grad, absgrad,
                rasterize_mode, global_z_order, constants: as in `rasterization`.
            background: colour [3] behind the Gaussians; None for black.
            capture: False never uses a CUDA graph.
            capacity: entries that the tile lists of a CUDA graph hold at first; None for an estimate. A picture that
                needs more enlarges them.

        Raises:
            InvalidInput: for an invalid option.
        """
        self._options: dict[str, Any] = {
            "tile_size": tile_size, "near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip,
            "eps2d": eps2d, "packed": packed, "render_mode": render_mode, "sparse_grad": sparse_grad, "absgrad": absgrad,
            "rasterize_mode": rasterize_mode, "global_z_order": global_z_order, "constants": constants,
        }  # fmt: skip
        settings = RenderSettings(width=1, height=1, **self._options)
        if background is not None:
            require_shape("background", background, (3,), "[3]")
        self._background = background
        plain = RenderSettings(width=1, height=1, render_mode=render_mode, packed=packed)
        self._captures = capture and settings == plain and render_mode in _CAPTURED_MODES
        self._capacity = capacity
        self._captured: tuple[Gaussians, FrameRenderer] | None = None

    @property
    def capacity(self) -> TileListCapacity | None:
        """Capacity of the CUDA graph's tile lists; the initial one, or None for an estimate, before the first graph."""
        return self._capacity if self._captured is None else self._captured[1].capacity

    def __call__(self, gaussians: Gaussians, camera: Camera) -> RasterizedPicture:
        """Return the picture of one camera.

        Raises:
            InvalidInput: if the Gaussians do not fit the options; see `rasterization`.
        """
        if self._captures and self._can_capture(gaussians):
            return self._from_graph(gaussians, camera)
        viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
        has_colors = self._options["render_mode"].startswith("RGB")
        behind = None
        if self._background is not None and has_colors:
            behind = self._background.to(gaussians.device, gaussians.dtype)[None]
        colors, alphas, meta = rasterization(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, viewmat[None],
            intrinsics[None], camera.width_px, camera.height_px, sh_degree=gaussians.sh_degree,
            camera_model=camera.model, backgrounds=behind, **self._options,
        )  # fmt: skip
        return RasterizedPicture(colors[0], alphas[0], meta)

    @staticmethod
    def _can_capture(gaussians: Gaussians) -> bool:
        if gaussians.device.type != "cuda" or gaussians.dtype != torch.float32 or CUDA_MISSING is not None:
            return False
        return not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in gaussians.left_tensors))

    def _from_graph(self, gaussians: Gaussians, camera: Camera) -> RasterizedPicture:
        kept = self._captured
        if kept is None or not _same_graph(*kept, gaussians, camera):
            background = None if self._background is None else self._background.to(gaussians.device)
            frames = FrameRenderer(gaussians, camera, background=background)
            if (capacity := self.capacity) is not None:
                frames.capacity = capacity
            kept = self._captured = gaussians, frames
        output = kept[1].render(camera).result()
        mode, depth = self._options["render_mode"], output.depth[..., None]
        parts = {"RGB": [output.image], "ED": [depth], "RGB+ED": [output.image, depth]}[mode]
        # Return copies (`cat` makes one), because the next picture overwrites the CUDA graph's memory.
        return RasterizedPicture(torch.cat(parts, -1), output.alpha[..., None].clone(), None)


def _same_graph(kept: Gaussians, frames: FrameRenderer, gaussians: Gaussians, camera: Camera) -> bool:
    shape = frames.picture_shape
    same_tensors = all(a is b for a, b in zip(kept.left_tensors, gaussians.left_tensors, strict=True))
    return same_tensors and shape == (camera.width_px, camera.height_px, camera.model)


def rasterization_inria_wrapper(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    far_plane: float = 100.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    **kwargs: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render with `rasterization`, as a stand-in for the renderer of the INRIA trainer, which is not part of this package.

    Arguments and results are those of gsplat's function of this name: a picture, its opacities and an empty dict.
    Further arguments are ignored, as there.
    """
    colours, alphas, _ = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d=eps2d,
        sh_degree=sh_degree, packed=False, backgrounds=backgrounds,
    )  # fmt: skip
    return colours, alphas, {}
