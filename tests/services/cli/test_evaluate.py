"""The --place option, and the table of an evaluation."""

from __future__ import annotations

from types import SimpleNamespace as Facts
from typing import Any

import pytest

from gsplat_core.errors import InvalidSetting
from services.cli import runs


def test_place_option_parses_two_stays() -> None:
    visits = runs._place("0:2,60:62.5")
    assert visits == runs.Visits((0.0, 2.0), (60.0, 62.5))


@pytest.mark.parametrize(
    "text", ["", "0:2", "0:2,60", "0,2:60", "0:2:3,60:62", "0:2,60:nan", "inf:2,3:4", "0:2,3:4,5:6", "a:b,c:d"]
)
def test_place_option_rejects_malformed_text(text: str) -> None:
    with pytest.raises(InvalidSetting, match="give two stays in seconds"):
        runs._place(text)


def score(psnr_db: float, ssim: float | None = 0.9) -> Any:
    return Facts(psnr_tissue_db=psnr_db, psnr_frame_db=psnr_db - 1, worst_db=psnr_db - 5, ssim=ssim, frames=12)


def baseline(name: str, age: int | None = None) -> Any:
    return Facts(
        name=name, label=name, frames_of="every", frames=11, psnr_tissue_db=20.0, psnr_frame_db=None,
        sees_future=name == "future", age_frames=age,
    )  # fmt: skip


def report(**facts: Any) -> Any:
    nothing = {"live": None, "causal": None, "heldout": None, "second_eye": None, "retention": None, "baselines": []}
    return Facts(**(nothing | facts))


def test_evaluation_table_lists_protocols_then_baselines() -> None:
    lines = runs.evaluation_table(report(causal=Facts(score=score(30.0)), baselines=[baseline("previous_frame", 1)]))
    assert [line.split() for line in lines[:1]] == [["frames", "tissue", "dB", "frame", "dB", "SSIM", "worst", "dB"]]
    assert lines[1].startswith("Causal: ") and lines[1].split()[-5:] == ["12", "30.00", "29.00", "0.9000", "25.00"]
    assert lines[2].startswith("  previous_frame ") and lines[2].split()[1:] == ["11", "20.00", "–"]
    assert lines[3] == "a raw frame shown k frames late scores, in tissue dB: 1: 20.00"
    assert len(lines) == 4
    ends = [line.index("30.00") + 5 for line in lines[1:2]] + [line.index("20.00") + 5 for line in lines[2:3]]
    assert ends == [lines[0].index("tissue dB") + 9] * 2, "numbers end below their heading"


def test_evaluation_table_without_protocol_lists_baselines() -> None:
    lines = runs.evaluation_table(report(baselines=[baseline("future")]))
    assert len(lines) == 2 and lines[1].startswith("  future (sees the future)")


def test_evaluation_table_of_live_run_ends_with_ages() -> None:
    ages = Facts(p50_ms=50.04, p95_ms=95.0, p99_ms=99.0, max_ms=120.0)
    live = Facts(score=score(30.0, None), settled=score(31.0), age_when_shown=ages)
    lines = runs.evaluation_table(report(live=live))
    assert lines[-1] == "age when shown: p50 50.0, p95 95.0, p99 99.0, max 120.0 ms"
    assert lines[1].split()[-2] == "–"
    live.age_when_shown = None
    assert len(runs.evaluation_table(report(live=live))) == 3


def test_evaluation_table_lists_both_stays_at_each_place() -> None:
    place = Facts(first_s=(0.0, 2.0), again_s=(60.0, 62.5), first=score(30.0), again=score(28.0))
    kept = Facts(last=score(31.0), last_range_s=(50.0, 62.5), places=[place])
    lines = runs.evaluation_table(report(retention=kept))
    assert [line.split()[-3:] for line in lines[-2:]] == [["12", "30.00", "29.00"], ["12", "28.00", "27.00"]]
    assert lines[-2].startswith("  place, first: 0.00 to 2.00 s") and lines[-1].startswith(
        "  place, again: 60.00 to 62.50 s"
    )
