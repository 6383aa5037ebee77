"""`report.html` is self-contained, complete and escaped."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from services.reports.figures import keyframe_pictures
from services.reports.html import _quality_over_age, render_html, write_html


class Page(HTMLParser):
    """HTML parser that collects elements and checks that they nest."""

    VOID = frozenset({"meta", "img", "br", "line", "circle", "polyline"})

    def __init__(self, text):
        super().__init__()
        self.elements, self.open = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        if tag in self.VOID:
            return
        assert self.open.pop() == tag, tag

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture
def text(report, scored) -> str:
    return render_html(report, [keyframe_pictures(scored)], worst_seq=1)


def test_report_html_loads_nothing(text):
    page = Page(text)
    for tag, attributes in page.elements:
        assert tag not in ("script", "link", "iframe", "object", "embed", "base", "form", "video", "audio"), tag
        for name in ("src", "href", "srcset", "poster", "action", "data"):
            if name in attributes:
                assert attributes[name].startswith("data:image/"), attributes[name][:60]
        assert not any(name.startswith("on") for name in attributes)
    assert not re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}", re.sub(r"data:image/[^\"]+", "", text))
    assert "@import" not in text and "url(" not in text
    (policy,) = [m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in policy


def test_report_html_has_four_pictures_with_alt_text(text):
    pictures = Page(text).all("img")
    assert [p["alt"] for p in pictures] == [f"frame 1, {name}" for name in ("raw", "reconstruction", "error", "depth")]
    assert all(p["src"].startswith("data:image/jpeg;base64,") for p in pictures)


def test_report_html_contains_notice_scores_and_labels(text):
    assert text.count("Research use only, not a medical device.") >= 2
    for value in ("38.50", "37.25", "+1.25 dB", "33.00", "24.50", "1,200", "lowest PSNR", "held out", "22.5", "1.25"):
        assert value in text, value
    page = Page(text)
    assert page.all("html")[0]["lang"] == "en"
    assert all("aria-label" in svg for svg in page.all("svg")) and len(page.all("svg")) == 2
    assert "prefers-color-scheme: dark" in text


def test_heldout_frames_with_both_neighbours_have_own_row(report, text):
    assert "with both neighbours" not in text
    quality = report.quality.model_dump() | {"heldout_between": {"psnr_tissue_db": 26.125, "frames": 2}}
    quality["heldout"]["frames"] = 3
    changed = report.model_validate(report.model_dump() | {"quality": quality})
    rows = re.sub(r"<[^>]*>", "|", render_html(changed, []))
    assert re.search(r"IntraSplat, held-out frames with both neighbours, 2 frames\|+26\.12", rows)
    assert re.search(
        r"Held-out frames with both neighbours: mean of both neighbours \(sees the future\)\|+24\.50", rows
    )


def test_report_html_notes_binned_series(report, text):
    binned = report.model_copy(update={"series_frames_per_entry": 12})
    assert "Each point is the mean of 12 frames." in render_html(binned, [])
    assert "Each point is the mean" not in text


def test_report_html_of_endless_stream(report):
    recording = report.recording.model_copy(update={"frames": None})
    run = report.run.model_copy(update={"stop_reason": "end of stream"})
    text = render_html(report.model_copy(update={"recording": recording, "run": run}), [])
    assert "a stream without an end, 24 x 16 px" in text and 'role="alert"' not in text


def test_report_html_escapes_names_and_notes(text):
    assert "take &lt;7&gt;" in text and "take <7>" not in text
    assert "no &lt;mask&gt;" in text


def test_report_html_shows_alert_if_interrupted(report):
    run = report.run.model_copy(update={"stop_reason": "interrupted", "interrupted": True})
    text = render_html(report.model_copy(update={"run": run}), [])
    assert 'role="alert"' in text and "interrupted" in text


def test_report_html_counts_damaged_frames_only_if_any(report, text):
    assert "damaged" not in text
    frames = report.frames.model_copy(update={"damaged": 3})
    assert "0 dropped, 3 damaged" in render_html(report.model_copy(update={"frames": frames}), [])


def test_report_html_of_empty_run_is_valid(report):
    content = report.model_dump() | {
        "latency_ms": {},
        "latency_quantiles_ms": {},
        "operators": {},
        "series": [],
        "model": None,
        "quality": {"live": None, "heldout": None, "baselines": {"previous_frame_db": None}},
    }
    Page(render_html(type(report).model_validate(content), []))


def test_write_html_leaves_only_complete_file(tmp_path, report, scored):
    write_html(report, [keyframe_pictures(scored)], tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().endswith("</html>\n")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_report_html_places_dots_proportionally_to_scores(text):
    """The scale extends one decibel below the lowest and above the highest score."""
    rows = re.findall(r'<td class="n">([0-9.]+)</td><td class="track">.*?left:([0-9.-]+)%', text)
    values, places = ([float(row[part]) for row in rows] for part in (0, 1))
    low, high = min(values) - 1, max(values) + 1
    assert len(rows) >= 3 and low < high - 2
    assert places == pytest.approx([100 * (value - low) / (high - low) for value in values], abs=0.2)


def test_quality_over_age_chart_sorts_frames_by_age(report):
    ages = [40.0, 10.0, 30.0, 20.0]
    measured = [
        entry.model_copy(update={"age_ms": age, "psnr_tissue_db": 20 + age, "previous_frame_db": 5.0})
        for entry, age in zip(report.series, ages, strict=True)
    ]
    shown, before = _quality_over_age(report.model_copy(update={"series": measured})).lines
    assert list(shown.x) == list(before.x) == sorted(ages)
    assert list(shown.y) == [30.0, 40.0, 50.0, 60.0] and list(before.y) == [5.0] * 4
