"""Loop a recording for hours and measure whether memory, time per frame and quality stay constant.

Usage: python benchmarks/endless.py RECORDING [--minutes 60] [--device cuda] [--steps 4] [--rehearse 4] [--scale 1] [--places] [--out FILE]
       python benchmarks/endless.py RECORDING --clock [--once] [--fps 30] ...

Each frame is processed as in a live run: observe, publish, render, grow, rehearse. Without `--clock` it gets a fixed number of steps. With `--clock`, frames
arrive at the recording's rate, or at `--fps`, and get the steps that a live run has time for. With `--once` the recording is played once.

One JSON line per minute of stream, then one line with the growth since the second minute and the score of the last 5 s, rendered again at the end. A minute is
the number of whole loops closest to 60 s, and the same frames are scored in each. `--out` also writes the lines into a file. A run that is stopped (Ctrl-C,
SIGTERM) prints its last line too. With `--places` each loop starts a new scene, as after a cut.
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_core.io.recordings import open_recording
from gsplat_core.machine import return_freed_memory
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.rendering.renderer import PendingFrame
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget
from operators.applications.live_settings import LiveSettings
from operators.frame_clock import FrameClock
from operators.reconstruct import warm_reconstructor

SCORED_EVERY = 10
REHEARSED_AT_ONCE = {"cpu": 1, "cuda": 3}
"""Rehearsal steps between two readings of the clock, as in `operators.reconstruct`."""
RETAINED_S = 5.0


def looped(frames: list[Frame], fps: float, new_scenes: bool, first: int = 0) -> Iterator[Frame]:
    """Yield the frames repeatedly, starting with number `first`, with increasing timestamps."""
    for seq in count(first):
        turn, index = divmod(seq, len(frames))
        begins = "loop" if new_scenes and index == 0 and turn else None
        yield replace(frames[index], seq=seq, pts_ns=round(seq * 1e9 / fps), new_scene=begins)


def memory_mib(device: str) -> dict[str, float]:
    """Return the memory in use by the process and the device in MiB, after freed memory was returned."""
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
    """Looped stream with its measurements."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        recording = open_recording(arguments.recording, scale=arguments.scale)
        self.frames = list(recording)
        self.fps, self.device = arguments.fps or recording.fps, arguments.device
        self.steps, self.rehearse = Budget.of_steps(arguments.steps), arguments.rehearse
        settings = LiveSettings(source=str(arguments.recording), out=Path("unused"), device=arguments.device)
        config = settings.reconstructor_config(recording.camera.width_px * recording.camera.height_px)
        self.reconstructor = Reconstructor(
            config, recording.camera, live=settings.chosen_training, device=arguments.device
        )
        self.renderer = AlphaRenderer(recording.camera, torch.device(arguments.device))
        self.new_scenes, self.once = arguments.places, arguments.once
        self.clock: FrameClock | None = None
        self.steps_taken = self.steps_rehearsed = 0
        if arguments.clock:
            warm_reconstructor(self.reconstructor)
            self.clock = FrameClock(settings.chosen_clock, self.fps)
            self.due_ns: int | None = None
        self.shown: PendingFrame | None = None

    def wait_for_next(self) -> None:
        """Wait until the next frame is due. A late run continues at once and does not catch up."""
        assert self.clock is not None
        now_ns = self.clock.now_ns()
        self.due_ns = now_ns if self.due_ns is None else max(now_ns, self.due_ns + round(1e9 / self.fps))
        time.sleep(max(0, self.due_ns - now_ns) * 1e-9)

    @property
    def turns_of_minute(self) -> int:
        """Return the number of whole loops that comes closest to a minute."""
        return 1 if self.once else max(1, round(60 * self.fps / len(self.frames)))

    def show(self, frame: Frame) -> PendingFrame:
        """Queue the picture of the newest model at a frame's time, and finish the previous one."""
        if self.shown is not None:
            self.shown.result()
        camera = self.reconstructor.camera
        pose = camera if frame.pose is None else camera.with_pose(frame.pose)
        self.shown = self.renderer.render(pose, frame.time_s, ["image"])
        return self.shown

    def work(self, frame: Frame) -> PendingFrame:
        """Process a frame as a live run does."""
        first = self.shown is None or frame.new_scene is not None
        if frame.new_scene is not None:
            self.reconstructor.begin_scene(frame)
        taken_ns, budget = 0, self.steps
        if self.clock is not None:
            taken_ns = self.clock.now_ns()
            budget = self.clock.budget(replace(frame, arrived_ns=self.due_ns), first=first)
        report = self.reconstructor.observe(frame, budget=budget)
        self.renderer.prepare(self.reconstructor.publish())
        if self.clock is not None and not first:
            self.clock.published(taken_ns, self.clock.now_ns(), report.steps, self.reconstructor.step_ns)
        picture = self.show(frame)
        if not first or self.clock is None:
            self.reconstructor.grow(frame)
        self.steps_taken += report.steps
        self.rehearse_in_time()
        return picture

    def rehearse_in_time(self) -> None:
        """Run the rehearsal steps of a frame: the requested number, or as many as the clock allows."""
        made = 0
        if self.clock is None:
            self.reconstructor.rehearse(made := self.rehearse)
        else:
            at_once = REHEARSED_AT_ONCE[self.device]
            while self.clock.may_rehearse(made, self.reconstructor.rehearsal_ns(at_once)):
                self.reconstructor.rehearse(at_once)
                made += at_once
        self.steps_rehearsed += made

    def minute(self, frames: Iterator[Frame]) -> dict[str, Any]:
        """Process the frames of one minute and yield its figures."""
        took_ms, psnr_db = [], []
        turns, length = self.turns_of_minute, len(self.frames)
        before: Frame | None = None
        copied_db: list[float] = []
        self.steps_taken = self.steps_rehearsed = 0
        for number, frame in enumerate(islice(frames, turns * length)):
            if self.clock is not None:
                self.wait_for_next()
            start = time.perf_counter()
            picture = self.work(frame)
            took_ms.append(1e3 * (time.perf_counter() - start))
            # Within ten turns every frame of the recording is scored once.
            turn, index = divmod(number, length)
            if (turn + index) % SCORED_EVERY == 0:
                psnr_db.append(self.score(picture, frame))
                if before is not None:
                    copied_db.append(psnr_tissue_db(before.image, frame.image, frame.mask))
            before = frame
        if self.device == "cuda":
            start = time.perf_counter()
            torch.cuda.synchronize()
            took_ms[-1] += 1e3 * (time.perf_counter() - start)
        return {
            "frames": len(took_ms),
            "frames_per_s": round(1e3 * len(took_ms) / sum(took_ms), 1),
            "p50_ms": round(float(np.percentile(took_ms, 50)), 3),
            "p99_ms": round(float(np.percentile(took_ms, 99)), 3),
            "mean_ms": round(float(np.mean(took_ms)), 3),
            "psnr_db": round(float(np.mean(psnr_db)), 3),
            "worst_db": round(min(psnr_db), 2),
            "previous_frame_db": round(float(np.mean(copied_db)), 3),
            "steps_per_frame": round(self.steps_taken / len(took_ms), 1),
            "rehearsed_per_frame": round(self.steps_rehearsed / len(took_ms), 1),
            **memory_mib(self.device),
            "gaussians": self.reconstructor.gaussians,
            **self.reconstructor.kept(),
        }

    def score(self, picture: PendingFrame, frame: Frame) -> float:
        """Return the tissue PSNR of an 8-bit picture."""
        image = (picture.result().image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return psnr_tissue_db(image, frame.image, frame.mask)

    def retention(self, frames_so_far: int) -> dict[str, float]:
        """Score the last seconds again, rendered by the final model with its whole history."""
        newest = min(frames_so_far, round(RETAINED_S * self.fps))
        frames = islice(looped(self.frames, self.fps, False, frames_so_far - newest), newest)
        self.renderer.prepare(self.reconstructor.snapshot())
        psnr_db = [self.score(self.show(frame), frame) for frame in frames]
        return {"retention_db": round(float(np.mean(psnr_db)), 2), "retention_worst_db": round(min(psnr_db), 2)}


def growth(minutes: list[dict[str, Any]]) -> dict[str, float]:
    """Return the last minute relative to the second one: memory and time in percent, quality in decibels."""
    early, late = minutes[min(1, len(minutes) - 1)], minutes[-1]
    names = [name for name in ("process_mib", "device_mib", "allocated_mib", "p50_ms", "mean_ms") if name in early]
    grown = {f"{name}_growth_percent": round(100 * (late[name] / early[name] - 1), 2) for name in names}
    return {**grown, "psnr_db_change": round(late["psnr_db"] - early["psnr_db"], 3)}


class Lines:
    """Writer of JSON lines to standard output and a file, flushed line by line."""

    def __init__(self, out: Path | None) -> None:
        self._file = None if out is None else out.open("w", encoding="utf-8")

    def write(self, **values: Any) -> None:
        print(json.dumps(values), flush=True)
        if self._file is not None:
            print(json.dumps(values), file=self._file, flush=True)


def interrupted(number: int, _: object) -> None:
    """Handle SIGTERM like Ctrl-C."""
    raise KeyboardInterrupt(signal.Signals(number).name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--rehearse", type=int, default=4)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--places", action="store_true")
    parser.add_argument("--clock", action="store_true", help="play at the recording's rate, with as many steps as fit")
    parser.add_argument("--once", action="store_true", help="play the recording once")
    parser.add_argument("--fps", type=float)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, interrupted)
    lines, stream = Lines(arguments.out), Stream(arguments)
    frames = looped(stream.frames, stream.fps, stream.new_scenes)
    minutes: list[dict[str, Any]] = []
    try:
        while len(minutes) < (1 if arguments.once else arguments.minutes):
            minutes.append(stream.minute(frames))
            lines.write(minute=len(minutes), **minutes[-1])
    except KeyboardInterrupt as stopped:
        lines.write(stopped=str(stopped) or "Ctrl-C", after_minutes=len(minutes))
    if minutes:
        seen = next(frames).seq
        grown = {} if arguments.once else growth(minutes)
        stated = {"device": arguments.device, "clock": arguments.clock, "once": arguments.once, "fps": stream.fps}
        lines.write(recording=arguments.recording.name, **stated, **grown, **stream.retention(seen))


if __name__ == "__main__":
    main()
