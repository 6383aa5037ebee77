"""Score held-out cameras with highlights as seen by the scope and as seen from the new viewpoint.

    python benchmarks/geometry_synthetic.py depth --width 320 --height 256 --frames 48 --fps 20 --steps 300 --work FOLDER
    python benchmarks/geometry_highlights.py FOLDER depth [--device cuda]

FOLDER is what `geometry_synthetic.py --work` left behind, of one run for each case that is named. One JSON line for each case: PSNR in dB of every view, both ways, of the same model, and
how much of its colours' change over time is foretold (`skill`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from geometry_synthetic import CASES

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.rendering.elsewhere import SeenFromElsewhere
from gsplat_core.scene.model import Model
from operators.applications.evaluate import SeenFromAnywhere, measure_geometry


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("cases", nargs="+", metavar="CASE", choices=[*CASES])
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    for case in asked.cases:
        model = load_bundle(asked.work / f"{case}-run" / "model").to(asked.device)
        seen = SeenFromElsewhere.of(model)
        line = {
            "case": case,
            "skill": None if seen is None else round(seen.skill, 3),
            "as_the_scope_saw": scores(asked, case, replace(model, scope_path=None)),
            "seen_from_there": scores(asked, case, model),
        }
        print(json.dumps(line), flush=True)


def scores(asked: argparse.Namespace, case: str, model: Model) -> dict[str, float | None]:
    """PSNR of each view."""
    whole = asked.work / f"recording-{CASES[case].camera}"
    recording = open_recording(whole)
    truth, poses = open_truth(whole, recording.frame_count), asked.work / f"{case}-poses.npy"
    pictures = SeenFromAnywhere(asked.device)
    found = measure_geometry(recording, recording.frame_count, recording.camera, model, pictures, truth, poses)
    return {view.name: round(view.model.psnr_tissue_db or 0.0, 2) for view in found.views}


if __name__ == "__main__":
    main()
