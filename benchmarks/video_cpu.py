"""Measure video decoding (as in a replay) and encoding (as a run's video), against OpenCV.

Usage: python benchmarks/video_cpu.py RECORDING_VIDEO [--frames 150]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np

from gsplat_core.io.recordings import open_recording
from operators.sinks.video import VideoFile


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--frames", type=int, default=150)
    arguments = parser.parse_args()
    images: list[np.ndarray] = []
    with measured("decode with PyAV, one thread, damage noted", lambda: len(images)):
        images.extend(frame.image for frame in islice(open_recording(arguments.video), arguments.frames))
    count = 0
    with measured("decode with OpenCV, as before", lambda: count):
        capture = cv2.VideoCapture(str(arguments.video), cv2.CAP_FFMPEG)
        while count < len(images) and capture.read()[0]:
            count += 1
    # As the video of a run: two pictures side by side.
    wide = [np.ascontiguousarray(np.concatenate([image, image], axis=1)) for image in images]
    with tempfile.TemporaryDirectory() as folder:
        for name, write in (("VP9 with PyAV", _write_vp9), ("MPEG-4 with OpenCV, as before", _write_mpeg4)):
            path = Path(folder) / "v.mp4"
            with measured(f"encode {name}, {wide[0].shape[1]}x{wide[0].shape[0]}", lambda: len(wide)):
                write(path, wide)
            report(quality=name, psnr_db=_psnr_db(path, wide), bytes_per_frame=path.stat().st_size // len(wide))
    return 0


@contextmanager
def measured(what: str, frames: Callable[[], int]) -> Iterator[None]:
    """Print frames per second and processor time per frame of the enclosed code."""
    wall, before = time.perf_counter(), os.times()
    yield
    wall, after = time.perf_counter() - wall, os.times()
    cpu = after.user + after.system - before.user - before.system
    report(what=what, frames_per_s=round(frames() / wall, 1), processor_ms_per_frame=round(1e3 * cpu / frames(), 2))


def report(**figures: object) -> None:
    print(json.dumps({"cores": os.cpu_count(), **figures}))


def _write_vp9(path: Path, images: list[np.ndarray]) -> None:
    with VideoFile(path, images[0].shape[1], images[0].shape[0], 30.0) as video:
        for image in images:
            video.write(image)


def _write_mpeg4(path: Path, images: list[np.ndarray]) -> None:
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()


def _psnr_db(path: Path, images: list[np.ndarray]) -> float:
    """Return the mean PSNR over frames."""
    with av.open(str(path)) as container:
        read = (frame.to_ndarray(format="rgb24") for frame in container.decode(video=0))
        errors = [float(((a.astype(np.float32) - b) ** 2).mean()) for a, b in zip(read, images, strict=True)]
    return round(float(np.mean([10 * np.log10(255**2 / error) for error in errors])), 2)


if __name__ == "__main__":
    sys.exit(main())
