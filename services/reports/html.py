"""Self-contained page `report.html`; only the video is a separate file next to it. Each function renders one section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from urllib.parse import quote

from operators.storage import write_whole
from services.reports.figures import NARROW, Chart, HiddenPictures, KeyframePictures, Line
from services.reports.schema import DepthErrors, FrameEntry, LiveFacts, RunFacts, RunReport, TruthFacts


def _decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def tile(name: str, value: str, unit: str, more: str) -> str:
    """Return a tile with a figure, its name, its unit and HTML with more about it."""
    return f'<li><span class="name">{name}</span><b>{value}<span>{unit}</span></b><span class="more">{more}</span></li>'


def against(psnr_db: float | None, baseline_db: float | None) -> str:
    """Return HTML with the gain of a PSNR over the previous-frame baseline, and that baseline, in dB; "no baseline" if either
    is None.
    """
    if psnr_db is None or baseline_db is None:
        return "no baseline"
    gain = psnr_db - baseline_db
    kind = "good" if gain >= 0 else "bad"
    return f'<span class="{kind}">{gain:+.2f} dB</span> against the previous frame ({baseline_db:.2f} dB)'


def _quality_tiles(report: RunReport) -> list[str]:
    """Return the tiles of the run's main quality scores, each next to that of the previous frame."""
    quality, baselines = report.quality, report.quality.baselines
    tiles = []
    if (next_frame := quality.next_frame) is not None:
        value, previous_db = next_frame.psnr_tissue_db, next_frame.previous_frame_db
        more = f"{against(value, previous_db)}; before training on the frame"
        tiles.append(tile("Next frame, predicted", _decibels(value), "dB", more))
    if (heldout := quality.heldout) is not None:
        more = against(heldout.psnr_tissue_db, baselines.heldout_previous_frame_db)
        tiles.append(tile("Held-out frames", _decibels(heldout.psnr_tissue_db), "dB", more))
    # `tiles_section` adds the tile of a live run, whose score excludes the first second.
    if (live := quality.live) is not None and report.live is None:
        more = f"training error; {against(live.psnr_tissue_db, baselines.previous_frame_db)}"
        tiles.append(tile("Displayed frame", _decibels(live.psnr_tissue_db), "dB", more))
    return tiles


def tiles_section(report: RunReport) -> str:
    """Return the tiles with the main figures."""
    frames, wall = report.frames, report.run.wall_s
    rate = frames.displayed / wall if wall else 0.0
    damaged = f", {frames.damaged:,} damaged" if frames.damaged else ""
    tiles = [
        *_quality_tiles(report),
        tile(
            "Frames displayed",
            f"{frames.displayed:,}",
            f"of {frames.ingested:,}",
            f"{frames.dropped:,} dropped{damaged}",
        ),
    ]
    if report.latency_ms and report.live is None:  # a live run states the age of its pictures in place of the latency
        path = _display_path(report)
        latency = report.latency_ms[path]
        tiles.append(
            tile(
                "Latency to display",
                f"{latency.p50:,.0f}",
                "ms",
                f"p95 {latency.p95:,.0f} ms, max {latency.max:,.0f} ms",
            )
        )
    tiles.append(tile("Run time", f"{wall:,.1f}", "s", f"{rate:.2f} frames a second"))
    if report.model:
        tiles.append(
            tile(
                "Gaussians",
                f"{report.model.gaussians:,}",
                "",
                f"{report.model.parameters:,} parameters, {escape(report.run.field)} field",
            )
        )
    return f'<ul class="tiles">{"".join(tiles)}</ul>'


def _display_path(report: RunReport) -> str:
    """Return the name of the graph path that ends at the video sink, or the first path without a video."""
    return next((path for path in report.latency_ms if path.endswith("video")), next(iter(report.latency_ms)))


