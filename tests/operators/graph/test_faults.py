"""Exceptions in operators, on every engine and scheduler."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from operators.errors import OperatorFailed
from operators.graph import DISABLE_BRANCH, CountCondition, FaultAction, FaultPolicy, Operator, StopReason


def test_operator_error_stops_graph_and_names_operator_and_frame(kit, runner):
    life = kit.Recorder()

    def wire(app):
        source = app.counted(20, life(kit.Source), name="source")
        fail = life(kit.Apply)(app, name="recon", function=lambda value: 1 // (7 - value))
        app.chain(source, fail, life(kit.Collect)(app, name="sink"))

    app = kit.Wired(wire)
    with pytest.raises(OperatorFailed, match="'recon' failed in compute on frame 7: ZeroDivisionError") as caught:
        runner(app)
    assert (caught.value.operator, caught.value.phase, caught.value.seq) == ("recon", "compute", 7)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert app.result.reason is StopReason.FAILED and app.result.error is caught.value
    assert life.names("stop") == ["sink", "recon", "source"]
    assert [fault.action for fault in app.result.faults] == [FaultAction.STOP_GRAPH]


def test_operator_error_takes_frame_from_message_attribute(kit, runner):
    class Plain(kit.Source):
        def compute(self, op_input, op_output, context):
            op_output.emit(SimpleNamespace(seq=41), "out")

    def boom(value):
        raise RuntimeError("boom")

    app = kit.Wired(lambda app: app.chain(Plain(app), kit.Collect(app, function=boom)))
    with pytest.raises(OperatorFailed, match="on frame 41: RuntimeError: boom"):
        runner(app)


def test_operator_error_without_frame_has_no_frame_number(kit, runner):
    class Bad(Operator):
        def compute(self, op_input, op_output, context):
            raise RuntimeError("boom")

    app = kit.Wired(lambda app: app.add_operator(Bad(app)))
    with pytest.raises(OperatorFailed, match="'Bad' failed in compute: RuntimeError: boom") as caught:
        runner(app)
    assert caught.value.seq is None


def test_restart_policy_continues_with_next_message(kit, runner):
    life = kit.Recorder()

    def flaky(value):
        if value in (3, 5):
            raise ValueError(value)

    def wire(app):
        sink = life(kit.Collect)(app, name="sink", function=flaky, fault_policy=FaultPolicy.restart(2))
        app.chain(app.counted(8, kit.Source), sink)
        return sink

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.FINISHED
    assert app.ops.values == [0, 1, 2, 4, 6, 7]
    assert [what for _, what in life.events] == ["initialize", "start", "stop", "start", "stop", "start", "stop"]
    assert [(fault.operator, fault.error.seq, fault.action) for fault in result.faults] == [
        ("sink", 3, FaultAction.RESTART),
        ("sink", 5, FaultAction.RESTART),
    ]


@pytest.mark.parametrize("afterwards", [FaultAction.STOP_GRAPH, FaultAction.DISABLE_BRANCH])
def test_restart_policy_ends_after_maximum_restarts(kit, runner, afterwards):
    def bad(value):
        raise ValueError(value)

    def wire(app):
        source, other = app.counted(9, kit.Source), kit.Collect(app, name="other")
        app.add_flow(
            source, kit.Collect(app, name="bad", function=bad, fault_policy=FaultPolicy.restart(2, afterwards))
        )
        app.add_flow(source, other)
        return other

    app = kit.Wired(wire)
    if afterwards is FaultAction.STOP_GRAPH:
        with pytest.raises(OperatorFailed, match="'bad' failed in compute on frame 2"):
            runner(app)
    else:
        assert runner(app).reason is StopReason.FINISHED
        assert app.ops.values == list(range(9))
    assert [fault.action for fault in app.result.faults] == [FaultAction.RESTART, FaultAction.RESTART, afterwards]


def test_disable_branch_policy_finishes_branch_and_keeps_others(kit, runner):
    def wire(app):
        source, raw = app.counted(30, kit.Source, name="ingest"), kit.Collect(app, name="raw")
        recon = kit.Apply(
            app, name="recon", function=lambda value: 1 // (4 - value) + 1 or 1, fault_policy=DISABLE_BRANCH
        )
        deform, display = kit.Apply(app, name="deform"), kit.Collect(app, name="display")
        app.chain(source, recon, deform, display)
        app.add_flow(source, raw)
        return raw, display

    app = kit.Wired(wire)
    result = runner(app)
    raw, display = app.ops
    assert result.reason is StopReason.FINISHED
    assert raw.values == list(range(30))
    assert display.seqs == [0, 1, 2, 3]
    assert result.computes["recon"] == 5
    assert [fault.error.seq for fault in result.faults] == [4]


def test_disabling_one_producer_of_join_ends_join(kit, runner):
    def wire(app):
        bad, good = app.counted(9, kit.Source, name="bad", failing={2}), app.counted(9, kit.Source, name="good")
        bad.fault_policy = DISABLE_BRANCH
        join, pairs, raw = kit.Join(app), kit.Collect(app, name="pairs"), kit.Collect(app, name="raw")
        app.add_flow(bad, join, {("out", "left")})
        app.add_flow(good, join, {("out", "right")})
        app.add_flow(join, pairs)
        app.add_flow(good, raw)
        return pairs, raw

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    pairs, raw = app.ops
    assert pairs.values == [(0, 0), (1, 1)]
    assert raw.values == list(range(9))


class Bad(Operator):
    def setup(self, spec):
        spec.param("phase")

    def _maybe(self, phase):
        if self.phase == phase:
            raise OSError(f"cannot {phase}")

    def initialize(self):
        self._maybe("initialize")

    def start(self):
        self._maybe("start")

    def compute(self, op_input, op_output, context):
        self._maybe("compute")

    def stop(self):
        self._maybe("stop")


@pytest.mark.parametrize("phase", ["initialize", "start", "stop"])
def test_error_outside_compute_stops_started_operators(kit, runner, phase):
    life = kit.Recorder()

    def wire(app):
        for name in ("first", "bad", "last"):
            kind, kwargs = (Bad, {"phase": phase}) if name == "bad" else (kit.Source, {})
            if name == "bad":
                app.add_operator(life(kind)(app, CountCondition(app, 1), name=name, **kwargs))
            else:
                app.chain(life(kind)(app, CountCondition(app, 1), name=name), kit.Collect(app, name=f"sink of {name}"))

    app = kit.Wired(wire)
    with pytest.raises(OperatorFailed, match=f"'bad' failed in {phase}: OSError: cannot {phase}"):
        runner(app)
    assert app.result.reason is StopReason.FAILED
    expected = {"initialize": [], "start": ["first"], "stop": ["last", "bad", "first"]}[phase]
    assert life.names("stop") == expected


def test_disable_branch_policy_applies_to_error_in_start(kit, runner):
    def wire(app):
        app.add_operator(Bad(app, name="bad", phase="start", fault_policy=DISABLE_BRANCH))
        sink = kit.Collect(app)
        app.chain(app.counted(3, kit.Source), sink)
        return sink

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.FINISHED
    assert app.ops.values == [0, 1, 2]
    assert result.computes["bad"] == 0


def test_first_of_several_operator_failures_is_raised(kit, runner):
    class Worse(Bad):
        def stop(self):
            raise OSError("cannot stop either")

    app = kit.Wired(lambda app: app.add_operator(Worse(app, phase="compute")))
    with pytest.raises(OperatorFailed, match="failed in compute"):
        runner(app)


def test_system_exit_in_compute_propagates_from_run(kit, runner):
    life = kit.Recorder()

    def leave(value):
        raise SystemExit(3)

    app = kit.Wired(
        lambda app: app.chain(life(kit.Source)(app, name="a"), life(kit.Collect)(app, name="b", function=leave))
    )
    with pytest.raises(SystemExit) as caught:
        runner(app)
    assert caught.value.code == 3
    assert len(life.names("stop")) == 2
    assert app.result.reason is StopReason.FAILED


@pytest.mark.parametrize(
    "arguments", [(FaultAction.RESTART, 0), (FaultAction.STOP_GRAPH, 1), (FaultAction.RESTART, -1)]
)
def test_fault_policy_refuses_invalid_combinations(arguments):
    with pytest.raises(ValueError, match="does not go with"):
        FaultPolicy(*arguments)
    with pytest.raises(ValueError, match="afterwards"):
        FaultPolicy.restart(1, FaultAction.RESTART)
