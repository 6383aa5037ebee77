"""`evaluation.html` is self-contained, complete and escaped; `evaluation.json` round-trips."""

from __future__ import annotations

import re

import pytest
from pydantic import ValidationError

from services.cli.runs import evaluation_table
from services.reports.evaluation import EvaluationReport
from services.reports.evaluation_html import at_age, render_evaluation, table_section, write_evaluation_html


def score(tissue, **more):
    return {
        "psnr_tissue_db": tissue,
        "psnr_frame_db": tissue + 1,
        "ssim": 0.95,
        "frames": 7,
        "worst_db": tissue - 3,
        "worst_seq": 4,
        "left_out": {},
        **more,
    }


def baseline(name, frames_of, tissue, **more):
    return {
        "name": name,
        "label": f"label of {name}",
        "frames_of": frames_of,
        "psnr_tissue_db": tissue,
        "psnr_frame_db": tissue + 1,
        "frames": 6,
        **more,
    }


def copies():
    curve = {1: 37.0, 2: 33.0, 3: 31.0}
    return [
        baseline("previous_frame" if age == 1 else f"copy_{age}", "every", db, age_frames=age, psnr_both_db=db + 0.2)
        for age, db in curve.items()
    ]


def ages(scale=1.0):
    return {"count": 9, "p50_ms": 12 * scale, "p95_ms": 20 * scale, "p99_ms": 21 * scale, "max_ms": 25.5 * scale}


def entries(**more):
    return [
        {"seq": k, "time_s": k / 25, "trained": False, "model_version": 1, "psnr_tissue_db": 30.0 + k, **more}
        for k in range(5)
    ]


@pytest.fixture
def content():
    return {
        "recording": {"name": "take <7>", "frames": 8, "width_px": 24, "height_px": 16, "fps": 25.0, "digest": "ab" * 32},
        "evaluated": {
            "path": "runs/<b>", "command": "live", "model": {"gaussians": 1200, "parameters": 99, "sha256": "cd" * 32, "version": 4},
            "time_window_s": [0.0, 0.28], "scale": 1.0, "device": "cpu", "renderer": "alpha", "version": "1.2.3",
            "started_at": "2026-01-02T03:04:05+00:00", "wall_s": 2.5, "interrupted": False, "machine": {"Processor": "abacus"},
        },
        "heldout": {
            "score": score(38.5, left_out={"damaged": 2}), "unrounded_db": 38.52,
            "depth": {"mae_mm": 1.5, "rmse_mm": 2.5, "relative": 0.03, "scaled_rmse_mm": 1.25, "covered": 0.995, "frames": 7},
        },
        "causal": {"score": score(39.25), "field": "basis", "steps_per_frame": 40, "seed": 0, "motion_prior": "flow"},
        "live": {
            "score": score(42.5), "settled": score(43.5), "age_when_shown": ages(), "age_on_screen": ages(3),
            "in_time": 5, "behind": {0: 5, 1: 1, 8: 1}, "states": {"live": 8, "stale": 1},
        },
        "retention": {
            "last": score(36.5), "last_range_s": [0.0, 0.28],
            "places": [{"first_s": [0.0, 0.04], "again_s": [0.2, 0.28], "first": score(34.0), "again": score(35.0)}],
        },
        "returns": {"causal": [{"again_s": [0.2, 0.28], "first_db": [31.5, None, 33.5], "frames_until_found": 3}]},
        "baselines": [
            *copies(), baseline("half_velocity_flow", "every", 38.25), baseline("previous_frame", "heldout", 37.25),
            baseline("half_way_flow", "heldout", 41.75, sees_future=True), baseline("last_frame", "last", 20.5),
            baseline("previous_frame", "live", 37.0), baseline("previous_frame", "settled", 37.5),
        ],
        "left_out": {"withheld": 1},
        "notes": ["no <mask>"],
        "outputs": {},
        "series": {
            "baselines": entries(half_velocity_flow_db=31.0, previous_frame_db=30.0, half_way_flow_db=34.0),
            "causal": entries(), "heldout": entries(), "live": entries(age_ms=40.0, behind=0, previous_frame_db=29.0), "retention": entries(),
        },
        "series_frames_per_entry": {"causal": 12},
    }  # fmt: skip


@pytest.fixture
def report(content) -> EvaluationReport:
    return EvaluationReport.model_validate(content)


