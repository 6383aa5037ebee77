"""Offline reconstruction with an automatic number of steps."""

from __future__ import annotations

import json

import pytest

from gsplat_core.training import offline
from operators.applications.reconstruct import ReconstructSettings, reconstruct
from services.reports.build import write_reports
from tests.gsplat_core.geometry.moving_scope import SIDEWAYS, video


@pytest.fixture
def settings(tmp_path):
    import cv2

    folder = tmp_path / "take"
    folder.mkdir()
    for number, frame in enumerate(video(16, SIDEWAYS)[0]):
        cv2.imwrite(str(folder / f"{number:03}.png"), cv2.resize(frame.image[..., ::-1], (64, 48)))
    return ReconstructSettings(recording=folder, out=tmp_path / "out", sinks=(), minutes=1.0)


def test_report_has_step_trials_and_reason_of_choice(settings, monkeypatch):
    monkeypatch.setattr(offline, "FIRST_STEPS", 2)
    monkeypatch.setattr(offline, "MOST_STEPS", 4)
    reconstruct(settings, clock=lambda: 0.0, report=write_reports)
    run = json.loads((settings.out / "report.json").read_text())["run"]["training_steps"]
    assert [trial["steps"] for trial in run["trials"]] == [2, 4]
    assert all(trial["setup_s"] == trial["seconds"] == 0 for trial in run["trials"]), "the clock stands still"
    assert run["steps"] in (2, 4) and run["reason"] in ("best", "most")


def test_time_limit_ends_step_search(settings, monkeypatch):
    monkeypatch.setattr(offline, "FIRST_STEPS", 2)
    seconds = iter(range(0, 10_000, 25))
    trained = set()
    outcome = reconstruct(settings, progress=lambda each: trained.add(each.stage), clock=lambda: float(next(seconds)))
    assert any("the time limit ended the search" in note for note in outcome.notes)
    assert trained - {"poses"} == {"validate", "evaluate"}
