"""Text of results/gsplat.md: figures of the gsplat surface from `logs/gsplat`. `publish.py` writes the file.

`SECTIONS` has one function per topic. It receives the logs of its topic by device and returns the table below the
heading, or an empty string. A topic without a log says so.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

from accepted import DEVICES, provenance

FOLDER = Path(__file__).resolve().parents[1] / "logs" / "gsplat"

Log = Mapping[str, Any]
Logs = Mapping[str, Log]
"""Logs of one topic by device."""


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def speed(folder: Path) -> str:
    """Return times of eager calls of both packages: `gpu_eager.py` in one process, and a script of timings in turn."""
    path = folder / "rasterization.jsonl"
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    rows: list[Sequence[object]] = []
    host: list[Sequence[object]] = []
    for each in (line["result"] for line in lines):
        if "ratio" in each:
            asked = each.get("asked_ms")
            kernels = f"{each['ours_kernel_ms']:.3f} / {each['gsplat_kernel_ms']:.3f} ms"
            verdict = "" if asked is None else f"≤ {asked} ms: {'met' if each['met'] else 'missed'}"
            rows.append([each["work"], f"{each['ours_ms']:.3f} ms", f"{each['gsplat_ms']:.3f} ms", f"{each['ratio']:.1f}", kernels, verdict])  # fmt: skip
        elif each["work"].endswith("host time"):
            host.append([each["work"].removesuffix(" host time"), *(f"{each[f'{part}_us']:.0f} ({each[f'{part}_native_us']:.0f}) µs" for part in ("forward", "forward_with_gradients", "backward")), f"{each['loss_us']:.0f} µs"])  # fmt: skip
    if not rows:
        return "Not measured yet."
    about = lines[0]
    text = [
        "Colour and expected depth, one call after another; the backward pass is that of a mean absolute difference, whose operations in torch"
        " are part of both times. Kernels are the time in which anything runs on the GPU. Other comparisons ran at the same time on a second GPU"
        " and on the same processor (`gpu_gsplat.sh`), which lengthens the host times of both packages, here and in the trainings below. [RESULTS.md](../RESULTS.md) has a run"
        " with nothing else on the machine.",
        table(("`gpu_eager.py`", "ours", "gsplat 1.5.3", "times faster", "kernels, ours / gsplat", "required"), rows),
        "Host time of one call (of it in native code), and of the loss in torch:",
        table(("scene", "forward", "forward with gradients", "backward", "loss"), host),
    ]
    runs = {}
    for module in ("gsplat", "gsplat_core"):
        found = folder / f"splat_bench-{module}.jsonl"
        if found.exists():
            runs[module] = [json.loads(line) for line in found.read_text(encoding="utf-8").splitlines()]
    if len(runs) == 2:
        text += [
            "Independent script of timings, one process for each package on the same machine:",
            table(
                (
                    "scene",
                    "forward: ours / gsplat",
                    "times faster",
                    "forward and backward: ours / gsplat",
                    "times faster",
                ),
                [
                    [
                        one["scene"],
                        f"{one['fwd_ms']:.3f} / {other['fwd_ms']:.3f} ms",
                        f"{other['fwd_ms'] / one['fwd_ms']:.1f}",
                        f"{one['fwd_bwd_ms']:.3f} / {other['fwd_bwd_ms']:.3f} ms",
                        f"{other['fwd_bwd_ms'] / one['fwd_bwd_ms']:.1f}",
                    ]
                    for one, other in zip(runs["gsplat_core"], runs["gsplat"], strict=True)
                ],
            ),
        ]
    return "\n\n".join([*text, provenance({"cuda": [about]})])


def own_tests(logs: Logs) -> str:
    """Return passed, failed and skipped tests of gsplat's own test files."""
    rows: list[Sequence[object]] = []
    scenes: list[str] = []
    for device, log in logs.items():
        for name, counts in log["files"].items():
            # A file that did not end has one entry of its own name.
            ended = log["tests"].get(name)
            failed = counts["failed"] if ended is None else f"{ended['why']} ({ended['seconds']:.0f} s)"
            rows.append([name, device, counts["passed"], failed, counts["skipped"]])
        scenes.append(f"{device}: compared with {log['compared_with']}; scene of test_basic: {log['scene']}.")
        if log.get("failed_with_gsplat") is not None:
            names = ", ".join(f"`{test}`" for test in log["failed_with_gsplat"])
            scenes.append(
                f"{device}: the same files with the compiled gsplat: {names + ' failed' if names else 'no test failed'}."
            )
    notes = [note for device, log in logs.items() for note in _exceptions(device, log)]
    text = "\n\n".join([table(("file", "device", "passed", "failed", "skipped"), rows), *scenes])
    return text + ("\n\nNamed exceptions:\n\n" + "\n".join(notes) if notes else "")


