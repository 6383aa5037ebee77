"""Measure geometry on random synthetic recordings: median and worst over the seeds of each class.

    python benchmarks/geometry_random.py [CLASS...] [--seeds 1000 1001 …] [--full] [--work FOLDER] [--log FILE]

    stereo  both eyes at rest: depth by matching; share of its 90 % intervals that contain the true depth
    poses   one moving eye with its poses, 10 s: depth by parallax (the default) and by breathing (experimental)
    blind   one moving eye without poses, 10 s: error of the estimated trajectory after the best similarity, relative to its length
    fixed   one eye at rest: relief from light (experimental; no depth by default), after one factor

One JSON line per recording and one summary per class. `depth` is the RMS error over believed tissue pixels relative to their median depth; `level` and `plane` are those of
each frame's level plane and of its best-fit (tilted) plane. `used` is the share of the frames with depth. A class without depth on a recording counts as its worst value.
`--full` renders 640x512 (several minutes of processor time for each recording). With `--work` recordings are kept and reused.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from run_facts import run_facts

from gsplat_core.depth.maps import DepthMap
from gsplat_core.depth.multiview import ParallaxDepth
from gsplat_core.depth.stereo import StereoDepth
from gsplat_core.endoscope.artefacts import FieldOfView
from gsplat_core.evaluation.depth import MOST_DEPTH_PIXELS, flat_depths, pixels_to_compare
from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.experimental.breathing_depth import MovingTissue
from gsplat_core.experimental.light import LightDepth
from gsplat_core.io.recordings import FileRecording, open_recording, synthesize
from gsplat_core.io.recordings.synthetic.random_scene import draw_scene
from gsplat_core.poses.odometry import trajectory_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame

CHECK_SEEDS = list(range(1000, 1010))
"""Seeds of the published figures. Development uses other seeds."""
NINETY = 1.645
"""Half width of a 90 % interval in standard deviations of a normal distribution."""
SIZES = {"stereo": (320, 256, 4, 2.0), "moving": (240, 192, 100, 10.0), "fixed": (320, 256, 8, 2.0)}
"""Width, height, frames and frame rate of the recordings."""


def folder_of(kind: str, seed: int, asked: argparse.Namespace) -> Path:
    """Return the folder of a recording."""
    width = 640 if asked.full else SIZES[kind][0]
    return asked.work / f"{kind}-{seed}-{width}"


def recording_of(kind: str, seed: int, asked: argparse.Namespace) -> FileRecording:
    """Render a recording unless it is there already."""
    width, height, frames, fps = SIZES[kind]
    if asked.full:
        width, height = 640, 512
    folder = folder_of(kind, seed, asked)
    if not folder.exists():
        drawn = draw_scene(seed, moving=kind == "moving", stereo=kind == "stereo")
        synthesize(folder, frames=frames, width_px=width, height_px=height, fps=fps, drawn=drawn)
    return open_recording(folder)


class Given:
    """Frames as an estimator gets them from the product: without depth, with the detected field of view."""

    def __init__(self) -> None:
        self._view = FieldOfView()

    def __call__(self, frame: Frame) -> Frame:
        inside = self._view.observe(frame.image)
        outside = frame.loss_mask
        if inside is not None:
            outside = inside if outside is None else np.minimum(inside, outside)
        return frame.with_fields(depth=None, depth_confidence=None, depth_origin=None, loss_mask=outside)


class Errors:
    """Depth errors of one recording, relative to the median depth of each frame."""

    def __init__(self, camera: Camera, *, scaled: bool = False) -> None:
        self._camera, self._scaled = camera, scaled
        self._squares: dict[str, list[float]] = {"depth": [], "level": [], "plane": []}
        self._medians: list[float] = []
        self._believed: list[float] = []
        self._inside: list[float] = []
        self._unsure: list[float] = []
        self._frames = 0

    def add(self, frame: Frame, found: DepthMap | None, error: np.ndarray | None = None) -> None:
        """Add a frame with true depth; `error` is the standard error of the estimate [H, W]."""
        self._frames += 1
        if found is None or found.doubt is not None:
            return
        true = frame.depth
        assert true is not None
        tissue = (true > 0) & (found.depth > 0) & (frame.mask > 0 if frame.mask is not None else True)
        where = tissue & (found.confidence >= BELIEVED)
        if where.sum() < 100:
            return
        rays, z, depth = pixels_to_compare(self._camera, where, MOST_DEPTH_PIXELS, true, found.depth)
        planes = flat_depths(rays, z)
        assert planes is not None
        factor = float(np.median(z / depth)) if self._scaled else 1.0
        middle = np.median(z)
        for name, values in (("depth", factor * depth), ("level", planes.level), ("plane", planes.plane)):
            self._squares[name].append(float(np.mean(((values - z) / middle) ** 2)))
        self._medians.append(float(np.median(np.abs(factor * depth - z) / z)))
        self._believed.append(float(where.sum() / max((frame.mask > 0).sum() if frame.mask is not None else 1, 1)))
        if error is not None:
            off = np.abs(factor * found.depth - true)[where]
            self._inside.append(float((off <= NINETY * factor * error[where]).mean()))
            self._unsure.append(float(np.median(factor * error[where] / true[where])))

    def figures(self) -> dict[str, Any]:
        """Return the figures of the recording; None without depth."""
        used = len(self._medians)
        mean = lambda values: round(float(np.mean(values)), 4) if values else None
        line = {
            name: round(float(np.sqrt(np.mean(values))), 5) if values else None
            for name, values in self._squares.items()
        }
        line |= {"median_error": mean(self._medians), "believed": mean(self._believed)}
        line["used"] = round(used / max(self._frames, 1), 3)
        if self._inside:
            line |= {"inside_90": mean(self._inside), "standard_error": mean(self._unsure)}
        return line


def stereo(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Match the eyes of each frame."""
    recording = recording_of("stereo", seed, asked)
    estimator, errors = StereoDepth(), Errors(recording.camera)
    given = Given()
    doubts = set[str]()
    for frame in recording:
        found = estimator.estimate(given(frame), recording.camera)
        assert found is not None
        if found.doubt is not None:
            doubts.add(found.doubt)
        errors.add(frame, found, estimator.standard_error(found, frame, recording.camera))
    return errors.figures() | {"doubts": sorted(doubts)}


