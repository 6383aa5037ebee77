"""Offline reconstruction with an automatic number of steps."""

from __future__ import annotations

import dataclasses
import itertools
import json

import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.training import offline
from operators.applications import reconstruct as module
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


@pytest.mark.parametrize(
    ("during", "steps", "done", "made", "what"),
    [
        ("validate", 2, 1, 1, "as it was then"),
        ("validate", 4, 3, 2, "that of an earlier complete training of 2 steps"),
        ("validate", 8, 2, 4, "that of an earlier complete training of 4 steps"),
        ("train", 8, 7, 8, "that of an earlier complete training of 8 steps"),
        ("train", 4, 2, 4, "that of an earlier complete training of 4 steps"),
    ],
)
def test_stop_request_during_training_keeps_best_complete_trial(settings, monkeypatch, during, steps, done, made, what):
    """Trials have 2, 4 and 8 steps and scores of the test, which grow unless 4 steps are to be chosen; the training on all
    frames follows.
    """
    monkeypatch.setattr(offline, "FIRST_STEPS", 2)
    monkeypatch.setattr(offline, "MOST_STEPS", 8)
    monkeypatch.setattr(module, "rigid_share", lambda frames: 0.0)
    is_stopped, newest, scored = False, None, {}

    def noted(each):
        nonlocal is_stopped, newest
        newest = each
        is_stopped |= (each.stage, each.total, each.done) == (during, steps, done)

    def score(learned, frames):
        scored[newest.total] = learned.snapshot().sha256()
        return 0.0 if len(scored) == 3 and (during, steps) == ("train", 4) else float(len(scored))

    monkeypatch.setattr(module, "validation_psnr_db", score)
    outcome = reconstruct(settings, progress=noted, stop_requested=lambda: is_stopped, clock=lambda: 0.0)
    assert outcome.interrupted
    chosen = outcome.find(offline.ChosenSteps)
    assert (chosen.steps, chosen.reason, chosen.trials) == (made, "interrupted", ())
    assert any(
        f"interrupted after {done} of {steps} training steps; the model is {what}" in note for note in outcome.notes
    )
    if made in scored:
        assert load_bundle(outcome.outputs["model"]).sha256() == scored[made]


def test_stop_request_during_training_of_given_steps_keeps_what_was_made(settings):
    is_stopped = False

    def noted(each):
        nonlocal is_stopped
        is_stopped |= each.done == 5

    outcome = reconstruct(settings, steps=20, progress=noted, stop_requested=lambda: is_stopped)
    assert outcome.find(offline.ChosenSteps) == offline.ChosenSteps(5, (), "interrupted")
    assert any(
        "interrupted after 5 of 20 training steps; the model is as it was then" in note for note in outcome.notes
    )


@pytest.mark.parametrize(("seconds_per_call", "steps"), [(0.0, 40), (0.5, 40), (2.0, 18)])
def test_few_frames_are_trained_within_the_time_limit(settings, monkeypatch, seconds_per_call, steps):
    """The clock advances at each of its calls: at the start of each training, at its first step and at the one that
    extrapolates. With 2 s a call, nine steps seem to take 2 s, and 4 of 12 s are left.
    """
    for path in sorted(settings.recording.iterdir())[2:]:
        path.unlink()
    monkeypatch.setattr(module, "USUAL_STEPS", 40)
    monkeypatch.setattr(offline, "USUAL_STEPS", 40)
    monkeypatch.setattr(module, "RATE_STEPS", 10)
    calls = itertools.count()
    trained = []
    outcome = reconstruct(
        dataclasses.replace(settings, minutes=12 / 60),
        progress=lambda each: trained.append((each.done, each.total)) if each.stage == "train" else None,
        clock=lambda: seconds_per_call * next(calls),
    )
    chosen = outcome.find(offline.ChosenSteps)
    assert (chosen.steps, chosen.reason) == (steps, "few frames") and trained[-1] == (steps, steps)
    assert ("fewer than the usual 40, because the time limit" in chosen.sentence) is (steps < 40)
