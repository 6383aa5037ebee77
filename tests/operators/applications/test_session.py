"""A session runs a graph that it knows nothing about, attempts every part, and puts together what operators contribute."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from gsplat_core.errors import InvalidInput
from operators.applications.session import RunSettings, Session
from operators.errors import RunFailed, StorageFull
from operators.graph import Application, Operator
from operators.ingest import SourceOp
from operators.sources.recording import RecordingSource

SETTINGS = RunSettings("cpu", "embedded", "none", "none", 0, 1.0, None, False)


@dataclass(frozen=True)
class Counted:
    frames: int


@dataclass(frozen=True)
class Named:
    name: str


class CountOp(Operator):
    """Counts what arrives; contributes the count."""

    started = 0

    def __init__(self, fragment, *args, fail_at=None, **kwargs):
        self.frames, self.fail_at = 0, fail_at
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec):
        spec.input("frame")

    def start(self):
        type(self).started += 1

    def compute(self, op_input, op_output, context):
        op_input.receive("frame")
        if self.frames == self.fail_at:
            raise StorageFull("no room")
        self.frames += 1

    def contribute(self, outcome):
        outcome.add(Counted(self.frames))
        outcome.note(f"{self.frames} counted")


class Graph(Application):
    def __init__(self, source, names=("count",), **options):
        super().__init__(name="counting", track=True)
        self.given, self.names, self.options = source, names, options

    def compose(self):
        source = SourceOp(self, name="source", source=self.given)
        for name in self.names:
            self.add_flow(source, CountOp(self, name=name, **self.options))

    def contribute(self, outcome):
        outcome.add(Named(self.name))


@pytest.fixture
def graph(recording):
    return Graph(RecordingSource(recording))


def test_session_outcome_combines_parts_of_operators_and_graph(graph):
    outcome = Session(graph, SETTINGS, command="count", notes=["first"]).execute()
    assert outcome.find(Counted) == Counted(5) and outcome.find(Named) == Named("counting")
    assert outcome.notes == ("first", "5 counted")
    assert (outcome.command, outcome.settings, outcome.stop_reason) == ("count", SETTINGS, "end of recording")
    assert not outcome.interrupted and outcome.dropped == 0
    assert outcome.operators["count"].count == 5 and set(outcome.latency) == {"source,count"}


def test_session_start_run_end_outcome_equal_execute(graph):
    session = Session(graph, SETTINGS, command="count")
    session.start()
    session.run()
    assert session.reached.find(Counted) is None, "nothing is collected before the end"
    session.end()
    assert session.outcome().find(Counted) == Counted(5)


def test_session_refuses_conflicting_outcome_parts_before_start(recording):
    CountOp.started = 0
    session = Session(Graph(RecordingSource(recording), ["one", "two"]), SETTINGS, command="count")
    with pytest.raises(RunFailed, match="two operators of one run contribute a Counted") as caught:
        session.execute()
    assert isinstance(caught.value.__cause__, InvalidInput) and CountOp.started == 0


def test_session_failure_keeps_partial_outcome_and_runs_other_finishers(recording):
    done = []

    def fails(session):
        done.append("fails")
        raise StorageFull("no room for this either")

    def works(session):
        done.append("works")
        session.reached.add(Named(f"after {session.reached.find(Counted).frames}"))

    graph = Graph(RecordingSource(recording), fail_at=3)
    graph.contribute = lambda outcome: None
    with pytest.raises(
        RunFailed, match="the count ended early: operator 'count' failed in compute on frame 3"
    ) as caught:
        Session(graph, SETTINGS, command="count", finish=[fails, works]).execute()
    outcome = caught.value.result
    assert done == ["fails", "works"]
    assert outcome.find(Counted) == Counted(3) and outcome.find(Named) == Named("after 3")
    assert outcome.stop_reason == "operator 'count' failed in compute on frame 3: StorageFull: no room"
    assert outcome.notes == (outcome.stop_reason, "no room for this either", "3 counted")


def test_session_raises_programming_error_immediately(graph):
    def broken(session):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        Session(graph, SETTINGS, command="count", finish=[broken]).execute()


def test_failing_contribution_keeps_other_contributions(recording):
    class Unreadable(Graph):
        over = False

        def contribute(self, outcome):
            if self.over:
                raise StorageFull("cannot be read back")

    graph = Unreadable(RecordingSource(recording))
    session = Session(graph, SETTINGS, command="count")
    session.start()
    session.run()
    graph.over = True
    session.end()
    assert str(session.failure) == "cannot be read back" and session.outcome().find(Counted) == Counted(5)


def test_stop_request_after_end_of_source_is_not_interruption(recording):
    graph = Graph(RecordingSource(recording))
    outcome = Session(graph, SETTINGS, command="count", stop_requested=lambda: True).execute()
    assert not outcome.interrupted, "the source was not asked to stop, and ended by itself"
