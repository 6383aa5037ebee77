"""Measure how often 90 % intervals of depth and of `intrasplat measure` contain the truth.

    python benchmarks/geometry_measure.py [--seeds 1000 1001 …] [--frames 0 1 2 3] [--recordings FOLDER] [--work FOLDER] [--log FILE]

Each random stereo recording of `geometry_random.py` is replayed with depth by matching. In the resulting model, points, straight distances and lengths along the surface
between random pixels are compared with the true depth at the times of the frames. One JSON line per recording and a summary. `inside` is the share of true values inside of
the 90 % interval, `error` the RMS relative error, `bias` the median relative error, `stated` the median relative standard error.

With `--recordings`, `scared_pair` follows: intervals of stereo depth and of a model trained on it. Values of the reference `disparity.tiff` scatter in steps of half pixels
around the surface, `rounding_px` in RMS. The reference is therefore replaced by the plane fitted to the known pixels of a window of 17x17 px. `rounded` is the share without
this correction.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from geometry_random import CHECK_SEEDS, NINETY, folder_of, recording_of
from run_facts import run_facts

from gsplat_core.depth.stereo import StereoDepth
from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.measure import Length, Measurement
from gsplat_core.geometry.mesh import points_of, rays_of
from gsplat_core.io.model_sources import load_model
from gsplat_core.io.recordings import open_recording
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED
from operators.applications.replay import ReplaySettings, replay

PAIRS = 150
"""Pairs of pixels measured in each frame."""
WINDOW_PX, FEWEST_KNOWN = 17, 96
"""Window of the plane fit to the reference disparity, and the known pixels that it needs."""


class Checked:
    """Measured values next to true ones, by kind of measurement."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[float, float, float]]] = {"depth": [], "distance": [], "path": []}

    def add(self, kind: str, value: float, error: float, true: float) -> None:
        """Add a value with its standard error."""
        self._rows[kind].append((value, error, true))

    def figures(self) -> dict[str, Any]:
        """Return the figures of each kind that was measured."""
        found: dict[str, Any] = {}
        for kind, rows in self._rows.items():
            if rows:
                value, error, true = np.array(rows).T
                off = value / true - 1
                found[kind] = {
                    "inside": round(float((np.abs(value - true) <= NINETY * error).mean()), 4),
                    "error": round(float(np.sqrt(np.mean(off**2))), 5),
                    "bias": round(float(np.median(off)), 5),
                    "stated": round(float(np.median(error / true)), 5),
                    "count": len(rows),
                }
        return found


def measured(model: Model, time_s: float, true: np.ndarray, tissue: np.ndarray, checked: Checked, seed: int) -> None:
    """Measure random pairs of tissue pixels at one time.

    Args:
        model: model with the camera of the true depth.
        time_s: time of the true depth.
        true: true z [H, W].
        tissue: pixels with known truth, bool [H, W].
        checked: gets the values.
        seed: seed of the pixels.
    """
    camera, measurement = model.camera, Measurement(model, time_s)
    places, random = points_of(true, camera), np.random.default_rng(seed)
    rows, columns = np.nonzero(tissue)
    for first, second in random.integers(0, len(rows), (PAIRS, 2)):
        pixels = [(float(columns[each]) + 0.5, float(rows[each]) + 0.5) for each in (first, second)]
        ends = [places[rows[each], columns[each]] for each in (first, second)]
        apart = float(np.linalg.norm(ends[0] - ends[1]))
        if apart == 0:
            continue
        try:
            points = [measurement.point(*pixel) for pixel in pixels]
        except InvalidSetting:  # nothing was observed there
            continue
        for point, end in zip(points, ends, strict=True):
            checked.add("depth", point.depth, point.depth_error, float(end[2]))
        _add(checked, "distance", measurement.distance(*points), apart)
        path = true_path(camera, true, tissue, *pixels)
        if path is not None:
            try:
                _add(checked, "path", measurement.length_along(*points), path)
            except InvalidSetting:
                continue


def _add(checked: Checked, kind: str, found: Length, true: float) -> None:
    checked.add(kind, found.value, found.error, true)


def true_path(
    camera: Camera, true: np.ndarray, tissue: np.ndarray, first: tuple[float, float], second: tuple[float, float]
) -> float | None:
    """Return the length of the true surface under a line in the picture; None if the truth is not known everywhere.

    Depth is interpolated between pixels and taken every pixel.
    """
    steps = max(1, round(math.dist(first, second)))
    pixels = np.linspace(first, second, steps + 1)
    column, row = (pixels[:, axis].astype(int) for axis in (0, 1))
    if not tissue[row, column].all():
        return None
    known = np.where(tissue, true, 0).astype(np.float32)
    x, y = (pixels[:, axis, None].astype(np.float32) - 0.5 for axis in (0, 1))
    sums, shares = (cv2.remap(plane, x, y, cv2.INTER_LINEAR)[:, 0] for plane in (known, tissue.astype(np.float32)))
    start, step = rays_of(camera, pixels)
    return float(np.linalg.norm(np.diff(start + step * (sums / shares)[:, None], axis=0), axis=1).sum())