def test_evaluation_html_loads_nothing_and_escapes_text(report):
    text = render_evaluation(report)
    assert not re.findall(r"<(script|link|iframe|object|embed|base|form|video|img)\b", text)
    assert not re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}", text) and "default-src 'none'" in text
    for raw in ("take <7>", "no <mask>", "runs/<b>"):
        assert raw not in text
    assert "take &lt;7&gt;" in text and "no &lt;mask&gt;" in text


def test_evaluation_html_contains_protocols_and_baselines(report):
    text = render_evaluation(report)
    for said in (
        "42.50", "39.25", "38.50", "36.50", "+1.00 dB", "+5.50 dB", "+6.00 dB", "-3.25 dB", "+16.00 dB", "41.75", "(sees the future)", "37.00",
        "Held out: not scored 2 (damaged)", "Baselines: not scored 1 (withheld)", "1.500 mm", "99.5 %",
        "31.50, –, 33.50", "1 by 1, 1 by 8 or more", "Each point is the mean of 12 frames.", "40 steps a frame, basis field, motion prior flow", "43.50",
    ):  # fmt: skip
        assert said in text, said
    assert text.count("<svg") == 5 and text.count("Research use only, not a medical device.") >= 2


def test_evaluation_table_rows_have_expected_columns(report):
    lines = evaluation_table(report)
    assert lines[0].split() == ["frames", "tissue", "dB", "frame", "dB", "SSIM", "worst", "dB"]
    (causal,) = [line for line in lines if line.startswith("Causal")]
    assert causal.split()[-5:] == ["7", "39.25", "40.25", "0.9500", "36.25"]
    assert any(line.startswith("  label of half_way_flow (sees the future)") for line in lines)
    assert "1: 37.00, 2: 33.00, 3: 31.00" in lines[-2] and "p99 21.0" in lines[-1]


def test_evaluation_without_protocols_lists_baselines(content):
    bare = content | {"heldout": None, "causal": None, "live": None, "retention": None, "returns": {}, "series": {}}
    report = EvaluationReport.model_validate(bare)
    assert "label of half_way_flow" in render_evaluation(report) and any(
        "half_way_flow" in line for line in evaluation_table(report)
    )
    nothing = report.model_copy(update={"baselines": [], "left_out": {}, "notes": []})
    assert "<table" in render_evaluation(nothing) and len(evaluation_table(nothing)) == 1


def test_evaluation_html_shows_alert_if_interrupted(report):
    evaluated = report.evaluated.model_copy(update={"interrupted": True})
    assert 'role="alert"' in render_evaluation(report.model_copy(update={"evaluated": evaluated}))
    assert 'role="alert"' not in render_evaluation(report)


def test_at_age_interpolates_measured_ages_and_is_none_beyond(report):
    assert [at_age(report, age) for age in (0.0, 1.0, 1.5, 3.0, 3.1)] == [37.0, 37.0, 35.0, 31.0, None]
    assert at_age(report.model_copy(update={"baselines": []}), 1.0) is None


def test_evaluation_json_round_trips_and_rejects_unknown_and_nan(tmp_path, report, content):
    report.write(tmp_path / "evaluation.json")
    assert EvaluationReport.read(tmp_path / "evaluation.json") == report
    write_evaluation_html(report, tmp_path / "evaluation.html")
    assert (tmp_path / "evaluation.html").read_text().endswith("</html>\n")
    with pytest.raises(ValidationError):
        EvaluationReport.model_validate(content | {"unknown": 1})
    content["heldout"]["unrounded_db"] = float("nan")
    with pytest.raises(ValidationError):
        EvaluationReport.model_validate(content)


def test_table_section_places_dots_proportionally_to_scores(report):
    text = table_section(report)
    rows = [
        (float(cells[1]), float(left))
        for row in text.split("<tr")[2:]
        if len(cells := re.findall(r'<td class="n">([^<]*)</td>', row)) == 5
        for left in re.findall(r"left:([0-9.]+)%", row)
    ]
    values = [value for value, _ in rows]
    low, high = min(values) - 1, max(values) + 1
    assert len(rows) >= 3 and high > low + 2
    for value, left in rows:
        assert left == pytest.approx(100 * (value - low) / (high - low), abs=0.3)
    ends = re.findall(r"<span>(-?[0-9]+)</span>", text)[:2]
    assert [float(each) for each in ends] == pytest.approx([low, high], abs=0.51)
