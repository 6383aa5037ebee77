"""Faults of a real scope in a live stream: the run continues, reports them, recovers, and does not train on faulty frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.schedule import Budget
from operators import display
from operators.applications import live as live_module
from operators.applications.live import live
from operators.applications.live_settings import LiveSettings
from operators.checks import CutCounts, MaskAndDepthCounts, OutOfBodyFrames, SequenceCounts
from operators.display import COLOURS, LiveDisplayResult
from operators.frame_clock import ClockSettings
from operators.ingest import SourceResult
from operators.messages import PictureState, Reconstruction
from operators.metrics import OnScreenResult
from operators.sources.live import FrameOrder
from operators.training import Learner, TrainingCounts
from tests.operators.applications.scripted import (
    BLACK,
    HEIGHT,
    INTERVAL_NS,
    SECOND_NS,
    WIDTH,
    Script,
    ScriptedSource,
    Watched,
    scope_picture,
    torn,
)

FEW_STEPS = ClockSettings(at_most_steps=4, rehearse_at_most=4)
"""Few steps per frame: the tests check the set of trained frames, not the quality."""


@pytest.fixture
def watched(tmp_path, monkeypatch) -> Callable[..., Watched]:
    """Run a script live to its end."""

    observe = Learner.observe

    def run(script: Script, *, source: dict[str, Any] | None = None, **settings: Any) -> Watched:
        watch = Watched(script)

        def observing(self: Learner, frame: Frame, *, budget: Budget | None = None, train: bool) -> Reconstruction:
            if train:
                watch.learned.add(frame.seq)
            return observe(self, frame, budget=budget, train=train)

        # The trial run before the stream trains, too.
        played = ScriptedSource(script, watch.learned.clear, **(source or {}))
        monkeypatch.setattr(live_module, "open_source", lambda address, options: played)
        monkeypatch.setattr(Learner, "observe", observing)
        # A busy machine displays pictures late, which is not tested here.
        monkeypatch.setattr(display, "STALE_AFTER_NS", 700e6)
        monkeypatch.setattr(display, "FROZEN_AFTER_NS", 1400e6)
        wanted = LiveSettings("scripted", tmp_path / "out", **{"out_of_body": "off", "clock": FEW_STEPS, **settings})
        watch.outcome = live(wanted, on_shown=watch.shown.append)
        assert watch.outcome.stop_reason == "end of stream"
        return watch

    return run


def all_frames_arrived(watch: Watched) -> None:
    assert watch.part(SourceResult).frames == len(watch.script.frames)
    assert watch.part(SourceResult).reached_end


def test_end_of_stream_does_not_show_source_lost_state(watched):
    script = Script()
    script.good(12)
    watch = watched(script)
    all_frames_arrived(watch)
    assert watch.part(LiveDisplayResult).states["live"] >= 1
    assert "source lost" not in watch.part(LiveDisplayResult).states
    assert all(picture.state is not PictureState.SOURCE_LOST for picture in watch.shown)


@pytest.mark.slow
def test_live_withholds_black_frozen_torn_and_damaged_frames(watched):
    """Black, duplicated, frozen, torn and damaged."""
    script = Script()
    script.good(20)
    script.fault(*[{"image": BLACK}] * 5)
    after = [script.good(15)]
    script.fault({"image": script.newest.image})
    after.append(script.good(15))
    frozen = script.fault(*[{"image": script.newest.image}] * 25)
    after.append(script.good(15))
    script.fault({"image": torn(scope_picture(len(script.frames)), script.newest.image)})
    after.append(script.good(15))
    script.fault(*[{"status": FrameStatus.DAMAGED, "damage": "lost packets"}] * 3)
    after.append(script.good(15))
    watch = watched(script)
    all_frames_arrived(watch)
    found = watch.part(SequenceCounts).found
    assert (found["black"], found["torn"], found["duplicate"] + found["frozen"]) == (5, 1, 26)
    assert found["frozen"] >= 15 and watch.part(SourceResult).damaged == 3
    withheld = watch.part(TrainingCounts).withheld
    assert {"black", "frozen"} <= set(withheld) <= {*found, "damaged"}
    assert all(count <= found[reason] for reason, count in withheld.items() if reason != "damaged")
    # A second of the same picture: what is shown is as old as the last one that was new.
    assert watch.part(LiveDisplayResult).states["stale"] >= 1
    assert any(each.state is PictureState.STALE and each.rendered.frame.seq in frozen for each in watch.shown)
    for frames in after:
        watch.recovers_in(frames)
    watch.learned_nothing_bad()


@pytest.mark.slow
def test_live_keeps_model_time_monotonic_on_late_frames_and_clock_jumps(watched):
    """The clock jumps forward by one hour and back by two; the model's time continues unchanged."""
    script = Script()
    script.good(20)
    script.fault(*[{"pts_ns": script.pts_ns - late * INTERVAL_NS} for late in (6, 9)])
    after = [script.good(15)]
    script.pts_ns += 3600 * SECOND_NS
    after.append(script.good(15))
    script.pts_ns -= 7200 * SECOND_NS
    after.append(script.good(25))
    watch = watched(script)
    all_frames_arrived(watch)
    found = watch.part(SequenceCounts).found
    # Before it is clear that the clock was set back, three frames look late.
    assert (found["out of order"], found["clock jump"]) == (5, 2)
    for frames in after:
        watch.recovers_in(frames)
    watch.learned_nothing_bad()
    model = load_bundle(watch.outcome.outputs["model"])
    times = [picture.rendered.frame.time_s for picture in watch.shown]
    assert times == sorted(times) and times[-1] - times[0] < 60
    assert 0 <= model.time_window_s[0] <= model.time_window_s[1] < 60


