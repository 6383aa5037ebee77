"""Sections of `report.html` that appear for live runs only."""

from __future__ import annotations

import pytest

from services.reports.html import AGE_GROUPS, live_section, render_html
from services.reports.schema import FrameEntry, Latency, LiveFacts, RunReport


@pytest.fixture
def live(report) -> RunReport:
    facts = LiveFacts(
        settled_psnr_tissue_db=43.21, worst_psnr_tissue_db=38.76, previous_frame_db=37.0, pictures=149, age_p50_ms=12.3, age_p95_ms=18.4,
        age_p99_ms=21.5, age_max_ms=66.6, first_picture_ms=222.0, states={"live": 1, "<lost>": 2}, dropped={"source -> reconstruct": 3},
        withheld={"blur": 4}, scenes={}, analysis={"gates": {"black": 5}}, frames_trained=150, steps=3000, rehearsed_steps=1234, unscored=0, not_on_screen=6,
    )  # fmt: skip
    series = [
        FrameEntry(
            seq=k, time_s=k / 25, trained=True, model_version=k + 1, psnr_tissue_db=45 - k / 10, psnr_frame_db=46.0, ssim=None,
            previous_frame_db=37.0, age_ms=10.0 + k, steps=20,
        )
        for k in range(40)
    ]  # fmt: skip
    return report.model_copy(update={"live": facts, "series": series})


def test_live_section_contains_ages_quality_and_counts(live):
    text = render_html(live, [])
    for said in ("43.21", "+6.21 dB", "38.76", "12.3", "p99 21.5, max 66.6 ms", "222", "source -&gt; reconstruct 3", "blur 4", "&lt;lost&gt; 2",
                 "black 5", "20.0 steps each", "1,234", "6 frames", "Quality over age", "Age over time", f"in {AGE_GROUPS} groups"):  # fmt: skip
        assert said in text, said
    assert "<lost>" not in text


def test_live_section_is_empty_for_replay_run(report):
    assert live_section(report) == "" and "Quality over age" not in render_html(report, [])


def test_live_section_omits_charts_without_enough_data(live):
    one = live.model_copy(update={"series": live.series[:1]})
    assert "Age over time" in live_section(one) and "Quality over age" not in live_section(one)
    bare = live.model_copy(update={"series": [entry.model_copy(update={"age_ms": None}) for entry in live.series]})
    assert "Age over time" not in live_section(bare)
    assert live.live is not None
    unknown = dict(
        settled_psnr_tissue_db=None, worst_psnr_tissue_db=None, previous_frame_db=None, first_picture_ms=None
    )
    assert "–" in live_section(live.model_copy(update={"live": live.live.model_copy(update=unknown)}))
    assert "Quality over age" in live_section(live.model_copy(update={"series": live.series[:3]}))


def test_latency_section_of_live_run_names_each_sink_once(live):
    ways = {
        "source,analysis,display,recorded": 239.0,
        "source,metrics,progress": 41.0,
        "source,display,metrics,progress": 318.0,
        "display,recorded": 0.7,
    }
    paths = {path: Latency(p50=p50, p95=p50, p99=p50, max=p50) for path, p50 in ways.items()}
    text = render_html(live.model_copy(update={"latency_ms": paths, "latency_quantiles_ms": {}}), [])
    latency = text[text.index("<h2>Latency</h2>") :]
    assert latency.count(">recorded<") == latency.count(">progress<") == 1
    assert "239.0" in latency and "318.0" in latency and "41.0" not in latency
    assert "Latency to display" not in text
