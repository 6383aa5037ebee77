"""A moving scope without given poses, run as a user runs it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from operators.applications.live import live_graph, warm_up
from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import Session
from operators.metrics import QualityResult, ShownComparison
from operators.pose import EstimatedPoses
from operators.sinks.session_recorder import RecordingResult
from operators.sources.source import SourceDescription, ThreadedSource
from tests.operators.applications.test_depth_of_a_moving_scope import clip  # noqa: F401 - a fixture

FRAMES = 10


def sha256(outcome) -> str:
    return outcome.find(QualityResult).frames_sha256


@pytest.fixture
def run(clip, tmp_path):  # noqa: F811
    """Replays the clip with these settings."""

    def replayed(**settings):
        name = f"out{len(list(tmp_path.iterdir()))}"
        return replay(
            ReplaySettings(recording=clip, out=tmp_path / name, steps_per_frame=1, sinks=(), depth="none", **settings)
        )

    return replayed


@pytest.mark.slow
def test_replay_with_estimated_poses_is_deterministic(run):
    given, first, again = run(), run(poses="estimated"), run(poses="estimated")
    assert given.find(EstimatedPoses) is None and first.find(EstimatedPoses).explained > 0.9
    assert any("the scope's poses were estimated" in note for note in first.notes)
    assert sha256(first) == sha256(again) != sha256(given)


class _Scope(ThreadedSource):
    """Frames of a recording in real time, without their poses. A frame waits for a picture after the last one, at most a second."""

    def __init__(self, recording) -> None:
        super().__init__(ahead=1)
        self.shown = threading.Event()
        self._recording = recording
        camera = recording.camera
        self.description = SourceDescription(
            "scope", camera.width_px, camera.height_px, 20.0, camera, frozenset({"mask"})
        )

    def frames(self) -> Iterator[Frame]:
        for frame in self._recording:
            time.sleep(0.05)
            if frame.seq > 0:
                self.shown.wait(1.0)
            self.shown.clear()
            yield frame.with_fields(pose=None, depth=None, depth_origin=None, arrived_ns=time.monotonic_ns())


@pytest.mark.slow
def test_session_replay_reproduces_recorded_estimated_poses(tmp_path):
    recording = render_recording(RenderSettings(FRAMES, 160, 128, fps=20, seed=1, camera="moving"))
    settings = LiveSettings(
        source="scope", out=tmp_path / "live", record=tmp_path / "session", depth="none", poses="estimated"
    )
    settings.out.mkdir()
    source = _Scope(recording)
    graph = live_graph(source, settings, warm_up(settings, source), on_shown=lambda picture: source.shown.set())
    live = Session(graph, settings.stated(), command="live").execute()
    assert live.find(EstimatedPoses).frames == FRAMES and live.find(RecordingResult).recorded.lost == {}
    prepared = [line for _, line in SessionReader(tmp_path / "session").lines() if line.event == "prepared"]
    assert len(prepared) == FRAMES and not np.array_equal(prepared[0].pose, prepared[-1].pose)
    outcome = replay(ReplaySettings(recording=tmp_path / "session", out=tmp_path / "replay", poses="estimated"))
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.different == 0 and comparison.same >= 1
    assert outcome.find(EstimatedPoses) is None, "they are those of the session"
