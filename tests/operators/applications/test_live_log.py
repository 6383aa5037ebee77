"""Live figures from the log of a run, and invalid logs."""

from __future__ import annotations

import json

import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.scores import NOTHING_SHOWN
from operators.frame_log import NO_FIGURE, NOT_SCORED, is_live_log, read_live_log

MS = 1_000_000


def line(seq, psnr_db=30.0, shown_seq=None, after_ms=9, **fields):
    """Frames come every 40 ms from 1000 ms on; the picture on the screen was shown so long after its own frame had come."""
    shown_seq = seq if shown_seq is None else shown_seq
    return {
        "seq": seq,
        "time_s": seq / 25,
        "trained": True,
        "model_version": seq + 1,
        "psnr_tissue_db": psnr_db,
        "psnr_frame_db": None if psnr_db is None else psnr_db + 1,
        "ssim": None,
        "previous_frame_db": 25.0 + seq,
        "arrived_ns": (1000 + 40 * seq) * MS,
        "shown_seq": shown_seq,
        "shown_ns": (1000 + 40 * shown_seq + after_ms) * MS,
        "age_ms": float(after_ms),
        "state": "live",
        "withheld": None,
        **fields,
    }


@pytest.fixture
def log(tmp_path):
    def write(*lines):
        path = tmp_path / "frames.jsonl"
        path.write_text("".join((each if isinstance(each, str) else json.dumps(each)) + "\n" for each in lines))
        return path

    return write


def test_read_live_log_scores_frames_against_pictures_on_screen(log):
    entries = []
    path = log(line(0), line(1, 20.0, shown_seq=0), line(2, 40.0, after_ms=30, state="stale"), line(3, 90.0))
    assert is_live_log(path)
    found = read_live_log(path, entries.append)
    assert found.score.psnr_tissue_db == pytest.approx(30) and found.score.psnr_frame_db == pytest.approx(31)
    assert (found.score.frames, found.score.worst_seq, found.score.ssim) == (3, 1, None), "the last one has no next one"
    assert (found.behind, found.in_time) == ({0: 2, 1: 1}, 2)
    assert found.age_when_shown is not None and found.age_on_screen is not None
    assert (found.age_when_shown.count, found.age_when_shown.max_ms) == (2, 30), "the picture of frame 0 was shown once"
    assert found.age_on_screen.max_ms == pytest.approx(80)
    assert found.states == {"live": 1, "stale": 1}
    assert (found.previous.psnr_tissue_db, found.previous.psnr_frame_db, found.previous.frames) == (26.0, None, 3)
    assert [entry["behind"] for entry in entries] == [0, 1, 0]


def test_live_log_counts_unscored_frames_by_reason(log):
    found = read_live_log(log(line(0), line(1, None, withheld="blur"), line(2, None), line(7), line(8)))
    assert found.score.left_out == {NO_FIGURE: 1, NOT_SCORED: 4, "withheld": 1} and found.score.frames == 2


def test_live_log_counts_frames_before_first_picture(log):
    found = read_live_log(log(line(4), line(5)))
    assert found.score.left_out == {NOTHING_SHOWN: 4} and found.score.frames == 1


def test_live_log_settled_figures_exclude_first_second(log):
    found = read_live_log(log(*(line(k, 10.0 if k < 25 else 30.0) for k in range(51))))
    assert (found.settled.frames, found.settled.worst_db) == (25, 30.0)


def test_is_live_log_rejects_replay_log_and_missing_file(log, tmp_path):
    assert not is_live_log(log({"seq": 0, "time_s": 0.0, "psnr_tissue_db": 30.0}))
    assert not is_live_log(tmp_path / "missing.jsonl") and not is_live_log(log())


@pytest.mark.parametrize(
    "bad",
    [
        "{",
        "[1, 2]",
        "7",
        '{"seq": 1}',
        json.dumps(line(1, shown_ns="now")),
        json.dumps(line(1, shown_ns=True)),
        json.dumps(line(1, arrived_ns=1e30)),
        json.dumps(line(1, age_ms=None)),
        json.dumps(line(1, time_s=float("nan"))),
        json.dumps(line(0)),
        json.dumps(line(1, arrived_ns=3)),
        "[" * 100_000,
    ],
)
def test_read_live_log_refuses_invalid_line_with_file_name(log, bad):
    with pytest.raises(InvalidSetting, match=r"frames\.jsonl"):
        read_live_log(log(line(0), bad, line(9)))


def test_read_live_log_ignores_truncated_last_line(log):
    path = log(line(0), line(1))
    path.write_bytes(path.read_bytes() + b'{"seq": 2, "ti')
    assert read_live_log(path).score.frames == 1
