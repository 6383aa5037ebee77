"""Install the packages of a lock file into the current Python environment, optionally with CPU-only torch.

    python install_packages.py requirements.lock
    python install_packages.py requirements.lock --torch-index-url URL [--torch-sha256 HEX]

Without an index all packages come from the lock and are checked by its hashes, including torch with CUDA's libraries. With an index, torch,
Triton and NVIDIA's libraries of the lock are not installed, and the same version of torch comes from the index as `VERSION+cpu`. The lock has
no hash of that wheel; --torch-sha256 checks it.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

ONLY_FOR_CUDA = re.compile(r"torch|triton|(cuda|nvidia)-[a-z0-9-]+")
NAME = re.compile(r"([a-z0-9][a-z0-9._-]*)==([^\s;\\]+)")


def requirements(lock: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, version and text of each requirement of a lock file, with its hashes."""
    for part in re.split(r"\n(?=[A-Za-z0-9])", "\n" + lock):
        text = part.strip("\n")
        if found := NAME.match(text):
            yield found[1], found[2], text


def without_cuda(lock: str) -> tuple[str, str]:
    """Return the lock file without torch, Triton and NVIDIA's libraries, and its version of torch. Raises ValueError without torch."""
    kept, version = [], None
    for name, number, text in requirements(lock):
        if name == "torch":
            version = number
        if not ONLY_FOR_CUDA.fullmatch(name):
            kept.append(text)
    if version is None:
        raise ValueError("the lock file has no torch==VERSION")
    return "\n".join(kept) + "\n", version


def main(arguments: Sequence[str] | None = None) -> int:
    """Install the packages and return pip's exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lock", type=Path)
    parser.add_argument(
        "--torch-index-url", default="", help="index with CPU builds of torch; empty: torch of the lock"
    )
    parser.add_argument("--torch-sha256", default="", help="required SHA-256 of the torch wheel; empty: not checked")
    given = parser.parse_args(arguments)
    if not given.torch_index_url:
        return pip("install", "--require-hashes", "-r", str(given.lock))
    kept, version = without_cuda(given.lock.read_text(encoding="utf-8"))
    wanted = f"torch=={version}+cpu"
    with tempfile.TemporaryDirectory() as folder:
        rest, torch = Path(folder, "rest.txt"), Path(folder, "torch.txt")
        rest.write_text(kept, encoding="utf-8")
        torch.write_text(wanted + (f" --hash=sha256:{given.torch_sha256}" if given.torch_sha256 else "") + "\n")
        # The lock is complete. Dependencies are not resolved, because they would reinstall the CUDA build. `pip check` reports missing packages.
        return (
            pip("install", "--require-hashes", "--no-deps", "-r", str(rest))
            or pip("install", "--no-deps", "--index-url", given.torch_index_url, "-r", str(torch))
            or pip("check")
        )


def pip(*arguments: str) -> int:
    """Run pip of the current environment and return its exit code."""
    return subprocess.run([sys.executable, "-m", "pip", *arguments], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
