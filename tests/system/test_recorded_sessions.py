"""`live --record` as a process: killed, interrupted, restarted and replayed."""

from __future__ import annotations

import os
import signal
import time

import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from services.reports.evaluation import EvaluationReport
from services.reports.schema import RunReport

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scope(tmp_path_factory):
    return synthesize(
        tmp_path_factory.mktemp("recordings") / "scope", frames=8, width_px=64, height_px=48, stereo=False
    )


def recording_under_way(start, source, out):
    """Start a live run and return when it has recorded a few frames."""
    process = start("live", source, "--loop", "--scale", 1, "--out", out, "--record", "--json")
    recordings = out / "recordings"
    for _ in range(6000):
        logs = [path.read_bytes() for path in recordings.glob("*/segments/000000/log.jsonl")]
        if any(log.count(b'"event":"shown"') > 5 for log in logs):
            return process
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.kill()
    pytest.fail("nothing was recorded within five minutes")


def replayed(intrasplat, folder, out):
    done = intrasplat("replay", folder, "--out", out, "--json")
    assert done.code == 0, done.err
    return RunReport.read(out / "report.json")


def test_killed_session_is_replayable_and_kept_until_record_keep(scope, tmp_path, start, intrasplat):
    out = tmp_path / "out"
    process = recording_under_way(start, scope, out)
    process.kill()
    process.communicate(timeout=300)
    (killed,) = (out / "recordings").iterdir()
    frames = open_recording(killed).frame_count
    assert frames >= 5  # six were shown, and FFmpeg keeps the newest picture until the next one
    notes = replayed(intrasplat, killed, tmp_path / "replay").notes
    assert any("byte for byte" in note for note in notes), notes

    options = ("--scale", 1, "--out", out, "--record", "--record-keep", "1h", "--json")
    done = intrasplat("live", scope, "--loop", "--max-frames", "20", *options)
    assert done.code == 0, done.err
    recordings = sorted((out / "recordings").iterdir())
    assert killed in recordings and len(recordings) == 2
    assert open_recording(killed).frame_count == frames
    assert any("frames were recorded in" in note for note in RunReport.read(out / "report.json").notes)
    assert (out / "model").is_dir()

    for log in killed.rglob("log.jsonl"):
        os.utime(log, (time.time() - 7200, time.time() - 7200))
    done = intrasplat("live", scope, "--loop", "--max-frames", "20", *options)
    assert done.code == 0 and not killed.exists() and len(list((out / "recordings").iterdir())) == 2
    assert any(
        "earlier recordings" in note and note.endswith(": 1") for note in RunReport.read(out / "report.json").notes
    )


def test_interrupted_session_is_complete_and_replayable(scope, tmp_path, start, intrasplat):
    process = recording_under_way(start, scope, tmp_path / "out")
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 0 and "Traceback" not in stderr
    (folder,) = (tmp_path / "out" / "recordings").iterdir()
    assert open_recording(folder).notes == ()
    assert intrasplat("validate", folder).code == 0
    notes = replayed(intrasplat, folder, tmp_path / "replay").notes
    assert any("byte for byte" in note for note in notes), notes


def test_live_record_without_out_is_refused(scope, intrasplat):
    done = intrasplat("live", scope, "--record", "--seconds", "1")
    assert done.code == 2
    assert "--out" in done.err and "Traceback" not in done.err


def test_evaluate_session_uses_its_own_size_and_times(scope, tmp_path, intrasplat):
    """Scale and times of the recorded run are not applied twice, even if the source looped."""
    out = tmp_path / "out"
    arguments = ("--loop", "--max-frames", "60", "--scale", "0.5", "--fps", "60", "--record", "--json")
    assert intrasplat("live", scope, *arguments, "--out", out).code == 0
    (session,) = (out / "recordings").iterdir()
    done = intrasplat("evaluate", out, session, "--protocol", "live", "--protocol", "retention", "--json")
    assert done.code == 0, done.err
    report = EvaluationReport.model_validate_json(done.out)
    assert (report.recording.width_px, report.recording.height_px, report.evaluated.scale) == (32, 24, 1.0)
    assert not any("as --scale says" in note or "looped" in note or "played" in note for note in report.notes)
    # On a busy machine the first and the last frame may be passed over: the model knows nothing of their times.
    start_s, end_s = load_bundle(out / "model").time_window_s
    scored = [frame for frame in open_recording(session) if frame.withheld is None and start_s <= frame.time_s <= end_s]
    assert report.retention is not None and report.retention.last.frames == len(scored) > 0
