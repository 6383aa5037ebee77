"""Damaged frames in a replay are shown and reported, but neither trained on nor scored."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from operators.applications.replay import ReplaySettings, replay
from operators.ingest import SourceResult
from operators.metrics import QualityResult
from operators.sinks.video import DisplayResult
from services.reports.build import build_report
from tests.gsplat_core.io.recordings import videos


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """Twenty frames; 13 to 19 are damaged or may depend on what is."""
    path = videos.encode(tmp_path / "v.avi", "ffv1_avi")
    begin, end = videos.payload(path)[13]
    path.write_bytes(videos.flipped(path.read_bytes(), (begin + end) // 2, 0))
    return path


def test_replay_shows_damaged_frames_without_training_or_score(
    damaged: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    outcome = replay(ReplaySettings(damaged, tmp_path / "out", steps_per_frame=1, scale=0.4))
    source, display, quality = (outcome.find(kind) for kind in (SourceResult, DisplayResult, QualityResult))
    assert source is not None and display is not None and quality is not None
    assert (source.frames, source.damaged, display.frames) == (videos.FRAMES, 7, videos.FRAMES)
    assert build_report(outcome).frames.damaged == 7
    sentence = "7 of 20 frames are damaged (13-19)"
    assert any(sentence in note for note in outcome.notes)
    assert any(sentence in message for message in caplog.messages)  # which reaches the terminal, with --json too
    for entry in quality.series:
        whole = entry["seq"] < 13
        assert entry["trained"] == whole
        assert (entry["psnr_tissue_db"] is not None) == whole
    assert quality.previous_frame_db is not None and math.isfinite(quality.previous_frame_db)
