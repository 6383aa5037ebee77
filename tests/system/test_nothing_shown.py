"""`intrasplat live`, `replay` and `batch` exit with 3 and a sentence if no frame was shown."""

from __future__ import annotations

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from services.cli.app import run
from services.cli.terminal import NOTHING_SHOWN, OK
from services.reports.evaluation import EvaluationReport
from services.reports.schema import RunReport


@pytest.fixture
def drapes(tmp_path):
    """A recording of blue drapes only, with slightly changing light."""
    folder = tmp_path / "in" / "drapes"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    folds = cv2.GaussianBlur(rng.normal(0, 1, (96, 128)), (0, 0), 10)
    for k in range(6):
        light = 1 + (0.2 + 0.02 * k) * folds / np.abs(folds).max()
        picture = np.clip(np.array([160, 110, 60]) * light[..., None] + rng.normal(0, 3, (96, 128, 3)), 0, 255)
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), picture.astype(np.uint8))
    return folder


def test_runs_and_batch_with_only_withheld_frames_exit_3(drapes, tmp_path, capsys):
    """One test, because a live run takes seconds."""
    assert (
        run(
            [
                "live",
                str(drapes),
                "--scale",
                "1",
                "--out",
                str(tmp_path / "out"),
                "--record",
                "--max-frames",
                "6",
                "--fps",
                "20",
            ]
        )
        == NOTHING_SHOWN
    )
    said = capsys.readouterr().err
    # A busy machine may miss a frame of a live source.
    counts = re.search(r"nothing was shown: (\d+) frames came, (\d+) withheld \(out of body", said)
    assert counts is not None and "--out-of-body off" in said
    came, withheld = map(int, counts.groups())
    assert came == withheld and 1 <= came <= 6
    (session,) = (tmp_path / "out" / "recordings").iterdir()
    for more in ([], ["--ignore-schedule"]):
        assert run(["replay", str(session), "--out", str(tmp_path / "again"), *more]) == NOTHING_SHOWN
        said = capsys.readouterr().err
        assert f"{came} withheld when they were recorded (out of body: {came})" in said and "interrupted" not in said
    assert run(["reconstruct", str(session), "--out", str(tmp_path / "fit"), "--steps", "2"]) == NOTHING_SHOWN
    said = capsys.readouterr().err
    assert "can be trained on" in said and said.strip().endswith("; give other frames")
    assert run(["batch", str(session.parent), "--out", str(tmp_path / "batch"), "--workers", "1"]) == NOTHING_SHOWN
    said = capsys.readouterr().err
    assert "withheld when they were recorded" in said and "error: 1 recordings have no result" in said


@pytest.mark.slow
def test_live_with_out_of_body_off_shows_frames(drapes, tmp_path, capsys):
    assert (
        run(
            [
                "live",
                str(drapes),
                "--scale",
                "1",
                "--out",
                str(tmp_path / "out"),
                "--out-of-body",
                "off",
                "--max-frames",
                "6",
                "--fps",
                "20",
            ]
        )
        == OK
    )
    assert "nothing was shown" not in capsys.readouterr().err


@pytest.mark.parametrize(("level", "bits"), [(0, 8), (4095, 16)])
def test_reconstruct_exits_3_for_black_images(level, bits, tmp_path, capsys):
    folder = tmp_path / "black" / "images"
    folder.mkdir(parents=True)
    for k in range(5):
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.full((48, 64, 3), level, np.uint8 if bits == 8 else np.uint16))
    assert run(["reconstruct", str(folder.parent), "--out", str(tmp_path / "out"), "--steps", "2"]) == NOTHING_SHOWN
    said = capsys.readouterr().err
    assert "(black: 5)" in said and "values up to 65535" in said


@pytest.fixture
def black_beginning(tiny, tmp_path):
    """The recording `tiny` with its first two images black."""
    recording = tmp_path / "recording"
    shutil.copytree(tiny, recording)
    for path in sorted((recording / "images").iterdir())[:2]:
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path))))
    return recording


def test_reconstruct_and_evaluate_omit_black_frames(black_beginning, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["reconstruct", str(black_beginning), "--out", str(out), "--steps", "2", "--device", "cpu"]) == OK
    assert "2 frames were withheld and not scored (black: 2)" in capsys.readouterr().err
    assert run(["evaluate", str(out), str(black_beginning), "--protocol", "retention", "--json"]) == OK
    report = EvaluationReport.model_validate_json(capsys.readouterr().out)
    assert report.left_out == {"withheld": 2}
    (copy,) = (each for each in report.baselines if each.age_frames == 1)
    assert copy.frames == 3 and copy.psnr_tissue_db < 50


def test_replay_previous_frame_baseline_omits_black_frames(black_beginning, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["replay", str(black_beginning), "--out", str(out), "--steps-per-frame", "2", "--device", "cpu"]) == OK
    quality = RunReport.read(out / "report.json").quality
    # The copy of a black picture for a black one would have an infinite PSNR, which counts as 100 dB.
    assert quality.live.frames == 4 and quality.baselines.previous_frame_db < 50
    lines = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    scored = [line["previous_frame_db"] for line in lines if line["previous_frame_db"] is not None]
    assert quality.baselines.previous_frame_db == pytest.approx(np.mean(scored))
