"""Run the published benchmarks and write a log line for every result.

    python benchmarks/suite.py --device cpu                       # as in `make bench`
    python benchmarks/suite.py --device cuda --minutes 9 --only replay_cutting rooms_cutting
    python benchmarks/suite.py --device cuda --list

`BENCHMARKS` defines all published benchmarks: name, command and number of runs. Each JSON line
printed by a command becomes a line of `benchmarks/logs/DEVICE/NAME.jsonl`, with command, commit,
machine, date and run number. `publish.py` generates RESULTS.md from these logs alone. A benchmark
replaces its own earlier log. The default live and offline commands are measured by `generality.py`. All benchmarks run once before any runs again, so a time limit leaves
at least one run of each.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from host_pauses import host_pauses

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "benchmarks" / "logs"
RECORDINGS = Path(os.environ.get("INTRASPLAT_RECORDINGS") or ROOT.parent / "shared" / "recordings")
TIMEOUT_S = 3600.0


@dataclass(frozen=True)
class Benchmark:
    """A command whose printed figures are published.

    Attributes:
        name: stem of the log file.
        command: arguments of Python; `{recordings}` is replaced by the folder of the real recordings.
        device: machine that it is for, `cpu` or `cuda`.
        runs: times that it is run. A command that repeats its work itself and prints medians is run once.
    """

    name: str
    command: str
    device: str
    runs: int = 3

    def arguments(self, recordings: Path = RECORDINGS) -> list[str]:
        return [word.replace("{recordings}", str(recordings)) for word in shlex.split(self.command)]

    def stated(self) -> str:
        """Return the command as logged, without paths of this machine."""
        return "python " + self.command.replace("{recordings}", "$INTRASPLAT_RECORDINGS")


def plain(name: str, device: str, command: str, recording: str, *options: str, runs: int = 3) -> Benchmark:
    """Define a run of an `intrasplat` command on a real recording with exactly the
    given options.
    """
    words = ["benchmarks/plain.py", command, f"{{recordings}}/{recording}", "--device", device, *options]
    return Benchmark(name, shlex.join(words).replace("'", ""), device, runs)


OTHERS = {name: f"others/{name}/video.mp4" for name in ("resting_bowel", "laparoscopy")}
REPLAYED = {"cutting": "cutting", "sinus": "sinus", "resting_bowel": OTHERS["resting_bowel"]}

BENCHMARKS = (
    plain("live_cutting_60", "cuda", "live", "cutting", "--fps", "60"),
    plain("live_laparoscopy_60", "cuda", "live", OTHERS["laparoscopy"], "--fps", "60"),
    plain("live_cutting_hexplane", "cuda", "live", "cutting", "--field", "hexplane", runs=1),
    *(plain(f"replay_{name}", "cuda", "replay", path) for name, path in REPLAYED.items()),
    plain("replay_sinus_no_depth", "cuda", "replay", "sinus", "--depth", "none"),
    *(
        Benchmark(f"stream_{name}", f"benchmarks/endless.py {{recordings}}/{path} --clock --once --device cuda", "cuda")
        for name, path in {
            "cutting": "cutting",
            "heart": "heart/left.mp4",
            "resting_bowel": OTHERS["resting_bowel"],
        }.items()
    ),
    Benchmark("rooms_cutting", "benchmarks/rooms.py {recordings}/cutting --rooms 4 --device cuda", "cuda"),
    Benchmark("rooms_cutting_mps", "benchmarks/rooms.py {recordings}/cutting --rooms 4 --device cuda --mps", "cuda"),
    Benchmark("render", "benchmarks/gpu_splat.py", "cuda", runs=1),
    Benchmark("rasterization", "benchmarks/gpu_eager.py", "cuda", runs=1),
    Benchmark("training", "benchmarks/gpu_training.py", "cuda", runs=1),
    Benchmark("deformation", "benchmarks/gpu_deformation.py", "cuda", runs=1),
    plain("replay_cutting", "cpu", "replay", "cutting"),
    plain("replay_sinus", "cpu", "replay", "sinus"),
    plain("replay_cutting_hexplane", "cpu", "replay", "cutting", "--field", "hexplane", runs=1),
    Benchmark("render", "benchmarks/splat_cpu.py", "cpu", runs=1),
    Benchmark("training", "benchmarks/training_cpu.py", "cpu", runs=1),
    Benchmark("deformation", "benchmarks/deformation_cpu.py", "cpu", runs=1),
    Benchmark("tool_mask", "benchmarks/tool_mask.py {recordings}/cutting", "cpu", runs=1),
    Benchmark("tool_mask_annotated", "benchmarks/tool_mask.py {recordings} --annotations", "cpu", runs=1),
    Benchmark(
        "tool_mask_classical", "benchmarks/tool_mask.py {recordings} --annotations --method classical", "cpu", runs=1
    ),
    *(
        Benchmark(f"breathing_{name}", f"benchmarks/geometry_moving.py --seeds 0 1 {options}".rstrip(), "cpu", runs=1)
        for name, options in {
            "steady": "",
            "ratio": "--breathing-ratio 2",
            "wander": "--rate-wander 0.15",
            "path": "--scope-path seeded --breathing-ratio 2 --rate-wander 0.15",
        }.items()
    ),
    Benchmark("stereo", "benchmarks/geometry_stereo.py --recordings {recordings} --without heart", "cpu", runs=1),
)


def results(text: str) -> list[Any]:
    """Return the JSON values of a command's output: one per line, or a single one over several lines.

    Raises:
        ValueError: the output holds none.
    """
    found = []
    for line in text.splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            found.append(value)
    if found:
        return found
    value = json.loads(text)
    return value if isinstance(value, list) else [value]


def machine(device: str) -> dict[str, Any]:
    """Return the properties of this machine that figures depend on."""
    import torch

    from gsplat_core.ops.native import instruction_set

    cpu = next((line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")), "?")
    stated = {
        "cpu": cpu, "cores": len(os.sched_getaffinity(0)), "instruction_set": instruction_set(),
        "python": platform.python_version(), "torch": torch.__version__, "kernel": platform.release(), "pauses": host_pauses(),
    }  # fmt: skip
    if device == "cuda":
        stated["gpu"] = torch.cuda.get_device_name(0)
        stated["cuda"] = torch.version.cuda
    return stated


def _lines(path: str) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines() if Path(path).exists() else []


def commit() -> str:
    """Return the measured commit, with `+` if files differ from it; INTRASPLAT_COMMIT if the tree is not a checkout.

    Raises:
        SystemExit: neither is known.
    """
    if stated := os.environ.get("INTRASPLAT_COMMIT"):
        return stated
    asked = {"cwd": ROOT, "capture_output": True, "text": True}
    try:
        head = subprocess.run(["git", "rev-parse", "--short=9", "HEAD"], check=True, **asked).stdout.strip()
        changed = subprocess.run(["git", "status", "--porcelain", "-uno"], check=True, **asked).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        sys.exit("the commit is unknown: run in a git checkout, or set INTRASPLAT_COMMIT")
    return head + ("+" if [line for line in changed.splitlines() if "benchmarks/logs/" not in line] else "")


def measured(benchmark: Benchmark, run: int, about: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Run the command once and yield a log line for each result, or one that reports
    the failure.
    """
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))}
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *benchmark.arguments()],
        cwd=ROOT, env=env, capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    line = {
        "benchmark": benchmark.name, "run": run, **about,
        "command": benchmark.stated(), "seconds": round(time.perf_counter() - start, 1),
    }  # fmt: skip
    if done.returncode != 0:
        yield line | {"exit_code": done.returncode, "error": done.stderr[-2000:]}
        return
    for result in results(done.stdout):
        yield line | {"result": result}


