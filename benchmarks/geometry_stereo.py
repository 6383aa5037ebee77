"""Measure the error and cost of stereo depth.

    python benchmarks/geometry_stereo.py --recordings FOLDER [--pictures OUT] [--device cuda] [--without synthetic heart …]

One JSON line each: `scared_pair` (disparity against ground truth), `scared_raw` and `hamlyn_pair` (rectified from their calibrations: vertical residual of SIFT
matches, and distances), `heart` (right picture warped from the left one), synthetic pairs (depth against ground truth), and the time per frame on one thread.
`--pictures` writes the left picture next to its depth: near is red, far is blue, black has low confidence. All use the same settings.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from gsplat_core.depth.maps import DepthMap
from gsplat_core.depth.stereo import StereoDepth, grey
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame

DEVICE = "cpu"
"""Device on which pictures are matched."""
HEART_BORDER_PX, HEART_ONE_EYED_PX = 10, 110


def estimates(frames: Iterable[Frame], camera: Camera) -> Iterator[tuple[Frame, DepthMap, float]]:
    """Yield each frame with its estimated depth and the CPU time in ms."""
    estimator = StereoDepth(DEVICE)
    for frame in frames:
        begun = time.process_time()
        found = estimator.estimate(frame, camera)
        assert found is not None
        yield frame, found, 1e3 * (time.process_time() - begun)


def believed(found: DepthMap) -> np.ndarray:
    return found.confidence >= BELIEVED


def scared_pair(folder: Path) -> dict[str, Any]:
    """Return the end-point error against `disparity.tiff`."""
    recording = open_recording(folder)
    truth = cv2.imread(str(folder / "disparity.tiff"), cv2.IMREAD_UNCHANGED)
    ((_, found, cpu_ms),) = estimates(recording, recording.camera)
    seen = (truth > 0) & believed(found)
    error = np.abs(recording.camera.K[0, 0] / found.depth[seen] - truth[seen])
    return {
        "mean_px": error.mean(), "median_px": np.median(error), "over_1_px": (error > 1).mean(),
        "estimated": seen.sum() / (truth > 0).sum(), "cpu_ms": cpu_ms,
    }  # fmt: skip


def rectified(folder: Path) -> dict[str, Any]:
    """Return the vertical residual of SIFT matches (ratio test 0.75, at most 8 px) after rectification, and the estimated distances."""
    recording = open_recording(folder)
    ((frame, found, cpu_ms),) = estimates(recording, recording.camera)
    finder = cv2.SIFT.create(2000)
    (here, left), (there, right) = (
        finder.detectAndCompute(grey(each), None) for each in (frame.image, frame.right_image)
    )
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(left, right, k=2) if a.distance < 0.75 * b.distance]
    lower = np.array([there[pair.trainIdx].pt[1] - here[pair.queryIdx].pt[1] for pair in pairs])
    lower = np.abs(lower[np.abs(lower) < 8])
    near, middle, far = np.percentile(found.depth[believed(found)], (1, 50, 99))
    return {
        "matches": len(lower), "vertical_median_px": np.median(lower), "vertical_mean_px": lower.mean(),
        "believed": believed(found).mean(), "metric": found.metric, "mm": [near, middle, far], "cpu_ms": cpu_ms,
    }  # fmt: skip


def heart(folder: Path) -> dict[str, Any]:
    """Score every tenth right picture, warped from the left one by the right eye's disparities."""
    recording = open_recording(folder)
    # Seen in a mirror the right eye is the left one, and its disparities are those that lead from its pixels to the left picture.
    mirrored = (
        frame.with_fields(image=flipped(frame.right_image), right_image=flipped(frame.image)) for frame in recording
    )
    estimator, focal_px = StereoDepth(DEVICE), recording.camera.K[0, 0]
    scores, shares, costs = [], [], []
    for index, frame in enumerate(mirrored):
        begun = time.process_time()
        found = estimator.estimate(frame, recording.camera)
        costs.append(1e3 * (time.process_time() - begun))
        if index % 10 == 0:
            known = found.depth > 0
            rows, columns = np.indices(known.shape, dtype=np.float32)
            disparity = filled(np.where(known, focal_px / np.maximum(found.depth, 1e-3), 0).astype(np.float32), known)
            lower = float(np.median(estimator._rows, axis=0)[0])
            warped = cv2.remap(frame.right_image, columns - disparity, rows + lower, cv2.INTER_LINEAR)
            scores.append(psnr_of_line(flipped(warped), flipped(frame.image)))
            shares.append(believed(found)[:, :-HEART_ONE_EYED_PX].mean())
    return {"right_from_left_db": np.mean(scores), "believed": np.mean(shares), "cpu_ms": np.mean(costs)}