def replayed(folder: Path, out: Path) -> Model:
    """Return the model of a replay with depth by matching, at the end of the recording."""
    if not (out / "model").exists():
        replay(ReplaySettings(recording=folder, out=out, depth="stereo"))
    return load_model(out / "model")


def random_recording(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Measure on a model of a random recording."""
    recording = recording_of("stereo", seed, asked)
    model = replayed(folder_of("stereo", seed, asked), asked.work / f"measured-{seed}")
    checked = Checked()
    for number, frame in enumerate(recording):
        true, mask = frame.depth, frame.mask
        assert true is not None
        if asked.frames is None or number in asked.frames:
            tissue = (true > 0) & (mask > 0 if mask is not None else True)
            measured(model, frame.time_s, true, tissue, checked, seed)
    return checked.figures()


def local_planes(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the value at each pixel of the plane fitted to the known pixels around it; 0 with too few of them."""
    y, x = np.indices(values.shape, dtype=np.float64)
    total = lambda plane: cv2.boxFilter(known * plane, cv2.CV_64F, (WINDOW_PX, WINDOW_PX), normalize=False)
    parts = [np.ones_like(x), x - x.mean(), y - y.mean()]
    sums = [[total(a * b) for b in parts] for a in parts]
    normal = np.stack([np.stack(row, -1) for row in sums], -2)
    right = np.stack([total(part * values) for part in parts], -1)
    enough = sums[0][0] >= FEWEST_KNOWN
    normal[~enough] = np.eye(3)
    plane = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.where(enough, sum(plane[..., index] * part for index, part in enumerate(parts)), 0)


def scared_pair(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """Measure stereo depth and a model trained on it against the reference without its rounding error."""
    recording = open_recording(folder)
    reference = np.asarray(cv2.imread(str(folder / "disparity.tiff"), cv2.IMREAD_UNCHANGED), np.float64)
    smooth = local_planes(reference, (reference > 0).astype(np.float64))
    (frame,), camera, estimator = list(recording), recording.camera, StereoDepth()
    found = estimator.estimate(frame, camera)
    assert found is not None
    error = estimator.standard_error(found, frame, camera)
    seen = (reference > 0) & (smooth > 0) & (found.confidence >= BELIEVED) & (found.depth > 0)
    shares = {
        name: round(float((np.abs(found.depth - camera.K[0, 0] / disparity)[seen] <= NINETY * error[seen]).mean()), 4)
        for name, disparity in (("inside", np.maximum(smooth, 1)), ("rounded", np.maximum(reference, 1)))
    }
    model, checked = replayed(folder, asked.work / "measured-scared_pair"), Checked()
    true = np.where(smooth > 0, camera.K[0, 0] / np.maximum(smooth, 1), 0)
    for seed in range(4):
        measured(model, frame.time_s, true, true > 0, checked, seed)
    rounding_px = round(float(np.sqrt(np.mean(np.square(reference - smooth)[seen]))), 3)
    return {"stereo": shares, "rounding_px": rounding_px, **checked.figures()}


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return mean, least and largest share inside of the intervals over the recordings."""
    found = {}
    for kind in ("depth", "distance", "path"):
        inside = [line[kind]["inside"] for line in lines if kind in line]
        found[kind] = [round(float(value), 4) for value in (np.mean(inside), min(inside), max(inside))]
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=CHECK_SEEDS)
    parser.add_argument("--frames", type=int, nargs="+", help="numbers of the frames that are measured; default all")
    parser.add_argument("--recordings", type=Path, help="folder that contains scared_pair")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--log", type=Path)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="geometry-measure-") as temporary:
        asked.work = asked.work or Path(temporary)
        said, lines = [json.dumps({"header": run_facts()})], []
        for seed in asked.seeds:
            lines.append(random_recording(seed, asked))
            said.append(json.dumps({"seed": seed, **lines[-1]}))
            print(said[-1], flush=True)
        if lines:
            said.append(json.dumps({"summary": summary(lines)}))
            print(said[-1], flush=True)
        if asked.recordings is not None:
            said.append(
                json.dumps({"recording": "scared_pair", **scared_pair(asked.recordings / "scared_pair", asked)})
            )
            print(said[-1], flush=True)
    if asked.log is not None:
        asked.log.parent.mkdir(parents=True, exist_ok=True)
        asked.log.write_text("\n".join(said) + "\n")


if __name__ == "__main__":
    main()
