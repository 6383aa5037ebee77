"""Compare depth from the scope's own light with planes, and measure its cost.

Usage: python benchmarks/geometry_light.py [--pictures DIR]

One JSON line per recording. `error` is the RMS error after one factor per frame, relative to the median depth. `level` and `plane` are the errors of the level plane and
of the best-fit plane (`gsplat_core.evaluation.depth`). `believed` is the share of pixels with a confidence of at least 0.5. `doubted` is the share of frames without
an estimate, which count as a level plane.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.depth import MOST_DEPTH_PIXELS, flat_depths, pixels_to_compare
from gsplat_core.experimental.light import LightDepth
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame

RECORDINGS = Path(__file__).resolve().parents[2] / "shared/recordings"
SEEDS = 6


def error(found: NDArray[np.float32], true: NDArray[np.float32], kept: NDArray[np.bool_]) -> float:
    """Return the depth error after scaling the median to the true one."""
    shown, known = found[kept].astype(np.float64), true[kept].astype(np.float64)
    off = shown * np.median(known / shown) - known
    return float(np.sqrt(np.mean(off * off)) / np.median(known))


def bare(frame: Frame) -> Frame:
    """Return the frame without its depth."""
    return frame.with_fields(depth=None, depth_confidence=None, depth_origin=None)


def known_tissue(frame: Frame) -> NDArray[np.bool_]:
    """Return the mask of tissue pixels with known true depth."""
    assert frame.depth is not None
    return (frame.depth > 0) if frame.mask is None else (frame.depth > 0) & (frame.mask != 0)


def measure(name: str, frames: Sequence[Frame], camera: Camera, pictures: Path | None) -> dict[str, object]:
    """Return the figures of a recording. The estimator receives the frames in order, without depth."""
    estimator = LightDepth()
    errors, levels, planes, believed, doubted, spent = [], [], [], [], [], []
    for frame in frames:
        began = time.process_time()
        found = estimator.estimate(bare(frame), camera)
        spent.append(time.process_time() - began)
        assert found is not None
        depth = np.ones_like(found.depth) if found.doubt else found.depth
        doubted.append(found.doubt is not None)
        believed.append(float((found.confidence >= BELIEVED).mean()))
        if frame.depth is not None:
            kept = known_tissue(frame)
            errors.append(error(depth, frame.depth, kept))
            rays, true = pixels_to_compare(camera, kept, MOST_DEPTH_PIXELS, frame.depth)
            flat = flat_depths(rays, true)
            assert flat is not None
            for found_errors, plane in ((levels, flat.level), (planes, flat.plane)):
                found_errors.append(float(np.sqrt(np.mean(np.square(plane - true))) / np.median(true)))
        if pictures is not None and frame.seq == 0:
            _draw(pictures / f"{name}.png", frame, depth)
    figures: dict[str, object] = {"recording": name, "frames": len(spent)}
    if errors:
        means = {"error": errors, "level": levels, "plane": planes}
        figures |= {name: round(float(np.mean(each)), 4) for name, each in means.items()}
        figures["worst_beside_level"] = round(float(np.max(np.subtract(errors, levels))), 4)
    figures |= {"believed": round(float(np.mean(believed)), 3), "doubted": round(float(np.mean(doubted)), 3)}
    return figures | {
        "cpu_ms_per_look": round(1e3 * max(spent), 1),
        "cpu_ms_per_frame": round(1e3 * float(np.mean(spent)), 2),
    }


def _draw(path: Path, frame: Frame, depth: NDArray[np.float32]) -> None:
    """Draw picture, estimated depth and, if known, true depth side by side."""
    planes = [depth] if frame.depth is None else [depth, frame.depth]
    drawn = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)]
    for plane in planes:
        low, high = np.percentile(plane[plane > 0], [2, 98])
        level = np.clip((plane - low) / max(high - low, 1e-6), 0, 1)
        drawn.append(cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack(drawn))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--frames", type=int, default=75)
    parser.add_argument("--pictures", type=Path)
    asked = parser.parse_args()
    for seed in range(SEEDS):
        made = render_recording(RenderSettings(frames=12, fps=3, seed=seed))
        print(json.dumps(measure(f"synthetic_{seed}", list(made), made.camera, asked.pictures)), flush=True)
    for name in ("colon", "cutting", "sinus", "heart/left.mp4"):
        recording = open_recording(asked.recordings / name)
        frames = [frame for frame in recording if frame.seq < asked.frames]
        print(json.dumps(measure(name.split("/")[0], frames, recording.camera, asked.pictures)), flush=True)


if __name__ == "__main__":
    main()
