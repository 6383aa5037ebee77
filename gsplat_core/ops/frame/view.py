"""Shared parts of the frame ops: the camera view with device tensors, and input checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.rendering.settings import EPS2D, FAR_PLANE, NEAR_PLANE
from gsplat_core.scene.cameras import CAMERA_MODELS, CameraModel
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, RAW_COLUMNS

GAUSSIAN_TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh")
"""Names of the Gaussians' tensors in the order used by ops, moments and learning rates."""


class View(NamedTuple):
    """Camera for `render_frame` and its backward ops; the tensors are read on the device at every launch and replay."""

    viewmat: Tensor
    """World-to-camera matrix [4, 4], OpenCV axes."""
    K: Tensor
    """Intrinsics [3, 3] in pixels, without skew."""
    width: int
    height: int
    background: Tensor | None = None
    """Background colour [3]; None for black."""
    camera_model: CameraModel = "pinhole"
    eps2d: float = EPS2D
    near_plane: float = NEAR_PLANE
    far_plane: float = FAR_PLANE
    """Largest rendered z. Camera model, blur and clipping planes have the meaning and defaults of
    `gsplat_core.rasterization`.
    """

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """viewmat, K and background in the argument order of the ops."""
        return self.viewmat, self.K, self.background

    @property
    def model_index(self) -> int:
        """Index of the camera model as used by the ops."""
        return CAMERA_MODELS.index(self.camera_model)


def check_inputs(
    op: str,
    gaussians: Sequence[Tensor],
    deltas: Tensor | None,
    view: View,
    *,
    half_sh: bool = False,
    **more: Tensor | None,
) -> None:
    """Raise InvalidInput unless shapes, dtypes and device are supported by `op`.

    `half_sh` permits float16 `sh`. Tensors in `more` must be float32 on the same device.
    """
    if len(gaussians) != len(GAUSSIAN_TENSORS):
        raise InvalidInput(f"gaussians must be {', '.join(GAUSSIAN_TENSORS)}, got {len(gaussians)} tensors")
    means, quats, log_scales, logit_opacities, sh = gaussians
    n = means.shape[0] if means.dim() else 0
    require_shape("means", means, (n, 3), "[N, 3]")
    require_shape("quats", quats, (n, 4), "[N, 4]")
    require_shape("log_scales", log_scales, (n, 3), "[N, 3]")
    require_shape("logit_opacities", logit_opacities, (n,), "[N]")
    bases = sh.shape[1] if sh.dim() == 3 else 0
    if bases not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)] or tuple(sh.shape) != (n, bases, 3):
        raise InvalidInput(
            f"sh must be [N, B, 3] with N = {n} and B = (degree + 1)², degree 0 to {MAX_SH_DEGREE}; got {list(sh.shape)}"
        )
    if deltas is not None:
        require_shape("deltas", deltas, (n, RAW_COLUMNS), "[N, 16]")
    _check_view(view)
    floats = dict(zip(GAUSSIAN_TENSORS, gaussians, strict=True)) | {
        "deltas": deltas, "viewmat": view.viewmat, "K": view.K, "background": view.background, **more,
    }  # fmt: skip
    if half_sh and sh.dtype == torch.float16:
        del floats["sh"]
    require_float32(op, **floats)
    if means.device.type != "cuda":
        raise InvalidInput(
            f"{op} runs on CUDA only and the Gaussians are on {means.device}; gsplat_core.render runs on any device"
        )


def _check_view(view: View) -> None:
    require_shape("viewmat", view.viewmat, (4, 4), "[4, 4]")
    require_shape("K", view.K, (3, 3), "[3, 3]")
    if view.background is not None:
        require_shape("background", view.background, (3,), "[3]")
    if view.width < 1 or view.height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={view.width}, height={view.height}")
    if view.camera_model not in CAMERA_MODELS:
        raise InvalidInput(f"unknown camera_model {view.camera_model!r}; the models are {', '.join(CAMERA_MODELS)}")
