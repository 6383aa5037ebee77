"""Measure causal next-frame prediction: render frame i + 1 with the model trained on frames 0 to i, score it, then train on it.

    python benchmarks/causal.py RECORDING... [--steps 40] [--device cuda] [--frames N] [--scale S] [--prior flow|learned] [--live]

One JSON line per recording: mean tissue PSNR in dB over the same frames, without the first two. Figures: the prediction; the newest state held; a copy of the
previous frame; the previous frame warped by half of the last optical flow (DIS, medium preset); the model on the frame just learned (`live_db`) and before its
first step on it (`start_db`). `--set name=value` changes a setting of `ReconstructorConfig`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.io.recordings import open_recording
from gsplat_core.rendering.renderer import new_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import ScoredMean, psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining


class HalfFlow:
    """Baseline without a reconstruction: the newest picture, warped by half of the last optical flow."""

    def __init__(self) -> None:
        self._method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._before: NDArray[Any] | None = None
        self.picture: NDArray[Any] | None = None
        """The guess for the next frame."""

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Add a picture to the flow."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self._before is not None:
            back = 0.5 * self._method.calc(grey, self._before, None)
            height, width = grey.shape
            x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
            self.picture = cv2.remap(
                image, x + back[..., 0], y + back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        self._before = grey


class Shown:
    """Renders the published model to 8-bit pictures, as displayed."""

    def __init__(self, reconstructor: Reconstructor, camera: Camera) -> None:
        self._reconstructor, self._camera = reconstructor, camera
        self._renderer = new_renderer("alpha", camera, reconstructor.device)
        self.published: Any = None

    def publish(self) -> None:
        """Publish the newest model and prepare it for rendering."""
        self.published = None
        self.published = self._reconstructor.publish()
        self._renderer.prepare(self.published)

    def psnr_db(self, frame: Frame, time_s: float | None = None) -> float:
        """Return the tissue PSNR of the picture rendered at the frame's pose, at `time_s` or at the frame's time."""
        camera = self._camera if frame.pose is None else self._camera.with_pose(frame.pose)
        at_s = frame.time_s if time_s is None else time_s
        image = self._renderer.render(camera, at_s, ("image",)).result().image
        shown = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return psnr_tissue_db(shown, frame.image, frame.mask)


def frames_in_pairs(frames: list[Frame]) -> Iterator[tuple[Frame | None, Frame]]:
    """Yield every frame with its predecessor."""
    yield None, frames[0]
    yield from pairwise(frames)


def measure(path: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the JSON line of one recording."""
    recording = open_recording(path, scale=arguments.scale, max_frames=arguments.frames)
    frames, camera = list(recording), recording.camera_at(0)
    config = with_settings(ReconstructorConfig(motion_prior=arguments.prior), arguments.set)
    device = arguments.device
    live = with_settings(LiveTraining(), arguments.set_live) if arguments.live else None
    reconstructor = Reconstructor(config, camera, live=live, device=device)
    shown, half_flow = Shown(reconstructor, camera), HalfFlow()
    means = {name: ScoredMean() for name in ("causal", "hold", "copy", "half_flow", "start", "live")}
    worst, learning_s = np.inf, 0.0
    for before, frame in frames_in_pairs(frames):
        scored = before is not None and half_flow.picture is not None
        if before is not None and scored:
            means["causal"].add(shown.psnr_db(frame))
            means["hold"].add(shown.psnr_db(frame, before.time_s))
            means["copy"].add(psnr_tissue_db(before.image, frame.image, frame.mask))
            means["half_flow"].add(psnr_tissue_db(half_flow.picture, frame.image, frame.mask))
        began_s = time.perf_counter()
        reconstructor.observe(frame, steps=arguments.steps if before is not None else max(60, arguments.steps))
        shown.publish()
        if arguments.rehearse and arguments.live:
            reconstructor.grow(frame)
            reconstructor.rehearse(arguments.rehearse)
        live_db = shown.psnr_db(frame)
        learning_s += time.perf_counter() - began_s
        half_flow.observe(frame.image)
        if scored:
            means["live"].add(live_db)
            worst = min(worst, live_db)
    each = {f"{name}_db": None if m.mean is None else round(m.mean, 3) for name, m in means.items() if m.count}
    per_frame_ms = round(1e3 * learning_s / len(frames), 2)
    return {
        "recording": path,
        "frames": len(frames),
        **each,
        "worst_live_db": round(worst, 2),
        "ms_a_frame": per_frame_ms,
    }


def with_settings(config: Any, settings: list[str]) -> Any:
    """Return the settings with `name=value` replaced."""
    changed = {}
    for setting in settings:
        name, value = setting.split("=")
        changed[name] = value if isinstance(getattr(config, name), str) else json.loads(value.lower())
    return dataclasses.replace(config, **changed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--prior", default="flow")
    parser.add_argument("--live", action="store_true", help="train as `intrasplat live` does")
    parser.add_argument(
        "--rehearse", type=int, default=0, help="with --live: steps on the window after a frame was shown"
    )
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--set-live", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    for path in arguments.recordings:
        settings = {"prior": arguments.prior, "steps": arguments.steps, "live": arguments.live}
        line = settings | {"set": arguments.set + arguments.set_live} | measure(path, arguments)
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