def _exceptions(device: str, log: Log) -> list[str]:
    """Return a line for each function of which tests failed on the device, with its proof in float64 or without one."""
    failed: dict[str, list[str]] = {}
    for test, about in log["tests"].items():
        if about["outcome"] == "failed" and "::" in test:
            name, _, case = test.partition("::")[2].partition("[")
            failed.setdefault(name, []).append(f"`{case.rstrip(']')}`" if case else "the test")
    proofs = logs_of("thresholds").get(device, {})
    lines = []
    for name, cases in failed.items():
        line = f"- {device}, `{name}`: {', '.join(cases)}."
        if name in proofs:
            runs = proofs[name]["runs"]
            most, unexplained = (max(run[key] for run in runs) for key in ("different", "largest_unexplained"))
            line += f" Rounding of float32: of {runs[0]['values']:,} values of a picture at most {most} differ from float64 by more than the tolerance,"
            line += (
                f" those that no threshold decides by at most {unexplained:.1e}"
                if unexplained
                else " all of these decided by a threshold"
            )
            line += " ([table](#rounding-near-the-thresholds-of-blending))."
        if log.get("failed_with_gsplat") is not None:
            also = [test for test in log["failed_with_gsplat"] if test.partition("::")[2].partition("[")[0] == name]
            line += (
                f" With the compiled gsplat, {len(also) or 'none'} of these cases fail{'s' if len(also) == 1 else ''}."
            )
        lines.append(line)
    return lines


def thresholds(logs: Logs) -> str:
    """Return the differences of blended pictures from float64."""
    head = ("call of", "device", "values", "outside the test's tolerance", "of these decided by a threshold", "largest difference of the others", "largest difference")  # fmt: skip
    rows = []
    for device, log in logs.items():
        for test in ("test_rasterize_to_pixels", "test_rasterize_to_pixels_2dgs"):
            runs = log[test]["runs"]
            total = {name: sum(run[name] for run in runs) for name in ("values", "different", "explained")}
            largest = {name: max(run[name] for run in runs) for name in ("largest_unexplained", "largest_difference")}
            rows.append([f"`{test}`", device, *(f"{each:,}" for each in total.values()), *(f"{each:.1e}" for each in largest.values())])  # fmt: skip
    said = (
        "Compiled blending in float32 next to the reference in float64 with the same inputs, in the scenes of two tests that"
        " fail on CUDA. A splat is omitted below an opacity of 1/255, and blending ends at a transmittance of 1e-4; where a"
        " value is that close to a threshold, rounding decides. Tolerances are those of the tests: 1e-5 and 1e-3."
    )
    return "\n\n".join([said, table(head, rows)])


def names(logs: Logs) -> str:
    """Return how many of gsplat's public names exist, and the parameters that differ."""
    lines = []
    for log in logs.values():
        present = log["names"] - len(log["absent"])
        lines.append(
            f"{present} of {log['names']} public names of gsplat {log['gsplat']}{'; absent: ' + ', '.join(log['absent']) if log['absent'] else ''}."
            f" Parameters have gsplat's names, order and defaults in all but {len(log['different'])} of them:"
        )
        lines.append("\n".join(f"- `{name}`: {'; '.join(found)}" for name, found in log["different"].items()))
    return "\n\n".join(lines)


def calls(logs: Logs) -> str:
    """Return the number of typical calls that work, and those that do not."""
    rows, missing = [], []
    for device, log in logs.items():
        rows.append([device, log["works"], log["calls"]])
        missing += [f"- {device}: `{name}`: {why}" for name, why in log["fails"].items()]
    return table(("device", "calls that work", "calls"), rows) + ("\n\n" + "\n".join(missing) if missing else "")


