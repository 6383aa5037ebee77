"""Measure stereo depth of one frame on a device: each op and the total.

    python benchmarks/stereo_ops.py [--device cuda] [--threads 1]

One JSON line per size. `match_ms`, `fit_ms` and `smooth_ms` are medians of device time (CUDA events; wall clock on the CPU). `frame_ms` is the time that a thread waits for
a frame's depth, `frame_cpu_ms` its processor time, `look_ms` the time of a frame in which the pair is also validated.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch

from gsplat_core.depth.stereo import SMOOTH_GREY, SMOOTHNESS, StereoDepth
from gsplat_core.ops.disparity_fit import fit_disparities
from gsplat_core.ops.edge_aware_filter import smooth_within_edges
from gsplat_core.ops.stereo_matching import UNKNOWN, match_disparities
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

SIZES = [(640, 512, 64), (640, 512, 128), (1280, 1024, 64)]
"""Width, height and number of disparities; pictures wider than 800 pixels are matched at half size."""
WARM_UP, REPEATS = 3, 15


def pair(width: int, height: int, most_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a grey stereo pair of a textured bowl with disparities up to `most_px`."""
    rng = np.random.default_rng(0)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), sigma) * sigma for sigma in (1.2, 3.0, 9.0)]
    left = np.clip(120 + 45 * np.sum(layers, axis=0), 0, 245).astype(np.float32)
    rows, columns = np.indices((height, width), dtype=np.float32)
    y, x = 2 * rows / height - 1, 2 * columns / width - 1
    disparity = (most_px * (0.9 - 0.2 * (x * x + y * y))).astype(np.float32)
    right = cv2.remap(left, columns + disparity, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return left.astype(np.uint8), np.clip(right, 0, 255).astype(np.uint8)


def device_ms(device: torch.device, work: Callable[[], object]) -> float:
    """Return the median over repeats in ms, after warm-up calls."""
    times = []
    for _ in range(WARM_UP + REPEATS):
        if device.type == "cuda":
            begun, ended = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            begun.record()
            work()
            ended.record()
            ended.synchronize()
            times.append(begun.elapsed_time(ended))
        else:
            start = time.perf_counter()
            work()
            times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[WARM_UP:]))


def ops(device: torch.device, width: int, height: int, count: int) -> dict[str, float]:
    """Time each op alone, on pictures already on the device."""
    left, right = (torch.from_numpy(each).to(device) for each in pair(width, height, count - 4))
    guide = left[..., None].expand(-1, -1, 3).contiguous()
    matches = match_disparities(left, right, 0, count)
    fitted = fit_disparities(left, right, matches.sixteenths)
    planes = torch.stack([fitted.px, torch.ones_like(fitted.px)])
    return {
        "known": (matches.sixteenths != UNKNOWN).float().mean().item(),
        "match_ms": device_ms(device, lambda: match_disparities(left, right, 0, count)),
        "fit_ms": device_ms(device, lambda: fit_disparities(left, right, matches.sixteenths)),
        "smooth_ms": device_ms(device, lambda: smooth_within_edges(planes, guide, SMOOTHNESS, SMOOTH_GREY)),
    }


def frames(device: torch.device, width: int, height: int, most_px: float) -> dict[str, float]:
    """Time whole frames, from pictures in host memory to depth in host memory."""
    camera = Camera.from_focal(float(width), width, height)
    left, right = (np.repeat(each[..., None], 3, axis=2) for each in pair(width, height, most_px))
    estimator = StereoDepth(device)
    waits, works = [], []
    for seq in range(1 + WARM_UP + REPEATS):
        frame = Frame(seq, seq * 33_000_000, left, right_image=right, right_camera=camera.right_eye(4.0))
        begun, begun_cpu = time.perf_counter(), time.thread_time()
        found = estimator.estimate(frame, camera)
        waits.append(1e3 * (time.perf_counter() - begun))
        works.append(1e3 * (time.thread_time() - begun_cpu))
        assert found is not None and found.doubt is None, found
    return {
        "frame_ms": float(np.median(waits[1 + WARM_UP :])),
        "frame_most_ms": max(waits[1 + WARM_UP :]),
        "frame_cpu_ms": float(np.median(works[1 + WARM_UP :])),
        "look_ms": waits[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    device = torch.device(arguments.device)
    for width, height, count in SIZES:
        shrink = 1 if width <= 800 else 2
        times = {
            **ops(device, width // shrink, height // shrink, count),
            **frames(device, width, height, shrink * (0.55 * count)),
        }
        print(
            json.dumps({"size": [width, height], "disparities": count, **{k: round(v, 3) for k, v in times.items()}}),
            flush=True,
        )


if __name__ == "__main__":
    main()
