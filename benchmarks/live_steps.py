"""Measure live training with a fixed number of steps per frame, without a clock, so that results can be repeated.

    python benchmarks/live_steps.py RECORDING... [--steps 60] [--rehearse 60] [--like cuda] [--frames 100] [--scale 0.5] [--fps 60]

Each frame gets `--steps` before it is shown and `--rehearse` steps after it. `--like` selects the settings of `intrasplat live` on that device; `--device` does the
work. One JSON line per recording, over the frames after the first second: tissue PSNR in dB of the displayed pictures (training error), of a copy of the previous
frame, and of the next frame before it is trained on (`next_db`). `retention_db` is the score of the last `--retained` seconds, rendered by the final model. `--set` and
`--set-live` change fields of `ReconstructorConfig` and `LiveTraining`. `--engine replay` trains as `intrasplat replay` does. `--analysed` runs the live checks first:
tool mask, field of view, withheld frames, cuts.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_core.io.recordings import open_recording
from gsplat_core.rendering.renderer import new_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import SETTLING_S, psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings
from operators.graph import Application
from operators.ingest import SourceOp
from operators.pipeline import analysis_operator
from operators.rasterize import without_surround
from operators.sinks.sink import CallbackSinkOp
from operators.sources.registry import SourceOptions, open_source

FIRST_STEPS = {"cpu": 4, "cuda": 60}
"""Steps on the first frame, about as many as in a live run."""


class Shown:
    """Renders the published model to 8-bit pictures, as displayed."""

    def __init__(self, reconstructor: Reconstructor, camera: Camera) -> None:
        self._reconstructor, self._camera = reconstructor, camera
        self._renderer = new_renderer("alpha", camera, reconstructor.device)
        self._published: Any = None

    def publish(self, whole: bool = False) -> None:
        """Publish the newest model; `whole` includes its history."""
        made = self._reconstructor
        self._published = made.snapshot() if whole else made.publish()
        self._renderer.prepare(self._published)

    def psnr_db(self, frame: Frame) -> float:
        """Return the tissue PSNR of the picture at the frame's time and camera."""
        camera = self._camera if frame.pose is None else self._camera.with_pose(frame.pose)
        image = self._renderer.render(camera, frame.time_s, ("image",)).result().image
        shown = without_surround((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy(), frame)
        return psnr_tissue_db(shown, frame.image, frame.tissue)


def with_settings(config: Any, settings: list[str]) -> Any:
    """Return the settings with every `name=value` replaced."""
    changed = {}
    for setting in settings:
        name, value = setting.split("=")
        changed[name] = value if isinstance(getattr(config, name), str) else json.loads(value.lower())
    return dataclasses.replace(config, **changed)


def new_reconstructor(path: str, camera: Camera, arguments: argparse.Namespace) -> Reconstructor:
    """Return the reconstructor of a live run, or of a replay, with the command line's changes."""
    pixels = camera.width_px * camera.height_px
    if arguments.engine == "replay":
        config: ReconstructorConfig = ReplaySettings(Path(path), Path("unused")).reconstructor_config(pixels=pixels)
        return Reconstructor(with_settings(config, arguments.set), camera, device=arguments.device)
    settings = LiveSettings(source=path, out=Path("unused"), device=arguments.like, field=arguments.field)
    live: LiveTraining = with_settings(settings.chosen_training, arguments.set_live)
    config = with_settings(settings.reconstructor_config(pixels), arguments.set)
    return Reconstructor(config, camera, live=live, device=arguments.device)


class Analysis(Application):
    """The operators of a live run up to training, without a clock."""

    def __init__(self, path: str, arguments: argparse.Namespace) -> None:
        super().__init__(name="analysis")
        options = SourceOptions(arguments.scale, arguments.frames, fps=arguments.fps)
        self._source = open_source(path, options)
        self._device = arguments.device
        self.frames: list[Frame] = []

    def compose(self) -> None:
        source = SourceOp(self, name="source", source=self._source)
        analysis = analysis_operator(self, "builtin", "withhold", device=self._device)
        sink = CallbackSinkOp(self, name="frames", callback=self.frames.append)
        self.add_flow(source, analysis, {("frame", "frame")})
        self.add_flow(analysis, sink, {("frame", "message")})


def frames_of(path: str, arguments: argparse.Namespace) -> tuple[list[Frame], Camera, float]:
    """Return the recording's frames at the wanted rate, their camera and the rate."""
    recording = open_recording(path, scale=arguments.scale, max_frames=arguments.frames)
    fps = arguments.fps or recording.fps
    frames = [dataclasses.replace(frame, pts_ns=round(number * 1e9 / fps)) for number, frame in enumerate(recording)]
    if arguments.analysed:
        graph = Analysis(path, arguments)
        graph.run()
        frames = graph.frames
    return frames, recording.camera_at(0), fps


class Run:
    """Training of one recording in one reconstructor, frame by frame."""

    def __init__(self, path: str, arguments: argparse.Namespace) -> None:
        self.arguments = arguments
        self.frames, camera, self.fps = frames_of(path, arguments)
        self.reconstructor = new_reconstructor(path, camera, arguments)
        self._shown = Shown(self.reconstructor, camera)
        self._scene: int | None = None
        self.series: dict[str, list[float]] = {"shown_db": [], "copy_db": [], "next_db": []}

    def __call__(self) -> None:
        """Process all frames."""
        before: Frame | None = None
        for frame in self.frames:
            scored, is_shown = frame.withheld is None, self._scene is not None
            nothing = float("nan")
            self.series["next_db"].append(self._shown.psnr_db(frame) if scored and is_shown else nothing)
            copied = scored and before is not None
            self.series["copy_db"].append(
                psnr_tissue_db(before.image, frame.image, frame.tissue) if copied and before is not None else nothing
            )
            self._learn(frame)
            self.series["shown_db"].append(self._shown.psnr_db(frame) if scored else nothing)
            self._rehearse(frame)
            before = frame

    def _learn(self, frame: Frame) -> None:
        """Train on a frame before it is shown."""
        made, first = self.reconstructor, self._scene is None
        if self.arguments.engine == "live" and not first and frame.scene != self._scene and frame.withheld is None:
            made.begin_scene(frame)
            first = True
        if first and frame.withheld is not None:
            return
        if frame.withheld is None:
            self._scene = frame.scene
        steps = FIRST_STEPS[self.arguments.like] if first else self.arguments.steps
        made.observe(frame, budget=Budget.of_steps(steps), train=frame.withheld is None)
        self._grows = frame.withheld is None and not first
        self._shown.publish()

    def _rehearse(self, frame: Frame) -> None:
        """Rehearse and grow as a live run does between frames."""
        made = self.reconstructor
        if self._scene is None or self.arguments.engine == "replay":
            return
        if self._grows:
            made.grow(frame)
        if self.arguments.rehearse:
            made.rehearse(self.arguments.rehearse)

    def retained(self) -> list[float]:
        """Return the PSNR of the newest frames, rendered by the final model."""
        self._shown.publish(whole=True)
        newest = self.frames[-max(1, round(self.arguments.retained * self.fps)) :]
        return [self._shown.psnr_db(f) for f in newest if f.withheld is None and f.scene == self._scene]


def measure(path: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Train on a recording frame by frame; return its figures."""
    run = Run(path, arguments)
    began_s = time.perf_counter()
    run()
    took_s = time.perf_counter() - began_s
    frames, retained = run.frames, run.retained()
    settled = sum(frame.time_s - frames[0].time_s < SETTLING_S for frame in frames)
    if settled >= len(frames):
        settled = len(frames) // 3
    line = {
        "recording": Path(path).name,
        "frames": len(frames),
        **figures_of(run.series, settled),
        "retention_db": round(float(np.mean(retained)), 2),
        "retention_worst_db": round(min(retained), 2),
        "gaussians": run.reconstructor.gaussians,
        "took_s": round(took_s, 1),
    }
    if arguments.series:
        line["series"] = [None if np.isnan(value) else round(value, 2) for value in run.series["shown_db"]]
    return line


def figures_of(series: dict[str, list[float]], settled: int) -> dict[str, float]:
    """Return the means after the first `settled` frames, median and minimum of the displayed pictures, and their smallest
    difference to the previous frame (`margin_worst_db`)."""
    kept = {name: np.array(values[settled:]) for name, values in series.items()}
    figures = {name: round(float(np.nanmean(values)), 2) for name, values in kept.items()}
    shown = kept["shown_db"]
    worst = {
        "shown_median_db": round(float(np.nanmedian(shown)), 2),
        "shown_worst_db": round(float(np.nanmin(shown)), 2),
        "margin_worst_db": round(float(np.nanmin(shown - kept["copy_db"])), 2),
    }
    return figures | worst


def commit() -> str:
    """Return the commit of the working tree, with a plus sign if files differ from it."""
    run = lambda *command: subprocess.run(["git", *command], capture_output=True, text=True, cwd=Path(__file__).parent)
    return run("rev-parse", "--short", "HEAD").stdout.strip() + (
        "+" if run("status", "--porcelain", "-uno").stdout else ""
    )


def lines(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield a result line per recording, with its settings."""
    for path in arguments.recordings:
        stated = {
            name: vars(arguments)[name] for name in ("engine", "like", "device", "steps", "rehearse", "scale", "fps")
        }
        changed = [*arguments.set, *arguments.set_live]
        yield {"commit": commit(), **stated, "set": changed, "field": arguments.field} | measure(path, arguments)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--engine", choices=("live", "replay"), default="live")
    parser.add_argument(
        "--like", choices=("cpu", "cuda"), default="cuda", help="device whose default settings are used"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--field", default="auto")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--rehearse", type=int, default=60)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--fps", type=float)
    parser.add_argument(
        "--retained", type=float, default=5.0, help="seconds at the end over which retention is measured"
    )
    parser.add_argument("--analysed", action="store_true", help="look for tools, blur and cuts first")
    parser.add_argument("--series", action="store_true", help="add the PSNR of every frame")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--set-live", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    for line in lines(arguments):
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
