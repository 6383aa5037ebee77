"""Replay of a recorded live session: with the recorded calls every picture is byte-identical."""

from __future__ import annotations

import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.sessions import SessionReader, WriterOptions
from gsplat_core.io.sessions.records import DepthTaken, Observed, Rehearsed, SceneBegun
from gsplat_core.scene.frames import Frame
from gsplat_core.training.placement import LateDepth
from operators.applications.live import live_graph, warm_up
from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import RunOutcome, Session
from operators.depth import FoundDepth, TakenDepth
from operators.metrics import QualityResult, ShownComparison
from operators.sinks.session_recorder import RecordingResult
from operators.sources.source import SourceDescription, ThreadedSource

FRAMES = 14


SHOWN_S, FOUND_S = 20.0, 60.0


class _Scope(ThreadedSource):
    """Frames of a recording in real time, with what happens to a scope.

    A frame waits until a picture was shown since the last one, at most `SHOWN_S`. A busy machine then drops none.
    Frames with a number in `waits_for` also wait for an event, at most `FOUND_S`.
    """

    def __init__(self, recording, change, waits_for) -> None:
        super().__init__(ahead=1)
        self._recording, self._change, self._waits_for = recording, change, waits_for
        self.shown = threading.Event()
        self.description = SourceDescription(
            "scope", recording.width_px, recording.height_px, 20.0, recording.camera, recording.fields
        )

    def frames(self) -> Iterator[Frame]:
        for frame in self._recording:
            time.sleep(0.05)
            if frame.seq > 0:
                self.shown.wait(SHOWN_S)
            if frame.seq in self._waits_for:
                self._waits_for[frame.seq].wait(FOUND_S)
            self.shown.clear()
            yield self._change(frame.with_fields(arrived_ns=time.monotonic_ns()))


def as_it_is(frame: Frame) -> Frame:
    return frame


def eventful(frame: Frame) -> Frame:
    """A cut, a blurred frame, a highlight, and at the end another size."""
    if frame.seq == 4:
        return frame.with_fields(withheld="blur")
    if frame.seq == 6:
        return frame.with_fields(new_scene="cut")
    if frame.seq >= 10:
        image = np.ascontiguousarray(frame.image[:40, :56])
        mask = None if frame.mask is None else np.ascontiguousarray(frame.mask[:40, :56])
        return frame.with_fields(image=image, mask=mask, depth=None, right_image=None, right_camera=None)
    loss_mask = np.ones(frame.image.shape[:2], np.uint8)
    loss_mask[:5, frame.seq] = 0
    return frame.with_fields(loss_mask=loss_mask)


def with_edges_in_depth(frame: Frame) -> Frame:
    """Return the frame with a step in its measured depth, whose pixels a replay of a recording gives less confidence."""
    assert frame.depth is not None
    depth = frame.depth.copy()
    depth[:, : 20 + frame.seq] *= 0.8
    return frame.with_fields(depth=depth)


def of_two_eyes(frame: Frame) -> Frame:
    """Return the frame without measured depth, with a cut at frame 6 and a smaller size from frame 11 on."""
    frame = frame.with_fields(depth=None, depth_origin=None, new_scene="cut" if frame.seq == 6 else None)
    if frame.seq < 11:
        return frame
    image, right = (np.ascontiguousarray(each[:40, :56]) for each in (frame.image, frame.right_image))
    eye = frame.right_camera.resized(56, 40)
    mask = None if frame.mask is None else np.ascontiguousarray(frame.mask[:40, :56])
    return frame.with_fields(image=image, right_image=right, right_camera=eye, mask=mask)


