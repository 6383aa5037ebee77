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
def test_scheduler_by_pace_and_device(pace, device, scheduler):
    assert type(pace.scheduler(device, Application())) is scheduler


def test_queues_drop_frames_only_with_clock():
    assert Pace().queue(3) == {}
    assert Pace(clock=CLOCK).queue(3) == {"policy": "drop_oldest", "capacity": 3}


def test_training_policy_prefers_clock_then_session():
    session = SimpleNamespace(schedule=list, late_depths=lambda: iter(()))
    depth = SimpleNamespace(background=None)
    paces = Pace(clock=CLOCK, session=session), Pace(session=session), Pace()
    assert [type(pace.training(depth, lambda: False)) for pace in paces] == [UntilDisplay, RecordedCalls, EveryFrame]


def device_of_tools(analysis):
    (tools,) = (operator for operator in analysis.parts if isinstance(operator, BuiltInToolMaskOp))
    return tools.device


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_tool_network_runs_on_device_of_run(recording, tmp_path, device):
    settings = ReplaySettings(tmp_path, tmp_path, device=device)
    graph = Pipeline(
        RecordingSource(recording), settings, tmp_path, name="replay", pace=Pace(), make_reconstructor=lambda: None
    )
    graph.compose()
    (analysis,) = (operator for operator in graph.operators if isinstance(operator, SideBySideOp))
    assert device_of_tools(analysis) == device
    assert device_of_tools(analysis_operator(Application(), "builtin", "withhold")) == "cpu"
