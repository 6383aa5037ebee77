"""Run live and offline reconstruction with default settings on every recording of a folder, and the checks of masks, gates and
geometry.

    python benchmarks/generality.py ../shared/recordings --device cuda
    python benchmarks/generality.py MY_RECORDINGS --parts live --runs 1 --out /tmp/mine.jsonl
    python benchmarks/generality.py ../shared/recordings --parts tools cutting_masks gates stereo poses blind fixed

Recordings are found by their files, so the script also runs on unknown recordings. The checks need the recordings of this
project, or none. Each run of a recording or result of a check is a line of the log. Lines of other parts stay in it.
`publish.py` generates results/generality.md from the logs in `logs/generality`.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import statistics
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import suite
from host_pauses import pauses_text

FOLDER = suite.LOGS / "generality"
VIDEOS = ("left.mp4", "video.mp4")
PARTS = ("live", "live_own_rate", "offline")
CHECKS = {
    "tools": "benchmarks/tool_mask.py {recordings} --annotations",
    "cutting_masks": "benchmarks/tool_mask.py {recordings}/cutting",
    "gates": "benchmarks/gates.py {recordings} --change unchanged --outside",
    **{name: f"benchmarks/geometry_random.py {name}" for name in ("stereo", "poses", "blind", "fixed")},
}
"""Commands of the checks of tool masks, gates, and geometry on random recordings, by part. Nothing in them is random, so they are run
once.
"""
LEAST_FRAMES = 31
"""Frames of a recording for a live run: a second and one more frame, since scores start after a second."""
OFFLINE_CPU_SCALE = "0.25"
MOST_LATE, MOST_AGE_MS = 0.005, 33
"""Required of live runs: largest share of late frames, and largest 99th percentile of the age after the first second, in ms."""
EQUAL_FRAMES_DB = 48.0
"""Required PSNR of held-out frames that equal their neighbours."""


def recordings(root: Path) -> dict[str, Path]:
    """Return the recordings below a folder by their path in it. Loose pictures are no recording."""
    found: dict[str, Path] = {}
    for folder in sorted(each for each in [root, *root.rglob("*")] if each.is_dir()):
        name = folder.relative_to(root).as_posix()
        videos = [folder / video for video in VIDEOS if (folder / video).is_file()]
        if (folder / "poses_bounds.npy").is_file() or (folder / "images").is_dir():
            found[name] = folder
        elif videos:
            found[name] = videos[0]
    return found


def frames_and_rate(recording: Path) -> tuple[int, float]:
    """Return the number of frames and the rate in frames/s; 30 for pictures without a rate."""
    import cv2

    videos = (
        [recording] if recording.is_file() else [recording / name for name in VIDEOS if (recording / name).is_file()]
    )
    if not videos:
        return len(list((recording / "images").iterdir())), 30.0
    video = cv2.VideoCapture(str(videos[0]))
    try:
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT)), float(video.get(cv2.CAP_PROP_FPS)) or 30.0
    finally:
        video.release()


def commands(
    root: Path, parts: Iterable[str], device: str, only: Collection[str] = ()
) -> Iterator[tuple[str, str, suite.Benchmark]]:
    """Yield part, name of the recording, and the command that measures it; of all recordings, or of those named in `only`."""
    scale = () if device == "cuda" else ("--scale", OFFLINE_CPU_SCALE)
    for name, recording in recordings(root).items():
        if only and name not in only:
            continue
        frames, rate = frames_and_rate(recording)
        for part in parts:
            own_rate = part == "live_own_rate"
            if part != "offline" and (frames < LEAST_FRAMES or (own_rate and abs(rate - 30.0) < 0.5)):
                continue
            options = {"live": ("live", "--fps", "30"), "live_own_rate": ("live",), "offline": ("reconstruct", *scale)}[
                part
            ]
            command, *more = options
            words = ["benchmarks/plain.py", command, str(recording), "--device", device, *more]
            yield part, name, suite.Benchmark(f"generality_{part}", shlex.join(words), device)


def checks(root: Path, parts: Iterable[str], device: str) -> Iterator[tuple[str, str, suite.Benchmark]]:
    """Yield part, the name `all`, and the command of each check."""
    for part in parts:
        command = CHECKS[part].replace("{recordings}", shlex.quote(str(root)))
        yield part, "all", suite.Benchmark(f"generality_{part}", command, device, runs=1)


def run(root: Path, parts: Iterable[str], device: str, runs: int, out: Path, only: Collection[str] = ()) -> None:
    """Write a line to the log for each run of each command, in place of earlier lines of the same parts."""
    date = datetime.now(UTC).strftime("%Y-%m-%d")
    about = {"commit": suite.commit(), "date": date, "machine": suite.machine(device)}
    wanted = tuple(parts)
    chosen = [
        *commands(root, [part for part in wanted if part in PARTS], device, only),
        *checks(root, [part for part in wanted if part in CHECKS], device),
    ]
    if not chosen:
        sys.exit(
            f"no recording is in {root}; a recording is a folder with images/, video.mp4, left.mp4 or poses_bounds.npy"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    earlier = out.read_text(encoding="utf-8").splitlines() if out.exists() else []
    kept = [line for line in earlier if line and json.loads(line)["part"] not in wanted]
    with out.open("w", encoding="utf-8") as log:
        log.write("".join(f"{line}\n" for line in kept))
        for number in range(1, runs + 1):
            for part, name, benchmark in chosen:
                if number > 1 and part in CHECKS:
                    continue
                ended = "done"
                for line in suite.measured(benchmark, number, about):
                    stated = {
                        "part": part,
                        "recording": name,
                        "command": line["command"].replace(str(root), "RECORDINGS"),
                    }
                    log.write(json.dumps(line | stated) + "\n")
                    log.flush()
                    ended = line.get("error", ended).strip().splitlines()[-1]
                print(f"{part} {name} run {number}: {ended}", flush=True)


def lines_of(folder: Path = FOLDER) -> dict[str, list[dict[str, Any]]]:
    """Return the log lines by device."""
    logs = {path.stem: path.read_text(encoding="utf-8").splitlines() for path in sorted(folder.glob("*.jsonl"))}
    return {device: [json.loads(line) for line in text if line] for device, text in logs.items()}


def value(result: Mapping[str, Any], path: str) -> float | None:
    """Return a number in a result by its dotted path; None if it is missing."""
    found: Any = result
    for key in path.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return float(found) if isinstance(found, int | float) else None


def _runs(lines: Iterable[Mapping[str, Any]]) -> str:
    """Return the number of runs of each recording, as a range if they differ."""
    counts = Counter(line["recording"] for line in lines).values()
    return str(max(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def cell(results: Iterable[Mapping[str, Any]], path: str, *, digits: int = 1, worst: str = "min") -> str:
    """Return the median over the runs, with the worst run in brackets."""
    values = [number for each in results if (number := value(each, path)) is not None]
    if not values:
        return "–"
    beyond = min(values) if worst == "min" else max(values)
    return f"{statistics.median(values):.{digits}f}" + (f" ({beyond:.{digits}f})" if len(values) > 1 else "")


def withheld(results: Iterable[Mapping[str, Any]]) -> str:
    """Return the withheld frames of the first run by reason."""
    first = next(iter(results))
    counts = (first.get("live") or {}).get("withheld") or {}
    return ", ".join(f"{reason} {count}" for reason, count in counts.items()) or "0"


def live_table(groups: Mapping[str, list[dict[str, Any]]], failed: Collection[str]) -> str:
    """Return the table of live runs. Recordings in `failed`, of which a run ended with an error, meet nothing."""
    head = (
        "recording", "width, px", "displayed frame (training error), dB", "previous frame, dB", "worst frame, dB", "worst difference to the previous frame, dB",
        "frames more than 1 dB below it", "late frames", "age p99, ms", "after the first second, ms", "of used frames, ms", "shown of", "withheld", "required: 3 dB above, never 1 dB below",
        f"required: at most {MOST_LATE:.1%} late, {MOST_AGE_MS} ms after the first second".replace("%", " %"),
    )  # fmt: skip
    rows = []
    for name, results in groups.items():
        gains = [
            shown - before
            for each in results
            if (shown := value(each, "live.settled_psnr_tissue_db")) is not None
            and (before := value(each, "live.previous_frame_db")) is not None
        ]
        far = [value(each, "margins.far_below") or 0 for each in results]
        met = "met" if gains and min(gains) >= 3 and max(far) == 0 and name not in failed else "missed"
        late = [(value(each, "live.not_on_screen") or 0) / (value(each, "frames.ingested") or 1) for each in results]
        ages_ms = [value(each, "live.settled_age_p99_ms") or math.inf for each in results]
        is_prompt = max(late) <= MOST_LATE and max(ages_ms) <= MOST_AGE_MS and name not in failed
        prompt = "met" if is_prompt else "missed"
        rows.append(
            (
                f"`{name}`",
                cell(results, "recording.width_px", digits=0),
                cell(results, "live.settled_psnr_tissue_db"),
                cell(results, "live.previous_frame_db"),
                cell(results, "live.worst_psnr_tissue_db"),
                cell(results, "margins.worst_db"),
                cell(results, "margins.far_below", digits=0, worst="max"),
                cell(results, "live.not_on_screen", digits=0, worst="max"),
                cell(results, "live.age_p99_ms", worst="max"),
                cell(results, "live.settled_age_p99_ms", worst="max"),
                cell(results, "live.used_age_p99_ms", worst="max"),
                f"{cell(results, 'live.pictures', digits=0)} of {cell(results[:1], 'frames.ingested', digits=0)}",
                withheld(results),
                met,
                prompt,
            )
        )
    return table(head, rows)


def offline_table(groups: Mapping[str, list[dict[str, Any]]], failed: Collection[str]) -> str:
    """Return the table of offline runs. Recordings in `failed`, of which a run ended with an error, meet nothing."""
    head = (
        "recording", "width, px", "held-out frames, dB", "of them with both neighbours, dB", "neighbours' mean, dB", "previous frame, dB", "training frames (training error), dB",
        "whole command, s", f"required: neighbours' mean ({EQUAL_FRAMES_DB:g} dB for equal frames)",
    )  # fmt: skip
    rows = []
    for name, results in groups.items():
        # Frames that equal their neighbours have an infinite PSNR, which is logged as 100 dB; `EQUAL_FRAMES_DB` is required there.
        gains = [
            held_out - (mean if mean < 100 else EQUAL_FRAMES_DB)
            for each in results
            if (held_out := value(each, "quality.heldout_between.psnr_tissue_db")) is not None
            and (mean := value(each, "quality.baselines.heldout_neighbour_mean_db")) is not None
        ]
        met = ("met" if min(gains) >= 0 and name not in failed else "missed") if gains else "–"
        rows.append(
            (
                f"`{name}`",
                cell(results[:1], "recording.width_px", digits=0),
                cell(results, "quality.heldout.psnr_tissue_db"),
                cell(results, "quality.heldout_between.psnr_tissue_db"),
                cell(results[:1], "quality.baselines.heldout_neighbour_mean_db"),
                cell(results[:1], "quality.baselines.heldout_previous_frame_db"),
                cell(results, "quality.training.psnr_tissue_db"),
                cell(results, "wall_s", worst="max"),
                met,
            )
        )
    return table(head, rows)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    titles = list(head)
    lines = [titles, ["---"] * len(titles), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(result: Mapping[str, Any], path: str, factor: float = 1.0, digits: int = 2) -> str:
    """Return a number of a result as text."""
    found = value(result, path)
    return "–" if found is None else f"{factor * found:.{digits}f}"


def tools_text(results: Mapping[str, list[dict[str, Any]]]) -> str:
    """Return the table of tool masks of the frames with outlines drawn by hand, and of the recorded masks of `cutting`."""
    head = ("recording", "frames", "mean IoU", "worst frame", "tools of more than 2 % of the picture", "of them missed", "tissue called tool, %", "required")  # fmt: skip
    rows = []
    for each in (*results["tools"], *results["cutting_masks"]):
        name, iou = each["recording"], value(each, "iou")
        least = {"mean of recordings": 0.70, "cutting": 0.80}.get(name, 0.55)
        required = "–" if iou is None else f"{least:.2f}: {'met' if iou >= least else 'missed'}"
        if name == "mean of recordings":
            rows.append((name, "", number(each, "iou"), "", "", "", "", required))
            continue
        counts = [number(each, path, digits=0) for path in ("large", "missed")]
        rows.append(
            (
                f"`{name}`" + (" (recorded masks)" if name == "cutting" else ""),
                number(each, "frames", digits=0),
                number(each, "iou"),
                number(each, "iou_min"),
                *counts,
                number(each, "false_share", 100.0, 1),
                required,
            )
        )
    return (
        "Frames with outlines drawn by hand; none was trained on. Some were looked at in development, `laparoscopy` and `pelvis_stills` decided between checkpoints "
        "([checks.md](checks.md#tool-masks-tool_maskpy)). A tool is missed if less than 30 % of it is found.\n\n"
        + table(head, rows)
    )


def gates_text(results: Mapping[str, list[dict[str, Any]]]) -> str:
    """Return the table of withheld frames of recordings from inside, and of pictures from outside."""
    inside = [each for each in results["gates"] if "recording" in each]
    outside = [each for each in results["gates"] if "outside" in each]
    rows = []
    for each in inside:
        out = sum(count for reason, count in each["withheld"].items() if reason.startswith("out of body"))
        rest = ", ".join(f"{reason} {n}" for reason, n in each["withheld"].items() if not reason.startswith("out of"))
        rows.append((f"`{each['recording']}`", str(each["frames"]), str(out), rest or "0", "0: met" if not out else "0: missed"))  # fmt: skip
    passed, pictures = 0, 0
    for each in outside:
        evidence = each["evidence"]
        counts = evidence if isinstance(evidence, Mapping) else {evidence: 1}
        passed, pictures = passed + counts.get("none", 0), pictures + sum(counts.values())
    head = ("recording", "frames", "withheld as out of body", "otherwise", "required")
    return (
        table(head, rows)
        + f"\n\nOf {pictures} pictures from outside of a body (3 recorded ones, the others drawn), {passed} show no evidence of it; required: 0."
    )


GEOMETRY = {
    "stereo": ("Both eyes at rest: depth by matching", "depth", (1.0, 2.0)),
    "poses": ("Moving eye with its poses, 10 s: depth by parallax, the default", "parallax.depth", (2.0, 4.0)),
    "poses, breathing": ("… depth by breathing (experimental)", "breathing.depth", (2.0, 4.0)),
    "blind": ("Moving eye without poses, 10 s: error of the path", "ate", (2.0, 5.0)),
    "fixed": ("One eye at rest: relief from light (experimental, no default)", "depth", None),
}
"""Title, figure, and required median and worst value in per cent, by part of the log."""


def geometry_text(results: Mapping[str, list[dict[str, Any]]]) -> str:
    """Return the table of errors on random recordings. A recording without an estimate counts as the worst."""
    head = ("estimate", "recordings", "with an estimate", "error, %: median; worst", "best-fit plane, %: median; worst", "smaller error than that plane", "required median; worst")  # fmt: skip
    rows = []
    for part, (title, path, most) in GEOMETRY.items():
        each = [result for result in results.get(part.split(",")[0], []) if "seed" in result]
        if not each:
            continue
        found = [value(result, path) for result in each]
        planes = [value(result, path.replace("depth", "plane")) for result in each] if "depth" in path else []
        errors = [math.inf if one is None else 100 * one for one in found]
        middle, worst = statistics.median(errors), max(errors)
        known = [100 * one for one in planes if one is not None]
        below = sum(a is not None and b is not None and a < b for a, b in zip(found, planes, strict=False))
        met = most is None or (middle <= most[0] and worst <= most[1])
        rows.append(
            (
                title,
                str(len(each)),
                str(sum(one is not None for one in found)),
                f"{_error(middle)}; {_error(worst)}",
                f"{statistics.median(known):.2f}; {max(known):.2f}" if known else "–",
                str(below) if planes else "–",
                f"below the plane on 8 of {len(each)}, or no default: met"
                if most is None
                else f"{most[0]:g}; {most[1]:g}: {'met' if met else 'missed'}",
            )
        )
    return (
        "`synthesize --random`, seeds 1000 to 1009, which development did not use. RMS error over believed tissue, relative to the median depth; of a path, RMS distance after "
        "the best similarity, relative to its length. Planes are each frame's best-fit plane, fitted to the truth, of recordings with an estimate. A recording without an estimate "
        "counts as an infinite error. [geometry.md](geometry.md#random-recordings-geometry_randompy) has single recordings and causes.\n\n"
        + table(head, rows)
    )


def _error(per_cent: float) -> str:
    return f"{per_cent:.2f}" if math.isfinite(per_cent) else "none"


TITLES = {
    "live": "Live at 30 frames/s",
    "live_own_rate": "Live at the recording's own rate",
    "offline": "Offline, default settings",
}


def _reason(error: str) -> str:
    """Return the line of a command's error output that says what happened."""
    lines = [line for line in error.strip().splitlines() if not line.startswith("error: this is a bug in intrasplat")]
    return next((line for line in reversed(lines) if line.strip()), "no message")


