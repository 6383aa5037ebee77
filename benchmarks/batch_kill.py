"""Kill the processes of `intrasplat batch` at random and check that each result is written exactly once.

    python benchmarks/batch_kill.py --recordings 200 --workers 2

Makes small recordings and runs `intrasplat batch` over them. Meanwhile SIGKILL is sent to attempts and sometimes to the batch, which is then restarted.
Prints one JSON object. Fails if a result is missing, was published twice, or differs from the others of the same recording.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from gsplat_core.io.recordings import synthesize

POLL_S = 0.02
WITHIN_S = 1800.0


def make_recordings(folder: Path, count: int, frames: int) -> None:
    """Write copies of one synthetic recording, whose results must be equal."""
    first = synthesize(folder / "case-000", frames=frames, width_px=64, height_px=48, stereo=False)
    for number in range(1, count):
        shutil.copytree(first, folder / f"case-{number:03d}")


@dataclass
class Killed:
    """Faults injected into a batch and changes observed in its results."""

    attempts: int = 0
    batches: int = 0
    replaced: list[str] = field(default_factory=list)
    """Results that were replaced after they were published."""
    seen: dict[str, int] = field(default_factory=dict)
    """Inode number of each result's folder."""

    def examine(self, out: Path) -> None:
        """Record which results exist."""
        now = {path.name: path.stat().st_ino for path in out.glob("case-*")} if out.is_dir() else {}
        self.replaced += [name for name, number in self.seen.items() if now.get(name) != number]
        self.seen |= now


def children(pid: int) -> list[int]:
    """Return the child processes of a process."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


@dataclass(frozen=True)
class Kills:
    """Frequency and targets of the injected kills."""

    between_s: tuple[float, float] = (0.5, 2.0)
    """Shortest and longest time between two kills."""
    batch_share: float = 0.1
    """Share of the kills that hit the batch itself; the others hit an attempt."""
    most: int = 1_000_000
    seed: int = 0


def run_batch(recordings: Path, out: Path, workers: int, kills: Kills) -> Killed:
    """Run a batch to its end; restart it whenever it was killed."""
    choose = random.Random(kills.seed)
    command = [sys.executable, "-m", "services.cli", "batch", recordings, "--out", out, "--workers", str(workers)]
    killed, until_s = Killed(), time.monotonic() + WITHIN_S
    while time.monotonic() < until_s:
        batch = subprocess.Popen([*map(str, command), "--steps-per-frame", "2", "--json"], stdout=subprocess.DEVNULL)
        next_s = time.monotonic() + choose.uniform(*kills.between_s)
        while batch.poll() is None:
            killed.examine(out)
            attempts = children(batch.pid)
            if time.monotonic() >= next_s and attempts and killed.attempts + killed.batches < kills.most:
                hits_batch = choose.random() < kills.batch_share
                victim = batch.pid if hits_batch else choose.choice(attempts)
                try:
                    os.kill(victim, signal.SIGKILL)
                except ProcessLookupError:
                    continue
                killed.batches += hits_batch
                killed.attempts += not hits_batch
                next_s = time.monotonic() + choose.uniform(*kills.between_s)
            time.sleep(POLL_S)
        killed.examine(out)
        if batch.returncode != -signal.SIGKILL:
            assert batch.returncode == 0, f"the batch ended with {batch.returncode}"
            return killed
    raise TimeoutError(f"the batch did not end within {WITHIN_S:g} s")


def check(recordings: Path, out: Path, killed: Killed) -> dict[str, object]:
    """Return the figures. Raises AssertionError if a result is missing or was published twice."""
    names = sorted(path.name for path in recordings.iterdir())
    assert sorted(path.name for path in out.glob("case-*")) == names, "a result is missing, or one is too many"
    assert not killed.replaced, f"replaced: {killed.replaced}"
    left = [path.name for path in (out / ".running").glob("*/*-*")]
    assert not left, f"half-made: {left}"
    reports = [json.loads((out / name / "report.json").read_text()) for name in names]
    pictures = {report["frames_sha256"] for report in reports}
    models = {report["model"]["sha256"] for report in reports}
    assert len(pictures) == len(models) == 1, "results of the same recording differ"
    with sqlite3.connect(out / "batch.sqlite") as database:
        rows = database.execute("select state, folder, attempts from jobs").fetchall()
    assert sorted(folder for state, folder, _ in rows if state == "done") == names and len(rows) == len(names)
    return {
        "recordings": len(names),
        "results": len(reports),
        "killed_attempts": killed.attempts,
        "killed_batches": killed.batches,
        "attempts": sum(attempts for _, _, attempts in rows),
        "most_attempts_of_one": max(attempts for _, _, attempts in rows),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--between-s", type=float, nargs=2, default=(0.5, 2.0), help="shortest and longest time between two kills"
    )
    parser.add_argument("--batch-share", type=float, default=0.1, help="share of the kills that hit the batch itself")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="batch-") as folder:
        recordings, out = Path(folder) / "recordings", Path(folder) / "out"
        make_recordings(recordings, options.recordings, options.frames)
        kills = Kills((options.between_s[0], options.between_s[1]), options.batch_share, seed=options.seed)
        began_s = time.monotonic()
        killed = run_batch(recordings, out, options.workers, kills)
        seconds = round(time.monotonic() - began_s, 1)
        print(json.dumps({**check(recordings, out, killed), "seconds": seconds, "workers": options.workers}))


if __name__ == "__main__":
    main()
