"""`intrasplat evaluate` on small recordings: agreement with the run's figures, reports, refused arguments."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import synthesize
from services.cli.app import run
from services.reports.evaluation import EvaluationReport
from services.reports.schema import RunReport


@pytest.fixture(scope="module")
def long(tmp_path_factory) -> Path:
    """Twelve synthetic frames of 64x48 px, with depth."""
    return synthesize(
        tmp_path_factory.mktemp("recordings") / "long", frames=12, width_px=64, height_px=48, stereo=False
    )


@pytest.fixture(scope="module")
def offline(long, tmp_path_factory) -> Path:
    """An offline reconstruction of `long`."""
    out = tmp_path_factory.mktemp("outputs") / "offline"
    assert run(["reconstruct", str(long), "--out", str(out), "--steps", "30"]) == 0
    return out


def run_evaluate(intrasplat, *arguments) -> EvaluationReport:
    done = intrasplat("evaluate", *arguments, "--json")
    assert done.code == 0, done.err
    return EvaluationReport.model_validate_json(done.out)


def test_evaluate_heldout_scores_match_run_report(intrasplat, long, offline):
    report = run_evaluate(intrasplat, offline, long, "--protocol", "heldout")
    own = RunReport.read(offline / "report.json")
    assert report.heldout is not None and own.quality.heldout is not None
    for name in ("psnr_tissue_db", "psnr_frame_db", "ssim", "frames"):
        assert getattr(report.heldout.score, name) == pytest.approx(getattr(own.quality.heldout, name), abs=1e-4)
    by_name = {each.name: each.psnr_tissue_db for each in report.baselines if each.frames_of == "heldout"}
    assert by_name["neighbour_mean"] == pytest.approx(own.quality.baselines.heldout_neighbour_mean_db, abs=1e-4)
    assert by_name["train_mean"] < by_name["neighbour_mean"] and own.quality.baselines.train_mean_db is None
    assert report.heldout.depth is not None and report.heldout.depth.covered > 0.9
    assert report.evaluated.command == "reconstruct" and report.causal is report.live is report.retention is None


def test_evaluate_model_without_run_notes_unknown_facts(intrasplat, long, offline, tmp_path):
    shutil.copytree(offline / "model", tmp_path / "elsewhere")
    report = run_evaluate(intrasplat, tmp_path / "elsewhere", long)
    assert report.heldout is not None and report.retention is not None and report.live is None
    assert any("it is not known whether the held-out frames" in note for note in report.notes)
    assert any("live was not measured" in note for note in report.notes)
    beside = run_evaluate(intrasplat, offline / "model", long)
    assert beside.evaluated.command == "reconstruct" and not any("it is not known" in note for note in beside.notes)


def test_evaluate_writes_reports_and_prints_table(intrasplat, long, offline, tmp_path):
    out = tmp_path / "out"
    done = intrasplat(
        "evaluate",
        offline,
        long,
        "--out",
        out,
        "--protocol",
        "causal",
        "--protocol",
        "retention",
        "--steps-per-frame",
        1,
    )
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == str(out / "evaluation.html")
    for said in (
        "Causal:",
        "Retention:",
        "Half of a constant-velocity optical flow",
        "Previous frame shown instead",
        "tissue dB",
        "frame dB",
    ):
        assert said in done.out
    report = EvaluationReport.read(out / "evaluation.json")
    assert report.causal is not None and report.causal.score.frames == 11
    assert (report.causal.steps_per_frame, report.causal.field) == (1, "basis")
    assert [len(report.series[name]) for name in ("baselines", "causal", "retention")] == [11, 11, 12]
    names = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    assert names == {
        "evaluation.json",
        "evaluation.html",
        *(f"evaluation-{n}.jsonl" for n in ("baselines", "causal", "retention")),
    }
    assert names == set(report.outputs.values())
    assert intrasplat("evaluate", offline, long, "--out", out, "--protocol", "heldout").code == 0
    assert not (out / "evaluation-causal.jsonl").exists(), "a new evaluation replaces the earlier one whole"


def test_evaluate_motion_prior_option_changes_prediction(intrasplat, long, offline):
    few = ("--protocol", "causal", "--steps-per-frame", 2, "--max-frames", 5)
    flow, plain = (run_evaluate(intrasplat, offline, long, *few, *more) for more in (("--motion-prior", "flow"), ()))
    assert flow.causal is not None and plain.causal is not None
    assert (flow.causal.motion_prior, plain.causal.motion_prior) == ("flow", "bumps")
    assert flow.series["causal"] != plain.series["causal"]


def test_causal_prediction_does_not_depend_on_later_frames(intrasplat, long, offline, tmp_path):
    whole = run_evaluate(intrasplat, offline, long, "--protocol", "causal", "--steps-per-frame", 2)
    start = run_evaluate(intrasplat, offline, long, "--protocol", "causal", "--steps-per-frame", 2, "--max-frames", 6)
    assert start.series["causal"] == whole.series["causal"][:5]


def test_evaluate_run_trained_on_all_frames_has_no_heldout_scores(intrasplat, tiny, tmp_path):
    assert intrasplat("replay", tiny, "--out", tmp_path / "run", "--steps-per-frame", 1).code == 0
    done = intrasplat("evaluate", tmp_path / "run", tiny, "--protocol", "heldout")
    assert done.code == 2 and "trained on the held-out frames" in done.err
    report = run_evaluate(intrasplat, tmp_path / "run", tiny)
    assert report.heldout is None and any("trained on the held-out frames" in note for note in report.notes)
    done = intrasplat("evaluate", tmp_path / "run", tiny, "--protocol", "live")
    assert done.code == 2 and "not a live run" in done.err


def test_evaluate_notes_or_refuses_other_recording(intrasplat, long, offline, tiny, tmp_path):
    report = run_evaluate(intrasplat, offline, tiny, "--protocol", "retention")
    assert any("made from other files" in note for note in report.notes)
    other = synthesize(tmp_path / "wide", frames=3, width_px=96, height_px=48, stereo=False)
    done = intrasplat("evaluate", offline, other)
    assert done.code == 2 and "another shape" in done.err
    shutil.copytree(tiny, tmp_path / "zoomed")
    described = json.loads((tmp_path / "zoomed" / "recording.json").read_text())
    described["camera"]["fx"] *= 1.5
    (tmp_path / "zoomed" / "recording.json").write_text(json.dumps(described))
    done = intrasplat("evaluate", offline, tmp_path / "zoomed")
    assert done.code == 2 and "focal length" in done.err


def test_evaluate_notes_partially_covered_recording(intrasplat, long, tmp_path):
    assert intrasplat("reconstruct", long, "--out", tmp_path / "run", "--steps", 5, "--max-frames", 4).code == 0
    report = run_evaluate(intrasplat, tmp_path / "run", long)
    assert any("the first 5 of the 12 frames" in note for note in report.notes)
    assert {each.frames for each in report.baselines if each.age_frames == 1} == {4}


def test_evaluate_uses_size_of_model_unless_scale_is_given(intrasplat, long, tmp_path):
    assert intrasplat("reconstruct", long, "--out", tmp_path / "run", "--steps", 5, "--scale", 0.5).code == 0
    report = run_evaluate(intrasplat, tmp_path / "run", long, "--protocol", "heldout")
    assert (report.recording.width_px, report.evaluated.scale) == (32, 0.5)
    alone = run_evaluate(
        intrasplat, shutil.copytree(tmp_path / "run" / "model", tmp_path / "m"), long, "--protocol", "heldout"
    )
    assert alone.evaluated.scale == 0.5 and any("model's size of 32x24" in note for note in alone.notes)
    full = run_evaluate(intrasplat, tmp_path / "run", long, "--protocol", "heldout", "--scale", 1)
    assert full.recording.width_px == 64 and any("as --scale says" in note for note in full.notes)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--protocol", "magic"], "choose among heldout, live, retention, second_eye, geometry, causal"),
        (["--scale", "0"], "scale is 0.0; it must be above 0"),
        (["--steps-per-frame", "0"], "steps_per_frame"),
        (["--max-frames", "0"], "max_frames"),
        (["--motion-prior", "magic"], "magic"),
        (["--device", "abacus"], "is not known"),
        (["--renderer", "crayon"], "crayon"),
    ],
)
def test_evaluate_prints_error_for_invalid_option(intrasplat, long, offline, arguments, said):
    done = intrasplat("evaluate", offline, long, *arguments)
    assert done.code == 2 and said in done.err and done.err.count("\n") <= 2


def test_evaluate_refuses_paths_without_valid_model_or_run(intrasplat, long, offline, tmp_path):
    for path in (tmp_path / "missing", tmp_path):
        done = intrasplat("evaluate", path, long)
        assert done.code == 2 and done.err.startswith("error: "), done.err
    (tmp_path / "report.json").write_text("{}")
    assert "not a report of this version" in intrasplat("evaluate", tmp_path, long).err
    folder = shutil.copytree(offline, tmp_path / "without")
    shutil.rmtree(folder / "model")
    assert "left no model" in intrasplat("evaluate", folder, long).err
    other = shutil.copytree(offline, tmp_path / "swapped")
    content = json.loads((other / "report.json").read_text())
    content["model"]["sha256"] = "ab" * 32
    (other / "report.json").write_text(json.dumps(content))
    assert "is not the model" in intrasplat("evaluate", other, long).err
    assert "report.json" not in intrasplat("evaluate", other / "model", long, "--protocol", "heldout").err


def test_evaluate_refuses_output_in_run_or_foreign_folder(intrasplat, long, offline, tmp_path, fingerprints):
    before = fingerprints(offline)
    assert intrasplat("evaluate", offline, long, "--out", offline / "evaluation").code == 2
    assert intrasplat("evaluate", offline, long, "--out", offline).code == 2
    assert fingerprints(offline) == before
    cv2.imwrite(str(tmp_path / "mine.png"), np.zeros((4, 4, 3), np.uint8))
    assert intrasplat("evaluate", offline, long, "--out", tmp_path).code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine.png"]


def test_evaluate_place_option_selects_time_ranges(intrasplat, long, offline):
    report = run_evaluate(intrasplat, offline, long, "--protocol", "retention", "--place", "0:0.05,0.2:0.3")
    assert report.retention is not None
    (place,) = report.retention.places
    assert (place.again_s, place.first.frames, place.again.frames) == ((0.2, 0.3), 2, 4)
    for wrong in ("0:1", "a:b,c:d", "0:2,1:3", "0:nan,5:6", ",", "0:1:2,3:4"):
        done = intrasplat("evaluate", offline, long, "--place", wrong)
        assert done.code == 2 and "such as 0:2,60:62" in done.err, wrong


@pytest.mark.slow
def test_interrupted_evaluate_writes_partial_report(long, offline, tmp_path, start):
    process = start(
        "evaluate", offline, long, "--protocol", "causal", "--steps-per-frame", 3000, "--out", tmp_path / "out"
    )
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("causal 1/"):
            break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    report = EvaluationReport.read(tmp_path / "out" / "evaluation.json")
    assert report.evaluated.interrupted and any("interrupted" in note for note in report.notes)
    assert report.causal is not None and report.causal.score.frames < 11


def test_evaluate_bins_long_series(intrasplat, long, offline, monkeypatch):
    monkeypatch.setattr("services.reports.evaluation.MAX_SERIES", 4)
    report = run_evaluate(intrasplat, offline, long, "--protocol", "retention")
    assert report.series_frames_per_entry == {"baselines": 3, "retention": 3}
    assert [len(report.series[name]) for name in ("baselines", "retention")] == [4, 4]
    (own,) = report.series["retention"][:1]
    assert own["frames"] == 3 and own["psnr_tissue_min_db"] <= own["psnr_tissue_db"]


def test_evaluate_looped_live_run_uses_its_own_frame_times(intrasplat, long, offline, tmp_path):
    """Imitate the output of `live --loop --fps 60`: the model's time is 2.5 rounds of 0.2 s."""
    folder = shutil.copytree(offline, tmp_path / "live")
    manifest = json.loads((folder / "model" / "manifest.json").read_text())
    manifest["time_window_s"] = [0.0, 0.5 - 1 / 60]
    (folder / "model" / "manifest.json").write_text(json.dumps(manifest))
    content = json.loads((folder / "report.json").read_text())
    content["run"]["command"], content["recording"]["fps"] = "live", 60.0
    content["model"]["sha256"] = load_bundle(folder / "model").sha256()
    (folder / "report.json").write_text(json.dumps(content))
    report = run_evaluate(intrasplat, folder, long, "--protocol", "retention")
    assert any("played the recording at 60 frames/s" in note for note in report.notes)
    assert any("last of 2.4 rounds" in note or "last of 2.5 rounds" in note for note in report.notes)
    series = report.series["retention"]
    assert [entry["seq"] for entry in series] == list(range(30)), "twelve frames a round, the third round half"
    assert series[-1]["time_s"] == pytest.approx(29 / 60, abs=1e-3)
    assert [entry["seq"] for entry in report.series["baselines"]] == list(range(1, 12))
    alone = run_evaluate(intrasplat, folder / "model", long, "--protocol", "retention", "--max-frames", 6)
    assert any("frames that are evaluated end" in note for note in alone.notes)