def pictures_section(keyframes: Sequence[KeyframePictures], worst_seq: int | None, report: RunReport) -> str:
    """Return the table with raw picture, reconstruction, error and depth of each key frame; empty without any."""
    if not keyframes:
        return ""
    cells = ["".join(f'<div class="head">{name}</div>' for name in ("Raw", "Reconstruction", "Error", "Depth"))]
    for pictures in keyframes:
        rendered, quality = pictures.scored.rendered, pictures.scored.quality
        seq = rendered.frame.seq
        tags = "" if rendered.trained else '<span class="tag held">not trained on</span>'
        if seq == worst_seq:
            tags += '<span class="tag worst">lowest PSNR</span>'
        near_far = pictures.depth_range
        # Without recorded depth the scale is unknown: the model's depth is relative, not in millimetres.
        unit = " mm" if rendered.frame.depth_is_metric else ", scale not known"
        depth = f"depth {near_far[0]:.1f} to {near_far[1]:.1f}{unit}" if near_far else "no depth"
        cells.append(
            f'<div class="row"><b>Frame {seq}</b><span>{rendered.frame.time_s:.2f} s</span><span>model {rendered.model_version}</span>'
            f"<span>{_finite(quality.psnr_tissue_db)} dB tissue{_kind(rendered.trained)}</span>"
            f"<span>previous frame {_finite(pictures.scored.previous_frame_db)} dB</span><span>SSIM {_finite(quality.ssim, 4)}</span><span>{depth}</span>{tags}</div>"
        )
        for name, uri in (
            ("raw", pictures.raw),
            ("reconstruction", pictures.reconstruction),
            ("error", pictures.error),
            ("depth", pictures.depth),
        ):
            cells.append(f'<img src="{uri}" alt="frame {seq}, {name}" loading="lazy">')
    return (
        "<section><h2>Frames</h2>"
        '<p class="lead">Dark grey areas with a light outline are remembered tissue, shown as last seen: behind a tool or outside '
        "of the field of view. "
        'Error <span class="scale inferno"></span> from 0 to 32 grey levels or more; '
        'depth <span class="scale viridis"></span> from near to far; grey marks tools, which are not scored, and unknown depth.</p>'
        f'<div class="frames">{"".join(cells)}</div></section>'
    )


def _kind(trained: bool) -> str:
    return " (training error)" if trained else ""


