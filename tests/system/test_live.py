"""`live` as a process: however it ends, results are saved and one sentence states the reason."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import synthesize
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications import live as live_module
from operators.applications.live_settings import LiveSettings
from operators.errors import RunFailed, SourceLost
from operators.frame_log import read_frames
from operators.sources.recording import RealtimeSource, play
from operators.storage import STAGING_PREFIX
from services.cli.terminal import NOTHING_SHOWN, user_sentence
from services.reports.schema import RunReport


@pytest.fixture(scope="module")
def scope(tmp_path_factory):
    return synthesize(
        tmp_path_factory.mktemp("recordings") / "scope", frames=8, width_px=64, height_px=48, stereo=False
    )


def start_showing(start, source, out):
    """Start a live run and return when its first picture is displayed."""
    process = start("live", source, "--loop", "--scale", 1, "--out", out)
    for line in process.stderr:
        if line.startswith("live"):
            return process
    pytest.fail("the process ended before its first picture")


def complete_report(out, frames=1):
    """Return the report of a run, after checking that all outputs are complete."""
    report = RunReport.read(out / "report.json")
    assert report.run.command == "live" and report.frames.displayed >= frames
    assert load_bundle(out / "model").sha256() == report.model.sha256
    assert len(list(read_frames(out / "frames.jsonl"))) >= frames
    assert "</html>" in (out / "report.html").read_text(encoding="utf-8")
    assert not [path for path in out.iterdir() if path.name.startswith(STAGING_PREFIX)], "nothing half-written stays"
    return report


def only_error_line(err):
    """Return the only error line."""
    assert "Traceback" not in err
    said = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(said) == 1, err
    return said[0]


@pytest.mark.slow
def test_sigterm_ends_live_with_exit_code_0(scope, tmp_path, start):
    process = start_showing(start, scope, tmp_path / "out")
    process.send_signal(signal.SIGTERM)  # SIGINT: test_recorded_sessions
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0 and "Traceback" not in err
    assert "ended: interrupted" in out and "error" not in err
    report = complete_report(tmp_path / "out")
    assert report.run.interrupted and report.run.stop_reason == "interrupted"


def test_live_ends_after_seconds_option(scope, tmp_path, intrasplat):
    for seconds in (2, 20, 200):  # a very busy machine shows nothing in the first ones
        done = intrasplat("live", scope, "--loop", "--seconds", seconds, "--out", tmp_path / "out", "--json")
        if done.code != NOTHING_SHOWN:
            break
    assert done.code == 0, done.err
    report = complete_report(tmp_path / "out")
    assert report.run.stop_reason == "end of the time asked for" and not report.run.interrupted
    assert json.loads(done.out)["run"]["stop_reason"] == "end of the time asked for", (
        "one JSON document and nothing else"
    )


class Dying(RealtimeSource):
    """Recording that is lost at its 40th frame. A busy machine has displayed a frame by then."""

    def frames(self) -> Iterator[Frame]:
        """See `RealtimeSource`."""
        for frame in super().frames():
            if frame.seq == 40:
                raise SourceLost("the scope was pulled out; plug it in again")
            yield frame


@pytest.mark.slow
def test_live_saves_results_if_source_is_lost(scope, tmp_path, intrasplat, monkeypatch):
    def dying(address, options):
        source = play(address, options)
        return Dying(source.recording, replace(options, process=False))

    monkeypatch.setattr(live_module, "open_source", dying)
    done = intrasplat("live", scope, "--loop", "--scale", 1, "--out", tmp_path / "out")
    assert done.code == 2
    assert "the scope was pulled out; plug it in again" in only_error_line(done.err)
    assert "the scope was pulled out" in complete_report(tmp_path / "out").run.stop_reason


@pytest.mark.slow
def test_live_saves_results_if_gpu_is_out_of_memory(scope, tmp_path, monkeypatch):
    observe = Reconstructor.observe

    def observing(self, frame, **more):
        if frame.seq >= 40:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return observe(self, frame, **more)

    monkeypatch.setattr(Reconstructor, "observe", observing)
    written = []
    settings = LiveSettings(str(scope), tmp_path / "out", loop=True, scale=1.0)
    with pytest.raises(RunFailed) as failed:
        live_module.live(settings, report=lambda outcome, folder: written.append(outcome))
    assert "operator 'reconstruct' failed" in written[0].stop_reason
    sentence = user_sentence(failed.value)
    assert sentence is not None and "there is not enough memory (CUDA out of memory." in sentence
    assert load_bundle(tmp_path / "out" / "model").gaussians.count > 0
    assert len(list(read_frames(tmp_path / "out" / "frames.jsonl"))) >= 1


@pytest.mark.slow
def test_live_saves_results_if_disk_fills_up(scope, small_disk, start):
    """Another program fills the disk; model and report use reserved space."""
    process = start_showing(start, scope, small_disk / "out")
    with open(small_disk / "ballast", "ab") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, shutil.disk_usage(small_disk).free - (6 << 20))
    _, err = process.communicate(timeout=300)
    assert process.returncode == 2
    assert "is full" in only_error_line(err) and "free some space" in only_error_line(err)
    assert "is full" in complete_report(small_disk / "out").run.stop_reason
