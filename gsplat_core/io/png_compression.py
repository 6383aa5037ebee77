"""Splats as a folder of PNG pictures and NPZ arrays with `meta.json`, in the layout of gsplat's `PngCompression`.

A splat is a pixel at the same place in all pictures: 16 bits for the centres (two pictures), 8 bits for the other values.
The harmonics of higher degree are clustered, and each splat has the number of its cluster. Values between the smallest and
the largest of a column are spread over the range of the integers, so the error of a value is at most half a step.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import BundleCorrupt, InvalidInput
from gsplat_core.io.ply import morton_order

_log = logging.getLogger(__name__)

META_FILE = "meta.json"
CLUSTERS = 1 << 16
"""Maximum number of clusters of the harmonics, so that their numbers fit in 16 bits."""
CENTROID_BITS = 6
KMEANS_STEPS = 5
COARSE = 256
"""Number of clusters in the first level of the two-level k-means; each of them is divided further."""
KMEANS_ROWS = 1 << 24
"""Largest number of distances between rows and centroids that k-means computes at a time, to bound memory."""
_PICTURES = {"means": 16, "scales": 8, "quats": 8, "opacities": 8, "sh0": 8}
"""Number of bits per value of each tensor that is stored as pictures; `shN` is stored by cluster instead."""
_CLUSTERED = "shN"


@dataclass
class PngCompression:
    """Compresses splats into a folder of PNG pictures, and reads them back."""

    use_sort: bool = True
    """True sorts the splats along a Z-curve, so that neighbouring pixels are similar and pictures are smaller."""
    verbose: bool = True
    """True logs how many splats were left out."""

    def compress(self, compress_dir: str, splats: Mapping[str, Tensor]) -> None:
        """Write the splats. If their number is no square, those of the smallest opacity are left out.

        Args:
            compress_dir: existing folder.
            splats: tensors with N rows: means, scales (logarithms), quats, opacities (logits), sh0 and shN. Others are stored
                without loss. The dict is not changed.

        Raises:
            InvalidInput: if there are no splats, a required tensor is missing, or a value is not finite.
        """
        folder = Path(compress_dir)
        missing = [name for name in (*_PICTURES, _CLUSTERED) if name not in splats]
        if missing:
            raise InvalidInput(f"splats lack {', '.join(missing)}; they have {', '.join(splats)}")
        count = len(splats["means"])
        if not count:
            raise InvalidInput("there are no splats to compress")
        values = {
            name: tensor.detach() if name == _CLUSTERED else tensor.detach().cpu() for name, tensor in splats.items()
        }
        for name, tensor in values.items():
            if len(tensor) != count or not bool(tensor.isfinite().all()):
                raise InvalidInput(f"{name} must have {count} rows of finite values, got {list(tensor.shape)}")
        values["means"] = torch.sign(values["means"]) * torch.log1p(values["means"].abs())
        values["quats"] = torch.nn.functional.normalize(values["quats"], dim=-1)
        side = math.isqrt(count)
        order = torch.argsort(values["opacities"].reshape(count, -1)[:, 0], descending=True, stable=True)[: side * side]
        if self.use_sort:
            order = order[torch.from_numpy(morton_order(values["means"][order].float().numpy()))]
        else:
            order = order.sort().values
        if self.verbose and side * side < count:
            _log.warning("%d of %d splats were left out, so that the pictures are square", count - side * side, count)
        meta: dict[str, Any] = {}
        for name, tensor in values.items():
            rows = tensor[order.to(tensor.device)]
            meta[name] = {"shape": list(rows.shape), "dtype": str(rows.dtype).removeprefix("torch.")}
            if name in _PICTURES and rows.numel():
                meta[name] |= _write_pictures(folder, name, rows, side, _PICTURES[name])
            elif name == _CLUSTERED and rows.numel():
                meta[name] |= _write_clusters(folder, name, rows)
            else:
                np.savez_compressed(folder / f"{name}.npz", arr=rows.cpu().numpy())
        (folder / META_FILE).write_text(json.dumps(meta), encoding="utf-8")

    def decompress(self, compress_dir: str) -> dict[str, Tensor]:
        """Read the splats of a folder that this class or gsplat's has written.

        Raises:
            BundleCorrupt: if a file is missing or does not fit `meta.json`.
        """
        folder = Path(compress_dir)
        try:
            meta = json.loads((folder / META_FILE).read_text(encoding="utf-8"))
            splats = {name: _read(folder, name, about) for name, about in meta.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
            raise BundleCorrupt(f"{folder} holds no compressed splats that can be read: {error}") from error
        if "means" in splats:
            splats["means"] = torch.sign(splats["means"]) * torch.expm1(splats["means"].abs())
        return splats


def _write_pictures(folder: Path, name: str, rows: Tensor, side: int, bits: int) -> dict[str, Any]:
    grid = rows.reshape(side, side, -1).double()
    low, high = grid.amin((0, 1)), grid.amax((0, 1))
    share = (grid - low) / torch.where(high > low, high - low, 1)
    steps = torch.round(share * (2**bits - 1)).numpy().astype(np.uint16)
    if bits == 16:
        _write_png(folder / f"{name}_l.png", (steps & 0xFF).astype(np.uint8))
        _write_png(folder / f"{name}_u.png", (steps >> 8).astype(np.uint8))
    else:
        _write_png(folder / f"{name}.png", steps.astype(np.uint8))
    return {"mins": low.tolist(), "maxs": high.tolist()}


def _write_clusters(folder: Path, name: str, rows: Tensor) -> dict[str, Any]:
    centroids, labels = clustered(rows.reshape(len(rows), -1).float(), CLUSTERS)
    low, high = float(centroids.min()), float(centroids.max())
    share = (centroids.double() - low) / (high - low if high > low else 1.0)
    steps = torch.round(share * (2**CENTROID_BITS - 1)).cpu().numpy().astype(np.uint8)
    np.savez_compressed(folder / f"{name}.npz", centroids=steps, labels=labels.cpu().numpy().astype(np.uint16))
    return {"mins": low, "maxs": high, "quantization": CENTROID_BITS}


def clustered(rows: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return at most `most` centroids [M, D] of rows [N, D] and the centroid of each row.

    The rows are divided into `COARSE` clusters by k-means, and each of these again, into a number of clusters in proportion to
    its rows. A row is compared with few centroids this way.
    """
    count = len(rows)
    if count <= most:
        return rows, torch.arange(count, device=rows.device)
    if most <= COARSE:
        return _k_means(rows, most)
    _, coarse = _k_means(rows, COARSE)
    order = torch.argsort(coarse, stable=True)
    centroids, labels, taken = [], [], 0
    for part in order.split(torch.bincount(coarse, minlength=COARSE).tolist()):
        if len(part):
            some, nearest = _k_means(rows[part], 1 + len(part) * (most - COARSE) // count)
            centroids.append(some)
            labels.append(nearest + taken)
            taken += len(some)
    return torch.cat(centroids), torch.cat(labels)[torch.argsort(order)]


def _k_means(rows: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return centroids and the nearest one of each row (Lloyd 1982).

    The first centroids are rows at equal distances in the order of the rows, so the result is the same in every run.
    """
    if len(rows) <= most:
        return rows, torch.arange(len(rows), device=rows.device)
    centroids = rows[torch.linspace(0, len(rows) - 1, most).long().to(rows.device)]
    labels = _nearest(rows, centroids)
    for _ in range(KMEANS_STEPS):
        order = torch.argsort(labels, stable=True)
        sizes = torch.bincount(labels, minlength=most)
        sums = torch.cat([rows.new_zeros(1, rows.shape[1], dtype=torch.float64), rows[order].double().cumsum(0)])
        ends = sizes.cumsum(0)
        means = (sums[ends] - sums[ends - sizes]) / sizes.clamp(min=1)[:, None]
        centroids = torch.where((sizes > 0)[:, None], means.to(rows.dtype), centroids)
        labels = _nearest(rows, centroids)
    return centroids, labels


def _nearest(rows: Tensor, centroids: Tensor) -> Tensor:
    squares = (centroids * centroids).sum(1)
    parts = rows.split(max(1, KMEANS_ROWS // len(centroids)))
    return torch.cat([torch.addmm(squares, part, centroids.T, alpha=-2).argmin(1) for part in parts])


def _read(folder: Path, name: str, about: Mapping[str, Any]) -> Tensor:
    shape, dtype = about["shape"], getattr(torch, about["dtype"])
    if not math.prod(shape):
        return torch.zeros(shape, dtype=dtype)
    if name not in (*_PICTURES, _CLUSTERED):
        return torch.from_numpy(np.load(folder / f"{name}.npz", allow_pickle=False)["arr"]).reshape(shape).to(dtype)
    low, high = (torch.tensor(about[each], dtype=torch.float64) for each in ("mins", "maxs"))
    if name == _CLUSTERED:
        stored = np.load(folder / f"{name}.npz", allow_pickle=False)
        steps, most = stored["centroids"][stored["labels"]], 2 ** about["quantization"] - 1
    elif _PICTURES[name] == 16:
        steps = _read_png(folder / f"{name}_u.png").astype(np.int64) << 8 | _read_png(folder / f"{name}_l.png")
        most = 2**16 - 1
    else:
        steps, most = _read_png(folder / f"{name}.png"), 2**8 - 1
    share = torch.from_numpy(steps.astype(np.float64)).reshape(-1, low.numel() if low.dim() else 1) / most
    return (share * (high - low) + low).reshape(shape).to(dtype)


def _write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", _swapped(picture) if picture.shape[-1] >= 3 else picture)
    if not done:
        raise InvalidInput(f"a picture of shape {list(picture.shape)} cannot be written to {path.name}")
    path.write_bytes(data.tobytes())


def _read_png(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint8:
        raise ValueError(f"{path.name} is no PNG picture of 8 bits")
    pixels = np.asarray(picture, np.uint8)
    return _swapped(pixels) if pixels.ndim == 3 else pixels


def _swapped(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Exchange the red and blue channels, because OpenCV reads and writes pictures as BGR."""
    order = [2, 1, 0, 3][: picture.shape[-1]]
    return np.ascontiguousarray(picture[..., order])
