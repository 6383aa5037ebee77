"""Run one `intrasplat` command on one recording and print its figures as one JSON line.

    python benchmarks/plain.py live RECORDING --device cuda --fps 30
    python benchmarks/plain.py replay RECORDING
    python benchmarks/plain.py reconstruct RECORDING --steps 16000

Further options are passed to the command. The line contains quality, baselines, latency, frames and
memory from the command's report. A recording of a single frame is played as eight equal frames.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

STILL_FRAMES = 8
KEPT = ("recording", "run", "frames", "quality", "model", "live", "frames_sha256", "notes", "operators")
"""Parts of a report that are logged."""


def main() -> int:
    command, recording, *options = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        images = Path(recording) / "images"
        single = images.is_dir() and len(list(images.iterdir())) == 1
        source = still(Path(recording), Path(folder)) if single else Path(recording)
        words = [
            sys.executable,
            "-m",
            "services.cli",
            command,
            str(source),
            "--json",
            "--out",
            f"{folder}/out",
            *options,
        ]
        start = time.perf_counter()
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        wall_s = time.perf_counter() - start
        if done.returncode != 0:
            print(done.stderr[-2000:], file=sys.stderr)
            return done.returncode
        line = json.dumps({"wall_s": round(wall_s, 2), **figures(json.loads(done.stdout))})
        print(line.replace(str(source.parent), "…"), flush=True)
    return 0


def figures(report: dict[str, Any]) -> dict[str, Any]:
    """Return the report without per-frame series, quantiles and the machine, which the
    log states.
    """
    kept = {name: report[name] for name in KEPT if report.get(name) is not None}
    kept["run"] = {name: value for name, value in kept["run"].items() if name not in ("machine", "started_at")}
    return kept | {"margins": margins(report)}


def margins(report: dict[str, Any]) -> dict[str, float | int] | None:
    """Compare each displayed frame with the previous frame as a prediction of it, after the first second.

    Args:
        report: the command's report, with an entry per frame.

    Returns:
        frames: number of compared frames. worst_db: lowest difference of the tissue PSNR of the displayed picture and
        of the previous frame. below: frames for which it is negative; far_below: for which it is below -1 dB. None for a
        report without such entries.
    """
    entries = report.get("series") or []
    if not entries or report.get("series_frames_per_entry", 1) != 1:
        return None
    settled_s = entries[0]["time_s"] + 1.0
    differences = [
        entry["psnr_tissue_db"] - entry["previous_frame_db"]
        for entry in entries
        if entry["time_s"] >= settled_s and None not in (entry["psnr_tissue_db"], entry["previous_frame_db"])
    ]
    if not differences:
        return None
    return {
        "frames": len(differences),
        "worst_db": round(min(differences), 3),
        "below": sum(each < 0 for each in differences),
        "far_below": sum(each < -1 for each in differences),
    }


def still(stills: Path, folder: Path) -> Path:
    """Return a recording that repeats the only frame of another one, with its calibration."""
    made = folder / stills.name
    for images in (each for each in stills.iterdir() if each.is_dir()):
        (made / images.name).mkdir(parents=True)
        (picture,) = images.iterdir()
        for frame in range(STILL_FRAMES):
            shutil.copyfile(picture, made / images.name / f"{frame:06d}{picture.suffix}")
    for file in (each for each in stills.iterdir() if each.is_file()):
        shutil.copyfile(file, made / file.name)
    return made


if __name__ == "__main__":
    sys.exit(main())