@pytest.mark.slow
def test_live_drops_duplicate_and_out_of_order_sequence_numbers(watched):
    """Duplicate, late and restarted sequence numbers are corrected or dropped at the input."""
    script = Script()
    script.good(20)
    twice = script.newest
    script.fault({"seq": twice.seq, "pts_ns": twice.pts_ns, "image": twice.image})
    after = [script.good(15)]
    late = script.frames[-4].frame
    script.fault({"seq": late.seq, "pts_ns": late.pts_ns})
    after.append(script.good(15))
    watch = watched(script, source={"order": FrameOrder()})
    counts = watch.part(SourceResult).counts
    assert counts["duplicates"] == counts["out_of_order"] == 1
    assert watch.part(SourceResult).frames == len(script.frames) - 2
    for frames in after:
        watch.recovers_in(frames)
    watch.learned_nothing_bad()


@pytest.mark.slow
def test_live_starts_new_scene_at_each_frame_size_change(watched):
    """Each size starts a new scene, even if its first pictures are black."""
    script = Script()
    script.good(20)
    sizes = (80, 64), (WIDTH, HEIGHT), (48, 72)
    after = []
    for width, height in sizes:
        script.fault(*[{"image": np.zeros((height, width, 3), np.uint8)}] * 2)
        first = len(script.frames)
        for k in range(first, first + 20):
            script.good(1, image=scope_picture(k, width, height))
        after.append(range(first, first + 20))
    watch = watched(script)
    all_frames_arrived(watch)
    assert watch.part(CutCounts).found["resized"] == 3
    assert watch.part(TrainingCounts).scenes == {"resized": 3}
    for frames in after:
        watch.recovers_in(frames)
    watch.learned_nothing_bad()
    camera = load_bundle(watch.outcome.outputs["model"]).camera
    assert (camera.width_px, camera.height_px) == sizes[-1]


