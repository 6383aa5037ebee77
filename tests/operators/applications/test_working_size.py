"""A live run on a CPU works at the largest size that keeps up with the stream, and reports it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.applications import live as live_module
from operators.applications import working_size
from operators.applications.live import on_trial
from operators.applications.live_settings import LiveSettings
from operators.applications.working_size import (
    GIVEN_UP_S,
    MIN_SIDE_PX,
    MOST_MEASUREMENTS,
    SCALE_STEPS,
    SHARE_OF_INTERVAL,
    STARTING_FRAMES,
    PacedTissue,
    choose_working_size,
    measured_frame_s,
)
from operators.messages import PictureState, RenderedFrame, ShownPicture
from operators.sources.derived import ScaledSource, scaled_description
from operators.sources.source import SourceDescription, SourceState


def stream(width_px=640, height_px=512, fps=30.0):
    camera = Camera.from_focal(0.9 * width_px, width_px, height_px)
    return SourceDescription("scope", width_px, height_px, fps, camera)


class Machine:
    """Takes a fixed time for a frame and a time for each of its pixels; notes what it was asked."""

    def __init__(self, about, fixed_ms, ms_per_megapixel):
        self.about, self.fixed_ms, self.slope = about, fixed_ms, ms_per_megapixel
        self.asked = []

    def frame_s(self, scale):
        pixels = scale**2 * self.about.width_px * self.about.height_px
        return 1e-3 * (self.fixed_ms + self.slope * pixels * 1e-6)

    def measure(self, scale):
        self.asked.append(scale)
        return self.frame_s(scale)

    def best(self, share=SHARE_OF_INTERVAL):
        """The largest scale that fits, by looking at all of them."""
        smallest = math.ceil(SCALE_STEPS * MIN_SIDE_PX / min(self.about.width_px, self.about.height_px))
        steps = [step / SCALE_STEPS for step in range(min(SCALE_STEPS, smallest), SCALE_STEPS + 1)]
        return max((scale for scale in steps if self.frame_s(scale) <= share / self.about.fps), default=steps[0])


@pytest.mark.parametrize("size", [(640, 512), (1920, 1080), (360, 288), (320, 256), (4096, 2160), (512, 640)])
@pytest.mark.parametrize("fixed_ms", [0.0, 4.0, 12.0, 25.0])
@pytest.mark.parametrize("ms_per_megapixel", [1.0, 30.0, 120.0, 300.0, 2000.0])
def test_working_size_is_largest_that_keeps_up(size, fixed_ms, ms_per_megapixel):
    machine = Machine(stream(*size), fixed_ms, ms_per_megapixel)
    chosen = choose_working_size(machine.about, machine.measure)
    assert len(machine.asked) == len(set(machine.asked)) <= MOST_MEASUREMENTS
    assert chosen.scale in machine.asked, "what is chosen was measured"
    assert chosen.scale == machine.best()
    if len(machine.asked) > 1:
        assert chosen.frame_s == pytest.approx(machine.frame_s(chosen.scale))


@pytest.mark.parametrize("disturbed", range(MOST_MEASUREMENTS))
@pytest.mark.parametrize(("fixed_ms", "ms_per_megapixel"), [(3.0, 100.0), (6.0, 200.0), (12.0, 500.0), (15.0, 700.0)])
@pytest.mark.parametrize("factor", [1.3, 2.0])
def test_working_size_changes_at_most_one_step_by_one_disturbed_measurement(
    fixed_ms, ms_per_megapixel, disturbed, factor
):
    machine = Machine(stream(), fixed_ms, ms_per_megapixel)

    def measure(scale):
        took_s = machine.measure(scale)
        return took_s * factor if len(machine.asked) == disturbed + 1 else took_s

    chosen = choose_working_size(machine.about, measure)
    assert abs(chosen.scale - machine.best()) <= 1 / SCALE_STEPS


@pytest.mark.parametrize("fps", [15.0, 25.0, 60.0])
def test_working_size_is_smaller_at_higher_fps(fps):
    machine = Machine(stream(fps=fps), 3.0, 200.0)
    assert machine.best() - choose_working_size(machine.about, machine.measure).scale <= 1 / SCALE_STEPS
    faster = Machine(stream(fps=2 * fps), 3.0, 200.0)
    assert (
        choose_working_size(faster.about, faster.measure).scale
        < choose_working_size(machine.about, machine.measure).scale
    )


def test_working_size_is_smaller_for_smaller_interval_share():
    machine = Machine(stream(), 3.0, 200.0)
    half = choose_working_size(machine.about, machine.measure, share=0.5)
    assert half.scale <= machine.best(0.5) < machine.best()


def test_fast_machine_works_at_full_size_after_two_measurements():
    machine = Machine(stream(), 1.0, 20.0)
    chosen = choose_working_size(machine.about, machine.measure)
    assert chosen.scale == 1 and len(machine.asked) == 2
    assert chosen.sentence.startswith("the run reconstructs all 640x512 pixels: a frame takes 8 ms at this size")


def test_working_size_keeps_pictures_at_minimum_side():
    machine = Machine(stream(80, 64), 500.0, 0.0)
    assert choose_working_size(machine.about, machine.measure).scale == 1 and machine.asked == [1.0]


def test_working_size_of_slow_machine_is_smallest_with_note_about_skipped_frames():
    machine = Machine(stream(), 90.0, 100.0)
    chosen = choose_working_size(machine.about, machine.measure)
    assert chosen.scale == machine.best() and min(chosen.width_px, chosen.height_px) >= MIN_SIDE_PX
    assert chosen.sentence == (
        f"the run reconstructs {chosen.width_px}x{chosen.height_px} of 640x512 pixels: even at this size a frame takes 91 ms on this machine,"
        " and frames come 33 ms apart, so some of them are passed over; --scale sets another size"
    )


@pytest.mark.parametrize(
    "times", [[0.040, 0.060, 0.020, 0.035, 0.030, 0.050], [0.02] * 6, [0.5, 0.001, 0.5, 0.001, 0.5, 0.001]]
)
def test_working_size_is_valid_for_inconsistent_measurements(times):
    """A smaller picture may take longer under a different load."""
    left, asked = iter(times), []

    def measure(scale):
        asked.append(scale)
        return next(left)

    chosen = choose_working_size(stream(), measure)
    assert len(asked) == len(set(asked)) and min(chosen.width_px, chosen.height_px) >= MIN_SIDE_PX
    assert chosen.scale * SCALE_STEPS == round(chosen.scale * SCALE_STEPS) and chosen.scale <= 1 and chosen.frame_s > 0


def test_requested_scale_is_kept_without_measurement(monkeypatch, tmp_path):
    tried = []
    monkeypatch.setattr(live_module, "trial_run", lambda settings, source, new_graph: tried.append(settings.scale))
    monkeypatch.setattr(live_module, "measured_frame_s", lambda *_: pytest.fail("nothing is to be measured"))
    for settings in (
        LiveSettings("a", tmp_path, scale=0.5),
        LiveSettings("a", tmp_path, scale=1.0),
        LiveSettings("a", tmp_path, device="cuda"),
    ):
        source, notes = object(), []
        assert on_trial(settings, source, notes) == (settings, source) and notes == []
    assert tried == [0.5, 1.0, None]


class Still:
    """A source of one picture."""

    state, state_sentence = SourceState.LIVE, "well"

    def __init__(self, about):
        self.description, self.calls = about, []

    def open(self):
        self.calls.append("open")

    def close(self):
        self.calls.append("close")

    def counts(self):
        return {"late": 3}

    def read(self, timeout_s):
        self.calls.append(timeout_s)
        shape = self.description.height_px, self.description.width_px
        return Frame(0, 0, np.full((*shape, 3), 90, np.uint8), mask=np.ones(shape, np.uint8))


def test_chosen_working_size_is_in_source_settings_and_note(monkeypatch, tmp_path):
    about = stream()
    machine, sizes = Machine(about, 4.0, 300.0), []

    def measured(settings, scaled, new_graph):
        sizes.append((scaled.width_px, scaled.height_px, settings.scale))
        return machine.measure(settings.scale)

    monkeypatch.setattr(live_module, "measured_frame_s", measured)
    notes = []
    settings, source = on_trial(LiveSettings("a", tmp_path), Still(about), notes)
    assert isinstance(source, ScaledSource)
    width, height = source.description.width_px, source.description.height_px
    assert (width, height) == (round(640 * settings.scale), round(512 * settings.scale))
    assert (width, height, settings.scale) in sizes
    assert settings.stated().scale == settings.scale == machine.asked[-1] or settings.scale in machine.asked
    assert len(notes) == 1 and notes[0].startswith(f"the run reconstructs {width}x{height} of 640x512 pixels")
    frame = source.read(0.1)
    assert frame.image.shape == (height, width, 3) and frame.mask.shape == (height, width)


def test_full_working_size_uses_source_without_scaling(monkeypatch, tmp_path):
    monkeypatch.setattr(live_module, "measured_frame_s", lambda *_: 0.001)
    read = Still(stream())
    settings, source = on_trial(LiveSettings("a", tmp_path), read, [])
    assert source is read and settings.scale == 1.0


def test_scaled_source_resizes_frames_and_forwards_calls():
    read = Still(stream())
    scaled = ScaledSource(read, 0.25)
    scaled.open()
    assert scaled.read(0.5).image.shape == (128, 160, 3)
    scaled.close()
    assert read.calls == ["open", 0.5, "close"]
    assert (scaled.state, scaled.state_sentence, scaled.counts()) == (SourceState.LIVE, "well", {"late": 3})
    about = scaled.description
    assert (about.width_px, about.height_px, about.camera.width_px, about.fps) == (160, 128, 160, 30.0)
    np.testing.assert_allclose(about.camera.K[:2], read.description.camera.K[:2] / 4)
    # A frame that is larger than was said stays larger.
    read.description = stream(1280, 1024)
    assert ScaledSource(read, 0.25).description.width_px == 320
    assert scaled.read(0.5).image.shape[:2] != (64, 80)


def test_scaled_source_read_returns_none_at_end_of_stream():
    class Ended(Still):
        def read(self, timeout_s):
            return None

    assert ScaledSource(Ended(stream()), 0.5).read(0.1) is None


def shown(frame, shown_ns, new=True):
    plane = np.zeros(frame.image.shape[:2], np.float32)
    picture = RenderedFrame(frame, frame.image, plane, plane, 1, True)
    return ShownPicture(picture, frame.image, PictureState.LIVE, 0, shown_ns, new)


def test_paced_tissue_waits_for_shown_frame_and_uses_lower_quartile_time(monkeypatch):
    tissue = PacedTissue(scaled_description(stream(), 0.125))
    took_ms = [900, 800, 700, 10, 12, 11, 500, 13, 9, 10, 12, 11]
    given = tissue.frames()
    for seq, took in enumerate(took_ms):
        frame = next(given)
        assert (frame.seq, frame.image.shape) == (seq, (64, 80, 3))
        tissue.shown(shown(frame, frame.arrived_ns + took * 1_000_000))
        tissue.shown(shown(frame, frame.arrived_ns + 10**12, new=False))
    assert next(given, None) is None
    assert tissue.frame_s == pytest.approx(0.010)


def test_paced_tissue_gives_up_if_no_frame_is_shown(monkeypatch):
    monkeypatch.setattr(working_size, "GIVEN_UP_S", 0.001)
    tissue = PacedTissue(scaled_description(stream(), 0.125))
    assert len(list(tissue.frames())) == STARTING_FRAMES + 1
    assert tissue.frame_s == 0.001


def test_measured_frame_s_runs_live_graph(tmp_path):
    about = scaled_description(stream(), 0.125)
    graphs = []

    def new_graph(tissue, settings):
        assert settings.clock.at_most_steps == 1 and settings.record is None
        from operators.applications.live import live_graph, new_parts

        graphs.append(live_graph(tissue, settings, new_parts(settings, tissue), on_shown=tissue.shown))
        return graphs[0]

    took_s = measured_frame_s(replace(LiveSettings("a", tmp_path), scale=0.125), about, new_graph)
    assert 0 < took_s < GIVEN_UP_S
    counts = graphs[0].reconstruct.counts
    assert counts.frames >= STARTING_FRAMES and counts.rehearsed == 0
    assert list(tmp_path.iterdir()) == []