def run_all(chosen: list[Benchmark], folder: Path, seconds: float, runs: int | None) -> None:
    """Run the benchmarks in turn until all runs are done or the time is over."""
    folder.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + seconds
    date = datetime.now(UTC).strftime("%Y-%m-%d")
    about = {"commit": commit(), "date": date, "machine": machine(chosen[0].device)}
    most = max(runs or each.runs for each in chosen)
    for run in range(1, most + 1):
        for benchmark in chosen:
            if run > (runs or benchmark.runs) or time.monotonic() > until:
                continue
            path = folder / f"{benchmark.name}.jsonl"
            lines = [json.dumps(line) for line in measured(benchmark, run, about)]
            earlier = path.read_text(encoding="utf-8").splitlines() if run > 1 and path.exists() else []
            with tempfile.NamedTemporaryFile("w", dir=folder, delete=False, encoding="utf-8") as file:
                file.write("".join(f"{line}\n" for line in [*earlier, *lines]))
            os.replace(file.name, path)
            os.chmod(path, 0o644)
            print(f"{benchmark.name} run {run}: {json.loads(lines[-1]).get('error', 'done')}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="run only these benchmarks")
    parser.add_argument("--runs", type=int, help="number of runs of each benchmark, in place of its default")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no run after this time in minutes")
    parser.add_argument("--out", type=Path, help="folder of the logs (default: benchmarks/logs/DEVICE)")
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    options = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    known = [each for each in BENCHMARKS if each.device == options.device]
    names = {each.name for each in known}
    if unknown := set(options.only or ()) - names:
        parser.error(f"no benchmark {sorted(unknown)} for {options.device}; there are {sorted(names)}")
    chosen = [each for each in known if not options.only or each.name in options.only]
    if options.list:
        for each in chosen:
            print(f"{each.name}: {each.stated()} ({each.runs} runs)")
        return
    run_all(chosen, options.out or LOGS / options.device, options.minutes * 60, options.runs)


if __name__ == "__main__":
    main()
