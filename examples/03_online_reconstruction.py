"""Reconstruct a recording while it plays, without a graph.

Makes a small synthetic recording, then gives its frames one by one to a `Reconstructor`. Each frame gets a few optimiser steps
and is shown right after them, next to the score of the trivial baseline (showing the previous frame).

Usage: python examples/03_online_reconstruction.py [--frames 8]
"""

import argparse
import tempfile
from pathlib import Path

from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=8)
    frames = parser.parse_args().frames

    with tempfile.TemporaryDirectory() as folder:
        recording = open_recording(
            synthesize(Path(folder) / "recording", frames=frames, width_px=96, height_px=80, fps=8, stereo=False)
        )
        config = ReconstructorConfig(gaussians=3000, max_gaussians=6000, steps_per_frame=16)
        reconstructor = Reconstructor(config, recording.camera, seed=0, recording_digest=recording.digest)
        previous = None
        for frame in recording:
            report = reconstructor.observe(frame)
            model = reconstructor.snapshot()  # immutable: a later step never changes it
            camera = recording.camera_at(frame.seq)
            live_db = psnr_tissue_db(model.render(frame.time_s, camera).image, frame.image, frame.mask)
            line = f"frame {frame.seq}: {report.steps} steps, model {model.version}, training error {live_db:.1f} dB"
            if previous is not None:
                line += (
                    f", previous frame shown instead {psnr_tissue_db(previous.image, frame.image, frame.mask):.1f} dB"
                )
            print(line)
            previous = frame
    print(f"{model.gaussians.count} Gaussians, {model.parameter_count} parameters, sha256 {model.sha256()[:16]}")


if __name__ == "__main__":
    main()