def _finite(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if value == value else "–"


def quality_over_time_section(report: RunReport) -> str:
    """Return the chart of tissue PSNR per frame, with the previous-frame baseline; empty without a series."""
    trained = [entry for entry in report.series if entry.trained]
    held_out = [entry for entry in report.series if not entry.trained]
    if not report.series:
        return ""
    lines = []
    if trained:
        shown = "training frames" if report.quality.live is None else "displayed frame"
        name = f"Reconstruction, {shown} (training error)"
        lines.append(Line(name, [e.time_s for e in trained], [e.psnr_tissue_db for e in trained], "main"))
    predicted = [entry for entry in report.series if entry.next_frame_db is not None]
    if predicted:
        name = "Next frame, predicted before training on it"
        lines.append(
            Line(
                name,
                [e.time_s for e in predicted],
                [e.next_frame_db for e in predicted],
                "third",
                marks=_is_sampled(report),
            )
        )
    lines.append(
        Line(
            "Previous frame shown instead",
            [e.time_s for e in report.series],
            [e.previous_frame_db for e in report.series],
            "base",
        )
    )
    if held_out:
        lines.append(
            Line(
                "Reconstruction, held-out frames",
                [e.time_s for e in held_out],
                [e.psnr_tissue_db for e in held_out],
                "second",
                marks=True,
            )
        )
    summed_up = (
        f" Each point is the mean of {report.series_frames_per_entry} frames."
        if report.series_frames_per_entry > 1
        else ""
    )
    chart = Chart(
        title="Tissue PSNR over time",
        description="Higher is better. A reconstruction under the dashed line shows less than a frozen video would."
        + summed_up,
        x_label="time in the recording, s",
        y_label="tissue PSNR, dB",
        lines=tuple(lines),
        x_unit=" s",
        y_unit=" dB",
    )
    return f"<section><h2>Quality over time</h2>{chart.figure()}</section>"


def _is_sampled(report: RunReport) -> bool:
    """Return True for a live run, in which only some frames are predicted: their scores are drawn as points without a line."""
    return report.live is not None


def baselines_section(report: RunReport) -> str:
    """Return the table of the reconstruction's scores and the trivial baselines."""
    quality, baselines = report.quality, report.quality.baselines
    rows: list[tuple[str, float | None, bool]] = []
    if quality.live is not None:
        rows += [
            (
                f"IntraSplat, displayed frame (training error), {quality.live.frames} frames",
                quality.live.psnr_tissue_db,
                True,
            ),
            ("Previous frame shown instead", baselines.previous_frame_db, False),
        ]
    if (next_frame := quality.next_frame) is not None:
        name = f"IntraSplat, next frame predicted before training on it, {next_frame.frames} frames"
        rows += [
            (name, next_frame.psnr_tissue_db, True),
            ("Those frames: previous frame shown instead", next_frame.previous_frame_db, False),
        ]
    if quality.training is not None:
        rows.append(
            (
                f"IntraSplat, training frames (training error), {quality.training.frames} frames",
                quality.training.psnr_tissue_db,
                True,
            )
        )
    if quality.heldout is not None:
        rows.append((f"IntraSplat, held out, {quality.heldout.frames} frames", quality.heldout.psnr_tissue_db, True))
    rows.append(("Held-out frames: previous frame", baselines.heldout_previous_frame_db, False))
    between, both = quality.heldout_between, "Held-out frames"
    if between is not None and quality.heldout is not None and between.frames < quality.heldout.frames:
        both = "Held-out frames with both neighbours"
        rows.append((f"IntraSplat, {both[0].lower()}{both[1:]}, {between.frames} frames", between.psnr_tissue_db, True))
    rows.append((f"{both}: mean of both neighbours (sees the future)", baselines.heldout_neighbour_mean_db, False))
    known = [value for _, value, _ in rows if value is not None]
    low, high = (min(known) - 1, max(known) + 1) if known else (0.0, 1.0)
    body = ""
    for name, value, ours in rows:
        if value is None:
            continue
        share = 100 * (value - low) / (high - low)
        body += (
            f'<tr{" class=ours" if ours else ""}><th scope="row">{escape(name)}</th><td class="n">{value:.2f}</td>'
            f'<td class="track"><span class="rail"><span class="dot" style="left:{share:.1f}%"></span></span></td></tr>'
        )
    extra = ""
    for name, part in (
        ("Displayed frame (training error)", quality.live),
        ("Held out", quality.heldout),
        ("Training frames (training error)", quality.training),
    ):
        if part is not None:
            ssim = "–" if part.ssim is None else f"{part.ssim:.4f}"
            extra += f"{name}: whole-frame PSNR {_decibels(part.psnr_frame_db)} dB, SSIM {ssim}. "
    return (
        '<section><h2>Against doing nothing</h2><p class="lead">Tissue PSNR in dB, mean over frames.</p>'
        f'<table><thead><tr><th scope="col">What is shown</th><th scope="col" class="n">dB</th><th scope="col" class="ends"><span>{low:.0f}</span><span>{high:.0f}</span></th></tr></thead>'
        f'<tbody>{body}</tbody></table><p class="note">{extra}</p></section>'
    )


def _longest_paths(report: RunReport) -> dict[str, str]:
    """Return the longest path from the source to each leaf operator; `report.json` has all paths."""
    longest: dict[str, str] = {}
    for path in report.latency_ms:
        end = path.rsplit(",", 1)[-1]
        if path.startswith("source,") and path.count(",") > longest.get(end, "").count(","):
            longest[end] = path
    return longest


def latency_section(report: RunReport) -> str:
    """Return the latency distribution from the source to each leaf operator; empty without measurements."""
    paths = _longest_paths(report)
    if not paths:
        return ""
    styles = ("main", "base", "second", "third")
    shares = [k / 100 for k in range(101)]
    lines = tuple(
        Line(end, values, shares, styles[k % len(styles)])
        for k, (end, path) in enumerate(paths.items())
        if len(values := report.latency_quantiles_ms.get(path, [])) == len(shares)
    )
    chart = Chart(
        title="Latency distribution",
        description="Share of frames whose latency, from the source to the end of each path, is below a time.",
        x_label="latency, ms (logarithmic)",
        y_label="share of frames",
        lines=lines,
        x_unit=" ms",
        y_range=(0.0, 1.0),
        x_log=True,
        width=NARROW,
    )
    rows = "".join(
        f'<tr><th scope="row">{escape(end)}</th><td class="n">{v.p50:,.1f}</td><td class="n">{v.p95:,.1f}</td><td class="n">{v.p99:,.1f}</td><td class="n">{v.max:,.1f}</td></tr>'
        for end, v in ((end, report.latency_ms[path]) for end, path in paths.items())
    )
    return (
        f"<section><h2>Latency</h2>{chart.figure() if lines else ''}"
        '<table><thead><tr><th scope="col">To</th><th scope="col" class="n">p50 ms</th><th scope="col" class="n">p95</th>'
        f'<th scope="col" class="n">p99</th><th scope="col" class="n">max</th></tr></thead><tbody>{rows}</tbody></table></section>'
    )


def operators_section(report: RunReport) -> str:
    """Return the table of operator run times; empty without any."""
    if not report.operators:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="n">{t.calls:,}</td><td class="n">{t.p50_ms:,.2f}</td><td class="n">{t.p99_ms:,.2f}</td></tr>'
        for name, t in report.operators.items()
    )
    return (
        '<section><h2>Operators</h2><table><thead><tr><th scope="col">Name</th><th scope="col" class="n">calls</th>'
        f'<th scope="col" class="n">p50 ms</th><th scope="col" class="n">p99 ms</th></tr></thead><tbody>{rows}</tbody></table></section>'
    )


