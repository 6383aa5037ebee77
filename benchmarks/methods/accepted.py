"""Text of results/methods.md: required and measured figures of each splatting method, from `logs/methods`.

`publish.py` writes the file. A line whose figure is in no log says so.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "logs" / "methods"
ALONE = FOLDER.parent / "h200-2026-11-28-methods" / "training_step_ms.jsonl"
"""Times of training steps that had the GPU for themselves: recording, variant, milliseconds."""
DEVICES = ("cpu", "cuda")


@dataclass(frozen=True)
class Figure:
    """A required figure of one log.

    Attributes:
        what: the figure in words.
        path: keys of the value in the log. Several paths separated by spaces are printed one after another.
        asked: the requirement in words; empty for a figure that is only reported.
        digits: digits after the point.
        scale: the printed figure is the value times this.
        unit: printed after the figure.
        note: reason for a requirement that is not met.
    """

    what: str
    path: tuple[str, ...]
    asked: str = ""
    digits: int = 2
    scale: float = 1.0
    unit: str = ""
    note: str = ""


def figure(what: str, path: str, asked: str = "", digits: int = 2, *, unit: str = "", scale: float = 1.0, note: str = "") -> Figure:  # fmt: skip
    return Figure(what, tuple(path.split("|")), asked, digits, scale, unit, note)


@dataclass(frozen=True)
class Method:
    """A section of the page: the log's name, and its figures."""

    title: str
    log: str
    figures: Sequence[Figure]


