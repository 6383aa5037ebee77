"""Scheduler, queues and training policy of a run with and without a clock."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from operators.applications.replay import ReplaySettings
from operators.frame_clock import ClockSettings, FrameClock
from operators.graph import Application, GreedyScheduler, MultiThreadScheduler
from operators.pipeline import Pace, Pipeline, SideBySideOp, analysis_operator
from operators.sources.recording import RecordingSource
from operators.tool_mask import BuiltInToolMaskOp
from operators.training import EveryFrame, RecordedCalls, UntilDisplay

CLOCK = FrameClock(ClockSettings(), 30.0)


@pytest.mark.parametrize(
    ("pace", "device", "scheduler"),
    [
        (Pace(), "cpu", GreedyScheduler),
        (Pace(), "cuda", MultiThreadScheduler),
        (Pace(clock=CLOCK), "cpu", MultiThreadScheduler),
        (Pace(clock=CLOCK), "cuda", MultiThreadScheduler),
    ],
)
def test_a_live_stream_has_one_thread_per_operator_on_every_device(pace, device, scheduler):
    assert type(pace.scheduler(device, Application())) is scheduler


def test_only_the_queues_of_a_live_stream_drop_frames():
    assert Pace().queue(3) == {}
    assert Pace(clock=CLOCK).queue(3) == {"policy": "drop_oldest", "capacity": 3}


def test_the_clock_decides_on_training_before_a_session_and_a_session_before_the_frames():
    session = SimpleNamespace(schedule=list, late_depths=lambda: iter(()))
    depth = SimpleNamespace(background=None)
    paces = Pace(clock=CLOCK, session=session), Pace(session=session), Pace()
    assert [type(pace.training(depth, lambda: False)) for pace in paces] == [UntilDisplay, RecordedCalls, EveryFrame]


def device_of_tools(analysis):
    (tools,) = (operator for operator in analysis.parts if isinstance(operator, BuiltInToolMaskOp))
    return tools.device


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_the_tool_network_runs_on_the_device_of_the_run(recording, tmp_path, device):
    settings = ReplaySettings(tmp_path, tmp_path, device=device)
    graph = Pipeline(
        RecordingSource(recording), settings, tmp_path, name="replay", pace=Pace(), make_reconstructor=lambda: None
    )
    graph.compose()
    (analysis,) = (operator for operator in graph.operators if isinstance(operator, SideBySideOp))
    assert device_of_tools(analysis) == device
    assert device_of_tools(analysis_operator(Application(), "builtin", "withhold")) == "cpu"
