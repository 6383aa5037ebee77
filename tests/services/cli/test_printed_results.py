"""Printed results and exit codes of live runs, trainings and backups."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from operators.applications.static_scene import SceneTraining
from operators.settings import TrainOptions
from services.backup import Backup
from services.cli import runs, serve
from services.cli.runs import live_command, print_live, print_report, train_command
from services.cli.terminal import BAD_INPUT, INTERRUPTED, OK

FACTS = {
    "pictures": 28, "dropped": {"late": 2, "behind": 3}, "age_p50_ms": 20.0, "age_p99_ms": 41.5, "age_max_ms": 60.25,
    "settled_age_p99_ms": 33.0, "used_age_p99_ms": 35.0, "withheld": {"blurred": 4}, "settled_psnr_tissue_db": 36.0,
    "previous_frame_db": 35.0, "worst_psnr_tissue_db": 22.0, "scenes": {}, "states": {"steady": 6, "behind": 1},
}  # fmt: skip


class Report(SimpleNamespace):
    def model_dump_json(self, indent: int) -> str:
        return json.dumps({"report": True}, indent=indent)


def report(**changed: Any) -> Any:
    next_frame = SimpleNamespace(psnr_tissue_db=31.0, previous_frame_db=30.0)
    baselines = SimpleNamespace(previous_frame_db=35.5, heldout_previous_frame_db=None, heldout_neighbour_mean_db=34.5)
    scores = [SimpleNamespace(psnr_tissue_db=each, frames=4) for each in (36.25, 33.0)]
    between = SimpleNamespace(psnr_tissue_db=33.5, frames=4)
    given = {
        "notes": ["a note"], "live": SimpleNamespace(**FACTS),
        "frames": SimpleNamespace(ingested=33, displayed=30, dropped=3),
        "run": SimpleNamespace(wall_s=12.34, stop_reason="the stream ended", interrupted=False),
        "quality": SimpleNamespace(next_frame=next_frame, live=scores[0], heldout=scores[1], training=None, baselines=baselines, heldout_between=between),
    }  # fmt: skip
    return Report(**{**given, **changed})


def test_print_live_prints_summary(capsys: pytest.CaptureFixture[str]) -> None:
    print_live(report(), Path("out"), as_json=False)
    out, err = capsys.readouterr()
    assert err == "note: a note\n"
    assert out.splitlines() == [
        "33 frames in 12.3 s, 28 pictures shown, 5 passed over; ended: the stream ended",
        "age of what was shown: p50 20.0 ms, p99 41.5 ms, most 60.2 ms",
        "age after the first second: p99 33.0 ms",
        "of used frames, not withheld or damaged: p99 35.0 ms",
        "tissue PSNR, displayed frame (training error): 36.00 dB (previous frame shown instead: 35.00 dB)",
        "tissue PSNR, worst displayed frame (training error): 22.00 dB",
        "tissue PSNR, next frame, predicted before training on it: 31.00 dB (previous frame shown instead: 30.00 dB)",
        "withheld: 4 x blurred",
        "changes of state: 6 x steady, 1 x behind",
        "out/report.html",
    ]


@pytest.mark.parametrize(
    ("changed", "missing"),
    [
        ({"settled_age_p99_ms": None}, "age after the first second"),
        ({"used_age_p99_ms": None}, "of used frames"),
        ({"withheld": {}}, "of used frames"),
        ({"settled_psnr_tissue_db": None}, "displayed frame (training error): 36"),
    ],
)
def test_print_live_omits_missing_figures(
    capsys: pytest.CaptureFixture[str], changed: dict[str, Any], missing: str
) -> None:
    print_live(report(), None, as_json=False)
    assert missing in (before := capsys.readouterr().out) and "report.html" not in before
    print_live(report(live=SimpleNamespace(**{**FACTS, **changed}), notes=[]), None, as_json=False)
    out, err = capsys.readouterr()
    assert missing not in out and err == "" and "passed over" in out
    print_live(report(live=None), None, as_json=False)
    assert capsys.readouterr().out == ""


def test_print_report_prints_figures_with_baselines(capsys: pytest.CaptureFixture[str]) -> None:
    print_report(report(), Path("out"), as_json=False)
    out, err = capsys.readouterr()
    assert err == "note: a note\n" and out.splitlines() == [
        "30 of 33 frames displayed, 3 dropped, in 12.3 s",
        "tissue PSNR, displayed frame (training error): 36.25 dB (previous frame shown instead: 35.50 dB)",
        "tissue PSNR, held-out frames: 33.00 dB (mean of both neighbours: 34.50 dB)",
        "tissue PSNR, next frame, predicted before training on it: 31.00 dB (previous frame shown instead: 30.00 dB)",
        "out/report.html",
    ]
    one_at_the_end = SimpleNamespace(psnr_tissue_db=33.5, frames=3)
    quality = SimpleNamespace(**{**vars(report().quality), "heldout_between": one_at_the_end})
    print_report(report(quality=quality), Path("out"), as_json=False)
    assert capsys.readouterr().out.splitlines()[2:4] == [
        "tissue PSNR, held-out frames: 33.00 dB",
        "tissue PSNR, held-out frames with both neighbours: 33.50 dB (mean of both neighbours: 34.50 dB)",
    ]
    stopped = SimpleNamespace(wall_s=1.0, stop_reason="", interrupted=True)
    quality = SimpleNamespace(**{**vars(report().quality), "next_frame": None})
    print_report(report(run=stopped, notes=[], quality=quality), Path("out"), as_json=False)
    out, err = capsys.readouterr()
    assert err == "interrupted: the figures cover the frames that were displayed\n" and "next frame" not in out
    for printed in (print_report, print_live):
        printed(report(), Path("out"), as_json=True)
        assert json.loads(capsys.readouterr().out) == {"report": True}


@pytest.mark.parametrize(("writes", "keep", "printed"), [(True, True, "out/report.html"), (True, False, "passed over"), (False, True, "")])  # fmt: skip
def test_live_command_prints_report_only_if_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], writes: bool, keep: bool, printed: str
) -> None:
    def live(settings: Any, *, stop_requested: Any, on_scored: Any, report: Any) -> str:
        if writes:
            report("outcome", Path("folder"))
        return "outcome"

    required = []
    monkeypatch.setattr(runs, "live", live)
    monkeypatch.setattr(runs, "write_reports", lambda outcome, folder: report())
    monkeypatch.setattr(runs, "require_shown", required.append)
    assert live_command(SimpleNamespace(out=Path("out")), keep=keep, as_json=False) == OK  # type: ignore[arg-type]
    out, err = capsys.readouterr()
    assert required == ["outcome"] and (printed in out if writes else out == "")
    assert ("report.html" in out) == (writes and keep)
    assert ("ended before there was anything to show" in err) == (not writes)


def scene_training(**changed: Any) -> SceneTraining:
    given = dict.fromkeys(SceneTraining.__dataclass_fields__, None) | {
        "steps": 50, "training_images": 7, "training_s": 2.0, "gaussians": 90, "device_peak_bytes": None,
        "peak_memory_bytes": 3 * 2**20,
    }  # fmt: skip
    return SceneTraining(**{**given, **changed})


def test_training_summary_has_speed_memory_and_heldout_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    heldout = SimpleNamespace(images=[1, 2], psnr_db=25.5, ssim=0.75, worst_db=20.0, worst="8.png")
    assert runs._lines(scene_training(heldout=heldout)) == [
        "50 steps on 7 images in 2.0 s (25.0 steps/s): 90 Gaussians, peak memory 3.0 MiB",
        "2 held-out images: PSNR 25.50 dB, SSIM 0.7500, worst 20.00 dB (8.png)",
    ]
    (line,) = runs._lines(scene_training(training_s=0.0, device_peak_bytes=5 * 2**20))
    assert "(0.0 steps/s)" in line and line.endswith("peak memory 5.0 MiB")


@pytest.mark.parametrize("as_json", [False, True])
@pytest.mark.parametrize("ends", ["done", "raised"])
def test_train_command_publishes_results_and_prints_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, as_json: bool, ends: str
) -> None:
    def train(scene: Path, options: Any, folder: Path, *, progress: Any, stop_requested: Any) -> SceneTraining:
        (folder / "training.json").write_text("{}")
        if ends == "raised":
            raise KeyboardInterrupt
        return scene_training()

    monkeypatch.setattr(runs, "train_scene", train)
    scene, out = tmp_path / "scene", tmp_path / "out"
    scene.mkdir()
    if ends == "raised":
        with pytest.raises(KeyboardInterrupt):
            train_command(scene, out, TrainOptions(), as_json=as_json)
    else:
        assert train_command(scene, out, TrainOptions(), as_json=as_json) == OK != INTERRUPTED
        printed = capsys.readouterr().out
        if as_json:
            assert json.loads(printed)["steps"] == 50
        else:
            assert "50 steps on 7 images" in printed and printed.splitlines()[-1].startswith(str(out))
    assert (out / "training.json").exists()


BACKUP = Backup(**{**dict.fromkeys(Backup.__dataclass_fields__, ()), "files": 3, "size_bytes": 3 << 20, "made_at": "then", "audit": "intact"})  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "code", "sentences"),
    [
        ({}, OK, []),
        ({"missing": ("liver/3",)}, BAD_INPUT, ["not in it: the files of liver/3", "files of 1 entries were missing"]),
        ({"audit": "line 3"}, BAD_INPUT, ["NOT as it was written: line 3", "the audit log was NOT as it was written"]),
        ({"elsewhere": ("the key file",)}, OK, ["not in it: the key file"]),
    ],
)
def test_backup_command_prints_missing_parts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, changed: dict[str, Any],
    code: int, sentences: list[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(serve, "make_backup", lambda settings, target: replace(BACKUP, **changed))
    monkeypatch.setattr(serve, "_settings", lambda config, data: SimpleNamespace(data_dir=data))
    assert serve.backup_command(tmp_path / "b", None, tmp_path, as_json=False) == code
    out, err = capsys.readouterr()
    assert f"{tmp_path / 'b'}: 3 files, 3.0 MiB, made then" in out
    assert all(sentence in out + err for sentence in sentences) and bool(err) == (code != OK)
    assert len(out.splitlines()) == 1 + sum(
        "not in it" in each or "NOT as it was written:" in each for each in sentences
    )


def test_restore_command_checks_or_restores_backup(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    calls = []
    monkeypatch.setattr(serve, "check_backup", lambda source: calls.append("check") or BACKUP)
    monkeypatch.setattr(serve, "restore_backup", lambda settings, source: calls.append("restore") or BACKUP)
    monkeypatch.setattr(serve, "_settings", lambda config, data: SimpleNamespace(data_dir=data))
    for check, call, begin in (
        (True, "check", "/b is whole: 3 files"),
        (False, "restore", f"restored into {tmp_path}: "),
    ):
        calls.clear()
        assert serve.restore_command(Path("/b"), None, tmp_path, check=check, as_json=False) == OK
        assert calls == [call] and begin in capsys.readouterr().out
    assert serve.restore_command(Path("/b"), None, tmp_path, check=True, as_json=True) == OK
    assert json.loads(capsys.readouterr().out)["files"] == 3