SIZES = ("1M", "10M", "50M", "106M")
TIMES = {
    "alpha": "alpha_ms", "stochastic, 1 sample": "stochastic_1_ms", "4 samples": "stochastic_4_ms",
    "16 samples": "stochastic_16_ms", "points": "points_1_ms", "weighted sum": "weighted_sum_ms",
    "stochastic to 35 dB": "stochastic_to_35_db.ms", "points to 35 dB": "points_to_35_db.ms", "gsplat 1.5.3": "gsplat_ms",
}  # fmt: skip
METHODS = (
    Method(
        "1, 2. Stochastic transparency and points", "stochastic",
        (
            figure("stochastic: mean of z", "z_fragments.mean", "within ±0.02", 4),
            figure("stochastic: variance of z", "z_fragments.variance", "0.97 to 1.03", 4),
            figure("stochastic: share of pixels with z beyond ±5", "z_fragments.share_above_5", "at most 1e-5", 6),
            figure("stochastic: PSNR per doubling of samples", "db_per_doubling_fragments", "3.01 ± 0.1", unit="dB"),
            figure("points: mean of z", "z_points.mean", "within ±0.02", 4),
            figure("points: variance of z", "z_points.variance", "0.97 to 1.03", 4),
            figure(
                "points: share of pixels with z beyond ±5", "z_points.share_above_5", "at most 1e-5", 6,
                note="two of 460,736 values of 16 pictures",
            ),
            figure("points: PSNR per doubling of samples", "db_per_doubling_points", "3.01 ± 0.1", unit="dB"),
            figure("points against alpha at pixel centres, S = 4", "points_to_alpha_at_pixel_centres_db|4", "at least 45", unit="dB"),
            figure("Poisson counts: smallest p of 20 rates", "poisson_smallest_p", "above 0.01", 4),
            figure("few huge splats, time relative to equal fragments", "huge_against_small.ratio", "at most 1.5"),
            figure("quantised against not quantised", "quantised.psnr_to_unquantised_db", "at least 45", unit="dB"),
            *(
                figure(f"memory beside parameters, frame and queue at {size}", f"speed_{size}.memory_stochastic_1.peak_share", "at most 2 %", 2, scale=100, unit="%", note="without the fixed queue")
                for size in SIZES
            ),
        ),
    ),
    Method(
        "1, 2. A .ply file on a camera path", "pretrained",
        (
            figure("splats of the file", "gaussians", "", 0),
            figure("frames of the path", "bench alpha|frames", "", 0),
            figure("width of the picture", "size_px|0", "", 0, unit="px"),
            figure("alpha", "bench alpha|fps_p50", "", 0, unit="frames/s"),
            figure("stochastic, 1 sample", "bench stochastic --samples 1|fps_p50", "", 0, unit="frames/s"),
            figure("stochastic, 16 samples", "bench stochastic --samples 16|fps_p50", "", 0, unit="frames/s"),
            figure("points, 1 sample", "bench points --samples 1|fps_p50", "", 0, unit="frames/s"),
            figure("time to load the .ply", "load|s", "", unit="s"),
            figure("memory while loading relative to the tensors", "load|peak_growth_over_tensors", ""),
        ),
    ),
    Method(
        "3. Weighted sum", "weighted_sum",
        (
            figure("trained on cutting: held out against alpha", "heldout_minus_alpha_db", "at least -1.0", unit="dB"),
            figure("popping against alpha, turns of 0.1°, 4x4 samples a pixel", "popping_ratio|4x", "at most 0.5"),
            figure("with 2x2 samples", "popping_ratio|2x", ""),
            figure("with 1 sample", "popping_ratio|1x", "", note="mostly interpolation of the compared pictures, which both share"),
            figure("time against alpha at 1 M, forward", "speed|1|time_ratio", "at most 1.3", note="the kernels alone on an H100 671 and 530 µs, 1.27 ([log](../logs/h100-2026-11-28-weighted-sum/kernels.txt))"),
        ),
    ),
    Method(
        "4. Ray depth, normals, semantics", "surface",
        (
            figure("wall at 35°: error of ray depth", "wall 35 deg: ray depth, largest error %", "at most 0.3", 4, unit="%"),
            figure("wall at 35°: error of centre depth", "wall 35 deg: centre depth, largest error %", "", unit="%"),
            figure("wall at 60°: error of ray depth", "wall 60 deg: ray depth, largest error %", "", unit="%", note="likely the limit to 3 standard deviations; not tested separately"),
            figure("semantics: IoU with labels on one frame in ten", "semantics: mean IoU", "at least 0.9"),
        ),
    ),
    Method(
        "4. Offline stereo with the losses ray_depth and normal_consistency", "surface-stereo",
        (
            figure("depth", "stereo: ray_depth,normal_consistency, ray depth, RMS %", "at most 0.9 of today's", 3, unit="%", note="0.653 % without the losses on seed 0 when the figure was asked for. Since then the surface of stereo depth is fitted to the pictures of both eyes, which improves training without the losses as much"),
            figure("depth without the losses", "stereo: today, ray depth, RMS %", "", 3, unit="%"),
            figure("normals", "stereo: ray_depth,normal_consistency, normals of ray depth, mean deg", "at most 4.5", unit="°", note="GPU: mean of three seeds, 5.18°, 4.24° and 4.31°. What remains is mostly noise of the splats: trained on exact depth at 160x128, the error is 1.8°. CPU before: 5.38°, and 6.25° without the losses ([log](../logs/cpu-2026-11-27-ray-interval/stereo.jsonl)). Three times the weight of normal_consistency: normals better by 0.5°, depth worse by 5 and 14 % on two seeds ([log](../logs/cpu-2026-11-28-stereo-surface/weights.txt)); on the three seeds of the GPU 4.00°, depth 19 % worse, third view 0.5 dB worse"),
            figure("normals without the losses", "stereo: today, normals of ray depth, mean deg", "", unit="°"),
            figure("third view", "stereo: ray_depth,normal_consistency, third view, dB", "at least -0.3 dB", unit="dB"),
            figure("third view without the losses", "stereo: today, third view, dB", "", unit="dB"),
        ),
    ),
    Method(
        "4. Step time of the losses ray_depth and normal_consistency", "surface-step",
        (
            figure("step without the losses", "step: losses none, ms", "", unit="ms"),
            figure("step with both losses", "step: losses both, ms", "", unit="ms"),
            figure("extra time", "step: extra cost of both %", "at most 25", 1, unit="%", note="one run on an H200 at ee74b9e5: 18.2 % ([log](../logs/h200-2026-11-28-methods/surface_step.json))"),
        ),
    ),
    Method(
        "5. Flow and occlusion",
        "flow",
        (
            figure("rigid motion: largest error", "rigid_neighbours_largest_px", "at most 1e-3", 5, unit="px"),
            figure("rigid motion with the published map: median error", "rigid_gaussianflow_median_px", "", 3, unit="px"),
            figure("5 % affine: p95", "affine_neighbours_p95_px", "at most 0.03", 5, unit="px"),
            figure(
                "trained without depth: followed points", "fixed_flow_points_mm", "20 % below today", 2, unit="mm",
                note="the depth of one eye at rest dominates, which flow does not show; training itself starts motion from flow",
            ),
            figure("today", "fixed_today_points_mm", "", 2, unit="mm"),
            figure("trained without depth: in the picture", "fixed_flow_points_px", "", 2, unit="px"),
            figure("today, in the picture", "fixed_today_points_px", "", 2, unit="px"),
            figure("trained with stereo depth: followed points", "stereo_flow_points_mm", "no worse than today", 3, unit="mm"),
            figure("today", "stereo_today_points_mm", "", 3, unit="mm"),
        ),
    ),
    Method(
        "6. Triangulation", "triangulation",
        (
            figure("loss of a surface displaced by 5 %", "seed0_loss_of_surface_displaced_by_5_percent", "above 0.1"),
            figure("loss of the true surface", "seed0_loss_of_true_surface", ""),
            figure("gradients that move it back", "seed0_gradients_that_move_it_back", "", 1, scale=100, unit="%"),
            figure("Chamfer against today, start on a plane", "seed0_plane_chamfer_ratio", "at most 0.85", 3),
            figure("Chamfer against today, start from parallax", "seed0_parallax_chamfer_ratio", "at most 0.85", 3),
        ),
    ),
    Method(
        "7. Range sensors", "range_sensors",
        (
            figure("time of flight: depth Chamfer against the camera alone", "time_of_flight_ratio", "at most 0.5", 3, note="at 256 pixels the parallax of 1 mm improves the camera alone: 1.71 mm after 300 steps, 1.52 after 1,200, 1.18 after 3,000; with the sensor 1.09, 0.80, 0.77 ([logs](../logs/h100-2026-11-28-methods))"),
            figure("structured light", "structured_light_ratio", "at most 0.5", 3),
            figure("OCT line", "oct_line_ratio", "at most 0.5", 3, note="one line constrains only the splats that it crosses"),
        ),
    ),
    Method(
        "8. Splat regression and birth-death", "regression",
        (
            figure("closed forms against autograd", "closed_form_error", "at most 1e-10", 17),
            figure("final loss relative to Adam: ratio of medians of 10 seeds, median of the sets", "ratio_of_medians", "at most 0.1", 4, note="Adam at its best rate for each set."),
            figure("the same, worst set", "worst_ratio_of_medians", "at most 0.1", 4),
            figure("final loss relative to Adam: median ratio", "median_ratio", "at most 0.1", 4),
        ),
    ),
    Method(
        "8. Birth and death as strategy of a reconstruction",
        "growth",
        (
            figure("cutting: held out", "birth_death|heldout_db", "", unit="dB"),
            figure("cutting: held out with the default strategy", "default|heldout_db", "", unit="dB"),
        ),
    ),
    Method(
        "10. Cut Gaussians (experimental)", "cut_gaussians",
        (
            figure("gain at equal bytes, mean of the pictures", "gain_db", "at least 0.5", unit="dB", note="by the signed distance from the curves. By the sign of the implicit form, with the gradient by the smallest flip, it was -2.26 dB at 48 pixels and 150 steps ([log](../logs/cpu-2026-11-28-cut-gaussians/sign-of-implicit-form.json))"),
            figure("median", "median_gain_db", "", unit="dB"),
            figure("worst picture", "worst_gain_db", "", unit="dB", note="at 96 pixels and half the steps: mean 0.98, median 0.17, worst -0.12 dB ([log](../logs/cpu-2026-11-28-cut-gaussians/96px-500-steps.json))"),
        ),
    ),
)  # fmt: skip


