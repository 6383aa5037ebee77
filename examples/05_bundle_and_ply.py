"""Save a model, read it back, and export one point in time for other programs.

Reconstructs three frames of a synthetic recording, writes the model as a bundle (safetensors and a manifest), reads it back
with every check, and exports the Gaussians at one time as `.ply`, which splat viewers and editors open.

Usage: python examples/05_bundle_and_ply.py [--out out/examples/bundle]
"""

import argparse
import json
import tempfile
from pathlib import Path

import torch

from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.io.ply import load_ply, save_ply
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/examples/bundle"))
    out = parser.parse_args().out

    with tempfile.TemporaryDirectory() as folder:
        recording = open_recording(synthesize(Path(folder) / "recording", frames=3, width_px=64, height_px=64))
        config = ReconstructorConfig(gaussians=800, first_frame_steps=20, steps_per_frame=4)
        reconstructor = Reconstructor(config, recording.camera, recording_digest=recording.digest)
        for frame in recording:
            reconstructor.observe(frame)
        model = reconstructor.snapshot()

    save_bundle(model, out)
    again = load_bundle(out)
    assert again.sha256() == model.sha256()
    manifest = json.loads((out / "manifest.json").read_text())
    print(
        f"format {manifest['format_version']}, {manifest['parameters']} parameters, {manifest['tensors']['bytes']} bytes"
    )

    moment = again.at(again.time_window_s[1])
    save_ply(moment, out / "last_frame.ply")
    assert torch.equal(load_ply(out / "last_frame.ply").means, moment.means)
    print(out / "last_frame.ply")


if __name__ == "__main__":
    main()
