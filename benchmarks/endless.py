"""A recording looped for as long as a stream may last: are memory, time per frame and quality as flat as they should be?

Usage: python benchmarks/endless.py RECORDING [--minutes 60] [--device cuda] [--steps 4] [--rehearse 0] [--scale 1] [--places]

The stream is not played to a clock: each frame gets a fixed number of steps, so that an hour takes as long as its work. Per frame it does
what a live run does: observe, publish, render, rehearse. One JSON line per minute of stream, then one with the growth since the second
minute and with what the last 5 s look like when they are rendered again at the end. With `--places` each loop begins as a new scene, as
after a cut, so that the place is left and found again.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_core.io.recordings import open_recording
from gsplat_core.memory import return_freed_memory
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.scene.frames import Frame
from gsplat_core.training.budget import Budget
from gsplat_core.training.live import LiveReconstructor
from gsplat_core.training.metrics import psnr_tissue_db
from operators.applications.live_settings import LiveSettings

SCORED_EVERY = 10
RETAINED_S = 5.0


def looped(frames: list[Frame], fps: float, count: int, new_scenes: bool) -> Iterator[Frame]:
    """`count` frames in an order of time that never runs back."""
    for seq in range(count):
        turn, index = divmod(seq, len(frames))
        begins = "loop" if new_scenes and index == 0 and turn else None
        yield replace(frames[index], seq=seq, pts_ns=round(seq * 1e9 / fps), new_scene=begins)


def memory_mib(device: str) -> dict[str, float]:
    """What the process and the device hold now, without what was freed already."""
    return_freed_memory()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    held = {"process_mib": round(pages * resource.getpagesize() / 2**20, 1)}
    if device == "cuda":
        free, total = torch.cuda.mem_get_info()
        held |= {
            "device_mib": round((total - free) / 2**20, 1),
            "allocated_mib": round(torch.cuda.memory_allocated() / 2**20, 1),
        }
    return held


class Stream:
    """The looped stream and what it is measured by."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        recording = open_recording(arguments.recording, scale=arguments.scale)
        self.frames = list(recording)
        self.fps, self.device = recording.fps, arguments.device
        self.steps, self.rehearse = Budget.of_steps(arguments.steps), arguments.rehearse
        settings = LiveSettings(source=str(arguments.recording), out=Path("unused"), device=arguments.device)
        config = settings.reconstructor_config(recording.camera.width_px * recording.camera.height_px)
        self.reconstructor = LiveReconstructor(config, recording.camera, device=arguments.device)
        self.renderer = AlphaRenderer(recording.camera, torch.device(arguments.device))
        self.new_scenes = arguments.places

    def show(self, frame: Frame) -> torch.Tensor:
        """The picture of the newest model at a frame's time."""
        camera = self.reconstructor.camera
        pose = camera if frame.pose is None else camera.with_pose(frame.pose)
        return self.renderer.render(pose, frame.time_s, ["image"]).result().image

    def minute(self, frames: Iterator[Frame]) -> dict[str, Any]:
        """Work through some frames."""
        took_ms, psnr_db = [], []
        for frame in frames:
            start = time.perf_counter()
            if frame.new_scene is not None:
                self.reconstructor.begin_scene(frame)
            self.reconstructor.observe(frame, budget=self.steps)
            self.renderer.prepare(self.reconstructor.publish())
            image = self.show(frame)
            self.reconstructor.grow(frame)
            if self.rehearse:
                self.reconstructor.rehearse(self.rehearse)
            if self.device == "cuda":
                torch.cuda.current_stream().synchronize()
            took_ms.append(1e3 * (time.perf_counter() - start))
            if frame.seq % SCORED_EVERY == 0:
                psnr_db.append(self.score(image, frame))
        return {
            "frames": len(took_ms),
            "frames_per_s": round(1e3 * len(took_ms) / sum(took_ms), 1),
            "p50_ms": round(float(np.percentile(took_ms, 50)), 3),
            "p99_ms": round(float(np.percentile(took_ms, 99)), 3),
            "mean_ms": round(float(np.mean(took_ms)), 3),
            "psnr_db": round(float(np.mean(psnr_db)), 2),
            **memory_mib(self.device),
            "gaussians": self.reconstructor.gaussians,
            **self.reconstructor.kept(),
        }

    def score(self, image: torch.Tensor, frame: Frame) -> float:
        """PSNR over tissue of a picture as it is displayed."""
        return psnr_tissue_db((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy(), frame.image, frame.mask)

    def retention(self, count: int) -> dict[str, float]:
        """What the last seconds look like now, from the model as it ended."""
        first = max(0, count - round(RETAINED_S * self.fps))
        psnr_db = [self.score(self.show(frame), frame) for frame in self.newest(first, count)]
        return {"retention_db": round(float(np.mean(psnr_db)), 2), "retention_worst_db": round(min(psnr_db), 2)}

    def newest(self, first: int, count: int) -> Iterator[Frame]:
        """The frames of the loop from number `first` on."""
        return (frame for frame in looped(self.frames, self.fps, count, False) if frame.seq >= first)


def growth(minutes: list[dict[str, Any]]) -> dict[str, float]:
    """The last minute over the second one, in percent."""
    early, late = minutes[min(1, len(minutes) - 1)], minutes[-1]
    names = [name for name in ("process_mib", "device_mib", "allocated_mib", "p50_ms", "mean_ms") if name in early]
    return {f"{name}_growth_percent": round(100 * (late[name] / early[name] - 1), 2) for name in names}


def main() -> None:
    """Run the stream."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--rehearse", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--places", action="store_true")
    arguments = parser.parse_args()
    stream = Stream(arguments)
    of_minute = round(60 * stream.fps)
    count = of_minute * arguments.minutes
    frames = looped(stream.frames, stream.fps, count, stream.new_scenes)
    minutes = []
    for minute in range(arguments.minutes):
        minutes.append(stream.minute(next(frames) for _ in range(of_minute)))
        print(json.dumps({"minute": minute + 1, **minutes[-1]}), flush=True)
    print(json.dumps({"recording": arguments.recording.name, **growth(minutes), **stream.retention(count)}))


if __name__ == "__main__":
    main()
