"""`intrasplat batch`: each recording of a folder once despite kills, and refused arguments."""

from __future__ import annotations

import importlib.util
import json
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "batch_kill.py"
QUICK = ("--steps-per-frame", "2")


@pytest.fixture(scope="module")
def batch_kill():
    """The benchmark module that runs and kills batches."""
    spec = importlib.util.spec_from_file_location("batch_kill", BENCHMARK)
    module = sys.modules["batch_kill"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recordings(tiny, tmp_path):
    """A folder with two recordings, an empty folder and a text file."""
    folder = tmp_path / "recordings"
    for name in ("a", "b"):
        shutil.copytree(tiny, folder / name)
    (folder / "empty").mkdir()
    (folder / "notes.txt").write_text("x")
    return folder


@pytest.mark.slow
def test_batch_makes_each_result_once_despite_kills(batch_kill, tmp_path):
    recordings, out = tmp_path / "recordings", tmp_path / "out"
    batch_kill.make_recordings(recordings, 3, frames=3)
    kills = batch_kill.Kills(between_s=(0.1, 0.5), batch_share=0.34, most=3, seed=1)
    killed = batch_kill.run_batch(recordings, out, 2, kills)
    figures = batch_kill.check(recordings, out, killed)
    assert figures["results"] == 3 and figures["killed_attempts"] + figures["killed_batches"] > 0
    assert figures["attempts"] > 3


@pytest.mark.slow
def test_second_batch_continues_and_names_failures(start, intrasplat, recordings):
    command = ("batch", recordings, "--workers", "1", *QUICK, "--json")
    first = start(*command)
    out, err = first.communicate(timeout=300)
    summary = json.loads(out)
    assert (first.returncode, summary["done"], summary["failed"], summary["already"]) == (2, 2, 1, 0), err
    assert summary["failures"][0]["recording"] == "empty" and "no images" in summary["failures"][0]["reason"].replace(
        "PNG or JPEG ", ""
    )
    results = recordings.with_name("recordings-replays")
    made = {name: (results / name).stat().st_ino for name in "ab"}
    shutil.rmtree(recordings / "empty")
    shutil.copytree(recordings / "a", recordings / "empty")
    out, err = start(*command).communicate(timeout=300)
    summary = json.loads(out)
    assert (summary["done"], summary["already"], summary["failed"]) == (3, 2, 0), err
    assert {name: (results / name).stat().st_ino for name in "ab"} == made
    assert (results / "empty" / "report.html").is_file() and (results / "a" / "model" / "manifest.json").is_file()
    err = intrasplat(*command[:-1], "--seed", "1").err
    assert "was begun with steps_per_frame 2" in err and "seed 1" in err


@pytest.mark.slow
def test_sigterm_ends_batch_without_partial_results(start, recordings, tmp_path):
    out = tmp_path / "out"
    batch = start("batch", recordings, "--out", out, "--workers", "1", "--steps-per-frame", "3000")
    until = time.monotonic() + 300
    while not list((out / ".running").glob("*/*-1")) and time.monotonic() < until:
        time.sleep(0.05)
    batch.send_signal(signal.SIGTERM)
    assert batch.wait(300) == 130
    assert list((out / ".running").iterdir()) == [] and not (out / "a").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere",), "is no folder"),
        (("empty",), "no videos and no folders"),
        (("recordings", "--out", "recordings/out"), "in, or around"),
        (("recordings", "--out", "."), "in, or around"),
        (("recordings", "--out", "other"), "no earlier batch's"),
        (("recordings", "--out", "file"), "is a file"),
        (("recordings", "--scale", "99"), "scale is 99.0; it must be above 0 and at most 64"),
        (("recordings", "--device", "tpu"), "device is 'tpu'; choose cpu or cuda"),
    ],
)
def test_batch_refuses_invalid_arguments_without_writing(
    intrasplat, recordings, tmp_path, monkeypatch, arguments, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").write_text("x")
    before = sorted(str(path) for path in tmp_path.rglob("*"))
    done = intrasplat("batch", *arguments)
    assert (done.code, said in done.err) == (2, True), done.err
    assert sorted(str(path) for path in tmp_path.rglob("*")) == before