def _steps(run: RunFacts) -> dict[str, str]:
    if run.training_steps is not None:
        return {"Training steps": f"{run.training_steps.steps} ({run.training_steps.reason})"}
    return {"Steps per frame": "default" if run.steps_per_frame is None else str(run.steps_per_frame)}


def facts_section(report: RunReport) -> str:
    """Return the facts about recording, settings, model and machine."""
    recording, run, model = report.recording, report.run, report.model
    length = "a stream without an end" if recording.frames is None else f"{recording.frames} frames"
    facts = {
        "Recording": f"{length}, {recording.width_px} x {recording.height_px} px, {recording.fps:g} fps",
        "Device, engine": f"{run.device}, {run.engine}",
        "Threads": str(run.threads),
        "Seed": str(run.seed),
        "Field, renderer": f"{run.field}, {run.renderer}",
        **_steps(run),
        "Eyes trained on": run.eyes,
        "Peak memory": "–" if run.peak_memory_bytes is None else f"{run.peak_memory_bytes / 2**30:.2f} GiB",
        "Ended by": run.stop_reason,
        **run.machine,
    }
    digests = {"Recording": recording.digest, "Model": model.sha256 if model else None, "Frames": report.frames_sha256}
    return facts_table("Run", facts, digests)


def facts_table(
    heading: str, facts: Mapping[str, str], digests: Mapping[str, str | None] = MappingProxyType({})
) -> str:
    """Return a section with a table of facts, and of the SHA-256 digests that are known."""
    rows = "".join(f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in facts.items())
    rows += "".join(
        f'<tr><th scope="row">{k} SHA-256</th><td><code>{v}</code></td></tr>' for k, v in digests.items() if v
    )
    return f'<section><h2>{heading}</h2><table class="facts"><tbody>{rows}</tbody></table></section>'


def notes_section(notes: Sequence[str]) -> str:
    """Return the section with the notes, which state fallbacks; empty without notes."""
    if not notes:
        return ""
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f'<section><h2>Notes</h2><ul class="notes">{items}</ul></section>'


