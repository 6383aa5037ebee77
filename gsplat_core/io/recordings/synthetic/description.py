"""Writer of `recording.json` and `views.json`, which document the files of a synthetic recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsplat_core.io.recordings.sidecars import RECORDING_FORMAT, RECORDING_VERSION
from gsplat_core.io.recordings.synthetic.extras import CLEAR
from gsplat_core.io.recordings.synthetic.files import DEPTH_UNIT_MM, FrameFiles
from gsplat_core.io.recordings.synthetic.scene import BASELINE_MM
from gsplat_core.io.recordings.synthetic.target import GENERATOR
from gsplat_core.io.recordings.truth import VIEWS_FILE, VIEWS_FORMAT, VIEWS_VERSION
from gsplat_core.scene.cameras import Camera

_ALWAYS = {
    "images": "sRGB, one ray for each pixel centre (column + 0.5, row + 0.5)",
    "images_right": "rendered from the right eye, rectified: disparity = fx * stereo_baseline_mm / depth",
    "masks": "255 = every pixel that the tool covers in part, 0 = tissue alone",
    "depth": "z of the first surface on the ray, tool or tissue, in units of depth_unit_mm",
    "poses_bounds.npy": "camera-to-world, OpenCV axes; (height, width, f); nearest and farthest depth in mm",
    "tracks.npy": "float32 [frames, points, 3]: material points of the tissue in the world, mm",
}
_THIRD = {"views": "cameras that are never given to training (views.json): images, masks and depth as of the left eye"}
_FLOW = {
    "flow": "float32 [H, W, 2], pixels: what is at pixel p of a frame is at p + flow in the next one; NaN where the tool is",
    "scene_flow": "float32 [H, W, 3], mm: how far that tissue moves in the world; NaN where the tool is",
}
_SEEN = {"tracks_seen.npy": "uint8 [frames, points]: 1 where the left eye sees the point"}
_NOISY = {
    "depth": "true_depth with noise that grows with the square of the distance",
    "true_depth": _ALWAYS["depth"],
}


_BEHIND = {
    "behind/images": "the left eye's picture through the tool: tissue that it hides, in its shadow",
    "behind/depth": "z of that tissue",
}


def describe(files: FrameFiles, frames: int) -> None:
    """Write `recording.json`, and `views.json` if the recording has a third camera."""
    extras, scene = files.extras, files.scene
    meaning = dict(_ALWAYS)
    for wanted, more in (
        (extras.third, _THIRD),
        (extras.flow, _FLOW),
        (extras.tracks, _SEEN),
        (extras.behind, _BEHIND),
    ):
        meaning |= more if wanted else {}
    meaning |= _NOISY if extras.depth_noise_mm else {}
    description: dict[str, Any] = {
        "format": RECORDING_FORMAT,
        "version": RECORDING_VERSION,
        "generator": GENERATOR,
        "seed": files.seed,
        "frames": frames,
        "fps": files.fps,
        "units": "mm",
        "camera": _intrinsics(scene.camera),
        "camera_moves": scene.moving,
        "depth_unit_mm": DEPTH_UNIT_MM,
        "stereo_baseline_mm": BASELINE_MM if files.stereo else None,
        "ground_truth": meaning,
    }
    if extras != CLEAR:
        description["made_with"] = extras.described()
    if extras.exposure_changes and scene.air is not None:
        description["exposure"] = [scene.air.exposure_at(index / files.fps) for index in range(frames)]
    _write(files.folder / "recording.json", description)
    if extras.third:
        third = {
            "name": "third",
            "folder": "views/third",
            "camera": _intrinsics(scene.camera),
            "left_to_view": scene.left_to("third").tolist(),
        }
        _write(
            files.folder / VIEWS_FILE,
            {"format": VIEWS_FORMAT, "version": VIEWS_VERSION, "depth_unit_mm": DEPTH_UNIT_MM, "views": [third]},
        )


def _intrinsics(camera: Camera) -> dict[str, Any]:
    return {
        "model": "pinhole",
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
    }


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