def poses(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Estimate depth from all frames and the true poses."""
    recording = recording_of("moving", seed, asked)
    frames = list(recording)
    given = Given()
    blind = [given(frame) for frame in frames]
    cameras = [recording.camera_at(frame.seq) for frame in frames]
    default = ParallaxDepth().of_recording(blind, cameras)
    errors, kind = Errors(recording.camera), ParallaxDepth.origin
    assert kind is not None
    for frame, found in zip(frames[::5], default.frames[::5], strict=True):
        depth, confidence = found.depth, found.depth_confidence
        if depth is None or confidence is None:
            errors.add(frame, None)
        else:
            errors.add(frame, DepthMap(depth, confidence, kind, metric=False), kind.relative_error * depth)
    line: dict[str, Any] = {"parallax": errors.figures(), "doubts": dict(default.doubts)}
    tissue, errors = MovingTissue(blind, cameras), Errors(recording.camera)
    for frame in frames[::5]:
        errors.add(frame, tissue.depth_of(frame.seq))
    return line | {"breathing": errors.figures(), "breathing_doubts": list(tissue.doubts)}


def blind(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Estimate the trajectory."""
    recording = recording_of("moving", seed, asked)
    given = Given()
    frames = [given(frame).with_fields(pose=None) for frame in recording]
    found = trajectory_of(frames, recording.camera)
    true = np.stack([recording.camera_at(frame.seq).world_to_camera for frame in frames])
    errors = evaluate_trajectory(found.poses, true)
    assert errors is not None
    line: dict[str, Any] = {
        "ate": round(errors.similarity_share, 5),
        "path_mm": round(errors.path, 1),
        "not_placed": len(found.lost),
    }
    line |= {"explained": round(found.explained, 3), "error_px": round(found.error_px, 3)}
    if found.breathing is not None:
        line |= {
            "breathing_hz": [round(hz, 3) for hz in found.breathing.frequencies_hz],
            "uncertain": round(found.breathing.uncertain / found.path, 4),
        }
    return line


def fixed(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Estimate relief from light."""
    recording = recording_of("fixed", seed, asked)
    estimator, errors = LightDepth(), Errors(recording.camera, scaled=True)
    given = Given()
    for frame in recording:
        found = estimator.estimate(given(frame), recording.camera)
        errors.add(frame, found, None if found is None else found.origin.relative_error * found.depth)
    line = errors.figures()
    return line | {"below_plane": line["depth"] is not None and line["depth"] < line["plane"]}


def conditions(seed: int, kind: str, asked: argparse.Namespace) -> dict[str, Any]:
    """Return the properties that explain a recording's figures."""
    drawn = draw_scene(seed, moving=kind in ("poses", "blind"), stereo=kind == "stereo")
    return {
        "organ": drawn.organ, "focal": round(drawn.focal, 2), "mm": round(drawn.shape.distance_mm), "smoke": round(drawn.smoke, 2),
        "particles": drawn.particles, "noise": round(drawn.sensor.shot_noise, 3), "quality": drawn.sensor.quality,
        "field": drawn.sensor.field.kind, "tools": len(drawn.tools), "lens": round(sum(drawn.lens), 3),
        "path": drawn.path.kind if drawn.path else None,
        "breath": [round(drawn.breathing.period_s, 2), round(drawn.breathing.ratio, 2), round(drawn.breathing.pause, 2), round(drawn.shape.breath, 2)],
    }  # fmt: skip


CLASSES: dict[str, Callable[[int, argparse.Namespace], dict[str, Any]]] = {
    "stereo": stereo,
    "poses": poses,
    "blind": blind,
    "fixed": fixed,
}


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return median and worst of each figure over the recordings; a missing figure is the worst one."""
    found: dict[str, Any] = {}
    for part in (None, "parallax", "breathing"):
        values = [line if part is None else line.get(part, {}) for line in lines]
        for name in ("depth", "level", "plane", "ate", "median_error", "inside_90", "used"):
            if not any(name in each for each in values):
                continue
            numbers = [np.inf if each.get(name) is None else each[name] for each in values]
            middle, worst = float(np.median(numbers)), float(min(numbers) if name == "used" else max(numbers))
            text = lambda number: round(number, 4) if np.isfinite(number) else "none"
            found[name if part is None else f"{part}_{name}"] = [text(middle), text(worst)]
            if name == "inside_90":
                found["inside_90_range"] = [text(float(min(numbers))), text(float(max(numbers)))]
    if any("below_plane" in line for line in lines):
        found["below_plane"] = sum(bool(line["below_plane"]) for line in lines)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("classes", nargs="*", metavar="CLASS", choices=[[], *CLASSES])
    parser.add_argument("--seeds", type=int, nargs="+", default=CHECK_SEEDS)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--log", type=Path)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="geometry-random-") as temporary:
        asked.work = asked.work or Path(temporary)
        said = [json.dumps({"header": run_facts()})]
        for name in asked.classes or CLASSES:
            lines = []
            for seed in asked.seeds:
                began_s = time.process_time()
                line = CLASSES[name](seed, asked)
                lines.append(line)
                took_s = round(time.process_time() - began_s, 1)
                text = json.dumps(
                    {"class": name, "seed": seed, **line, "drawn": conditions(seed, name, asked), "s": took_s}
                )
                said.append(text)
                print(text, flush=True)
            said.append(json.dumps({"class": name, "summary": summary(lines)}))
            print(said[-1], flush=True)
    if asked.log is not None:
        asked.log.parent.mkdir(parents=True, exist_ok=True)
        asked.log.write_text("\n".join(said) + "\n")


if __name__ == "__main__":
    main()
