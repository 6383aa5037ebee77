"""The displayed age of a picture and its meaning."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.scene.frames import FrameStatus
from operators import display
from operators.display import (
    COLOURS,
    LEAST_LABELLED_PX,
    POLL_NS,
    DisplayOp,
    LiveDisplayResult,
    _age_text,
    _is_outdated,
    draw_label,
    picture_state,
)
from operators.frame_clock import BehindGuard, ClockSettings, FrameClock
from operators.messages import PictureState
from operators.outcome import OutcomeBuilder
from operators.sources.source import SourceState


class Screen:
    """A display on a clock that is moved by hand."""

    def __init__(self, fake_time):
        self.time = fake_time
        self.source = SourceState.LIVE
        clock = FrameClock(ClockSettings(), 30.0, fake_time)
        self.operator = DisplayOp(None, clock=clock, source_state=lambda: self.source)
        self.operator.start()


@pytest.fixture
def screen(fake_time):
    return Screen(fake_time)


def picture_aged(rendered, frame, fake_time, seq=0, age_ms=10.0):
    """A picture of a frame that came so long ago."""
    return rendered(seq, frame=frame(seq, arrived_ns=fake_time.ns - round(age_ms * 1e6)))


def grey_picture(height, rendered, frame, fake_time):
    """An even grey picture of that height of a frame that arrived 10 ms ago."""
    image = np.full((height, 320, 3), 7, np.uint8)
    return rendered(0, frame=frame(0, arrived_ns=fake_time.ns - 10_000_000, image=image))


def test_display_shows_new_picture_with_age(screen, rendered, frame, fake_time, compute_queued):
    (shown,) = compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time)])
    assert shown.state is PictureState.LIVE
    assert shown.new
    assert shown.age_ns == 10_000_000


def test_display_age_is_age_of_content(screen, rendered, frame, fake_time, compute_queued):
    old = frame(0, arrived_ns=fake_time.ns - 500_000_000)
    picture = rendered(5, frame=frame(5, arrived_ns=fake_time.ns), content=old)
    (shown,) = compute_queued(screen.operator, rendered=[picture])
    assert shown.age_ns == 500_000_000
    assert shown.state is PictureState.STALE


def test_display_picture_becomes_stale_then_frozen(screen, rendered, frame, fake_time, compute_queued):
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time)])
    states = []
    for _ in range(30):
        fake_time.pass_ms(50)
        states += [shown.state for shown in compute_queued(screen.operator) if not shown.new]
    changes = [state for k, state in enumerate(states) if k == 0 or states[k - 1] is not state]
    assert changes == [PictureState.STALE, PictureState.FROZEN]


def test_display_shows_source_lost_immediately_and_live_after_recovery(
    screen, rendered, frame, fake_time, compute_queued
):
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time)])
    screen.source = SourceState.RECONNECTING
    (shown,) = compute_queued(screen.operator)
    assert (shown.state, shown.new) == (PictureState.SOURCE_LOST, False)
    screen.source = SourceState.LIVE
    (shown,) = compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, seq=1)])
    assert shown.state is PictureState.LIVE


def test_display_does_not_resend_unchanged_live_picture(screen, rendered, frame, fake_time, compute_queued):
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time)])
    fake_time.pass_ms(20)
    assert compute_queued(screen.operator) == []


def test_display_emits_nothing_before_first_picture(screen, compute_queued):
    screen.source = SourceState.STALLED
    assert compute_queued(screen.operator) == []


def test_picture_state_depends_on_frame_interval(fake_time):
    assert picture_state(300e6, interval_ns=200e6, source=SourceState.LIVE) is PictureState.LIVE
    assert picture_state(300e6, interval_ns=33e6, source=SourceState.LIVE) is PictureState.STALE


def test_display_labels_non_live_picture_below_minimum_height(fake_time, rendered, frame, compute_queued, monkeypatch):
    monkeypatch.setattr(display, "LEAST_LABELLED_PX", 10_000)
    screen = Screen(fake_time)
    picture = picture_aged(rendered, frame, fake_time)
    (live,) = compute_queued(screen.operator, rendered=[picture])
    assert live.image is picture.image
    screen.source = SourceState.STALLED
    (lost,) = compute_queued(screen.operator)
    assert (lost.image != picture.image).any()


@pytest.mark.parametrize("state", [state for state in PictureState if state is not PictureState.BEHIND])
def test_display_draws_label_into_copy(screen, rendered, frame, fake_time, compute_queued, state):
    picture = grey_picture(LEAST_LABELLED_PX, rendered, frame, fake_time)
    before = picture.image.copy()
    fake_time.pass_ms({PictureState.STALE: 500, PictureState.FROZEN: 5000}.get(state, 0))
    screen.source = SourceState.STALLED if state is PictureState.SOURCE_LOST else SourceState.LIVE
    (shown,) = compute_queued(screen.operator, rendered=[picture])
    assert shown.state is state and (shown.image != before).any()
    assert np.array_equal(picture.image, before)


@pytest.mark.parametrize(("height", "labelled"), [(120, False), (240, True)])
def test_display_does_not_label_small_live_picture(
    screen, rendered, frame, fake_time, compute_queued, height, labelled
):
    picture = grey_picture(height, rendered, frame, fake_time)
    (live,) = compute_queued(screen.operator, rendered=[picture])
    assert (live.state, bool((live.image != picture.image).any())) == (PictureState.LIVE, labelled)
    fake_time.pass_ms(500)
    (stale,) = compute_queued(screen.operator)
    assert stale.state is PictureState.STALE and (stale.image != picture.image).any()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (7, 5)])
def test_draw_label_on_tiny_picture(size):
    picture = np.zeros((*size, 3), np.uint8)
    draw_label(picture, PictureState.FROZEN, 3e9)
    assert picture.any()


def with_tool(frame, **fields):
    """A frame with a tool over its upper half."""
    mask = np.ones(frame(0).image.shape[:2], np.uint8)
    mask[:8] = 0
    return frame(**{"mask": mask, **fields})


def test_display_marks_tissue_behind_tool_only(fake_time, rendered, frame, compute_queued, monkeypatch):
    monkeypatch.setattr(display, "LEAST_LABELLED_PX", 10_000)
    picture = rendered(0, frame=with_tool(frame, arrived_ns=fake_time.ns))
    (shown,) = compute_queued(Screen(fake_time).operator, rendered=[picture])
    tissue = picture.frame.mask > 0
    assert np.array_equal(shown.remembered == 0, tissue)
    assert np.array_equal(shown.image[tissue], picture.image[tissue])
    assert (np.ptp(shown.image[~tissue], axis=-1) == 0).all()


def test_display_marks_whole_picture_as_remembered_if_outdated(screen, rendered, frame, fake_time, compute_queued):
    content = frame(0, arrived_ns=fake_time.ns)
    seen = rendered(0, frame=content, content=content)
    black = rendered(1, frame=frame(1, withheld="black"), content=content)
    assert compute_queued(screen.operator, rendered=[black])[0].remembered is None, "what it shows was seen just now"
    fake_time.pass_ms(300)
    (held,) = compute_queued(screen.operator, rendered=[black])
    (late,) = compute_queued(screen.operator, rendered=[seen])
    assert held.state is late.state is PictureState.STALE
    assert held.remembered.all() and late.remembered is None, "a slow machine is late and not blind"
    fake_time.pass_ms(900)
    (frozen,) = compute_queued(screen.operator)
    assert frozen.state is PictureState.FROZEN and frozen.remembered.all()
    screen.source = SourceState.RECONNECTING
    (lost,) = compute_queued(screen.operator)
    assert lost.state is PictureState.SOURCE_LOST and lost.remembered.all()


def test_display_outcome_counts_states_and_ages(screen, rendered, frame, fake_time, compute_queued):
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, age_ms=40)])
    fake_time.pass_ms(100)
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, seq=1, age_ms=10)])
    outcome = OutcomeBuilder()
    screen.operator.contribute(outcome)
    result = outcome.find(LiveDisplayResult)
    assert (result.pictures, result.states, result.first_picture_ms) == (2, {"live": 1}, 40.0)
    assert result.age.max_ms == 40.0


def test_display_outcome_separates_ages_of_first_second_and_withheld_frames(
    screen, rendered, frame, fake_time, compute_queued
):
    for time_s, age_ms, withheld in [(3.0, 200.0, None), (3.99, 100.0, None), (4.0, 20.0, None), (4.5, 90.0, "blur")]:
        of_frame = frame(
            0, pts_ns=round(time_s * 1e9), withheld=withheld, arrived_ns=fake_time.ns - round(age_ms * 1e6)
        )
        compute_queued(screen.operator, rendered=[rendered(0, frame=of_frame)])
        fake_time.pass_ms(300)
    outcome = OutcomeBuilder()
    screen.operator.contribute(outcome)
    result = outcome.find(LiveDisplayResult)
    assert [ages.max_ms for ages in (result.age, result.settled_age, result.used_age)] == [200.0, 90.0, 20.0]
    assert [ages.count for ages in (result.age, result.settled_age, result.used_age)] == [4, 2, 1]


@pytest.mark.parametrize(
    ("interval_ms", "stale_ms", "frozen_ms"),
    [(33.3, 150.0, 1000.0), (100.0, 300.0, 1000.0), (200.0, 600.0, 1200.0), (1000.0, 3000.0, 6000.0)],
)
def test_picture_state_thresholds_by_frame_interval(interval_ms, stale_ms, frozen_ms):
    state = lambda age_ms: picture_state(age_ms * 1e6, interval_ms * 1e6, SourceState.LIVE)
    assert state(0) is state(stale_ms) is PictureState.LIVE
    assert state(stale_ms + 0.1) is state(frozen_ms) is PictureState.STALE
    assert state(frozen_ms + 0.1) is PictureState.FROZEN


@pytest.mark.parametrize("source", [each for each in SourceState if each is not SourceState.LIVE])
def test_picture_state_is_source_lost_if_source_is_not_live(source):
    assert picture_state(0.0, 33e6, source) is PictureState.SOURCE_LOST


def test_display_resends_non_live_picture_every_200_ms(screen, rendered, frame, fake_time, compute_queued):
    compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, age_ms=0)])
    sent_ms = []
    for now_ms in range(10, 1001, 10):
        fake_time.pass_ms(10)
        again = compute_queued(screen.operator)
        assert all(shown.age_ns == now_ms * 1_000_000 and not shown.new for shown in again)
        sent_ms += [now_ms for _ in again]
    assert sent_ms == [160, 360, 560, 760, 960]


def test_display_age_of_future_picture_is_zero(screen, rendered, frame, fake_time, compute_queued):
    """Clocks of two processes may differ by a little."""
    (shown,) = compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, age_ms=-5)])
    assert (shown.age_ns, shown.state) == (0, PictureState.LIVE)
    assert screen.operator.age_p50_ms == 0


def test_display_updates_display_time_of_frame_clock(screen, rendered, frame, fake_time, compute_queued):
    usual_ns = screen.operator.clock.display_ns
    picture = rendered(0, frame=frame(0, arrived_ns=fake_time.ns), published_ns=fake_time.ns - 6_000_000)
    compute_queued(screen.operator, rendered=[picture])
    assert usual_ns < screen.operator.clock.display_ns < 6_000_000


def test_display_counts_each_state_change_once(screen, rendered, frame, fake_time, compute_queued):
    for seq in range(2):
        compute_queued(screen.operator, rendered=[picture_aged(rendered, frame, fake_time, seq=seq)])
        for _ in range(40):
            fake_time.pass_ms(50)
            compute_queued(screen.operator)
    assert screen.operator.states == {"live": 2, "stale": 2, "frozen": 2}


@pytest.mark.parametrize(("age_ns", "said"), [(4_400_000, "4 ms"), (999_000_000, "999 ms"), (1_250_000_000, "1.2 s")])
def test_age_text_is_in_ms_or_s(age_ns, said):
    assert _age_text(age_ns) == said


def test_display_op_polls_every_50_ms_and_queues_four_pictures(fake_time):
    clock = FrameClock(ClockSettings(), 25, fake_time)
    operator = DisplayOp(None, clock=clock, source_state=lambda: SourceState.LIVE)
    (condition,) = operator.conditions
    assert POLL_NS == condition.timeout_ns == 50_000_000
    assert operator.spec.inputs["rendered"].capacity == 4


@pytest.mark.parametrize(
    ("state", "unused", "outdated"),
    [
        (PictureState.LIVE, True, False),
        (PictureState.STALE, True, True),
        (PictureState.STALE, False, False),
        (PictureState.FROZEN, False, True),
        (PictureState.SOURCE_LOST, False, True),
    ],
)
def test_is_outdated_by_state_and_frame_use(rendered, frame, state, unused, outdated):
    for fields in ({"withheld": "black"}, {"status": FrameStatus.DAMAGED, "damage": "torn"}) if unused else ({},):
        assert _is_outdated(rendered(frame=frame(**fields)), state) is outdated


@pytest.mark.parametrize(("height", "edge"), [(64, 2), (160, 2), (240, 3)])
def test_draw_label_border_is_an_80th_of_picture_height(height, edge):
    picture = np.full((height, 320, 3), 7, np.uint8)
    draw_label(picture, PictureState.FROZEN, 0)
    column = (picture[:, 300] != 7).any(-1)
    # OpenCV draws a line of that thickness around the border, half of it inside of the picture.
    assert 0 < int(column[: height // 2].sum()) <= edge and column[0] and column[-1]
    live = np.full((height, 320, 3), 7, np.uint8)
    draw_label(live, PictureState.LIVE, 0)
    assert (live[-1] == 7).all() and (live[:, -1] == 7).all() and (live[:8, :8] != 7).any()


def test_display_op_initial_state(fake_time):
    operator = DisplayOp(None, clock=FrameClock(ClockSettings(), 25, fake_time), source_state=lambda: SourceState.LIVE)
    assert (operator.pictures, operator.state, operator.states, operator.age_p50_ms) == (0, None, {}, 0.0)


@pytest.mark.parametrize("state", PictureState)
def test_draw_label_text_lies_inside_box(state):
    picture = np.full((200, 400, 3), 7, np.uint8)
    draw_label(picture, state, 120e6)
    inside = picture[5:-5, 5:-5]
    text = inside.max(-1) > max(COLOURS[state]) // 2  # its edges are smoothed
    rows, columns = np.nonzero(text)
    black = np.nonzero((inside == 0).all(-1))
    assert len(rows) > 20 and rows.max() < black[0].max() and columns.max() < black[1].max()
    assert len(black[0]) > len(rows)


def test_display_shows_behind_if_previous_frame_is_better(rendered, frame, fake_time, compute_queued):
    guard = BehindGuard()
    guard.scene_begun(0)
    clock = FrameClock(ClockSettings(), 30.0, fake_time)
    operator = DisplayOp(None, clock=clock, source_state=lambda: SourceState.LIVE, guard=guard)
    guard.scene_begun(0)
    states = []
    for seq in range(4):
        arriving = frame(seq, arrived_ns=fake_time.ns)
        image = 255 - arriving.image if seq in (1, 2) else arriving.image
        (shown,) = compute_queued(operator, rendered=[rendered(seq, frame=arriving, image=image)])
        states.append(shown.state)
        fake_time.pass_ms(33)
    assert states == [PictureState.LIVE, PictureState.BEHIND, PictureState.BEHIND, PictureState.LIVE]
    assert operator.states == {"live": 2, "behind": 1}
