"""A replay from the command line: outputs, messages and reproducibility."""

from __future__ import annotations

import json

import cv2
import pytest

from gsplat_core.io.bundle import load_bundle
from services.reports.schema import RunReport

QUICK = ("--steps-per-frame", "2")
PATH = "source,analysis,reconstruct,deform,rasterize,"


def test_replay_writes_consistent_outputs(finished, tiny):
    assert {p.name for p in finished.iterdir()} == {
        ".intrasplat.json",
        "reconstruction.mp4",
        "model",
        "report.json",
        "report.html",
        "frames.jsonl",
    }
    report = RunReport.read(finished / "report.json")
    assert (report.recording.frames, report.recording.width_px, report.recording.height_px) == (6, 64, 48)
    assert (report.frames.ingested, report.frames.displayed, report.frames.dropped) == (6, 6, 0)
    assert report.run.stop_reason == "end of recording" and not report.run.interrupted
    assert set(report.latency_ms) == {PATH + leaf for leaf in ("video", "metrics,keyframes", "metrics,progress")}
    assert {name: times.calls for name, times in report.operators.items()} == dict.fromkeys(
        (
            "source",
            "analysis",
            "reconstruct",
            "deform",
            "rasterize",
            "video",
            "metrics",
            "keyframes",
            "progress",
        ),
        6,
    )
    assert report.model is not None
    model = load_bundle(finished / "model")
    assert model.sha256() == report.model.sha256
    assert model.gaussians.count == report.model.gaussians
    assert model.training_digest == report.recording.digest
    video = cv2.VideoCapture(str(finished / "reconstruction.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert "Research use only" in (finished / "report.html").read_text()


def test_replay_report_has_live_and_heldout_quality_with_baselines(finished):
    report = RunReport.read(finished / "report.json")
    live, held_out = report.quality.live, report.quality.heldout
    assert live is not None and held_out is not None
    assert (live.frames, held_out.frames) == (5, 1)
    assert [entry.trained for entry in report.series] == [True, False, True, True, True, True]
    assert live.psnr_tissue_db is not None and live.psnr_tissue_db > 25
    assert report.quality.baselines.previous_frame_db is not None
    assert report.quality.baselines.heldout_neighbour_mean_db is not None


@pytest.mark.parametrize("engine", ["embedded", pytest.param("holoscan", marks=pytest.mark.holoscan)])
def test_replay_with_same_seed_is_identical(request, tiny, tmp_path, intrasplat, finished, engine):
    if engine == "holoscan":
        request.getfixturevalue("sdk")
    done = intrasplat("replay", tiny, "--out", tmp_path / "again", "--heldout", "--json", "--engine", engine, *QUICK)
    assert done.code == 0, done.err
    again, before = RunReport.model_validate_json(done.out), RunReport.read(finished / "report.json")
    assert again.frames_sha256 == before.frames_sha256
    assert again.model.sha256 == before.model.sha256
    assert again.run.engine == engine
    assert (again.frames, again.quality) == (before.frames, before.quality)


def test_replay_with_other_seed_differs(tiny, tmp_path, intrasplat):
    digests = {
        json.loads(
            intrasplat(
                "replay", tiny, "--out", tmp_path / seed, "--seed", seed, "--max-frames", 2, "--json", *QUICK
            ).out
        )["frames_sha256"]
        for seed in ("1", "2")
    }
    assert len(digests) == 2


def test_replay_output_ends_with_report_path(tiny, tmp_path, intrasplat):
    done = intrasplat("replay", tiny, "--out", tmp_path / "out", "--max-frames", 2, "--scale", 0.5, *QUICK)
    assert done.code == 0
    assert done.out.splitlines()[-1] == str(tmp_path / "out" / "report.html")
    assert "replay 2/2" in done.err
    assert RunReport.read(tmp_path / "out" / "report.json").recording.width_px == 32


def test_second_replay_replaces_first_with_note(tiny, tmp_path, intrasplat):
    for _ in range(2):
        done = intrasplat("replay", tiny, "--out", tmp_path / "out", "--max-frames", 1, *QUICK)
        assert done.code == 0
    assert "note: the output folder held an earlier run; this one replaces its files" in done.err


def test_render_writes_video_and_images(finished, tmp_path, intrasplat):
    done = intrasplat("render", finished / "model", "--out", tmp_path / "model.mp4", "--fps", 30)
    assert done.code == 0 and done.out.strip() == str(tmp_path / "model.mp4")
    video = cv2.VideoCapture(str(tmp_path / "model.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    done = intrasplat("render", finished / "model", "--out", tmp_path / "images", "--fps", 15, "--scale", 2, "--json")
    assert json.loads(done.out)["frames"] == 3
    names = sorted(p.name for p in (tmp_path / "images").glob("*.png"))
    assert names == ["000000.png", "000001.png", "000002.png"]
    assert cv2.imread(str(tmp_path / "images" / names[0])).shape == (96, 128, 3)


def test_reconstruct_scores_training_and_heldout_frames(tiny, tmp_path, intrasplat):
    done = intrasplat("reconstruct", tiny, "--out", tmp_path / "out", "--steps", 40, "--json")
    assert done.code == 0, done.err
    report = RunReport.model_validate_json(done.out)
    assert report.run.command == "reconstruct"
    assert report.quality.live is None
    assert report.quality.training.frames == 5 and report.quality.heldout.frames == 1
    assert report.frames.displayed == 6
    assert load_bundle(tmp_path / "out" / "model").sha256() == report.model.sha256


def test_synthesize_writes_valid_recording(tmp_path, intrasplat):
    done = intrasplat("synthesize", "--out", tmp_path / "take", "--frames", 2, "--width", 48, "--height", 40, "--json")
    assert done.code == 0
    assert json.loads(done.out)["frames"] == 2
    done = intrasplat("validate", tmp_path / "take", "--json")
    assert done.code == 0 and json.loads(done.out)["ok"]


def test_doctor_lists_instruction_set_ops_and_gpu(intrasplat):
    done = intrasplat("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(done.out)["checks"]}
    assert done.code == 0
    assert checks["instruction set in use"]["value"] in ("baseline", "avx2", "avx512")
    assert "composite" in checks["ops on the CPU"]["value"]
    assert not checks["GPU"]["needed"]
    assert intrasplat("doctor").out.rstrip().endswith("everything that is needed is here")
