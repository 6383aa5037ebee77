"""The PSNR of a trained frame is labelled as training error everywhere and has a baseline."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operators.messages import PictureState, ShownPicture
from operators.metrics import NextFrameResult
from services.cli.runs import LiveStatus, _summary, print_report
from services.reports.build import _next_frame
from services.reports.figures import keyframe_pictures
from services.reports.html import render_html
from services.reports.schema import LiveFacts, NextFrameQuality, RunReport
from services.supervisor.screen import Screen


@pytest.fixture
def predicted(report) -> RunReport:
    """The report of a run with predictions."""
    measured = NextFrameQuality(psnr_tissue_db=36.12, previous_frame_db=35.9, frames=3)
    series = [
        entry.model_copy(update={"next_frame_db": None if k == 0 else 35.5}) for k, entry in enumerate(report.series)
    ]
    quality = report.quality.model_copy(update={"next_frame": measured})
    return report.model_copy(update={"quality": quality, "series": series})


def text_of(page: str) -> str:
    """Return the text of a page, one line per block element."""
    page = re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
    return re.sub(r"<[^>]+>", " ", re.sub(r"</(?:li|tr|p|h2|figcaption|div)>", "\n", page))


@pytest.mark.parametrize("figure", ["38.50"])
def test_report_html_labels_training_error_everywhere(predicted, scored, figure):
    lines = [
        line for line in text_of(render_html(predicted, [keyframe_pictures(scored)])).splitlines() if figure in line
    ]
    assert len(lines) >= 2, "tile and table"
    assert all("training error" in line.lower() for line in lines), lines


def test_report_html_shows_next_frame_prediction_with_baseline(predicted):
    page = text_of(render_html(predicted, []))
    tile = next(line for line in page.splitlines() if "Next frame, predicted" in line)
    assert "36.12" in tile and "+0.22 dB" in tile and "35.90" in tile and "before training on the frame" in tile
    table = page[page.index("Against doing nothing") :]
    assert re.search(r"next frame predicted before training on it, 3 frames\s+36\.12", table)
    assert re.search(r"Those frames: previous frame shown instead\s+35\.90", table)
    assert 'class="line third"' in render_html(predicted, [])


def test_report_html_without_predictions_omits_next_frame(report):
    page = render_html(report, [])
    assert "Next frame" not in page and "next frame predicted" not in page


def test_report_pictures_label_training_error_and_baseline(report, scored):
    shown = lambda trained: text_of(
        render_html(report, [keyframe_pictures(replace(scored, rendered=replace(scored.rendered, trained=trained)))])
    )
    assert re.search(r"33\.00 dB tissue \(training error\)\s+previous frame 36\.00 dB", shown(True))
    assert re.search(r"33\.00 dB tissue\s+previous frame 36\.00 dB", shown(False))


def test_print_report_labels_figures_and_prints_baselines(predicted, tmp_path, capsys):
    print_report(predicted, tmp_path, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert "tissue PSNR, displayed frame (training error): 38.50 dB (previous frame shown instead: 37.25 dB)" in lines
    assert (
        "tissue PSNR, held-out frames: 33.00 dB (previous frame shown instead: 36.00 dB; mean of both neighbours: 24.50 dB)"
        in lines
    )
    assert (
        "tissue PSNR, next frame, predicted before training on it: 36.12 dB (previous frame shown instead: 35.90 dB)"
        in lines
    )


def test_live_summary_labels_figures_and_prints_baselines(predicted):
    facts = LiveFacts(
        settled_psnr_tissue_db=43.21, worst_psnr_tissue_db=38.76, previous_frame_db=37.0, pictures=149, age_p50_ms=12.3,
        age_p95_ms=18.4, age_p99_ms=21.5, age_max_ms=66.6, first_picture_ms=222.0, states={}, dropped={}, withheld={}, scenes={},
        frames_trained=150, steps=3000, rehearsed_steps=0, unscored=0, not_on_screen=0,
    )  # fmt: skip
    lines = _summary(predicted, facts).splitlines()
    assert "tissue PSNR, displayed frame (training error): 43.21 dB (previous frame shown instead: 37.00 dB)" in lines
    assert "tissue PSNR, worst displayed frame (training error): 38.76 dB" in lines
    assert any(
        line.endswith("before training on it: 36.12 dB (previous frame shown instead: 35.90 dB)") for line in lines
    )
    page = text_of(render_html(predicted.model_copy(update={"live": facts}), []))
    for figure in ("43.21", "38.76"):
        assert all("training error" in line for line in page.splitlines() if figure in line), figure


@pytest.mark.parametrize(("previous_db", "text"), [(36.0, "36.00 dB"), (np.nan, "    - dB")])
def test_live_status_line_labels_training_error_with_baseline(scored, capsys, previous_db, text):
    graph = SimpleNamespace(
        display=SimpleNamespace(pictures=3, state=PictureState.LIVE, age_p50_ms=12.0),
        reconstruct=SimpleNamespace(newest_gaussians=99),
    )
    with LiveStatus() as status:
        status(graph, replace(scored, previous_frame_db=previous_db))
    assert f"training error 33.00 dB (previous frame {text})" in capsys.readouterr().err


def test_next_frame_quality_is_none_without_frames():
    assert _next_frame(None) is None and _next_frame(NextFrameResult(None, None, 0)) is None
    assert _next_frame(NextFrameResult(36.0, 35.0, 2)) == NextFrameQuality(
        psnr_tissue_db=36.0, previous_frame_db=35.0, frames=2
    )


def test_screen_headers_contain_scores_of_newest_scored_frame(scored):
    from dataclasses import replace

    headers = []
    screen = Screen(SimpleNamespace(publish=lambda header, image: headers.append(header)))
    picture = ShownPicture(scored.rendered, scored.rendered.image, PictureState.LIVE, 5_000_000, 1, True)
    screen.show(picture)
    screen.scored(replace(scored, next_frame_db=34.5))
    screen.show(picture)
    screen.scored(replace(scored, previous_frame_db=np.nan))
    screen.show(picture)
    figures = [[header[name] for name in ("psnr_db", "previous_frame_db", "next_frame_db")] for header in headers]
    assert figures == [[None, None, None], [33.0, 36.0, 34.5], [33.0, None, 34.5]]
