"""Write LICENSES.md: name, version and licence of every package that `requirements-service.lock` pins for this platform.

Versions come from the lock file. Licences come from the metadata of the installed packages, read by `pip-licenses`.

Usage: python deploy/third_party_licences.py [--out LICENSES.md]
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
UNSTATED = {"cuda-toolkit": "no code of its own: requires NVIDIA's CUDA packages"}
"""Packages without a licence in their metadata, and the reason why none is needed."""
HEADER = """# Third-party licences
The packages that `requirements-service.lock` installs on Linux with Python {python}, including those of `requirements.lock`, with the licence
of their metadata. Written by `deploy/third_party_licences.py`. None of them is part of this repository.

OpenCV's wheel contains FFmpeg's libraries, which are under the LGPL 2.1. PyAV (`av`) is under the BSD licence. Its wheel contains
FFmpeg's libraries, which state LGPL 3 or later, and x264 and x265, which are under the GPL 2 or later. Of these, IntraSplat uses
FFmpeg's demuxers, muxers, decoders and FFV1 encoder, libvpx and dav1d (both BSD). Only its tests use x264 and x265, but redistributing
the wheel, for example in a container image, also redistributes them. To avoid this, build PyAV against a separate FFmpeg.

NVIDIA's packages come with torch. `make cuda` also installs NVIDIA's compiler (`requirements-cuda.lock`), under NVIDIA's own licence.
The compiled kernels contain CUDA's static runtime.

| package | version | licence |
|---|---|---|
"""


def locked(path: Path) -> tuple[dict[str, Requirement], list[str]]:
    """Return the requirements pinned for this platform by name, and `name version` of those pinned for others."""
    here: dict[str, Requirement] = {}
    elsewhere: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not re.match(r"[A-Za-z0-9]", line):
            continue
        requirement = Requirement(line.rstrip(" \\"))
        if requirement.marker is None or requirement.marker.evaluate({"extra": "build"}):
            here[canonicalize_name(requirement.name)] = requirement
        else:
            elsewhere.append(f"{requirement.name} {version_of(requirement)}")
    return here, elsewhere


def version_of(requirement: Requirement) -> str:
    """Return the pinned version of a requirement."""
    return str(requirement.specifier).removeprefix("==")


def stated_licences() -> dict[str, str]:
    """Return the licence of each installed package by canonical name; long texts are cut to their first line."""
    command = [sys.executable, "-m", "piplicenses", "--python", sys.executable, "--with-system", "--format=json"]
    listed = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {canonicalize_name(entry["Name"]): entry["License"].splitlines()[0] for entry in listed}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "LICENSES.md")
    out = parser.parse_args().out
    here, elsewhere = locked(ROOT / "requirements-service.lock")
    licences = stated_licences() | UNSTATED
    unknown = [name for name in here if licences.get(name, "UNKNOWN") == "UNKNOWN"]
    if unknown:
        sys.stderr.write(
            f"no licence is stated by {', '.join(unknown)}: install requirements-service.lock, or look it up\n"
        )
        return 1
    rows = [f"| {name} | {version_of(entry)} | {licences[name]} |\n" for name, entry in sorted(here.items())]
    text = HEADER.format(python=f"{sys.version_info.major}.{sys.version_info.minor}") + "".join(rows)
    if elsewhere:
        text += f"\nPinned for other platforms or Python versions: {', '.join(sorted(elsewhere))}.\n"
    out.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
