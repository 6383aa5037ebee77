"""Small functions of `gsplat.utils` and `gsplat.exporter`, the scene of gsplat's tests and profiles, and a stand-in for gsplat's compiled extension."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.io.exports.export import export_splats
from gsplat_core.io.ply import load_ply
from gsplat_core.ops.arguments import require_trailing
from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.training.strategies.strategy import draw


def normalized_quat_to_rotmat(quat: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of unit quaternions wxyz [..., 4]."""
    require_trailing("quat", quat, (4,), "[..., 4]")
    vector = quat[..., 1:]
    w = quat[..., :1, None]
    outer = vector[..., :, None] * vector[..., None, :]
    identity = torch.eye(3, dtype=quat.dtype, device=quat.device)
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    square = (vector * vector).sum(-1)[..., None, None]
    return identity + 2 * (outer - square * identity + w * cross)


def log_transform(x: Tensor) -> Tensor:
    """Return sign(x) log(1 + |x|)."""
    return torch.sign(x) * torch.log1p(x.abs())


def inverse_log_transform(y: Tensor) -> Tensor:
    """Return the value whose `log_transform` is `y`."""
    return torch.sign(y) * torch.expm1(y.abs())


def get_projection_matrix(
    znear: float, zfar: float, fovX: float, fovY: float, device: torch.device | str | None = None
) -> Tensor:
    """Return the projection matrix [4, 4] of a camera with its axis along +z, with depth from 0 to 1.

    Args:
        znear: z of the near plane.
        zfar: z of the far plane.
        fovX: horizontal field of view in radians.
        fovY: vertical field of view in radians.
        device: device of the matrix; None for CUDA if there is a GPU, as in gsplat, and else for the default device of torch.
    """
    if device is None and torch.cuda.is_available():
        device = "cuda"
    matrix = torch.zeros(4, 4, device=device)
    matrix[0, 0] = 1 / math.tan(0.5 * fovX)
    matrix[1, 1] = 1 / math.tan(0.5 * fovY)
    matrix[2, 2] = zfar / (zfar - znear)
    matrix[2, 3] = -zfar * znear / (zfar - znear)
    matrix[3, 2] = 1
    return matrix


def save_ply(splats: Mapping[str, Tensor], dir: str, colors: Tensor | None = None) -> None:
    """Write splats to a `.ply` file.

    Args:
        splats: tensors means [N, 3], scales [N, 3] (logarithms), quats [N, 4], opacities [N] (logits), sh0 [N, 1, 3] and
            shN [N, K, 3].
        dir: path of the file.
        colors: colours [N, 3] from 0 to 1 that replace the spherical harmonics.
    """
    sh0, shN = splats.get("sh0"), splats.get("shN")
    if colors is not None:
        sh0, shN = ((colors - 0.5) / SH_C0)[:, None], colors.new_zeros(len(colors), 0, 3)
    if sh0 is None or shN is None:
        raise InvalidInput("splats must hold sh0 and shN, or give colors")
    export_splats(
        splats["means"], splats["scales"], splats["quats"], splats["opacities"], sh0, shN, format="ply", save_to=dir
    )


def sh2rgb(sh: Tensor) -> Tensor:
    """Return the colours of coefficients of the constant spherical harmonic, in the same shape; not clamped to 0 to 1."""
    return sh * SH_C0 + 0.5


def load_ply_to_splats(path: str | Path) -> dict[str, Tensor]:
    """Read a `.ply` file, on the CPU: means [N, 3], scales [N, 3] (logarithms), quats [N, 4], opacities [N] (logits), sh0
    [N, 1, 3] and shN [N, K, 3].

    Raises:
        BundleError: if the file is missing or damaged.
    """
    read = load_ply(path)
    return {
        "means": read.means, "scales": read.log_scales, "quats": read.quats, "opacities": read.logit_opacities,
        "sh0": read.sh[:, :1], "shN": read.sh[:, 1:],
    }  # fmt: skip


