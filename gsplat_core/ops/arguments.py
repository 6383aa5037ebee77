"""Arguments and results that ops share with each other and with their oracles: checks, result types, the camera view with
device tensors, and the partition of an image into tiles.

This module does not load the compiled library, so that `gsplat_core.reference` works without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.rendering.settings import EPS2D, FAR_PLANE, NEAR_PLANE, TILE_SIZE
from gsplat_core.scene.cameras import CAMERA_MODELS, CameraModel
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, RAW_COLUMNS


def require_shape(name: str, tensor: Tensor, shape: tuple[int, ...], meaning: str) -> None:
    """Raise InvalidInput unless `tensor` has exactly `shape`.

    Args:
        name: argument name for the message.
        tensor: argument.
        shape: required shape.
        meaning: symbolic shape for the message, such as "[..., N, 3]".
    """
    if not isinstance(tensor, Tensor):
        raise InvalidInput(
            f"{name} must be a tensor {meaning}, got {type(tensor).__name__}; convert it by torch.as_tensor"
        )
    if tuple(tensor.shape) != tuple(shape):
        raise InvalidInput(f"{name} must be {meaning} = {list(shape)}, got {list(tensor.shape)}")


def require_trailing(name: str, tensor: Tensor, trailing: tuple[int, ...], meaning: str) -> tuple[int, ...]:
    """Raise InvalidInput unless the shape ends in `trailing`; return the leading dimensions."""
    split = tensor.dim() - len(trailing)
    if split < 0 or tuple(tensor.shape[split:]) != tuple(trailing):
        raise InvalidInput(f"{name} must be {meaning}, got {list(tensor.shape)}")
    return tuple(tensor.shape[:split])


def require_same_kind(**tensors: Tensor | None) -> None:
    """Raise InvalidInput unless all given tensors are floating point, of one dtype and on one device."""
    given = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    kinds = {(tensor.dtype, tensor.device) for tensor in given.values()}
    if len(kinds) > 1 or any(not tensor.is_floating_point() for tensor in given.values()):
        found = ", ".join(f"{name}: {tensor.dtype} on {tensor.device}" for name, tensor in given.items())
        raise InvalidInput(
            f"all inputs must have one floating-point dtype and one device, got {found}; convert them with Tensor.to"
        )


def require_float32(op: str, **tensors: Tensor | None) -> None:
    """Raise InvalidInput unless all tensors are float32 on one device with compiled kernels for `op`."""
    device = None
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{op}: {name} must be float32, got {tensor.dtype}; convert it, or use gsplat_core.reference, which takes"
                " any floating-point dtype"
            )
        if device is None:
            device = tensor.device
            require_kernels(op, name, tensor)
        elif tensor.device != device:
            found = ", ".join(f"{name}: {each.device}" for name, each in tensors.items() if each is not None)
            raise InvalidInput(f"{op}: all inputs must be on one device, got {found}")


def require_kernels(op: str, name: str, tensor: Tensor) -> None:
    """Raise InvalidInput unless this build has kernels for the device of `tensor`."""
    if tensor.device.type == "cpu":
        return
    from gsplat_core.ops.native import CUDA_MISSING  # here, because the reference works without the compiled core

    if tensor.device.type == "cuda" and CUDA_MISSING is None:
        return
    why = "and CUDA" if CUDA_MISSING is None else f"only: those for CUDA are {CUDA_MISSING}"
    raise InvalidInput(
        f"{op}: {name} is on {tensor.device}, and this build has kernels for the CPU {why}; move it with .cpu(), or use"
        " gsplat_core.reference, which runs on any device"
    )


def require_tiled_splats(
    op: str, size_px: tuple[int, int], isect_offsets: Tensor, flatten_ids: Tensor, opacities: Tensor,
    **rows: tuple[Tensor, int],
) -> None:  # fmt: skip
    """Check the splats of one image and their lists, for an op that blends tiles of 16 pixels.

    Args:
        op: name of the op for messages.
        size_px: width and height of the image.
        isect_offsets: int32 [tile_height, tile_width].
        flatten_ids: int32 [M].
        opacities: float32 [N].
        rows: further float32 tensors [N, K] by name, each with K.

    Raises:
        InvalidInput: for wrong shapes or dtypes, or if the tiles do not cover the image.
    """
    require_float32(op, opacities=opacities, **{name: tensor for name, (tensor, _) in rows.items()})
    if opacities.ndim != 1:
        raise InvalidInput(f"opacities must be [N], got {list(opacities.shape)}")
    for name, (tensor, width) in rows.items():
        require_shape(name, tensor, (len(opacities), width), f"[N, {width}]")
    for name, tensor in {"isect_offsets": isect_offsets, "flatten_ids": flatten_ids}.items():
        if tensor.dtype != torch.int32:
            raise InvalidInput(f"{name} must be int32 as bin_splats returns it, got {tensor.dtype}")
    if isect_offsets.ndim != 2 or flatten_ids.ndim != 1:
        raise InvalidInput(
            "isect_offsets must be [tile_height, tile_width] and flatten_ids [M], got"
            f" {list(isect_offsets.shape)} and {list(flatten_ids.shape)}"
        )
    if any(tiles * TILE_SIZE < side for tiles, side in zip(reversed(isect_offsets.shape), size_px, strict=True)):
        raise InvalidInput(
            f"{list(isect_offsets.shape)} tiles of {TILE_SIZE} px do not cover the image of {size_px[0]} x {size_px[1]} px"
        )


def check_max_alpha(max_alpha: float) -> None:
    """Raise InvalidInput unless the upper limit of alpha is from 1/255 to below 1."""
    if not 1 / 255 <= max_alpha < 1:
        raise InvalidInput(f"max_alpha must be from 1/255 to below 1, got {max_alpha}")


def check_covariance_arguments(quats: Tensor, scales: Tensor) -> None:
    """Raise InvalidInput unless quats are [..., 4] and scales [..., 3], of one dtype and device."""
    leading = require_trailing("quats", quats, (4,), "[..., 4] (wxyz)")
    require_shape("scales", scales, (*leading, 3), "[..., 3]")
    require_same_kind(quats=quats, scales=scales)


def check_spherical_harmonics_arguments(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None
) -> None:
    """Raise InvalidInput unless dirs are [..., 3], coeffs [..., K, 3] with K >= (degree + 1)² and masks bool [...].

    The leading dimensions of coeffs and masks must broadcast to those of dirs.
    """
    leading = require_trailing("dirs", dirs, (3,), "[..., 3]")
    if not 0 <= degrees_to_use <= MAX_SH_DEGREE:
        raise InvalidInput(f"degrees_to_use must be 0 to {MAX_SH_DEGREE}, got {degrees_to_use}")
    if coeffs.shape[-2:] == (4, 4):
        raise InvalidInput(
            f"coeffs must be [..., K, 3], got {list(coeffs.shape)}, which may be viewmats of gsplat 1.6; give the directions"
            " means - torch.linalg.inv(viewmats)[..., None, :3, 3] and the coefficients, as in gsplat 1.5.3"
        )
    bases = (degrees_to_use + 1) ** 2
    if coeffs.dim() < 2 or coeffs.shape[-1] != 3 or coeffs.shape[-2] < bases:
        raise InvalidInput(
            f"coeffs must be [..., K, 3] with K >= {bases} for degree {degrees_to_use}, got {list(coeffs.shape)}"
        )
    require_same_kind(dirs=dirs, coeffs=coeffs)
    if masks is not None and masks.dtype != torch.bool:
        raise InvalidInput(f"masks must be bool, got {masks.dtype}")
    for name, shape in (("coeffs", coeffs.shape[:-2]), ("masks", () if masks is None else masks.shape)):
        pairs = zip(reversed(shape), reversed(leading), strict=False)
        if len(shape) > len(leading) or any(have not in (1, want) for have, want in pairs):
            raise InvalidInput(
                f"{name} must have the leading dimensions of dirs, {list(leading)}, or broadcast to them;"
                f" got {list(shape)}"
            )


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
    """Antialiasing factor on the opacity [..., C, N]; None if it was not requested."""


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
        """Return the id of the pair of camera and Gaussian in each packed row, int64 [rows], ascending."""
        return (rows.batch_ids * self.cameras + rows.camera_ids) * self.gaussians + rows.gaussian_ids

    def gaussians_of(self, ids: Tensor) -> Tensor:
        """Return for each pair id the index of its Gaussian among the Gaussians of all batches, int64 [rows]."""
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
        if camera_model == "ftheta":
            raise NotImplementedError(
                "camera_model='ftheta' needs the unscented projection; use rasterization(with_ut=True, ftheta_coeffs=...)"
                " or fully_fused_projection_with_ut"
            )
        if camera_model == "lidar":
            raise NotImplementedError(
                f"camera_model='lidar' is not supported; the models are {', '.join(CAMERA_MODELS)}"
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
    """Return the packed projection: one row for each pair of camera and surfel that is not culled."""
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
