"""Compare a model's depth and normals with the recorded depth, by depth definition and by depth weight in the loss.

Usage: python benchmarks/geometry_views.py [--frames N] [--width W] [--moving] [--weights 0.0003 0.02 0.1 0.2]

Replays a synthetic recording with its depth for each weight (`ReconstructorConfig.depth_weight`). One JSON line each: live PSNR, and over the tissue of every fourth
frame, in percent of its median depth: RMS, median absolute and mean error of the splats' centres, of the ray's expected depth and of its median depth; the spread
that the model states; in degrees the median error of the blended normals, and of normals from depth.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core import Model, Reconstructor, ReconstructorConfig
from gsplat_core.geometry.mesh import normals_of
from gsplat_core.io.recordings.synthetic.rendered import RenderedRecording, RenderSettings, render_recording
from gsplat_core.scene.frames import Frame


def errors_of(model: Model, frame: Frame, camera: Any) -> dict[str, float]:
    """Return the depth and normal errors of one frame."""
    assert frame.depth is not None and frame.mask is not None
    tissue = (frame.mask != 0) & (frame.depth > 0)
    true = frame.depth[tissue].astype(np.float64)
    typical = float(np.median(true))
    surface, picture = model.surface(frame.time_s, camera), model.render(frame.time_s, camera)
    planes = {"centres": picture.depth, "ray": surface.ray_depth, "median": surface.median_depth}
    found: dict[str, float] = {"spread": 100 * float(np.median(surface.spread.numpy()[tissue])) / typical}
    for name, plane in planes.items():
        off = plane.numpy()[tissue] - true
        found[f"{name}_rmse"] = 100 * float(np.sqrt(np.mean(off**2))) / typical
        found[f"{name}_median_absolute"] = 100 * float(np.median(np.abs(off))) / typical
        found[f"{name}_mean"] = 100 * float(off.mean()) / typical
    exact = normals_of(frame.depth, camera)
    found["normals_deg"] = angle_between(surface.normals.numpy(), exact, tissue)
    found["normals_from_depth_deg"] = angle_between(normals_of(surface.ray_depth.numpy(), camera), exact, tissue)
    image = (picture.image.clamp(0, 1) * 255).round().numpy()
    squared = np.mean((image[frame.mask != 0] - frame.image[frame.mask != 0].astype(np.float64)) ** 2)
    found["psnr_db"] = 10 * float(np.log10(255**2 / squared))
    return found


def angle_between(found: NDArray[np.float32], exact: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    """Return the median angle in degrees where both normals are known."""
    both = where & found.any(-1) & exact.any(-1)
    cosine = np.clip(np.einsum("ij,ij->i", found[both], exact[both]), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def replayed(recording: RenderedRecording, weight: float) -> dict[str, float]:
    """Return means over every fourth frame, each measured right after training on it."""
    pixels = recording.width_px * recording.height_px
    config = ReconstructorConfig(gaussians=pixels // 4, max_gaussians=pixels // 2, depth_weight=weight)
    learning = Reconstructor(config, recording.camera)
    rows = []
    for index, frame in enumerate(recording):
        learning.observe(frame)
        if index % 4 == 3:
            rows.append(errors_of(learning.snapshot(), frame, recording.camera_at(index)))
    return {name: round(float(np.mean([row[name] for row in rows])), 3) for name in rows[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--moving", action="store_true")
    parser.add_argument("--weights", type=float, nargs="+", default=[0.0003, 0.02, 0.1, 0.2])
    arguments = parser.parse_args()
    width, camera = arguments.width, "moving" if arguments.moving else "fixed"
    asked = RenderSettings(frames=arguments.frames, width_px=width, height_px=width * 4 // 5, camera=camera)  # type: ignore[arg-type]
    recording = render_recording(asked)
    for weight in arguments.weights:
        print(json.dumps({"camera": camera, "depth_weight": weight, **replayed(recording, weight)}), flush=True)


if __name__ == "__main__":
    main()