def generality_text(folder: Path = FOLDER) -> str:
    """Return the text of results/generality.md."""
    parts = [
        "# Default commands on every recording",
        "Generated by `python benchmarks/publish.py` from the logs in [logs/generality](../logs/generality); do not edit. `python benchmarks/generality.py "
        "RECORDINGS` runs the default commands on every recording of a folder. A figure is the median over the runs, with the worst run in brackets. PSNR is over "
        "tissue. The displayed frame was trained on before it is shown, so its PSNR is a training error. Differences to the previous frame are of single frames after "
        "the first second. Without a GPU, live chooses the size at which the machine keeps up; in small pictures the previous frame scores more. A late frame "
        "is one whose own picture was not on the screen when the next frame arrived. The picture of a withheld frame shows the content of an earlier one; ages of used frames leave such pictures out. On machines whose processors are slow at times, ages and worst frames are worse ([live.md](live.md#hosts-whose-processors-stall)), as on one of the two hosts of the live runs on a GPU ([live.md](live.md#a-busier-host)).",
    ]
    for device, lines in lines_of(folder).items():
        name = "one GPU" if device == "cuda" else "two CPU cores"
        for part, title in TITLES.items():
            own = [line for line in lines if line["part"] == part]
            groups: dict[str, list[dict[str, Any]]] = {}
            for line in own:
                if "result" in line:
                    groups.setdefault(line["recording"], []).append(line["result"])
            failed = [line for line in own if "error" in line]
            if not own:
                continue
            table_of = live_table if part.startswith("live") else offline_table
            parts += [f"## {title}, {name}", table_of(groups, [line["recording"] for line in failed])]
            if failed:
                runs = (f"- `{line['recording']}`, run {line['run']}: {_reason(line['error'])}" for line in failed)
                parts.append(
                    "Ended with an error, so that the figures are those of the other runs:\n\n" + "\n".join(runs)
                )
            parts.append(
                f"{_origin(own)}; {_runs(own)} runs of `{own[0]['command']}` and the same for the other recordings."
            )
        for title, needed, text_of in (
            ("Tool masks", ("tools", "cutting_masks"), tools_text),
            ("Gates", ("gates",), gates_text),
            ("Geometry of random recordings", tuple(GEOMETRY), geometry_text),
        ):
            found = {part: [line for line in lines if line["part"] == part] for part in needed}
            if not any(found.values()):
                continue
            results = {part: [line["result"] for line in own if "result" in line] for part, own in found.items()}
            firsts = [own[0] for own in found.values() if own]
            parts += [f"## {title}, {name}", text_of(results)]
            parts.append(
                f"{_origin(firsts, is_timed=False)}; " + ", ".join(f"`{each['command']}`" for each in firsts) + "."
            )
    if len(parts) == 2:
        parts.append("Not measured yet.")
    return "\n\n".join(parts) + "\n"


def _origin(lines: Sequence[Mapping[str, Any]], *, is_timed: bool = True) -> str:
    """Return commit, date and machine of log lines as text; of timed runs with the machine's largest interruptions."""
    first, about = lines[0], lines[0]["machine"]
    commits = " and ".join(dict.fromkeys(line["commit"] for line in lines))
    gpu = f"{about['gpu']}, " if "gpu" in about else ""
    return (
        f"Measured at commit {commits}, {first['date']}, {gpu}{about['cores']} cores of {about['cpu']}, torch {about['torch']}"
        f"{pauses_text(line['machine'] for line in lines) if is_timed else ''}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="?", default=suite.RECORDINGS, help="folder of recordings")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--parts", nargs="+", choices=[*PARTS, *CHECKS], default=list(PARTS))
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="recordings, by their path in the folder")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--out", type=Path, help="log (default: benchmarks/logs/generality/DEVICE.jsonl)")
    options = parser.parse_args()
    out = options.out or FOLDER / f"{options.device}.jsonl"
    run(options.recordings.resolve(), options.parts, options.device, options.runs, out, options.only)


if __name__ == "__main__":
    main()