def logs_of(method: str, device: str, folder: Path) -> list[dict[str, Any]]:
    """Return the logs of a method on a device: METHOD-DEVICE.json, and further runs METHOD-DEVICE-2.json and so on."""
    first = folder / f"{method}-{device}.json"
    paths = [*([first] if first.exists() else ()), *sorted(folder.glob(f"{method}-{device}-[0-9].json"))]
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


def log_of(method: str, device: str, folder: Path) -> dict[str, Any] | None:
    """Return the first log of a method on a device, or None."""
    return next(iter(logs_of(method, device, folder)), None)


def value_at(log: Any, path: Sequence[str]) -> Any:
    """Return the value at a path. A key with dots may also be a path of keys."""
    value = log
    for key in path:
        if isinstance(value, list):
            value = value[int(key)] if int(key) < len(value) else None
        elif isinstance(value, Mapping):
            value = value[key] if key in value else value_at(value, key.split(".")) if "." in key else None
    return value


def cell(figure: Figure, logs: Sequence[Mapping[str, Any]]) -> str:
    """Return the figure, or the median of several runs with the smallest and the largest."""
    values = [value for log in logs if isinstance(value := value_at(log, figure.path), int | float)]
    if not values:
        return "–"
    texts = [
        f"{figure.scale * value:.{figure.digits}f}" if figure.digits < 10 else f"{value:.1e}"
        for value in (statistics.median(values), min(values), max(values))
    ]
    spread = f" ({texts[1]} to {texts[2]})" if texts[1] != texts[2] else ""
    return f"{texts[0]} {figure.unit}".strip() + spread