def splat2ply_bytes(means: Tensor, scales: Tensor, quats: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor) -> bytes:
    """Return the bytes of a `.ply` file.

    Args:
        means: positions [N, 3].
        scales: logarithms [N, 3].
        quats: rotations wxyz [N, 4].
        opacities: logits [N].
        sh0: coefficients [N, 3] of the constant spherical harmonic.
        shN: further coefficients [N, 3 K], all of red first, then of green, then of blue.
    """
    further = shN.reshape(len(shN), 3, shN.shape[1] // 3).mT
    return export_splats(means, scales, quats, opacities, sh0[:, None], further, format="ply")


def splat2splat_bytes(means: Tensor, scales: Tensor, quats: Tensor, opacities: Tensor, sh0: Tensor) -> bytes:
    """Return the bytes of a `.splat` file. Arguments are those of `splat2ply_bytes`."""
    return export_splats(means, scales, quats, opacities, sh0[:, None], sh0.new_zeros(len(sh0), 0, 3), format="splat")


def _multinomial_sample(weights: Tensor, n: int, replacement: bool = True) -> Tensor:
    """Draw `n` indices in proportion to `weights` [N], int64 [n]; forks of MCMC import it from `gsplat.strategy.ops`."""
    return draw(weights, n) if replacement else torch.multinomial(weights, n, replacement=False)


LARGEST_SCALE = 0.02
"""Largest standard deviation along an axis of the random Gaussians of `load_test_data`, in world units."""


def load_test_data(
    data_path: str | Path | None = None,
    device: torch.device | str = "cuda",
    scene_crop: tuple[float, float, float, float, float, float] = (-2, -2, -2, 2, 2, 2),
    scene_grid: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int, int]:
    """Return means, quats, scales, opacities, colors, viewmats, Ks, width and height.

    Args:
        data_path: file with means3d [N, 3], colors [N, 3] from 0 to 255, viewmats [C, 4, 4], Ks [C, 3, 3], width and height.
        device: device of the tensors.
        scene_crop: smallest and largest x, y, z of the points that are kept.
        scene_grid: the scene is repeated this many times along x and y; odd.

    Raises:
        InvalidInput: without a file, or for an even `scene_grid`.
    """
    if data_path is None:
        raise InvalidInput("load_test_data needs data_path: this package does not contain gsplat's test scene")
    if scene_grid % 2 != 1:
        raise InvalidInput(f"scene_grid must be odd, got {scene_grid}")
    with np.load(data_path) as data:
        read = lambda name: torch.from_numpy(np.asarray(data[name], np.float32)).to(device)
        means, colors, viewmats, Ks = read("means3d"), read("colors") / 255, read("viewmats"), read("Ks")
        width, height = int(data["width"]), int(data["height"])
    low, high = torch.tensor(scene_crop, device=device, dtype=means.dtype).split(3)
    kept = ((means >= low) & (means <= high)).all(-1)
    means, colors = means[kept], colors[kept]
    half = scene_grid // 2
    steps = torch.arange(-half, half + 1, device=device, dtype=means.dtype)
    cells = torch.cartesian_prod(steps, steps)
    shifts = torch.cat([cells, torch.zeros_like(cells[:, :1])], 1) * (high - low)
    means = (means[None] + shifts[:, None]).reshape(-1, 3)
    colors = colors.repeat(len(shifts), 1)
    n = len(means)
    scales = LARGEST_SCALE * torch.rand(n, 3, device=device)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, device=device), dim=-1)
    opacities = torch.rand(n, device=device)
    return means, quats, scales, opacities, colors, viewmats, Ks, width, height


class _Extension:
    """Stand-in for gsplat's compiled extension, without functions."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"gsplat_core does not have {name!r} of gsplat's compiled extension; call the functions of gsplat.cuda._wrapper,"
            " for example fully_fused_projection and rasterize_to_pixels"
        )


_C = _Extension()
"""Not None, because programs take None to mean that there are no kernels."""


def _make_lazy_cuda_obj(name: str) -> Any:
    """Raise the AttributeError of `_C`. Programs import this function also where they do not call it."""
    return getattr(_C, name)


def _make_lazy_cuda_func(name: str) -> Callable[..., Any]:
    """Return a function that raises the AttributeError of `_C` when it is called."""

    def call(*arguments: Any, **options: Any) -> Any:
        return _make_lazy_cuda_obj(name)(*arguments, **options)

    return call