def static(logs: Logs) -> str:
    """Return scores of trained static scenes and of trivial baselines."""
    head = ("training", "device", "PSNR", "SSIM", "Gaussians", "training time", "processor time", "peak memory")
    rows = []
    for device, log in logs.items():
        for name, each in log["baselines"].items():
            rows.append([name, device, f"{each['psnr_db']:.1f} dB", f"{each['ssim']:.3f}", *["–"] * 4])
        for name, run in log["strategies"].items():
            (psnr, psnr_worst), (ssim, ssim_worst), (count, _) = run["psnr_db"], run["ssim"], run["gaussians"]
            (seconds, seconds_worst), (processor, processor_worst) = run["training_s"], run["processor_s"]
            peak, _ = run["peak_mib"]
            rows.append(
                [
                    f"`--strategy {name}`",
                    device,
                    f"{psnr:.1f} ({psnr_worst:.1f}) dB",
                    f"{ssim:.3f} ({ssim_worst:.3f})",
                    f"{count:,.0f}",
                    f"{seconds:.0f} ({seconds_worst:.0f}) s",
                    f"{processor:.0f} ({processor_worst:.0f}) s",
                    f"{peak:,.0f} MiB",
                ]
            )
    sizes = {
        f"{log['scene']['views']} views of {log['scene']['width_px']}x{log['scene']['height_px']} px, {log['steps']:,} steps ({device})"
        for device, log in logs.items()
    }
    said = (
        f"Synthetic scene: {'; '.join(sorted(sizes))}. Every 8th image is held out and scored. Median of three seeds, with the"
        " worst in brackets. The baselines show the training image of the nearest camera, and the mean of the training images."
        " Processor time and peak memory include the start of the process, reading and evaluation. Other work ran on the machine of"
        " the CPU figures, so their training time is an upper bound. gsplat's own trainer needs CUDA and was not run on the CPU."
    )
    return f"{said}\n\n{table(head, rows)}"


def cameras(logs: Logs) -> str:
    """Return the errors of unscented projection, and the PSNR of rolling shutters."""
    rows = []
    for device, log in logs.items():
        for model in ("pinhole", "fisheye"):
            rows += [
                [f"{model}: means to OpenCV, worst", device, f"{log[f'{model}_mean_px_worst']:.4f} px"],
                [
                    f"{model}: covariance to samples (4 px), median / worst",
                    device,
                    f"{100 * log[f'{model}_covariance_4px_median']:.2f} / {100 * log[f'{model}_covariance_4px_worst']:.2f} %",
                ],
                [f"{model}: pixel to ray and back, worst", device, f"{log[f'{model}_inversion_px_worst']:.5f} px"],
            ]
        for name, words in (("picture_plane", "blended in the picture plane"), ("eval3d", "`with_eval3d`")):
            found, still = log[f"shutter_{name}_psnr_db"], log[f"shutter_{name}_global_psnr_db"]
            moved = log["shutter_motion_px_median"]
            rows.append(
                [
                    f"rolling shutter to pictures of each row, {words} (motion {moved:.1f} px; a global shutter scores {still:.1f} dB)",
                    device,
                    f"{found:.1f} dB",
                ]
            )
        count = log["timed_gaussians"]
        for name in ("linear", "unscented"):
            rows.append([f"{name} projection of {count} Gaussians, forward", device, f"{log[f'{name}_ms']:.2f} ms"])
    return table(("figure", "device", "value"), rows)


def memory(logs: Logs) -> str:
    """Return bytes of gradients and peak memory by the share of visible Gaussians."""
    rows = []
    for device, log in logs.items():
        for each in log["rows"]:
            held, peak = (f"{each[name] / 2**20:,.1f} MiB" for name in ("gradient_bytes", "peak_bytes"))
            rows.append([f"{each['share']:.0%}", each["mode"], device, held, peak])
    counts = ", ".join(f"{log['gaussians']:,} ({device})" for device, log in logs.items())
    said = (
        f"One forward and backward pass of {counts} Gaussians with spherical harmonics of degree 3, one camera. Peak memory is"
        " the increase during the pass. `sparse_grad=True` concerns means, quats and scales as in gsplat, `'all'` opacities and"
        " colours, too."
    )
    return f"{said}\n\n{table(('visible', 'mode', 'device', 'gradients', 'peak'), rows)}"


