"""Image quality measures: PSNR over tissue, PSNR over the frame, and SSIM of masked images.

* Equal images have no finite PSNR; it is capped at `PSNR_CAP_DB` so that reports are valid JSON.
* A frame without tissue has no quality: the functions return NaN, and `QualityTracker` excludes it
from its means.
* Non-finite pixels count as black, so broken pictures score badly instead of being excluded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ssim import ssim_map

ImageLike: TypeAlias = NDArray[np.generic] | Tensor
"""RGB [H, W, 3], uint8 or floats in 0..1."""

PSNR_CAP_DB = 100.0
"""PSNR of equal images and highest reported value, corresponding to a mean squared error of 1e-10."""
SETTLING_S = 1.0
"""Duration in seconds of the start of a live stream, which "settled" quality scores and picture ages leave out because the
model is still being initialised.
"""


_UNIT_OF_BYTE: NDArray[np.float32] = (torch.arange(256, dtype=torch.float32) / 255).numpy()
"""Lookup table from a byte to its float value in 0..1, float32 [256]."""


@dataclass(frozen=True)
class _MaskedPair:
    """Two images [H, W, 3], both uint8 or both float32 in 0..1, with a tissue mask.

    Bytes are compared directly. OpenCV releases the interpreter lock, so a scoring thread does not
    delay the thread that queues training on a GPU.
    """

    image: NDArray[Any]
    target: NDArray[Any]
    tissue: NDArray[np.uint8] | None
    """Mask [H, W], 0 outside the tissue; None if all pixels are tissue."""
    tissue_pixels: int

    @property
    def pixels(self) -> int:
        return int(self.image.shape[0] * self.image.shape[1])

    def masked(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return image and target with pixels outside the tissue set to 0."""
        if self.tissue is None:
            return self.image, self.target
        # Without a destination, OpenCV sets masked-out pixels to 0.
        return cv2.copyTo(self.image, self.tissue), cv2.copyTo(self.target, self.tissue)

    def squared_error(self) -> float:
        """Return the squared error summed over tissue pixels and channels, for values in 0..1; exact for bytes."""
        if self.image.dtype == np.uint8:
            return float(cv2.norm(self.image, self.target, cv2.NORM_L2SQR, self.tissue)) / 255**2
        image, target = (torch.from_numpy(values) for values in self.masked())
        # Summed in float64, since a frame has a million terms.
        return float((image - target).square_().sum(dtype=torch.float64))

    def psnrs_db(self) -> tuple[float, float]:
        """Return the PSNR over tissue and over the whole frame; NaN without tissue."""
        error = self.squared_error()
        return _psnr_db(error, self.tissue_pixels), _psnr_db(error, self.pixels if self.tissue_pixels else 0)

    def mean_ssim(self) -> float:
        """Return the mean similarity over all pixels and channels."""
        image, target = (torch.from_numpy(unit_image(values)) for values in self.masked())
        # OpenCV accumulates in float64 directly; torch would first copy the map to float64, which is much slower.
        return sum(cv2.mean(ssim_map(image, target).numpy())[:3]) / 3


def _image(image: ImageLike, name: str) -> NDArray[Any]:
    """Return the image [H, W, 3] on the CPU as uint8 or floating point."""
    array = _host_array(image)
    if array.ndim != 3 or array.shape[2] != 3:
        raise InvalidInput(f"{name} must be RGB [H, W, 3], got {list(array.shape)}")
    if array.dtype != np.uint8 and not np.issubdtype(array.dtype, np.floating):
        raise InvalidInput(f"{name} must be uint8 (0..255) or floating point (0..1), got {array.dtype}")
    return array


def _host_array(values: ImageLike) -> NDArray[Any]:
    return np.ascontiguousarray(values.detach().cpu().numpy() if isinstance(values, Tensor) else values)


def unit_image(image: NDArray[Any]) -> NDArray[np.float32]:
    """Convert an image, uint8 or float in 0..1, to float32 in 0..1. Non-finite values become 0."""
    if image.dtype == np.uint8:
        return np.asarray(cv2.LUT(image, _UNIT_OF_BYTE), dtype=np.float32)
    return np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _masked_pair(image: ImageLike, target: ImageLike, mask: ImageLike | None) -> _MaskedPair:
    x, y = _image(image, "image"), _image(target, "target")
    if x.shape != y.shape:
        raise InvalidInput(f"image {list(x.shape)} and target {list(y.shape)} must have one size")
    if x.dtype != np.uint8 or y.dtype != np.uint8:
        x, y = unit_image(x), unit_image(y)
    if mask is None:
        return _MaskedPair(x, y, None, x.shape[0] * x.shape[1])
    tissue = _host_array(mask)
    if tissue.shape != x.shape[:2]:
        raise InvalidInput(f"mask must be [H, W] = {list(x.shape[:2])}, got {list(tissue.shape)}")
    if tissue.dtype != np.uint8:
        tissue = (tissue != 0).astype(np.uint8)
    pixels = cv2.countNonZero(tissue)
    return _MaskedPair(x, y, None if pixels == tissue.size else tissue, pixels)