@pytest.mark.slow
def test_live_rejects_impossible_masks_and_unusable_depth(watched):
    """Masks of tool only (briefly and for a second) and of tissue only; depth of NaN, infinity and implausible values."""
    tool = np.ones((HEIGHT, WIDTH), np.uint8)
    tool[:, : WIDTH // 4] = 0
    plane = np.full((HEIGHT, WIDTH), 60.0, np.float32)
    holes = plane.copy()
    holes[::9, ::7], holes[4::9, 3::7] = np.nan, np.inf
    script = Script(mask=lambda seq: tool, depth=lambda seq: plane)
    script.good(20)
    script.fault(*[{"mask": np.zeros_like(tool)}] * 4)
    after = [script.good(12)]
    script.fault(*[{"mask": np.ones_like(tool)}] * 4)
    after.append(script.good(12))
    for depth in (np.full_like(plane, np.nan), holes, np.full_like(plane, np.inf), -plane, plane * 1000):
        after.append(script.good(12, depth=depth))
    after.append(script.good(12))
    hidden = script.fault(*[{"mask": np.zeros_like(tool)}] * 28)
    after.append(script.good(12))
    watch = watched(script)
    all_frames_arrived(watch)
    found = watch.part(MaskAndDepthCounts).found
    assert (found["no tissue"], found["tool mask lost"]) == (4 + 28, 4)
    assert found["depth not usable"] == 48 and found["depth repaired"] == 12
    assert set(watch.part(TrainingCounts).withheld) <= {"no tissue", "tool mask lost"}
    stale = [each for each in watch.shown if each.state is PictureState.STALE and each.rendered.frame.seq in hidden]
    assert stale and all(picture.remembered is not None for picture in stale), "after 0.7 s nothing of it is live"
    for picture in watch.shown:
        if picture.state is PictureState.LIVE and picture.remembered is not None:
            assert not picture.remembered[tool > 0].any(), "only what the tool hides is marked in a live picture"
    for frames in after:
        watch.recovers_in(frames)
    watch.learned_nothing_bad()


@pytest.mark.slow
def test_live_shows_source_lost_during_five_second_gap_and_recovers(watched):
    script = Script()
    script.good(20)
    after = script.good(25, pause_s=5.0)
    watch = watched(script)
    all_frames_arrived(watch)
    source, states = watch.part(SourceResult), watch.part(LiveDisplayResult).states
    assert source.state_s["stalled"] > 4 and source.counts["stalls"] == 1
    assert states["live"] >= 2 and states["source lost"] == 1, "the end of the script is none"
    gone = [
        picture
        for picture in watch.shown
        if picture.state is PictureState.SOURCE_LOST and not picture.new and picture.rendered.frame.seq < after[0]
    ]
    assert max(picture.age_ns for picture in gone) > 4.5e9, "its age is shown as long as nothing comes"
    red = tuple(COLOURS[PictureState.SOURCE_LOST])
    assert all(tuple(picture.image[-1, -1]) == red for picture in gone), "drawn into the picture"
    assert all(picture.remembered is not None for picture in gone), "nobody sees any of it"
    watch.recovers_in(after)
    watch.learned_nothing_bad()


@pytest.mark.slow
def test_live_neither_trains_on_nor_shows_out_of_body_frames(watched):
    """No out-of-body picture is trained on or shown, and the stream is trusted again after ten frames from inside."""
    room = np.full((HEIGHT, WIDTH, 3), (90, 140, 200), np.uint8) + np.arange(WIDTH, dtype=np.uint8)[:, None] // 2
    script = Script()
    script.good(25)
    outside = script.fault(*[{"image": np.roll(room, k, axis=1)} for k in range(6)])
    script.fault(*[{}] * 9)
    after = script.good(25)
    watch = watched(script, out_of_body="withhold")
    all_frames_arrived(watch)
    gate = watch.part(OutOfBodyFrames)
    assert sum(gate.withheld.values()) >= 15 and gate.passed >= 20
    assert watch.part(TrainingCounts).withheld["out of body"] >= 1
    watch.recovers_in(after)
    watch.learned_nothing_bad()
    for picture in watch.shown:
        if picture.rendered.frame.seq in outside:
            assert not picture.rendered.trained and not picture.rendered.frame.image.any()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_live_recovers_from_random_mixture_of_faults(watched, seed):
    """Random faults start at the first frame."""
    rng = np.random.default_rng(seed)
    script = Script(mask=lambda seq: None, depth=lambda seq: None)
    small = np.zeros((32, 40, 3), np.uint8)
    noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    choices = [
        lambda: script.fault({"image": BLACK}),
        lambda: script.fault({"image": small}),
        lambda: script.fault({"image": np.full_like(BLACK, 255)}),
        lambda: script.fault({"image": noise}),
        lambda: script.fault({"mask": np.zeros((HEIGHT, WIDTH), np.uint8)}),
        lambda: script.fault({"status": FrameStatus.DAMAGED, "mask": np.ones((HEIGHT, WIDTH), np.uint8)}),
        lambda: script.good(1, depth=np.full((HEIGHT, WIDTH), np.nan, np.float32)),
        lambda: script.good(1, image=scope_picture(len(script.frames), 56, 40)),
        lambda: setattr(script, "pts_ns", script.pts_ns + int(rng.integers(-9, 9)) * SECOND_NS),
    ]
    for _ in range(60):
        choices[rng.integers(len(choices))]()
        script.good(int(rng.integers(0, 3)))
    after = script.good(40)
    watch = watched(script)
    all_frames_arrived(watch)
    watch.recovers_in(after)
    watch.learned_nothing_bad()


def test_live_run_without_log_still_scores_pictures(watched):
    script = Script()
    script.good(15)
    watch = watched(script, report=False)
    assert watch.outcome is not None
    assert "frames" not in watch.outcome.outputs
    assert watch.part(OnScreenResult).frames > 5