def provenance(logs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return commit, date, machine and command of the logs by device; of runs with the same ones their number."""
    parts = []
    for device, runs in logs.items():
        if not runs:
            continue
        log, machine = runs[0], runs[0]["machine"]
        name = machine.get("gpu") or f"{machine['cpu']}, {machine['cores']} cores"
        count = f", {len(runs)} runs" if len(runs) > 1 else ""
        parts.append(f"{device}: commit {log['commit']}, {log['date']}, {name}{count}, `{log['command']}`")
    return "; ".join(parts)


def section(method: Method, folder: Path) -> str:
    """Return the table of one method."""
    logs = {device: logs_of(method.log, device, folder) for device in DEVICES}
    lines = ["| figure | required | CPU | GPU | note |", "|---|---|---|---|---|"]
    for each in method.figures:
        cpu, gpu = (cell(each, logs[device]) for device in DEVICES)
        lines.append(f"| {each.what} | {each.asked or '–'} | {cpu} | {gpu} | {each.note} |")
    return f"## {method.title}\n\n" + "\n".join(lines) + "\n\n" + (provenance(logs) or "Not measured yet.")


def speed(folder: Path) -> str:
    """Return the frame times by number of splats."""
    log = log_of("stochastic", "cuda", folder)
    if log is None:
        return ""
    lines = ["| splats | " + " | ".join(TIMES) + " | peak memory (MB) |", "|---" * (len(TIMES) + 2) + "|"]
    for size in SIZES:
        found = [value_at(log, (f"speed_{size}", path)) for path in TIMES.values()]
        cells = [f"{value:.1f}" if isinstance(value, int | float) else "–" for value in found]
        peak = value_at(log, (f"speed_{size}", "memory_stochastic_1.peak_mb"))
        lines.append(f"| {size} | " + " | ".join(cells) + f" | {'–' if peak is None else f'{peak:.0f}'} |")
    text = (
        "Milliseconds a frame of 1920x1080 on one GPU, of random scenes of degree 3. A dash: not measured in this run."
        " Required is one sample faster than alpha and gsplat from 10 million splats on."
    )
    return "## Frame times\n\n" + text + "\n\n" + "\n".join(lines) + "\n\n" + provenance({"cuda": [log]})


def unchanged(folder: Path) -> str:
    """Return the comparison of rendering, replay and live with the commit before the methods."""
    log = log_of("unchanged", "cuda", folder)
    if log is None:
        return ""
    lines = ["| figure | before | now | worst before | worst now | now / before |", "|---|---|---|---|---|---|"]
    for work, figures in log.items():
        if not isinstance(figures, dict) or work == "machine":
            continue
        for what, row in figures.items():
            cells = [
                "–" if row.get(key) is None else f"{row[key]:.4g}"
                for key in ("old", "new", "old_worst", "new_worst", "ratio")
            ]
            lines.append(f"| {work}: {what} | " + " | ".join(cells) + " |")
    text = (
        f"Medians of {log['runs']} runs in turn on one machine of {log['old_commit']}, the last commit before the methods, and of"
        " the newer commit. Live and replay changed for other reasons too ([live.md](live.md))."
    )
    return (
        "## Speed before and after the methods were added\n\n"
        + text
        + "\n\n"
        + "\n".join(lines)
        + "\n\n"
        + provenance({"cuda": [log]})
    )


def training(folder: Path) -> str:
    """Return the comparison of losses and renderers in training."""
    timed = [json.loads(line) for line in ALONE.read_text(encoding="utf-8").splitlines()]
    alone = {(name, variant): step_ms for name, variant, step_ms in timed}
    log = log_of("training", "cuda", folder) or log_of("training", "cpu", folder)
    if log is None:
        return ""
    lines = [
        "| recording | trained with | held out (dB) | neighbours' mean (dB) | depth RMS (%) | plane (%) | normals (°)"
        " | followed points (mm) | step (ms) | step alone (ms) | command (s) |",
        "|---" * 11 + "|",
    ]
    for name, variants in log.items():
        if not isinstance(variants, dict) or "alpha" not in variants:
            continue
        for variant, found in variants.items():
            numbers = [
                (found.get("heldout_db"), 1, 2), (found.get("neighbours_mean_db"), 1, 2),
                (found.get("depth_rmse_share"), 100, 3), (found.get("plane_rmse_share"), 100, 2),
                (found.get("normals_mean_deg"), 1, 2), (found.get("points_mean_mm"), 1, 3),
                (found.get("step_ms"), 1, 2), (alone.get((name, variant)), 1, 2), (found.get("wall_s"), 1, 0),
            ]  # fmt: skip
            cells = ["–" if value is None else f"{value * scale:.{digits}f}" for value, scale, digits in numbers]
            lines.append(f"| {name} | {variant} | " + " | ".join(cells) + " |")
    text = (
        f"`intrasplat reconstruct` with {log['steps']} steps, {log['together']} runs at a time. The synthetic recordings"
        " have exact depth. Depth and followed points of weighted sums are not evaluated: they have no depth along a ray. Other"
        " benchmarks shared the GPU with these runs and with the times of their steps; the steps alone were timed afterwards"
        f" until the loan ended ([log](../{ALONE.relative_to(FOLDER.parents[1])}))."
    )
    return "## Training\n\n" + text + "\n\n" + "\n".join(lines) + "\n\n" + provenance({"run": [log]})


def methods_text(folder: Path = FOLDER) -> str:
    """Return the text of results/methods.md."""
    head = (
        "# Splatting methods\n\nGenerated by `python benchmarks/publish.py` from [logs/methods](../logs/methods); do not"
        " edit. [docs/methods.md](../../docs/methods.md) says what each method is for. Figures are single runs, or where stated the median"
        " of several with the smallest and the largest. The default weights of"
        " the losses ray_depth, normal_consistency, flow, triangulation and range were chosen on the synthetic scenes that"
        " these tables evaluate, so their figures may be too favourable for other scenes."
    )
    parts = [head, *(section(method, folder) for method in METHODS), speed(folder), training(folder), unchanged(folder)]
    return "\n\n".join(part for part in parts if part) + "\n"