def _psnr_db(squared_error: float, pixels: int) -> float:
    """Return the PSNR in dB of a sum of squared errors over a number of RGB pixels; NaN for 0 pixels."""
    return _decibels(squared_error / (3 * pixels)) if pixels else math.nan


def _decibels(mean_squared_error: float) -> float:
    if mean_squared_error <= 10 ** (-PSNR_CAP_DB / 10):
        return PSNR_CAP_DB
    return -10 * math.log10(mean_squared_error)


def psnr_tissue_db(image: ImageLike, target: ImageLike, mask: ImageLike | None = None) -> float:
    """Return the PSNR in dB over tissue pixels: squared error over tissue / (3 x tissue pixels).
    EndoGaussian calls it PSNR*.

    Args:
        image: [H, W, 3], uint8 or floats in 0..1.
        target: [H, W, 3], uint8 or floats in 0..1.
        mask: [H, W], non-zero = tissue; None = all pixels.

    Returns:
        At most PSNR_CAP_DB; NaN if the mask has no tissue.
    """
    pair = _masked_pair(image, target, mask)
    return _psnr_db(pair.squared_error(), pair.tissue_pixels)


def psnr_frame_db(image: ImageLike, target: ImageLike, mask: ImageLike | None = None) -> float:
    """Return the PSNR in dB of masked images over the whole frame: squared error over tissue / (3 x all pixels).

    Most papers report this variant. It rises with the tool's area, so report it only together with `psnr_tissue_db`.
    Arguments and return value are those of `psnr_tissue_db`.
    """
    pair = _masked_pair(image, target, mask)
    return _psnr_db(pair.squared_error(), pair.pixels if pair.tissue_pixels else 0)


def psnrs_db(image: ImageLike, target: ImageLike, mask: ImageLike | None = None) -> tuple[float, float]:
    """Return `psnr_tissue_db` and `psnr_frame_db` of one pair of images, compared once."""
    return _masked_pair(image, target, mask).psnrs_db()


def ssim(image: ImageLike, target: ImageLike, mask: ImageLike | None = None) -> float:
    """Return the mean structural similarity of the masked images over the whole frame (Wang et al. 2004).

    It uses the usual convention: 11x11 Gaussian of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2, range 1.
    Masked-out pixels count as equal. Arguments as in `psnr_tissue_db`; NaN if the mask has no tissue.
    """
    pair = _masked_pair(image, target, mask)
    return pair.mean_ssim() if pair.tissue_pixels else math.nan


@dataclass(frozen=True)
class FrameQuality:
    """Quality measures of one frame; NaN if the frame has no tissue."""

    seq: int
    psnr_tissue_db: float
    psnr_frame_db: float
    ssim: float


MEASURES = ("psnr_tissue_db", "psnr_frame_db", "ssim")


class ScoredMean:
    """Correctly rounded mean of the finite values of a stream, in constant memory.

    The sum is kept as non-overlapping floats (Shewchuk, "Adaptive Precision Floating-Point
    Arithmetic", 1997), so the mean does not depend on the order of the values.
    """

    def __init__(self) -> None:
        self.count = 0
        """Number of finite values in the mean."""
        self._parts: list[float] = []

    def add(self, value: float) -> None:
        """Add a value to the mean; non-finite values are ignored."""
        if not math.isfinite(value):
            return
        self.count += 1
        kept: list[float] = []
        for part in self._parts:
            if abs(value) < abs(part):
                value, part = part, value
            total = value + part
            lost = part - (total - value)
            if lost:
                kept.append(lost)
            value = total
        self._parts = [*kept, value]

    @property
    def mean(self) -> float | None:
        """Mean of the values so far; None without any."""
        return math.fsum(self._parts) / self.count if self.count else None


def frame_quality(
    seq: int, image: ImageLike, target: ImageLike, mask: ImageLike | None = None, *, similarity: bool = True
) -> FrameQuality:
    """Compute all measures of one frame, comparing its images once.

    Args:
        seq: frame number.
        image, target, mask: as in `psnr_tissue_db`.
        similarity: True to compute SSIM, the slowest measure. False sets it to NaN.
    """
    pair = _masked_pair(image, target, mask)
    measured = similarity and pair.tissue_pixels
    return FrameQuality(seq, *pair.psnrs_db(), pair.mean_ssim() if measured else math.nan)


class QualityTracker:
    """Means of the quality measures over displayed frames, in constant memory."""

    def __init__(self) -> None:
        self.count = 0
        """Number of frames observed, including those without tissue."""
        self._means = {name: ScoredMean() for name in MEASURES}

    def observe(
        self, seq: int, image: ImageLike, target: ImageLike, mask: ImageLike | None = None, *, similarity: bool = True
    ) -> FrameQuality:
        """Score one frame and add it to the means; arguments as in `frame_quality`."""
        quality = frame_quality(seq, image, target, mask, similarity=similarity)
        self.take(quality)
        return quality

    def take(self, quality: FrameQuality) -> None:
        """Add a frame's measures to the means; non-finite ones are ignored."""
        self.count += 1
        for name, mean in self._means.items():
            mean.add(getattr(quality, name))

    def means(self) -> dict[str, float | None]:
        """Return the mean of each measure over frames that have it (PSNR averaged in dB), or None without any."""
        return {name: mean.mean for name, mean in self._means.items()}
