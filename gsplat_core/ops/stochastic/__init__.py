"""Random samples of splats without sorting, compiled: stochastic transparency and Gaussian point splatting.

Stochastic transparency (StochasticSplats, ICCV 2025) lets every covered sub-pixel draw against a splat's alpha. Point
splatting (Rijsdijk et al., TOG 2026) draws a Poisson number of points from every splat. The nearest splat of a sub-pixel
gives its colour, so the expectation is that of alpha blending.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import require_float32
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera

Method = Literal["fragments", "points"]
METHODS: tuple[str, ...] = get_args(Method)
QUEUE_BYTES = 64 << 20
"""Default memory of the queue of large splats, which limits the memory of a frame."""
CHUNK = 4096
"""Number of consecutive splats whose positions, log-scales and harmonics are quantised relative to common ranges."""
COLOUR_CHUNK = 256
"""Number of consecutive splats whose colours are quantised relative to a common range."""
CHUNK_FLOATS = 20 + 6 * (CHUNK // COLOUR_CHUNK)
"""Number of float32 values of a chunk's ranges: minima and steps of positions and log-scales [3 each], of the four
bands, and of each colour chunk.
"""
MOST_PIXELS = 1 << 16
"""Largest width and height of a picture in sub-pixels."""


class SplatScene(NamedTuple):
    """Splats in one of three formats, in the op's argument order.

    The formats are `covars` and `opacities`; `quats`, `log_scales` and `logits`; or `packed`, `chunks` and `packed_sh`.
    The tensors of the other formats are None.
    """

    means: Tensor | None = None
    """Centres [N, 3]; None if packed."""
    covars: Tensor | None = None
    """Upper triangles of the covariances [N, 6]."""
    opacities: Tensor | None = None
    """Opacities [N] in 0..1."""
    quats: Tensor | None = None
    """Rotations [N, 4] as wxyz, of any non-zero length."""
    log_scales: Tensor | None = None
    """Natural logarithms of the standard deviations [N, 3]."""
    logits: Tensor | None = None
    """Logits of the opacities [N]."""
    sh: Tensor | None = None
    """Spherical-harmonics coefficients [N, K, 3]; None if packed."""
    file_index: Tensor | None = None
    """Index of each row in the model's file, int32 [N], which selects its random numbers; None if it is the row number.
    """
    packed: Tensor | None = None
    """Quantised geometry and colour, int32 [N, 4]; `quantised.h` defines the bits."""
    chunks: Tensor | None = None
    """Ranges of each chunk of `CHUNK` rows, float32 [C, CHUNK_FLOATS]."""
    packed_sh: Tensor | None = None
    """Quantised coefficients of the bands from 1, uint8 [N, K - 1, 3]; None for degree 0."""

    @property
    def splat_count(self) -> int:
        """Number of splats."""
        first = self.means if self.packed is None else self.packed
        return 0 if first is None else int(first.shape[0])

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the tensors of the scene's format, which are those that are not None."""
        return tuple(tensor for tensor in self if tensor is not None)


class SampleOptions(NamedTuple):
    """Integer options of `sample_splats`, in the argument order of the compiled op."""

    width: int
    height: int
    camera_model: int
    """Index of the camera model in CAMERA_MODELS."""
    method: int
    """Index of the sampling method in METHODS."""
    pixel_order: int
    """1 to order fragments by the depth of the splat's plane, 0 by that of its centre."""
    first_sample: int
    samples: int
    supersampling: int
    """Sub-pixels per pixel and axis."""
    seed: int
    queue_bytes: int


def new_sums(camera: Camera, device: torch.device | str) -> Tensor:
    """Return zeroed sums [H, W, 5] for `sample_splats`."""
    return torch.zeros(camera.height_px, camera.width_px, 5, device=device)


