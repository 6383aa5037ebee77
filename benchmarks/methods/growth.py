"""Strategies of an offline reconstruction: splits of large errors (the default) against birth and death, on a recording.

    python benchmarks/methods/growth.py [--recording DIR] [--steps 300] [--full] [--device cpu|cuda] [--out FILE]

Both start with the same Gaussians and end with the same number. Frames that are not trained on are scored.
"""

from __future__ import annotations

import os
import statistics
import time
from pathlib import Path

import log
import numpy as np

from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.rendering.rasterization import render
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor

RECORDINGS = Path(
    os.environ.get("INTRASPLAT_RECORDINGS", Path(__file__).resolve().parents[3] / "shared" / "recordings")
)


def main() -> None:
    parser = log.options("Growth of an offline reconstruction on a recording.")
    parser.add_argument("--recording", type=Path, default=RECORDINGS / "cutting")
    parser.add_argument("--steps", type=int)
    chosen = parser.parse_args()
    scale, most, steps, first, last = (1.0, None, 2000, 30_000, 60_000) if chosen.full else (0.25, 25, 300, 2000, 4000)
    steps = chosen.steps or steps
    recording = open_recording(str(chosen.recording), scale=scale, max_frames=most)
    frames = list(recording)
    figures: dict[str, object] = {"recording": chosen.recording.name, "scale": scale, "steps": steps, "gaussians": last}
    for name, strategy in (("default", "streaming"), ("birth_death", "birth_death")):
        config = ReconstructorConfig(
            gaussians=first, max_gaussians=last, motion_spacing_s=0.05, squared_error=True, strategy=strategy
        )
        learning = Reconstructor(config, recording.camera, device=chosen.device)
        start = time.perf_counter()
        learning.fit([frame for frame in frames if not is_heldout(frame.seq)], steps)
        model = learning.snapshot()
        seconds = time.perf_counter() - start
        scores = []
        for frame in frames:
            if is_heldout(frame.seq):
                camera = recording.camera if frame.pose is None else recording.camera.with_pose(frame.pose)
                image = render(model.at(frame.time_s), camera).image.clamp(0, 1).cpu().numpy()
                scores.append(psnr_tissue_db(np.asarray(image, np.float32), frame.image, frame.mask))
        figures[name] = {
            "heldout_db": round(statistics.mean(scores), 3),
            "gaussians": model.gaussian_count,
            "seconds": round(seconds, 1),
        }
    log.write("growth", chosen, figures)


if __name__ == "__main__":
    main()