def processes(logs: Logs) -> str:
    """Return the difference between one process and several."""
    head = ("device", "processes", "backend", "Gaussians", "cameras", "picture", "gradients")
    rows = [
        [device, log["processes"], log["backend"], f"{log['gaussians']:,}", log["cameras"], f"{log['picture']:.1e}",
         f"{log['gradients']:.1e}"]
        for device, log in logs.items()
    ]  # fmt: skip
    said = (
        "Largest difference of pictures and gradients of `distributed=True` from one process, packed and dense. Differences of"
        " gradients are relative to the largest gradient of the same tensor. Required: 1e-4."
    )
    return f"{said}\n\n{table(head, rows)}"


def surfels(logs: Logs) -> str:
    """Return times of surfels next to those of Gaussians, and errors on planes."""
    times, planes = [], []
    for device, log in logs.items():
        for what, words in (("forward", "picture"), ("step", "picture and gradients")):
            ours, other = log[f"surfels_{what}_ms"], log[f"gaussians_{what}_ms"]
            peer = log.get(f"gsplat_{what}_ms")
            beside = ["not run", ""] if peer is None else [f"{peer:.2f} ms", f"{ours / peer:.2f}"]
            times.append([words, device, f"{ours:.2f} ms", f"{other:.2f} ms", f"{log[f'{what}_ratio']:.2f}", *beside])
        for name, each in log["planes"].items():
            planes.append(
                [
                    name,
                    device,
                    f"{each['depth_percent']:.2f} %",
                    f"{each['median_percent']:.2f} %",
                    f"{each['normal_deg']:.3f}°",
                    f"{each['depth_normal_deg']:.2f}°",
                ]
            )
    sizes = ", ".join(
        f"{log['gaussians']:,} at {log['width_px']}x{log['height_px']} px ({device})" for device, log in logs.items()
    )
    head = ("plane at a distance of 40", "device", "depth", "median depth", "normal", "normal of the depth")
    said = (
        f"`rasterization_2dgs` next to `rasterization` with the same inputs, both with depth: {sizes}. On the CPU the times are"
        " processor time, with one thread. gsplat's 2DGS needs CUDA. Depth is that of the surfels' centres, as in"
        " gsplat, so its error on a tilted plane is proportional to the standard deviation of the surfels."
    )
    both = (
        table(("", "device", "surfels", "Gaussians", "ratio", "gsplat's surfels", "surfels to gsplat's"), times),
        table(head, planes),
    )
    return f"{said}\n\n{both[0]}\n\nMean errors on a plane:\n\n{both[1]}"


def strategies(logs: Logs) -> str:
    """Return held-out scores of ADC and of MCMC with a share of ADC's Gaussians."""
    head = ("pictures", "device", "ADC", "Gaussians", "MCMC", "Gaussians", "MCMC minus ADC")
    rows, sizes = [], set()
    for device, log in logs.items():
        for name, figures in log["scenes"].items():
            adc, mcmc, gain = figures["adc"], figures["mcmc"], figures["gain_db"]
            scores = [f"{each['psnr_db']['median']:.2f} ({each['psnr_db']['worst']:.2f}) dB" for each in (adc, mcmc)]
            counts = [f"{each['gaussians']:,.0f}" for each in (adc, mcmc)]
            difference = f"{gain['median']:+.2f} ({gain['worst']:+.2f}) dB"
            rows.append([name, device, scores[0], counts[0], scores[1], counts[1], difference])
        sizes.add(
            f"{log['views']} pictures of {log['size_px'][0]}x{log['size_px'][1]} px, {log['steps']:,} steps,"
            f" {log['held_out']} held-out pictures without noise ({device})"
        )
    said = f"Required: MCMC reaches ADC's PSNR with at most half of its Gaussians. {'; '.join(sorted(sizes))}."
    said += " Median of three seeds, with the worst in brackets."
    if log := logs.get("cuda"):
        said += (
            f" On CUDA the steps, intervals and learning rates are those of gsplat's trainer{'' if log['steps'] == 30_000 else ', but for the number of steps'},"
            f" and ADC multiplies Gaussians with a mean gradient above {log['options']['grow_grad2d']:g}, where gsplat's default is 0.0002, because the"
            " pictures are small."
        )
    tried = (
        "It is not reached on the CPU in trainings this short. A possible cause, not tested: copies of MCMC start at one place and part"
        " slowly."
    )
    if "cuda" not in logs:
        tried += " More than 1,500 steps were not tried."
    reached = all(figures["gain_db"]["worst"] >= 0 for figures in logs.get("cpu", {"scenes": {}})["scenes"].values())
    return f"{said}{'' if reached else ' ' + tried}\n\n{table(head, rows)}"