def hidden_section(report: RunReport, pictures: HiddenPictures | None) -> str:
    """Return pictures of the last frame, and scores if the recording has ground truth; empty without both."""
    truth = report.quality.truth
    if pictures is None and truth is None:
        return ""
    return (
        "<section><h2>What the camera does not show</h2>"
        f"{'' if pictures is None else _row(pictures)}{'' if truth is None else _figures(truth)}</section>"
    )


def _row(pictures: HiddenPictures) -> str:
    names = ("Raw", "Tissue behind the tool", "Depth", "From the side")
    uris = (pictures.raw, pictures.behind, pictures.depth, pictures.aside)
    heads = "".join(f'<div class="head">{name}</div>' for name in names)
    images = "".join(
        f'<img src="{uri}" alt="frame {pictures.seq}, {name.lower()}">' for name, uri in zip(names, uris, strict=True)
    )
    return (
        f'<p class="lead">Frame {pictures.seq} at {pictures.time_s:.2f} s. Tissue behind tools and outside of the view is shown as it was seen last;'
        " where the model has nothing it is grey. From the side: the same time, from 16 degrees to the side.</p>"
        f'<div class="frames">{heads}{images}</div>'
    )


def _figures(truth: TruthFacts) -> str:
    tables = ""
    if truth.behind_tools_psnr_db is not None:
        tables += _table(
            f"Behind tools, PSNR of {truth.frames} frames",
            ("IntraSplat", _hidden_decibels(truth.behind_tools_psnr_db)),
            ("Each pixel as it was seen last", _hidden_decibels(truth.last_seen_psnr_db)),
            ("Filled in from around the tool", _hidden_decibels(truth.inpainted_psnr_db)),
        )
    for name, errors in (("Depth that is seen", truth.depth), ("Depth behind tools", truth.depth_behind_tools)):
        tables += "" if errors is None else _depth(name, errors)
    return (
        '<p class="lead">Compared with the ground truth of a synthetic recording, which training does not use. Both planes are fitted to it.</p>'
        f'<div class="three">{tables}</div>'
    )


def _depth(name: str, errors: DepthErrors) -> str:
    return _table(
        f"{name}, RMS error of {errors.frames} frames",
        ("IntraSplat", _percent(errors.reconstruction)),
        ("Best level plane", _percent(errors.level_plane)),
        ("Best tilted plane", _percent(errors.best_plane)),
    )


def _table(name: str, own: tuple[str, str], *baselines: tuple[str, str]) -> str:
    """Return a table of the reconstruction's score and its baselines."""
    rows = "".join(
        f'<tr{" class=ours" if row is own else ""}><th scope="row">{row[0]}</th><td class="n">{row[1]}</td></tr>'
        for row in (own, *baselines)
    )
    return f'<table><thead><tr><th scope="col" colspan="2">{name}</th></tr></thead><tbody>{rows}</tbody></table>'


def _hidden_decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} dB"


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"


AGE_GROUPS = 12
"""Points of the quality-over-age curve; each groups equally many frames."""


def live_section(report: RunReport) -> str:
    """Return ages, quality over age, states and counts; empty for runs without a clock."""
    live = report.live
    if live is None:
        return ""
    charts = "".join(
        f"<section><h2>{chart.title}</h2>{chart.figure()}</section>"
        for chart in (_ages_over_time(report), _quality_over_age(report))
        if chart is not None
    )
    return f'{_tiles(live)}<div class="two">{charts}</div>{_counts(live)}'


