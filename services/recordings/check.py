"""Check of an uploaded recording as a separate program: `python -m services.recordings.check FOLDER
--kind KIND --name NAME`.

FOLDER contains the uploaded file `upload`. An archive is unpacked into FOLDER/NAME; a video becomes
NAME with its suffix. Then every frame is read, as in `intrasplat validate`. The verdict is one JSON
line: `{"stage": "ready", …}` or `{"stage": "rejected", "reason": …}`. Exit code 0 means that there
is a verdict. The service never imports this module, because it loads OpenCV and the decoders.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

from gsplat_core.io.recordings import validate_recording
from services.private_files import keep_files_private
from services.recordings.archives import ARCHIVE, MOST_UNPACKED_BYTES, ArchiveInvalid, unpack
from services.registry.records import NICENESS, lower_limit, taken_bytes

UPLOAD = "upload"
_REPORTED_FACTS = (
    "layout",
    "frames",
    "frames_damaged",
    "width_px",
    "height_px",
    "fps",
    "duration_s",
    "fields",
    "calibration",
)
MOST_PROBLEMS = 3
CHECK_MEMORY_BYTES = 4 << 30
"""Limit of the memory of the check beyond its libraries, in bytes."""
CHECK_S = 3600.0
"""Limit of the processor time of the check in seconds. Exceeding it rejects the recording."""


def main(arguments: list[str] | None = None) -> int:
    """Check one upload and print the verdict."""
    keep_files_private()
    options = _options(arguments)
    _limit_resources(options.most_bytes)
    path = options.folder / _file_name(options)
    try:
        _put(options, path)
        verdict = _verdict(path, options.folder)
    except ArchiveInvalid as error:
        verdict = {"stage": "rejected", "reason": str(error)}
    except MemoryError:
        verdict = {
            "stage": "rejected",
            "reason": f"it needs more than {CHECK_MEMORY_BYTES} bytes of memory to read",
        }
    sys.stdout.write(json.dumps(verdict, allow_nan=False) + "\n")
    return 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m services.recordings.check", description="Check an uploaded recording."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--kind", required=True, help="archive, or a video's suffix")
    parser.add_argument("--name", required=True, help="original file name")
    parser.add_argument("--most-bytes", type=int, default=MOST_UNPACKED_BYTES, help="largest unpacked size in bytes")
    return parser.parse_args(arguments)


def _limit_resources(most_bytes: int) -> None:
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    lower_limit(resource.RLIMIT_FSIZE, max(most_bytes, 1 << 20))
    lower_limit(resource.RLIMIT_DATA, taken_bytes() + CHECK_MEMORY_BYTES)
    lower_limit(resource.RLIMIT_CPU, int(CHECK_S) + 1, spare=5)


def _file_name(options: argparse.Namespace) -> str:
    return str(options.name) if options.kind == ARCHIVE else f"{options.name}{options.kind}"


def _put(options: argparse.Namespace, path: Path) -> None:
    """Unpack the archive, or link the video, to `path`, after deleting leftovers of an interrupted check."""
    upload = options.folder / UPLOAD
    if options.kind == ARCHIVE:
        shutil.rmtree(path, ignore_errors=True)
        unpack(upload, path, options.most_bytes)
    else:
        path.unlink(missing_ok=True)
        os.link(upload, path)


def _verdict(path: Path, folder: Path) -> dict[str, Any]:
    report = validate_recording(path)
    if report.ok:
        facts = {name: report.facts[name] for name in _REPORTED_FACTS if name in report.facts}
        return {"stage": "ready", **facts, "warnings": len(report.warnings)}
    said = "; ".join(str(problem) for problem in report.problems[:MOST_PROBLEMS])
    more = len(report.problems) - MOST_PROBLEMS
    reason = said.replace(f"{folder}/", "") + (f"; and {more} more" if more > 0 else "")
    return {"stage": "rejected", "reason": reason}


if __name__ == "__main__":
    sys.exit(main())