TRAINER_VARIANTS = {
    "gsplat": "gsplat 1.5.3",
    "ours": "ours",
    "ours-selective": "ours, `SelectiveAdam`",
    "gsplat-selective": "gsplat 1.5.3, `SelectiveAdam`",
}


def trainings(logs: Logs) -> str:
    """Return scores, memory and times of trainings by gsplat's example trainer with gsplat and with this package."""
    rows, texts = [], []
    for device, log in logs.items():
        for strategy, variants in log["summary"].items():
            for name, each in variants.items():
                rows.append([f"`{strategy}`", TRAINER_VARIANTS[name], device, *_trained(each)])
        scene = log["scene"]
        installed = any(
            "fused_ssim" not in run["replaced"] for run in log["runs"] if run["variant"].startswith("gsplat")
        )
        runs = {run["seed"] for run in log["runs"]}
        names = {name for variants in log["summary"].values() for name in variants}
        absent = [
            f"`{strategy}` with {TRAINER_VARIANTS[name]}"
            for strategy, variants in log["summary"].items()
            for name in sorted(names - set(variants))
            if name != "ours-selective"
        ]
        counts = Counter((run["strategy"], run["variant"]) for run in log["runs"])
        fewer = [
            f"`{strategy}` with {TRAINER_VARIANTS[name]} ({count})"
            for (strategy, name), count in sorted(counts.items())
            if count < max(counts.values())
        ]
        texts.append(
            f"{device}: {scene['views']} views of {scene['width_px']}x{scene['height_px']} px, {scene['points']:,} points,"
            f" {log['steps']:,} steps with all intervals scaled by {log['steps'] / 30_000:g}, cap of `mcmc` {log['cap']:,},"
            f" seeds {', '.join(str(seed) for seed in sorted(runs))}. SSIM of the loss with gsplat:"
            f" {'the package fused-ssim' if installed else 'ours, because fused-ssim was not installed'}."
            f" Replaced packages: {', '.join(sorted({each for run in log['runs'] for each in run['replaced']}))}."
            + (f" Not run for want of time: {', '.join(absent)}." if absent else "")
            + (f" With fewer seeds, for want of time: {', '.join(fewer)}." if fewer else "")
        )
    head = ("strategy", "package", "device", "PSNR", "SSIM", "splats", "peak memory", "training time", "waiting", "ratio", "ratio without waiting")  # fmt: skip
    return "\n\n".join([*texts, table(head, rows)])


def trainer(logs: Logs) -> str:
    """Return how gsplat's example trainer was run, and its results."""
    said = (
        "`simple_trainer.py` of gsplat's examples, abridged to what it uses without a viewer, on a synthetic scene in COLMAP's"
        " format. Each training is a process of its own, with the same arguments and seeds for all variants of a strategy, but"
        " for the option `visible_adam` where `SelectiveAdam` is named, and `--strategy.compat 1.5.3` for `default` with ours, because"
        " gsplat 1.5.3 never resets opacities. Every 8th image is held out and scored. Median of the seeds, with the worst in"
        " brackets. Training time excludes start and evaluation, and includes waiting for the trainer's own reader of pictures,"
        " which is the same for all. Ratios are to gsplat with the same seed; the last one is without the waiting. Peak memory is"
        " that of PyTorch's allocator on CUDA, and that of the process on the CPU. LPIPS is not measured."
        " Required: at most 0.65"
        " of gsplat's time, and 0.5 with our optimiser and SSIM. gsplat needs CUDA."
    )
    return "\n\n".join([said, trainings(logs), *_own_trainer(logs)])