def record(folder: Path, change, options: WriterOptions | None = None, waits_for=MappingProxyType({})) -> RunOutcome:
    recording = open_recording(synthesize(folder / "synthetic", frames=FRAMES, width_px=64, height_px=48))
    (folder / "live").mkdir()
    settings = LiveSettings(
        source="scope",
        out=folder / "live",
        record=folder / "session",
        recording=options or WriterOptions(),
        seed=3,
        eyes="both",
    )
    source = _Scope(recording, change, waits_for)
    graph = live_graph(source, settings, warm_up(settings, source), on_shown=lambda picture: source.shown.set())
    return Session(graph, settings.stated(), command="live").execute()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A session in several segments; read only."""
    folder = tmp_path_factory.mktemp("recorded")
    record(folder, as_it_is, WriterOptions(segment_bytes=60_000))
    assert len(list((folder / "session/segments").iterdir())) > 2
    return folder


@pytest.fixture
def session(recorded, tmp_path) -> Path:
    """A folder with a copy of it."""
    shutil.copytree(recorded / "session", tmp_path / "session")
    return tmp_path


def replayed(folder: Path, **settings) -> RunOutcome:
    shutil.rmtree(folder / "replay", ignore_errors=True)
    return replay(ReplaySettings(recording=folder / "session", out=folder / "replay", **settings))


@pytest.mark.slow
@pytest.mark.parametrize("change", [as_it_is, eventful, with_edges_in_depth])
def test_session_replay_reproduces_shown_pictures_byte_for_byte(tmp_path, change):
    live = record(tmp_path, change)
    recorded = live.find(RecordingResult)
    assert recorded is not None and recorded.recorded.lost == {}
    lines = [line for _, line in SessionReader(tmp_path / "session").lines()]
    assert any(line.steps > 0 for line in lines if isinstance(line, Observed | Rehearsed))
    scenes = [line.seq for line in lines if isinstance(line, SceneBegun)]
    assert bool(scenes) == (change is eventful)
    outcome = replayed(tmp_path)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None
    assert comparison.different == 0
    assert comparison.same >= 1
    assert any("byte for byte" in note for note in outcome.notes)


@pytest.fixture
def depth_found(monkeypatch):
    """Let frame 5 wait for the depth of a frame before the cut, and frame 10 for that of one after it."""
    before, after = threading.Event(), threading.Event()
    made = LateDepth.of

    def of(frame, *arguments, **options):
        late = made(frame, *arguments, **options)
        (before if frame.seq < 6 else after).set()
        return late

    monkeypatch.setattr(LateDepth, "of", of)
    return {5: before, 10: after}


@pytest.mark.slow
def test_session_replay_reproduces_late_depth(tmp_path, depth_found):
    live = record(tmp_path, of_two_eyes, waits_for=depth_found)
    found, taken = live.find(FoundDepth), live.find(TakenDepth)
    assert found.frames.get("stereo", 0) >= taken.frames >= 2 and found.metric
    reader = SessionReader(tmp_path / "session")
    lines = [line.seq for _, line in reader.lines() if isinstance(line, DepthTaken)]
    assert len(lines) == taken.frames and any(seq >= 6 for seq in lines)
    assert {frame.depth is None and frame.right_camera is not None for _, frame in reader.frames()} == {True}
    outcome = replayed(tmp_path)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.different == 0 and comparison.same >= 1


@pytest.mark.slow
def test_session_replay_without_one_late_depth_differs_and_notes_frame(tmp_path, depth_found):
    """Without one of the depths the comparison fails, and the replay names the missing depth."""
    assert record(tmp_path, of_two_eyes, waits_for=depth_found).find(TakenDepth).frames >= 2
    log = next((tmp_path / "session/segments").glob("*/log.jsonl"))
    first = re.search(r'"event":"take_depth","seq":(\d+),[^\n]*"tracks":(\{[^}]*\})', log.read_text())
    log.write_text(log.read_text().replace(first[2], '{"depth":999999}', 1))
    outcome = replayed(tmp_path)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.different > 0
    assert any(f"frame {first[1]} was trained on" in note and "its depth" in note for note in outcome.notes)


def leaving_the_body(frame: Frame) -> Frame:
    """Frames 5 to 8 show a blue room."""
    if 5 <= frame.seq <= 8:
        room = np.empty_like(frame.image)
        room[...] = 20, 60, 230
        return frame.with_fields(image=room, right_image=room)
    return frame


@pytest.mark.slow
def test_session_recording_contains_no_out_of_body_pixels(tmp_path):
    record(tmp_path, leaving_the_body)
    reader = SessionReader(tmp_path / "session")
    frames = [frame for _, frame in reader.frames()] + list(reader.prepared())
    withheld = {frame.seq for frame in frames if frame.withheld == "out of body"}
    assert {5, 6, 7, 8} <= withheld < set(range(FRAMES))
    for frame in frames:
        assert frame.image[..., 2].mean() < 150, f"frame {frame.seq} shows the room"
        if frame.seq in withheld:
            assert not frame.image.any() and not frame.right_image.any() and frame.depth is None
    comparison = replayed(tmp_path).find(ShownComparison)
    assert comparison is not None and comparison.different == 0 and comparison.same > 0


@pytest.mark.slow
def test_session_replay_with_ignore_schedule_differs(session):
    with_it, without = replayed(session), replayed(session, ignore_schedule=True)
    digests = [outcome.find(QualityResult).frames_sha256 for outcome in (with_it, without)]
    assert digests[0] != digests[1]
    assert without.find(ShownComparison) is None


@pytest.mark.slow
def test_session_replay_with_changed_schedule_reports_first_different_frame(session):
    """With one additional step in one call the comparison fails."""
    logs = sorted((session / "session/segments").glob("*/log.jsonl"))
    log = next(path for path in logs if '"event":"observe"' in path.read_text())
    before, steps, after = re.split(r'("event":"observe","seq":\d+,"steps":)', log.read_text(), maxsplit=1)
    count, rest = after.split(",", 1)
    log.write_text(f"{before}{steps}{int(count) + 1},{rest}")
    outcome = replayed(session)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.different > 0
    assert any(f"the first of frame {comparison.first_different}" in note for note in outcome.notes)


def test_truncated_session_replays_identically_up_to_cut(session):
    segments = sorted((session / "session/segments").iterdir())
    (image,) = segments[1].glob("image_*.mkv")
    before = [line.seq for line in SessionReader(session / "session").frame_lines()]
    with image.open("r+b") as file:
        file.truncate(image.stat().st_size // 2)
    there = {line.seq for line in SessionReader(session / "session").frame_lines()}
    cut = next(seq for seq in before if seq not in there)
    outcome = replayed(session)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.same > 0
    assert comparison.first_different is None or comparison.first_different > cut
    assert any("is not in its recording" in note for note in outcome.notes)


@pytest.mark.parametrize("options", [{"scale": 0.5}, {"heldout": True}, {"steps_per_frame": 3}])
@pytest.mark.slow
def test_session_replay_with_other_options_does_not_follow_schedule(session, options):
    outcome = replayed(session, **options)
    assert outcome.find(ShownComparison) is None
    assert any("schedule is not followed" in note for note in outcome.notes)
    assert outcome.find(QualityResult).frames == FRAMES


def test_session_replay_without_first_segment_does_not_follow_schedule(session):
    shutil.rmtree(session / "session/segments/000000")
    outcome = replayed(session)
    assert any("schedule is not followed" in note for note in outcome.notes)


def test_session_replay_refuses_settings_of_other_version(session):
    log = session / "session/segments/000000/log.jsonl"
    log.write_text(log.read_text().replace('"sh_degree":0', '"sh_degree":77'))
    with pytest.raises(InvalidSetting, match="--ignore-schedule"):
        replayed(session)


def test_session_replay_with_max_frames_matches_beginning(session):
    outcome = replayed(session, max_frames=5)
    comparison = outcome.find(ShownComparison)
    assert comparison is not None and comparison.different == 0
    assert comparison.same + comparison.not_shown <= 5
