"""Checks of tensor arguments, shared by the ops and their references."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import MAX_SH_DEGREE


def require_shape(name: str, tensor: Tensor, shape: tuple[int, ...], meaning: str) -> None:
    """Raise InvalidInput unless `tensor` has exactly `shape`.

    Args:
        name: argument name for the message.
        tensor: argument.
        shape: required shape.
        meaning: symbolic shape for the message, such as "[..., N, 3]".
    """
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
        raise InvalidInput(f"all inputs must have one floating-point dtype and one device, got {found}")


def require_float32(op: str, **tensors: Tensor | None) -> None:
    """Raise InvalidInput unless all tensors are float32 on one device with compiled kernels for `op`."""
    given = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    first = next(iter(given.values()), None)
    for name, tensor in given.items():
        if tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{op}: {name} must be float32, got {tensor.dtype}; convert it, or use gsplat_core.reference, which takes"
                " any floating-point dtype"
            )
        if first is not None and tensor.device != first.device:
            found = ", ".join(f"{name}: {tensor.device}" for name, tensor in given.items())
            raise InvalidInput(f"{op}: all inputs must be on one device, got {found}")
        require_kernels(op, name, tensor)


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


TILE_SIZE = 16
"""Side in pixels of the tiles of ops that blend one image."""


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
