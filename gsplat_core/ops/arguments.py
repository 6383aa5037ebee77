"""Arguments and results that ops share with each other and with their oracles: checks, result types, the camera view with
device tensors, and the partition of an image into tiles.

This module does not load the compiled library, so that `gsplat_core.reference` works without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32, require_same_kind, require_shape, require_trailing
from gsplat_core.errors import InvalidInput
from gsplat_core.rendering.settings import EPS2D, FAR_PLANE, NEAR_PLANE
from gsplat_core.scene.cameras import CAMERA_MODELS, CameraModel
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, RAW_COLUMNS

MAX_EXTENT_SIGMAS = 3.33
"""Distance in standard deviations at which an opaque Gaussian falls below the 1/255 alpha cut-off."""
ALPHA_CUTOFF = 1.0 / 255.0
COMPENSATION_FLOOR = 0.005
"""Default lower limit of the antialiasing compensation (Yu et al. 2024, Mip-Splatting code)."""
MAX_RADIUS_PX = 1e9
"""Upper limit of radii in pixels, so that they fit an int32."""
FOV_MARGIN = 0.3
"""Margin beyond the field of view at which the pinhole Jacobian is clamped.

The point is at most (1 + 0.3) half fields of view off the axis (Kerbl et al. 2023).
"""


class DenseProjection(NamedTuple):
    """Results of a projection with one row per camera and Gaussian; zeros where the Gaussian is culled."""

    radii: Tensor
    """Half width and half height of the bounding box in pixels, int32 [..., C, N, 2]; (0, 0) = culled."""
    means2d: Tensor
    """Projected centres [..., C, N, 2] in pixels."""
    depths: Tensor
    """Camera-space z [..., C, N]."""
    conics: Tensor
    """Inverse of the blurred 2D covariance as (xx, xy, yy), [..., C, N, 3]."""
    compensations: Tensor | None
    """Antialiasing factor on the opacity [..., C, N], or None."""


class PackedProjection(NamedTuple):
    """Results of a projection with one row per camera and Gaussian that is not culled, ordered by batch, camera,
    Gaussian.
    """

    batch_ids: Tensor
    """Batch index of each row, int64 [nnz], over the flattened batch dimensions."""
    camera_ids: Tensor
    """Camera index of each row, int64 [nnz]."""
    gaussian_ids: Tensor
    """Gaussian index of each row, int64 [nnz]."""
    radii: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor
    compensations: Tensor | None


class Pairs(NamedTuple):
    """Numbers of batches, cameras and Gaussians. They determine the id of each pair of camera and Gaussian.

    The id of a pair is (batch * cameras + camera) * gaussians + gaussian. Values of each camera and Gaussian are those
    of B * C batches with one camera.
    """

    batches: int
    cameras: int
    gaussians: int

    def ids_of(self, rows: PackedProjection) -> Tensor:
        """Return the ids of the rows, int64 [rows], ascending."""
        return (rows.batch_ids * self.cameras + rows.camera_ids) * self.gaussians + rows.gaussian_ids

    def gaussians_of(self, ids: Tensor) -> Tensor:
        """Return the index of each row into the Gaussians of all batches, int64 [rows]."""
        if self.cameras == 1:
            return ids
        gaussian = ids % self.gaussians
        return gaussian if self.batches == 1 else ids // (self.cameras * self.gaussians) * self.gaussians + gaussian


def check_projection_tensors(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
) -> tuple[int, ...]:
    """Check shapes, dtypes and devices of a projection's tensors; return the batch dimensions.

    Raises:
        InvalidInput: if they do not match.
    """
    *batch, n = require_trailing("means", means, (3,), "[..., N, 3]") or (None,)
    if n is None:
        raise InvalidInput(f"means must be [..., N, 3], got {list(means.shape)}")
    batch_dims = tuple(batch)
    if covars is not None:
        if quats is not None or scales is not None:
            raise InvalidInput("give covars, or quats and scales, not both")
        require_shape("covars", covars, (*batch_dims, n, 6), "[..., N, 6] (upper triangle)")
    elif quats is None or scales is None:
        raise InvalidInput("give covars, or both quats and scales")
    else:
        require_shape("quats", quats, (*batch_dims, n, 4), "[..., N, 4]")
        require_shape("scales", scales, (*batch_dims, n, 3), "[..., N, 3]")
    if opacities is not None:
        require_shape("opacities", opacities, (*batch_dims, n), "[..., N]")
    c = viewmats.shape[-3] if viewmats.dim() >= 3 else 0
    require_shape("viewmats", viewmats, (*batch_dims, c, 4, 4), "[..., C, 4, 4]")
    require_shape("Ks", Ks, (*batch_dims, c, 3, 3), "[..., C, 3, 3]")
    require_same_kind(
        means=means, covars=covars, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks
    )
    return batch_dims


def check_projection_options(width: int, height: int, camera_model: str, compensation_floor: float) -> None:
    """Check the options of a projection.

    Raises:
        InvalidInput: for an empty image, an unknown camera model or a floor outside 0..1.
        NotImplementedError: for camera models that only gsplat supports.
    """
    if width < 1 or height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={width}, height={height}")
    if not 0 <= compensation_floor <= 1:
        raise InvalidInput(f"compensation_floor must be from 0 to 1, got {compensation_floor}")
    if camera_model not in CAMERA_MODELS:
        if camera_model in ("ftheta", "lidar"):
            raise NotImplementedError(
                f"camera_model={camera_model!r} is not supported; the models are {', '.join(CAMERA_MODELS)}"
            )
        raise InvalidInput(f"unknown camera_model {camera_model!r}; the models are {', '.join(CAMERA_MODELS)}")


def check_sparse_gradient(sparse_grad: bool, packed: bool, batch_dims: tuple[int, ...]) -> None:
    """Raise InvalidInput for sparse gradients of a projection that is not packed or has batch dimensions."""
    if sparse_grad and not packed:
        raise InvalidInput("sparse_grad=True needs packed=True; give packed=True, or leave sparse_grad out")
    if sparse_grad and batch_dims:
        raise InvalidInput(
            f"sparse_grad=True takes tensors without batch dimensions, got {list(batch_dims)}; render one scene at a"
            " time, or leave sparse_grad out"
        )


LEAST_EXTENT_SQUARED = 1e-4
"""Lower limit in pixels² of a surfel's squared half width or half height at one standard deviation."""


