"""Score each eye's picture when training uses one eye or both eyes of a stereo scope.

    python benchmarks/geometry_eyes.py heart/left.mp4 --right heart/right.mp4 --below 0.5 [--eyes left both] [--steps 3 10 30]
    python benchmarks/geometry_eyes.py heart/left.mp4 --right heart/right.mp4 --below 0.5 --fps 30 --device cuda
    python benchmarks/geometry_eyes.py RECORDING --fit 1500 --scale 0.5

With `--steps` each frame gets this number of optimiser steps before it is shown and half as many rehearsal steps after it, with the device's live settings. With
`--fps` steps run until 0.6 of the frame interval (at most 17 ms), then rehearsal until the next frame; scoring stops the clock. With `--fit` all frames are
trained on offline.

One JSON line per run. left_db: PSNR of the newest frame in the left eye, mean over every tenth frame after the first second (`left_all_db`: all frames).
right_db: the same for the right eye by `gsplat_core.evaluation.views`, next to its baselines. depth_px: median disparity error against the given depth. For two
videos without calibration, the focal length is 0.9 of the width, the baseline puts the typical disparity at 60 mm, and `--below` is the vertical offset of the
right picture in pixels.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_core.depth.maps import DepthFinder
from gsplat_core.evaluation.views import EVERY, evaluate_second_eye, matched_disparity
from gsplat_core.io.recordings import open_recording
from gsplat_core.models import Model
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget
from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings
from operators.reconstruct import warm_reconstructor

Arguments = argparse.Namespace
PLANE_MM = 60.0
SHOW_AFTER, SHOW_AFTER_S = 0.6, 0.017


def frames_of(asked: Arguments) -> tuple[list[Frame], Camera]:
    """Return all frames with both eyes and with the requested depth."""
    recording = open_recording(asked.recording, scale=asked.scale)
    camera = recording.camera
    frames = list(islice(recording, asked.frames))
    if asked.right is not None:
        rights = [frame.image for frame in islice(open_recording(asked.right, scale=asked.scale), asked.frames)]
        camera = Camera.from_focal(0.9 * recording.width_px, recording.width_px, recording.height_px)
        disparity = float(np.median(matched_disparity(frames[0].image, rights[0])))
        eye = camera.right_eye(PLANE_MM * disparity / camera.K[0, 0])
        K = eye.K.copy()
        K[1, 2] += asked.below * asked.scale
        eye = replace(eye, K=K)
        frames = [
            frame.with_fields(right_image=right, right_camera=eye) for frame, right in zip(frames, rights, strict=True)
        ]
    finder = DepthFinder(asked.depth, camera)
    return [finder.with_depth(frame) for frame in frames], camera


class Scores:
    """Scores of one run's pictures."""

    def __init__(self, camera: Camera, left_out_px: int | None) -> None:
        self._camera, self._left_out_px = camera, left_out_px
        self._left: list[float] = []
        self._settled: list[float] = []
        self._depth: list[float] = []
        self._views: dict[int, np.ndarray] = {}

    def take(self, frame: Frame, model: Model) -> None:
        """Score the model's left and right pictures and its depth for a frame."""
        now = model.at(frame.time_s)
        pose = self._camera.world_to_camera if frame.pose is None else frame.pose
        eye = frame.right_camera
        with torch.no_grad():
            left = render(now, self._camera.with_pose(pose))
            if eye is not None:
                eye = eye.with_pose(eye.world_to_camera @ pose)
                seen = now.seen_by_right()
                self._views[frame.seq] = render(seen, eye).image.cpu().numpy()
        value = psnr_tissue_db((left.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu(), frame.image, frame.mask)
        self._left.append(value)
        if frame.time_s >= 1:
            self._settled.append(value)
        if frame.depth is not None and eye is not None:
            focal_mm = float(self._camera.K[0, 0] * np.linalg.norm(eye.world_to_camera[:3, 3]))
            shown, known = left.depth.cpu().numpy(), np.isfinite(frame.depth) & (frame.depth > 0)
            if frame.mask is not None:
                known &= frame.mask > 0
            known &= shown > 0
            self._depth.append(float(np.median(np.abs(focal_mm / shown[known] - focal_mm / frame.depth[known]))))

    def line(self, frames: list[Frame]) -> dict[str, Any]:
        """Return all scores, rounded."""
        rounded = lambda value: None if value is None else round(float(value), 2)
        mean = lambda values: rounded(np.mean(values)) if values else None
        found = evaluate_second_eye(
            frames, self._camera, lambda frame, _: self._views[frame.seq], left_out_px=self._left_out_px
        )
        line = {"left_db": mean(self._settled), "left_all_db": mean(self._left), "depth_px": mean(self._depth)}
        if found is None:
            return line
        return line | {
            "right_db": rounded(found.score.psnr_tissue_db),
            "baselines_db": {name: rounded(one.psnr_tissue_db) for name, one in found.baselines.items()},
            "left_out_px": found.left_out_px,
        }


def live(asked: Arguments, eyes: str, camera: Camera) -> Reconstructor:
    """Return a reconstructor configured as in the live application."""
    settings = LiveSettings(source="", out=Path(), device=asked.device, eyes=eyes)  # type: ignore[arg-type]
    config = replace(settings.reconstructor_config(camera.width_px * camera.height_px), **asked.set)
    learning = Reconstructor(config, camera, live=settings.chosen_training, device=asked.device)
    warm_reconstructor(learning, stereo=eyes == "both")
    return learning


def by_steps(learning: Reconstructor, frame: Frame, steps: int) -> Iterator[Model]:
    """Train on a frame, show it, rehearse."""
    learning.observe(frame, steps=steps)
    yield learning.publish().as_model()
    learning.grow(frame)
    learning.rehearse(steps // 2)


def by_clock(learning: Reconstructor, frame: Frame, fps: float, first: bool, made: list[int]) -> Iterator[Model]:
    """Train within the frame's time budget and yield the model to score."""
    began = time.monotonic()
    until = began + min(SHOW_AFTER / fps, SHOW_AFTER_S)
    report = learning.observe(frame, budget=Budget.until(until, at_least=5 if first else 3))
    model = learning.publish()
    spent = time.monotonic() - began
    made.append(report.steps)
    yield model.as_model()
    ends = time.monotonic() + 1 / fps - spent
    learning.grow(frame)
    while time.monotonic() + learning.rehearsal_ns(3) * 1e-9 < ends:
        learning.rehearse(3)


def online(asked: Arguments, eyes: str, frames: list[Frame], camera: Camera, steps: int | None) -> dict[str, Any]:
    """Train and score one run frame by frame."""
    learning, scores, made = live(asked, eyes, camera), Scores(camera, asked.left_out), list[int]()
    for frame in frames:
        shown = (
            by_clock(learning, frame, asked.fps, not learning.gaussians, made)
            if steps is None
            else by_steps(learning, frame, steps)
        )
        for model in shown:
            if steps is None or frame.seq % EVERY == 0 or asked.device == "cuda" or len(frames) <= 30:
                scores.take(frame, model)
    line = {"eyes": eyes, "gaussians": learning.gaussians, **scores.line(frames)}
    return line | ({"steps": steps} if steps is not None else {"steps_mean": round(float(np.mean(made)), 1)})


def offline(asked: Arguments, eyes: str, frames: list[Frame], camera: Camera, steps: int) -> dict[str, Any]:
    """Train and score one run on all frames."""
    settings = ReplaySettings(recording="", out=Path(), device=asked.device, eyes=eyes)  # type: ignore[arg-type]
    config = replace(settings.reconstructor_config(camera.width_px * camera.height_px, offline=True), **asked.set)
    learning, scores = Reconstructor(config, camera, device=asked.device), Scores(camera, asked.left_out)
    learning.fit(frames, steps)
    model = learning.snapshot()
    for frame in frames[::EVERY]:
        scores.take(frame, model)
    return {"eyes": eyes, "fit_steps": steps, "gaussians": learning.gaussians, **scores.line(frames)}


def arguments() -> Arguments:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--right", type=Path, help="the right eye's video; without it the recording has both")
    parser.add_argument("--below", type=float, default=0.0)
    parser.add_argument("--eyes", nargs="+", default=["left", "both"], choices=["left", "both"])
    parser.add_argument("--steps", nargs="+", type=int, default=[])
    parser.add_argument("--fps", type=float)
    parser.add_argument("--fit", nargs="+", type=int, default=[])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--depth", default="auto")
    parser.add_argument("--left-out", type=int, help="columns at the right edge (heart: 110)")
    parser.add_argument("--set", default="", help="name=number,… of ReconstructorConfig")
    asked = parser.parse_args()
    pairs = (one.split("=") for one in asked.set.split(",") if one)
    asked.set = {name: json.loads(value) for name, value in pairs}
    return asked


def main() -> None:
    asked = arguments()
    frames, camera = frames_of(asked)
    runs: list[Callable[[str], dict[str, Any]]] = []
    runs += [lambda eyes, steps=steps: online(asked, eyes, frames, camera, steps) for steps in asked.steps]
    runs += [lambda eyes: online(asked, eyes, frames, camera, None)] if asked.fps else []
    runs += [lambda eyes, steps=steps: offline(asked, eyes, frames, camera, steps) for steps in asked.fit]
    for run in runs:
        for eyes in asked.eyes:
            began = time.perf_counter()
            line = run(eyes)
            line |= {"frames": len(frames), "set": asked.set, "took_s": round(time.perf_counter() - began, 1)}
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
