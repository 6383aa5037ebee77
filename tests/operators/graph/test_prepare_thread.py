"""`prepare` runs once in the computing thread, before any compute, and its exceptions end the run."""

import threading

import pytest

from operators.errors import OperatorFailed
from operators.graph import Application, GreedyScheduler, MultiThreadScheduler, Operator, run


class Notes(Operator):
    """Says when it prepared and computed, and in which thread."""

    def __init__(self, fragment, *args, events, fails=False, **kwargs):
        self.events, self.fails = events, fails
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec):
        if self.name == "first":
            spec.output("value")
        else:
            spec.input("value")

    def prepare_thread(self):
        self.events.append((self.name, "prepares", threading.get_ident()))
        if self.fails:
            raise RuntimeError("no font")

    def compute(self, op_input, op_output, context):
        self.events.append((self.name, "computes", threading.get_ident()))
        if self.name == "first":
            op_output.emit(1, "value")
            self.stop_execution()
        else:
            op_input.receive("value")


def run_two(scheduler, fails=False):
    events = []

    class Two(Application):
        def compose(self):
            first = Notes(self, name="first", events=events)
            second = Notes(self, name="second", events=events, fails=fails)
            self.add_flow(first, second, {("value", "value")})

    graph = Two()
    graph.scheduler(scheduler(graph))
    run(graph, "embedded")
    return events


@pytest.mark.parametrize("scheduler", [GreedyScheduler, MultiThreadScheduler])
def test_prepare_thread_runs_once_per_operator_before_any_compute(scheduler):
    events = run_two(scheduler)
    assert sorted(name for name, what, _ in events[:2] if what == "prepares") == ["first", "second"]
    assert [what for _, what, _ in events[2:]] == ["computes", "computes"]
    for name in ("first", "second"):
        assert len({thread for one, _, thread in events if one == name}) == 1


@pytest.mark.parametrize("scheduler", [GreedyScheduler, MultiThreadScheduler])
def test_prepare_thread_error_ends_run_before_any_compute(scheduler):
    with pytest.raises(OperatorFailed, match=r"'second' failed in prepare_thread.*no font"):
        run_two(scheduler, fails=True)