def _tiles(live: LiveFacts) -> str:
    versus = against(live.settled_psnr_tissue_db, live.previous_frame_db)
    first = "–" if live.first_picture_ms is None else f"{live.first_picture_ms:,.0f}"
    tiles = (
        (
            "Displayed frame, after the first second",
            _decibels(live.settled_psnr_tissue_db),
            "dB",
            f"training error; {versus}",
        ),
        ("Worst frame since then", _decibels(live.worst_psnr_tissue_db), "dB", "training error"),
        (
            "Age of what is shown",
            f"{live.age_p50_ms:,.1f}",
            "ms",
            f"p99 {live.age_p99_ms:,.1f}, max {live.age_max_ms:,.1f} ms",
        ),
        ("First picture", first, "ms", "after the first frame"),
    )
    items = "".join(
        f'<li><span class="name">{name}</span><b>{value}<span>{unit}</span></b><span class="more">{more}</span></li>'
        for name, value, unit, more in tiles
    )
    return f'<ul class="tiles">{items}</ul>'


def _ages_over_time(report: RunReport) -> Chart | None:
    entries = [entry for entry in report.series if entry.age_ms is not None]
    if not entries:
        return None
    times, interval_ms = [entry.time_s for entry in entries], 1000 / report.recording.fps
    lines = (
        Line("Age when shown", times, [entry.age_ms for entry in entries], "main"),
        Line("Time between two frames", [times[0], times[-1]], [interval_ms, interval_ms], "base"),
    )
    return Chart(
        title="Age over time",
        description="From a frame's arrival to its picture. Above the broken line a picture comes after the next frame."
        + _summed_up(report),
        x_label="time in the recording, s",
        y_label="age, ms",
        lines=lines,
        x_unit=" s",
        y_unit=" ms",
        width=NARROW,
    )


def _quality_over_age(report: RunReport) -> Chart | None:
    entries = [entry for entry in report.series if entry.age_ms is not None and entry.psnr_tissue_db is not None]
    if len(entries) < 2:
        return None
    groups = _by_age(entries)
    ages = [fmean(entry.age_ms or 0.0 for entry in group) for group in groups]
    lines = (
        Line(
            "On the screen when the next frame came (training error)",
            ages,
            [_mean(group, "psnr_tissue_db") for group in groups],
            "main",
        ),
        Line("Previous frame shown instead", ages, [_mean(group, "previous_frame_db") for group in groups], "base"),
    )
    return Chart(
        title="Quality over age",
        description=f"Tissue PSNR of frames in {len(groups)} groups of like age. Older pictures show less of what is there now.",
        x_label="age when shown, ms",
        y_label="tissue PSNR, dB",
        lines=lines,
        x_unit=" ms",
        y_unit=" dB",
        width=NARROW,
    )


def _by_age(entries: list[FrameEntry]) -> list[list[FrameEntry]]:
    """Sort frames by the age of their picture and split them into groups of about equal size, youngest first."""
    ordered = sorted(entries, key=lambda entry: entry.age_ms or 0.0)
    count = min(AGE_GROUPS, len(ordered))
    edges = [round(k * len(ordered) / count) for k in range(count + 1)]
    return [ordered[low:high] for low, high in pairwise(edges)]


def _mean(entries: list[FrameEntry], name: str) -> float | None:
    values = [value for entry in entries if (value := getattr(entry, name)) is not None]
    return fmean(values) if values else None


def _counts(live: LiveFacts) -> str:
    per_frame = live.steps / live.frames_trained if live.frames_trained else 0.0
    ages = f"p50 {live.age_p50_ms:,.1f}, p95 {live.age_p95_ms:,.1f}, p99 {live.age_p99_ms:,.1f}, max {live.age_max_ms:,.1f} ms"
    later = {
        "p99 after the first second": live.settled_age_p99_ms,
        "p99 after it, of used frames (not withheld or damaged)": live.used_age_p99_ms,
    }
    ages += "".join(f", {name} {value:,.1f} ms" for name, value in later.items() if value is not None)
    facts = {
        "Age when shown": f"{ages}, {live.pictures:,} pictures",
        "Frames trained on": f"{live.frames_trained:,}, {per_frame:.1f} steps each before they were shown",
        "Steps on earlier frames": f"{live.rehearsed_steps:,}",
        "Not on the screen in time": f"{live.not_on_screen:,} frames",
        "States, entered": _listed(live.states),
        "Passed over": _listed(live.dropped),
        "Withheld": _listed(live.withheld),
        "New scenes": _listed(live.scenes),
        **{f"Found by {stage}": _listed(found) for stage, found in live.analysis.items()},
        "Too fast to be scored": f"{live.unscored:,} frames",
    }
    rows = "".join(f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in facts.items())
    return f'<section><h2>Live</h2><table class="facts"><tbody>{rows}</tbody></table></section>'


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in counts.items()) or "none"