def _own_trainer(logs: Logs) -> list[str]:
    """Return the times of `intrasplat train`, relative to gsplat's trainer, where both trained the same scene with as many steps."""
    lines = []
    for device, own in logs_of("static").items():
        theirs = logs.get(device)
        if theirs is None or any(own[name] != theirs[name] for name in ("scene", "steps")):
            continue
        for name, strategy in (("adc", "default"), ("mcmc", "mcmc")):
            ours, peer = own["strategies"][name], theirs["summary"][strategy].get("gsplat")
            if peer is not None:
                median, worst = (seconds / peer["training_s"][0] for seconds in ours["training_s"])
                lines.append(
                    f"- {device}: `intrasplat train --strategy {name}` takes {median:.2f} ({worst:.2f}) of the median time of gsplat's trainer with"
                    f" `{strategy}`: {ours['psnr_db'][0]:.2f} and {peer['psnr_db'][0]:.2f} dB, {ours['gaussians'][0]:,.0f} and {peer['gaussians'][0]:,.0f} Gaussians."
                )
    if not lines:
        return []
    return [
        "The same scene with as many steps by [`intrasplat train`](#static-scenes-intrasplat-train), which has its own schedule of"
        " strategies and whose times vary, because other benchmarks shared its GPU:\n\n" + "\n".join(lines)
    ]


def _trained(each: Mapping[str, Any]) -> list[str]:
    """Return the cells of one variant."""

    def both(name: str, digits: int, unit: str = "") -> str:
        if each[name] is None:
            return "–"
        median, worst = each[name]
        return f"{median:,.{digits}f} ({worst:,.{digits}f}){unit}"

    cells = [both("psnr_db", 2, " dB"), both("ssim", 3), both("gaussians", 0), both("peak_mib", 0, " MiB")]
    return [
        *cells, both("training_s", 1, " s"), both("waiting_s", 1, " s"), both("time_ratio", 2), both("busy_ratio", 2)
    ]  # fmt: skip


SECTIONS: tuple[tuple[str, str, Callable[[Logs], str]], ...] = (
    ("gsplat's own tests", "own_tests", own_tests),
    ("Rounding near the thresholds of blending", "thresholds", thresholds),
    ("Public names", "names", names),
    ("Typical calls", "calls", calls),
    ("Memory of packed and sparse gradients", "memory", memory),
    ("Surfels (2D Gaussian Splatting)", "surfels", surfels),
    ("Several processes", "processes", processes),
    ("Static scenes: `intrasplat train`", "static", static),
    ("gsplat's example trainer", "trainer", trainer),
    ("gsplat's example trainer, 1280x960 pixels", "trainer_wide", trainings),
    ("Cameras", "cameras", cameras),
    ("ADC and MCMC", "strategies", strategies),
)
"""Title, stem of the log files, and function of each topic."""


def logs_of(topic: str, folder: Path = FOLDER) -> dict[str, Any]:
    """Return the logs of a topic by device."""
    paths = {device: folder / f"{topic}-{device}.json" for device in DEVICES}
    return {device: json.loads(path.read_text(encoding="utf-8")) for device, path in paths.items() if path.exists()}


def gsplat_text(folder: Path = FOLDER) -> str:
    """Return the text of results/gsplat.md."""
    parts = [
        "# The gsplat surface\n\nGenerated by `python benchmarks/publish.py` from the logs of the scripts in [benchmarks/gsplat](../gsplat); do not edit."
        " [docs/gsplat.md](../../docs/gsplat.md) says how to run gsplat programs."
    ]
    parts.append(f"## Speed of eager calls\n\n{speed(folder)}")
    for title, topic, section in SECTIONS:
        logs = logs_of(topic, folder)
        text = section(logs) if logs else ""
        parts.append(
            f"## {title}\n\n"
            + (
                f"{text}\n\n{provenance({device: [log] for device, log in logs.items()})}"
                if text
                else "Not measured yet."
            )
        )
    return "\n\n".join(parts) + "\n"