def flipped(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[:, ::-1])


def filled(plane: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill unknown values with means of known neighbours, in growing windows."""
    weight = known.astype(np.float32)
    for side in (5, 15, 45, 135, 301):
        share = cv2.blur(weight, (side, side))
        plane = np.where(
            (weight == 0) & (share > 1e-3), cv2.blur(plane * weight, (side, side)) / np.maximum(share, 1e-6), plane
        )
        weight = ((weight > 0) | (share > 1e-3)).astype(np.float32)
    return plane.astype(np.float32)


def psnr_of_line(shown: np.ndarray, true: np.ndarray) -> float:
    """Return the PSNR after a linear fit per channel, without the border and columns that one eye does not see."""
    inside = np.s_[HEART_BORDER_PX:-HEART_BORDER_PX, HEART_BORDER_PX:-HEART_ONE_EYED_PX]
    errors = []
    for channel in range(3):
        a, b = shown[inside][..., channel].ravel().astype(float), true[inside][..., channel].ravel().astype(float)
        line = np.stack([a, np.ones_like(a)], axis=1)
        errors.append(np.mean((line @ np.linalg.lstsq(line, b, rcond=None)[0] - b) ** 2))
    return float(10 * np.log10(255**2 / np.mean(errors)))


def synthetic(asked: RenderSettings) -> dict[str, Any]:
    """Return the RMS error of confident depth on tissue over all frames, relative to the median depth."""
    recording = render_recording(asked)
    squares, shares, costs, everywhere = [], [], [], []
    for frame, found, cpu_ms in estimates(recording, recording.camera):
        off = (found.depth - frame.depth) / np.median(frame.depth)
        seen, tissue = believed(found), frame.mask > 0
        squares.append(np.mean(off[seen & tissue] ** 2))
        everywhere.append(np.mean(off[seen] ** 2))
        shares.append((seen & tissue).sum() / tissue.sum())
        costs.append(cpu_ms)
    return {
        "size": [asked.width_px, asked.height_px], "frames": asked.frames, "seed": asked.seed, "camera": asked.camera,
        "rmse_tissue": np.sqrt(np.mean(squares)), "rmse_with_tools": np.sqrt(np.mean(everywhere)),
        "tissue_believed": np.mean(shares), "first_cpu_ms": costs[0], "cpu_ms": np.median(costs[1:]),
    }  # fmt: skip


def picture(folder: Path, path: Path) -> None:
    """Write the first frame's left picture and its depth side by side."""
    recording = open_recording(folder, max_frames=1)
    ((frame, found, _),) = estimates(recording, recording.camera)
    seen = believed(found)
    near, far = np.percentile(found.depth[seen], (1, 99))
    level = np.clip(255 * (far - found.depth) / (far - near), 0, 255).astype(np.uint8)
    depth = cv2.applyColorMap(level, cv2.COLORMAP_TURBO) * seen[..., None].astype(np.uint8)
    cv2.imwrite(str(path), np.hstack([frame.image[..., ::-1], depth]))


def main() -> None:
    global DEVICE
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--without", nargs="*", default=[])
    parser.add_argument("--device", default=DEVICE)
    arguments = parser.parse_args()
    DEVICE = arguments.device
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    given = arguments.recordings
    small = RenderSettings(frames=6, stereo=True)
    usual = RenderSettings(frames=4, width_px=640, height_px=512, stereo=True, camera="moving", seed=1)
    large = RenderSettings(frames=3, width_px=1280, height_px=1024, stereo=True, seed=2)
    runs: dict[str, list[tuple[str, Any]]] = {
        "scared_pair": [("scared_pair", lambda: scared_pair(given / "scared_pair"))],
        "scared_raw": [("scared_raw", lambda: rectified(given / "scared_raw"))],
        "hamlyn_pair": [("hamlyn_pair", lambda: rectified(given / "hamlyn_pair"))],
        "heart": [("heart", lambda: heart(given / "heart"))],
        "synthetic": [("synthetic", lambda each=each: synthetic(each)) for each in (small, usual, large)],
    }
    for kind, measures in runs.items():
        for name, measure in measures if kind not in arguments.without else ():
            print(json.dumps({"measured": name, **rounded(measure())}), flush=True)
    if arguments.pictures is not None:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        for name in ("scared_pair", "scared_raw", "hamlyn_pair", "heart"):
            picture(given / name, arguments.pictures / f"{name}.png")


def rounded(values: dict[str, Any]) -> dict[str, Any]:
    return {
        name: np.round(value, 4).tolist() if isinstance(value, float | list | np.floating) else value
        for name, value in values.items()
    }


if __name__ == "__main__":
    main()