def _summed_up(report: RunReport) -> str:
    per_entry = report.series_frames_per_entry
    return f" Each point is the first of {per_entry} frames." if per_entry > 1 else ""


def video_section(report: RunReport) -> str:
    """Return a video player; empty if the run wrote no video."""
    name = report.outputs.get("video")
    if name is None:
        return ""
    return (
        '<section><h2>Video</h2><p class="lead">Raw frame and reconstruction side by side, with frame number and model version.</p>'
        f'<video controls muted loop playsinline preload="auto"><source src="{escape(quote(name))}" type="video/mp4">'
        f"This browser plays no video; open <code>{escape(name)}</code>.</video></section>"
    )


# Content security policy: only the video next to the page may be loaded.
POLICY = "default-src 'none'; img-src data:; media-src 'self'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


def write_html(
    report: RunReport,
    keyframes: Sequence[KeyframePictures],
    path: Path,
    worst_seq: int | None = None,
    hidden: HiddenPictures | None = None,
) -> None:
    """Write the page atomically."""
    write_whole(path, render_html(report, keyframes, worst_seq, hidden).encode())


def render_html(
    report: RunReport,
    keyframes: Sequence[KeyframePictures],
    worst_seq: int | None = None,
    hidden: HiddenPictures | None = None,
) -> str:
    """Render the page: inline style and SVG, pictures as `data:` URIs, no script, no external resources."""
    recording, run = report.recording, report.run
    sections = [
        tiles_section(report),
        live_section(report),
        hidden_section(report, hidden),
        video_section(report),
        pictures_section(keyframes, worst_seq, report),
        quality_over_time_section(report),
        f'<div class="two">{baselines_section(report)}{latency_section(report)}</div>',
        f'<div class="two">{operators_section(report)}{facts_section(report)}</div>',
        notes_section(report.notes),
    ]
    ended = (
        f'<p class="notice ended" role="alert">This run did not reach the end of the recording: {escape(run.stop_reason)}. '
        "All figures cover the frames that were displayed.</p>"
        if run.stop_reason not in ("end of recording", "end of stream", "end of the time asked for")
        else ""
    )
    return page(recording.name, run.command, run.started_at, run.version, report.notice, ended, sections, "report.json")


def page(
    name: str,
    kind: str,
    started_at: str,
    version: str,
    notice: str,
    ended: str,
    sections: Sequence[str],
    data: str,
) -> str:
    """Return a self-contained HTML page.

    Args:
        name: name of the recording, the heading.
        kind: command that made the page, in the title.
        started_at: start of the run, ISO 8601 in UTC.
        version: version of IntraSplat.
        notice: notice shown above the sections and in the footer.
        ended: HTML about an early end of the run, or an empty string.
        sections: HTML of the sections.
        data: name of the file with the same figures.
    """
    name, when, notice = escape(name), escape(started_at), escape(notice)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<title>{name} - IntraSplat {kind}</title>
<style>{style()}</style>
</head>
<body>
<main>
<header><h1>{name}<small>IntraSplat {kind}</small></h1>
<div class="when"><time datetime="{when}">{when.replace("T", " ").replace("+00:00", " UTC")}</time></div></header>
<p class="notice" role="note">{notice}</p>{ended}
{"".join(sections)}
<footer>Written by IntraSplat {escape(version)}. The same figures for programs: <code>{data}</code>. {notice}</footer>
</main>
</body>
</html>
"""


@cache
def style() -> str:
    """Return the style sheet of all pages."""
    return files("services.reports").joinpath("style.css").read_text(encoding="utf-8")
