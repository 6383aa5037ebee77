"""Measure the time from the start of an offline training to its first optimiser step.

    python benchmarks/offline_setup.py RECORDING... [--device cpu] [--runs 3]

The frames that are not held out are trained on for one step, from prepared observations, as in every trial of `intrasplat reconstruct`. One JSON line
per run: wall time until the end of the first step, and the number of Gaussians then. One warm-up training precedes the first run.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch
from run_facts import run_facts

from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor

WARM_UPS = 1


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--runs", type=int, default=3)
    asked = parser.parse_args()
    device = torch.device(asked.device)
    facts = run_facts()
    for path in asked.recordings:
        recording = open_recording(path)
        frames = [frame for frame in recording if not is_heldout(frame.seq)]
        config = ReconstructorConfig.offline()
        prepared = Reconstructor(config, recording.camera, device=device).prepared(frames)
        for run in range(1 - WARM_UPS, asked.runs + 1):
            learning = Reconstructor(config, recording.camera, device=device)
            begin_s = time.perf_counter()
            report = learning.fit(prepared, 1)
            loss = report.loss  # waits for the device
            setup_s = time.perf_counter() - begin_s
            line = {
                "recording": path.parent.name if path.is_file() else path.name,
                "device": asked.device,
                "run": run,
                "frames": len(frames),
                "setup_s": round(setup_s, 2),
                "gaussians": learning.gaussians,
                "loss": loss,
            }
            if run >= 1:
                print(json.dumps(line | facts), flush=True)


if __name__ == "__main__":
    main()
