"""Measure the processor time per frame of each stage that prepares a real endoscope's video, on one core.

Usage: python benchmarks/endoscope_cpu.py RECORDING... [--frames 150] [--width 640 --height 512]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from gsplat_core.io.recordings import open_recording
from gsplat_core.scene.frames import Frame
from operators.checks import PICTURE_STAGES, MaskAndDepthStage


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    size = (arguments.width, arguments.height)
    for path in arguments.recordings:
        frames = [
            Frame(k, k * 33_333_333, cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA))
            for k, frame in enumerate(islice(open_recording(path), arguments.frames))
        ]
        for name, make in {**PICTURE_STAGES, "mask and depth": MaskAndDepthStage}.items():
            stage, spent_ms = make(), []
            for index, frame in enumerate(frames):
                before = time.process_time()
                frames[index] = stage.apply(frame)
                spent_ms.append(1e3 * (time.process_time() - before))
            p50, p99 = (round(float(value), 2) for value in np.percentile(spent_ms, [50, 99]))
            found = dict(stage.counts().found)
            result = {
                "recording": path.name,
                "size": f"{size[0]}x{size[1]}",
                "stage": name,
                "p50_ms": p50,
                "p99_ms": p99,
            }
            print(json.dumps({**result, "found": found}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