def sample_splats(
    scene: SplatScene,
    camera: Camera,
    sums: Tensor,
    *,
    method: Method = "fragments",
    first_sample: int = 0,
    samples: int = 1,
    supersampling: int = 1,
    seed: int = 0,
    pixel_order: bool = False,
    queue_bytes: int = QUEUE_BYTES,
) -> None:
    """Add random samples of a picture to `sums`.

    The random numbers depend on seed, sample, file index and sub-pixel, so equal seeds give equal bytes on one device,
    for any order of the splats. Two splats of exactly equal depth are ordered by their rows. The op has no gradient.

    Args:
        scene: splats on the device of `sums`.
        camera: camera of the picture.
        sums: float32 [H, W, 5], changed in place. Red, green, blue, number of hits and z, summed over samples and
            sub-pixels.
        method: `fragments` for stochastic transparency, `points` for point splatting.
        first_sample: number of the first sample. Samples with other numbers are independent.
        samples: number of samples.
        supersampling: sub-pixels per pixel and axis.
        seed: seed of all random numbers.
        pixel_order: order by the depth of each splat's plane at the fragment, for pinhole cameras and fragments only.
        queue_bytes: memory of the queue of large splats.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices, and for unsupported combinations.
    """
    if method not in METHODS:
        raise InvalidInput(f"unknown method {method!r}; choose {' or '.join(METHODS)}")
    if pixel_order and (method != "fragments" or camera.model != "pinhole"):
        raise InvalidInput(
            f"order by pixel needs stochastic transparency and a pinhole camera, got {method} and {camera.model};"
            " order by splat"
        )
    side = max(camera.width_px, camera.height_px) * supersampling
    if supersampling < 1 or side > MOST_PIXELS:
        raise InvalidInput(
            f"a picture may have 1 to {MOST_PIXELS} sub-pixels per side, got {side}; choose a smaller size or"
            " supersampling"
        )
    require_float32("sample_splats", sums=sums)
    if sums.shape != (camera.height_px, camera.width_px, 5):
        raise InvalidInput(f"sums must be [{camera.height_px}, {camera.width_px}, 5], got {list(sums.shape)}")
    for name, tensor in zip(scene._fields, scene, strict=True):
        if tensor is not None and tensor.is_floating_point() and tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{name} of the splats must be float32, got {tensor.dtype}; convert the Gaussians by .to(dtype=torch.float32)"
            )
    for tensor in scene.tensors():
        if tensor.device != sums.device:
            raise InvalidInput(f"the splats are on {tensor.device} and the sums on {sums.device}; use one device")
    viewmat, intrinsics = camera.matrices(sums.device)
    options = SampleOptions(
        camera.width_px,
        camera.height_px,
        CAMERA_MODELS.index(camera.model),
        METHODS.index(method),
        int(pixel_order),
        first_sample,
        samples,
        supersampling,
        seed,
        queue_bytes,
    )
    torch.ops.gsplat_core.splat_samples_(list(scene), viewmat, intrinsics, sums, list(options))


class SampledPicture(NamedTuple):
    """Mean picture of random samples."""

    image: Tensor
    """Mean colours [H, W, 3]."""
    alpha: Tensor
    """Share of samples that hit a splat [H, W]."""
    depth: Tensor
    """Mean z [H, W] of the samples that hit a splat, in the scene's unit; 0 in pixels without such a sample."""


def picture_of(sums: Tensor, samples: int, background: Tensor | None = None) -> SampledPicture:
    """Return the mean picture of `samples` samples, counted with their sub-pixels.

    Args:
        sums: result of `sample_splats` [H, W, 5].
        samples: number of samples times the number of sub-pixels per pixel.
        background: colour [3] behind the splats; None for black.
    """
    image, hits = sums[..., :3], sums[..., 3]
    if background is not None:
        image = image + (samples - hits)[..., None] * background
    return SampledPicture(image / samples, hits / samples, sums[..., 4] / hits.clamp_min(1))


@torch.library.register_fake("gsplat_core::splat_samples_")
def _fake(scene: list[Tensor | None], viewmat: Tensor, intrinsics: Tensor, sums: Tensor, options: list[int]) -> None:
    return None


@torch.library.register_fake("gsplat_core::poisson_draws")
def _fake_poisson(rates: Tensor, count: int, seed: int) -> Tensor:
    return rates.new_empty((rates.shape[0], count), dtype=torch.int64)