class DenseSurfels(NamedTuple):
    """Results of a projection with one row per camera and surfel; zeros where the surfel is culled."""

    radii: Tensor
    """Half width and half height of the bounding box in pixels, int32 [..., C, N, 2]; (0, 0) = culled."""
    means2d: Tensor
    """Centres of the bounding boxes at one standard deviation [..., C, N, 2] in pixels."""
    depths: Tensor
    """Camera-space z of the surfels' centres [..., C, N]."""
    ray_transforms: Tensor
    """Homographies [..., C, N, 3, 3] from (u, v, 1), in standard deviations on the surfel, to homogeneous pixels."""
    normals: Tensor
    """Unit normals in camera axes, towards the camera, [..., C, N, 3]."""


class PackedSurfels(NamedTuple):
    """Results of a projection with one row per camera and surfel that is not culled, ordered by batch, camera, surfel."""

    batch_ids: Tensor
    """Batch index of each row, int64 [nnz], over the flattened batch dimensions."""
    camera_ids: Tensor
    """Camera index of each row, int64 [nnz]."""
    gaussian_ids: Tensor
    """Surfel index of each row, int64 [nnz]."""
    radii: Tensor
    means2d: Tensor
    depths: Tensor
    ray_transforms: Tensor
    normals: Tensor


def check_surfel_arguments(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    packed: bool,
    sparse_grad: bool,
) -> tuple[int, ...]:
    """Check shapes, dtypes, devices and options of a projection; return the batch dimensions.

    Raises:
        InvalidInput: if they do not match.
    """
    *batch, n = require_trailing("means", means, (3,), "[..., N, 3]") or (None,)
    if n is None:
        raise InvalidInput(f"means must be [..., N, 3], got {list(means.shape)}")
    batch_dims = tuple(batch)
    require_shape("quats", quats, (*batch_dims, n, 4), "[..., N, 4]")
    require_shape("scales", scales, (*batch_dims, n, 3), "[..., N, 3]")
    c = viewmats.shape[-3] if viewmats.dim() >= 3 else 0
    require_shape("viewmats", viewmats, (*batch_dims, c, 4, 4), "[..., C, 4, 4]")
    require_shape("Ks", Ks, (*batch_dims, c, 3, 3), "[..., C, 3, 3]")
    require_same_kind(means=means, quats=quats, scales=scales, viewmats=viewmats, Ks=Ks)
    if width < 1 or height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={width}, height={height}")
    if sparse_grad and (not packed or batch_dims):
        raise InvalidInput(
            f"sparse_grad=True needs packed=True and means [N, 3] without batch dimensions, got packed={packed} and"
            f" {list(means.shape)}"
        )
    return batch_dims


def pack_surfels(dense: DenseSurfels) -> PackedSurfels:
    """Keep only the rows that are not culled."""
    n_cameras, n_surfels = dense.radii.shape[-3:-1]
    rows = dense.radii.detach().reshape(-1, 2)[:, 0].nonzero().squeeze(-1)
    images = torch.div(rows, max(n_surfels, 1), rounding_mode="floor")
    return PackedSurfels(
        batch_ids=torch.div(images, max(n_cameras, 1), rounding_mode="floor"),
        camera_ids=images % max(n_cameras, 1),
        gaussian_ids=rows % max(n_surfels, 1),
        radii=dense.radii.reshape(-1, 2)[rows],
        means2d=dense.means2d.reshape(-1, 2)[rows],
        depths=dense.depths.reshape(-1)[rows],
        ray_transforms=dense.ray_transforms.reshape(-1, 3, 3)[rows],
        normals=dense.normals.reshape(-1, 3)[rows],
    )


class TileGrid(NamedTuple):
    """Grid of square tiles covering an image; the fields are in the argument order of `isect_tiles`."""

    tile_size: int
    """Side of a tile in pixels."""
    tile_width: int
    """Number of tiles per row."""
    tile_height: int
    """Number of tiles per column."""


class ImageLoss(NamedTuple):
    """Image loss with its gradients, the input of the renderer's backward op."""

    loss: Tensor
    """Weighted sum of the loss terms, scalar; differentiable in image and depth."""
    terms: Tensor
    """Terms [3] before weighting: L1 or squared error, 1 - SSIM (0 if unweighted), inverse-depth L1.

    Not differentiable.
    """
    grad_image: Tensor
    """Gradient of the loss by the image, dL/dimage [H, W, C]. Not differentiable."""
    grad_depth: Tensor | None
    """dL/ddepth [H, W]; None without depth. Not differentiable."""


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
