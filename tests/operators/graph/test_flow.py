"""What flows, and how runs end: the same on every engine and scheduler."""

from __future__ import annotations

import threading
import time

import pytest

from operators.errors import GraphBusy, GraphDeadlock, MetadataConflict, OperatorFailed, PortError, QueueFull
from operators.graph import (
    AsynchronousCondition,
    AsynchronousEventState,
    BooleanCondition,
    ConditionType,
    CountCondition,
    IOSpec,
    MetadataPolicy,
    Operator,
    PeriodicCondition,
    StopReason,
)


def test_chain_delivers_everything_in_order(kit, runner):
    app = kit.Wired(lambda app: _chain(app, kit, 50))
    result = runner(app)
    _, _, sink = app.ops
    assert sink.values == [2 * i for i in range(50)]
    assert sink.seqs == list(range(50))
    assert result.reason is StopReason.FINISHED and result.error is None and app.result is result
    assert result.computes == {"source": 50, "double": 50, "sink": 50} == app.compute_counts()
    assert [(edge.sent, edge.received, edge.queued, edge.dropped) for edge in result.edges] == [(50, 50, 0, {})] * 2


def _chain(app, kit, count):
    operators = (
        app.counted(count, kit.Source, name="source"),
        kit.Apply(app, name="double", function=lambda value: 2 * value),
        kit.Collect(app, name="sink"),
    )
    app.chain(*operators)
    return operators


def test_values_travel_by_reference(kit, runner):
    import numpy as np

    made = []

    def make(value):
        made.append({"mask": np.zeros(3, bool), "image": np.zeros((2, 2))})
        return made[-1]

    def wire(app):
        sink = kit.Collect(app, name="sink")
        app.chain(app.counted(3, kit.Source, name="source"), kit.Apply(app, name="make", function=make), sink)
        return sink

    app = kit.Wired(wire)
    runner(app)
    assert all(got is sent for got, sent in zip(app.ops.values, made, strict=True))


def test_diamond_joins_the_branches_of_one_frame(kit, runner):
    def wire(app):
        source, join, sink = app.counted(30, kit.Source), kit.Join(app), kit.Collect(app)
        left, right = kit.Apply(app, name="a", function=lambda v: v), kit.Apply(app, name="b", function=lambda v: -v)
        app.add_flow(source, left)
        app.add_flow(source, right)
        app.add_flow(left, join, {("out", "left")})
        app.add_flow(right, join, {("out", "right")})
        app.add_flow(join, sink)
        return sink

    app = kit.Wired(wire)
    runner(app)
    assert app.ops.values == [(i, -i) for i in range(30)]
    assert app.ops.seqs == list(range(30))


class Tag(Operator):
    def setup(self, spec):
        spec.input("in")
        spec.output("out")
        spec.param("key")

    def compute(self, op_input, op_output, context):
        value = op_input.receive("in")
        self.metadata["tag"] = self.key
        self.metadata[self.key] = value
        op_output.emit(value, "out")


@pytest.mark.parametrize(
    ("policy", "tag"), [(MetadataPolicy.UPDATE, "right"), (MetadataPolicy.REJECT, "left"), (MetadataPolicy.RAISE, None)]
)
def test_metadata_of_a_join_follows_its_policy(kit, runner, policy, tag):
    seen = []

    class Look(kit.Join):
        metadata_policy = policy

        def compute(self, op_input, op_output, context):
            super().compute(op_input, op_output, context)
            seen.append(dict(self.metadata))

    def wire(app):
        source, join = app.counted(3, kit.Source), Look(app, name="join")
        left, right = Tag(app, name="l", key="left"), Tag(app, name="r", key="right")
        app.add_flow(source, left)
        app.add_flow(source, right)
        app.add_flow(left, join, {("out", "left")})
        app.add_flow(right, join, {("out", "right")})
        app.add_flow(join, kit.Collect(app))

    app = kit.Wired(wire)
    if policy is MetadataPolicy.RAISE:
        with pytest.raises(OperatorFailed, match=r"'join'.*frame 0.*'tag'") as caught:
            runner(app)
        assert isinstance(caught.value.__cause__, MetadataConflict)
    else:
        runner(app)
        assert seen == [{"seq": i, "tag": tag, "left": i, "right": i} for i in range(3)]


def test_a_finished_consumer_does_not_hold_up_the_others(kit, runner):
    def wire(app):
        source = app.counted(20, kit.Source, name="source")
        few, all_ = kit.Collect(app, CountCondition(app, 3), name="few"), kit.Collect(app, name="all")
        app.add_flow(source, few)
        app.add_flow(source, all_)
        return few, all_

    app = kit.Wired(wire)
    result = runner(app)
    few, all_ = app.ops
    assert few.values == [0, 1, 2] and all_.values == list(range(20))
    assert result.reason is StopReason.FINISHED
    stats = {edge.edge: edge for edge in result.edges}["source.out -> few.in"]
    assert (stats.sent, stats.received, stats.queued, stats.dropped) == (20, 3, 0, {"closed": 17})


def test_a_join_that_starved_does_not_hold_up_its_other_producer(kit, runner):
    def wire(app):
        short, long = app.counted(2, kit.Source, name="short"), app.counted(9, kit.Source, name="long")
        join, sink = kit.Join(app, name="join"), kit.Collect(app, name="sink")
        app.add_flow(short, join, {("out", "left")})
        app.add_flow(long, join, {("out", "right")})
        app.add_flow(join, kit.Collect(app, name="pairs"))
        app.add_flow(long, sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values == list(range(9))


def test_a_source_whose_only_consumer_is_done_finishes(kit, runner):
    def wire(app):
        app.chain(kit.Source(app, name="endless"), kit.Collect(app, CountCondition(app, 4), name="sink"))

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.FINISHED
    assert result.computes["sink"] == 4


def test_deadlock_says_who_waits_on_what(kit, runner):
    def wire(app):
        source, join = app.counted(10, kit.Source, name="source"), kit.Join(app, name="join")
        nothing = kit.Apply(app, name="nothing", function=lambda value: None)
        app.add_flow(source, nothing)
        app.add_flow(nothing, join, {("out", "left")})
        app.add_flow(source, join, {("out", "right")})
        app.add_flow(join, kit.Collect(app, name="sink"))

    app = kit.Wired(wire)
    with pytest.raises(GraphDeadlock, match=r"source waits for room on source.out -> join.right") as caught:
        runner(app)
    assert caught.value.waiting == {
        "source": "room on source.out -> join.right (1 of 1 taken)",
        "nothing": "a message on source.out -> nothing.in",
        "join": "a message on nothing.out -> join.left",
        "sink": "a message on join.out -> sink.in",
    }
    assert app.result.reason is StopReason.DEADLOCK and app.result.computes["source"] == 1


def test_stop_execution_in_compute_ends_an_endless_graph(kit, runner):
    def wire(app):
        def stop_at(value):
            if value == 5:
                app.stop_execution()

        sink = kit.Collect(app, name="sink", function=stop_at)
        app.chain(kit.Source(app), sink)
        return sink

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.STOPPED and result.error is None
    assert app.ops.values == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("waiting_for", ["event", "time", "nothing"])
def test_stop_execution_from_another_thread(kit, runner, waiting_for):
    begun = threading.Event()

    class Waiting(Operator):
        def compute(self, op_input, op_output, context):
            if waiting_for == "event":
                self.conditions[0].event_state = AsynchronousEventState.EVENT_WAITING
            begun.set()

    def wire(app):
        conditions = {
            "event": AsynchronousCondition(app),
            "time": PeriodicCondition(app, 3600 * 10**9),
            "nothing": BooleanCondition(app),
        }
        app.add_operator(Waiting(app, conditions[waiting_for]))

    app = kit.Wired(wire)
    thread, outcome = runner.in_background(app)
    assert begun.wait(10)
    with pytest.raises(GraphBusy):
        app.run()
    app.stop_execution()
    thread.join(10)
    assert not thread.is_alive(), "stop_execution did not end the run"
    assert outcome[0].reason is StopReason.STOPPED


def test_an_operator_can_finish_alone(kit, runner):
    def wire(app):
        source, sink = kit.Source(app, name="source"), kit.Collect(app, name="sink")
        sink.function = lambda value: source.stop_execution() if value == 3 else None
        app.chain(source, sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values[:4] == [0, 1, 2, 3]
    assert app.ops.values == list(range(len(app.ops.values)))


def test_an_outside_event_wakes(kit, runner):
    class Driven(Operator):
        def start(self):
            self.computes = 0
            self.asleep = threading.Event()

        def compute(self, op_input, op_output, context):
            self.computes += 1
            self.conditions[0].event_state = AsynchronousEventState.EVENT_WAITING
            self.asleep.set()

    ready = threading.Event()

    class Started(Driven):
        def start(self):
            super().start()
            ready.set()

    def wire(app):
        driven = Started(app, AsynchronousCondition(app, name="camera"))
        app.add_operator(driven)
        return driven

    app = kit.Wired(wire)
    thread, outcome = runner.in_background(app)
    assert ready.wait(10)
    event = app.ops.conditions[0]
    for _ in range(3):
        assert app.ops.asleep.wait(10)
        app.ops.asleep.clear()
        time.sleep(0.02)
        event.event_state = AsynchronousEventState.EVENT_DONE
    assert app.ops.asleep.wait(10)
    time.sleep(0.02)
    event.event_state = AsynchronousEventState.EVENT_NEVER
    thread.join(10)
    assert not thread.is_alive(), "EVENT_NEVER did not end the run"
    assert outcome[0].reason is StopReason.FINISHED
    assert app.ops.computes == 4


def test_boolean_condition_finishes_the_operator(kit, runner):
    def wire(app):
        enabled = BooleanCondition(app)
        sink = kit.Collect(app, function=lambda value: enabled.disable_tick() if value == 2 else None)
        app.chain(kit.Source(app, enabled), sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values[:3] == [0, 1, 2]


@pytest.mark.parametrize(("policy", "received"), [("drop_oldest", [2, 5, 8]), ("drop_new", [0, 3, 6])])
def test_drops_are_counted(kit, runner, policy, received):
    def wire(app):
        source, sink = app.counted(3, kit.Source, name="source", per_compute=3), kit.Collect(app, name="sink")
        app.add_flow(source, sink, policy=policy)
        return sink

    app = kit.Wired(wire)
    (stats,) = runner(app).edges
    assert stats.sent == 9 and stats.queued == 0
    assert stats.received + sum(stats.dropped.values()) == 9
    assert len(app.ops.values) == stats.received
    assert app.ops.values == sorted(app.ops.values)
    if policy == "drop_oldest":
        assert app.ops.values[-1] == 8
    if not runner.threads:
        assert app.ops.values == received
        assert stats.dropped == {policy: 6}


def test_a_dropping_edge_does_not_hold_up_its_producer(kit, runner):
    """A viewer never slows the graph: the source goes on while the viewer's frame is unseen."""
    seen = threading.Event()

    def wire(app):
        source = app.counted(100, kit.Source, name="source")
        slow, fast = kit.Collect(app, name="viewer"), kit.Collect(app, name="recorder")
        if runner.threads:
            slow.function = lambda value: seen.wait(10)
            fast.function = lambda value: seen.set() if value == 99 else None
        app.add_flow(source, slow, policy="drop_oldest")
        app.add_flow(source, fast)
        return slow, fast

    app = kit.Wired(wire)
    result = runner(app)
    viewer, recorder = app.ops
    assert recorder.values == list(range(100))
    assert viewer.values[-1] == 99
    if runner.threads:
        assert len(viewer.values) <= 3
    stats = {edge.edge: edge for edge in result.edges}["source.out -> viewer.in"]
    assert stats.sent == 100 == stats.received + sum(stats.dropped.values())


def test_emitting_more_than_a_blocking_edge_holds_is_an_error(kit, runner):
    app = kit.Wired(lambda app: app.chain(app.counted(1, kit.Source, per_compute=2), kit.Collect(app)))
    with pytest.raises(OperatorFailed, match=r"Source.out -> Collect.in holds 1") as caught:
        runner(app)
    assert isinstance(caught.value.__cause__, QueueFull)


def test_a_larger_capacity_takes_more(kit, runner):
    with pytest.raises(OperatorFailed, match="holds 2"):
        # The default condition of an output asks for room for one message only.
        runner(
            kit.Wired(lambda app: app.chain(app.counted(4, kit.Source, per_compute=3), kit.Collect(app), capacity=2))
        )

    class Pairs(kit.Source):
        def setup(self, spec):
            super().setup(spec)
            spec.outputs["out"].condition(ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE, min_size=2)

    app = kit.Wired(lambda app: app.chain(app.counted(4, Pairs, per_compute=2), kit.Collect(app, name="c"), capacity=2))
    assert runner(app).computes["c"] == 8


class Batch(Operator):
    def setup(self, spec):
        spec.input("in", size=3)
        self.values = []

    def compute(self, op_input, op_output, context):
        self.values.append(op_input.receive("in"))


def test_a_port_of_size_n_receives_n_at_once(kit, runner):
    def wire(app):
        batch = Batch(app)
        app.chain(app.counted(7, kit.Source), batch)
        return batch

    app = kit.Wired(wire)
    (stats,) = runner(app).edges
    assert app.ops.values == [(0, 1, 2), (3, 4, 5)]
    assert stats.dropped == {"closed": 1}


class Many(Operator):
    def setup(self, spec):
        spec.input("in", size=IOSpec.ANY_SIZE)
        self.values = []

    def compute(self, op_input, op_output, context):
        self.values.append(op_input.receive("in"))


def test_any_size_receives_from_every_connection_in_order(kit, runner):
    def wire(app):
        many = Many(app)
        for factor in (1, 10, 100):
            scale = kit.Apply(app, name=f"x{factor}", function=lambda value, factor=factor: value * factor)
            app.chain(app.counted(3, kit.Source, name=f"s{factor}"), scale, many)
        return many

    app = kit.Wired(wire)
    runner(app)
    assert app.ops.values == [(0, 0, 0), (1, 10, 100), (2, 20, 200)]


class Optional(Operator):
    def setup(self, spec):
        spec.input("in")
        spec.input("hint", optional=True)
        spec.input("extra").condition(ConditionType.NONE)
        spec.output("debug", optional=True)
        self.values = []

    def compute(self, op_input, op_output, context):
        op_output.emit("unheard", "debug")
        self.values.append((op_input.receive("in"), op_input.receive("hint"), op_input.receive("extra")))


def test_optional_ports_may_stay_unconnected(kit, runner):
    def wire(app):
        optional = Optional(app)
        app.add_flow(app.counted(2, kit.Source), optional, {("out", "in")})
        return optional

    app = kit.Wired(wire)
    runner(app)
    assert app.ops.values == [(0, None, None), (1, None, None)]


class Feedback(Operator):
    def setup(self, spec):
        spec.input("in")
        spec.input("back").condition(ConditionType.NONE)
        spec.output("out")

    def compute(self, op_input, op_output, context):
        op_output.emit(op_input.receive("in") + (op_input.receive("back") or 0), "out")


def test_a_loop_runs_and_ends(kit, greedy_runner):
    def wire(app):
        feedback, sink, tee = Feedback(app, name="sum"), kit.Collect(app, name="sink"), kit.Apply(app, name="tee")
        app.add_flow(app.counted(5, kit.Source), feedback, {("out", "in")})
        app.add_flow(feedback, tee)
        app.add_flow(tee, feedback, {("out", "back")}, policy="drop_oldest")
        app.add_flow(tee, sink)
        return sink

    app = kit.Wired(wire)
    assert greedy_runner(app).reason is StopReason.FINISHED
    assert app.ops.values == [0, 1, 3, 6, 10]


def test_run_again_recomposes(kit, runner):
    app = kit.Wired(lambda app: _chain(app, kit, 4))
    runner(app)
    first = app.ops
    result = runner(app)
    assert app.ops[0] is not first[0]
    assert app.ops[2].values == first[2].values == [0, 2, 4, 6]
    assert result.computes["sink"] == 4


def test_periodic_operators_keep_their_rate(kit, runner):
    stamps = []

    class Clocked(kit.Source):
        def compute(self, op_input, op_output, context):
            stamps.append(context.clock.timestamp())
            super().compute(op_input, op_output, context)

    def wire(app):
        app.chain(Clocked(app, CountCondition(app, 4), PeriodicCondition(app, 20_000_000)), kit.Collect(app))

    runner(kit.Wired(wire))
    assert len(stamps) == 4
    assert stamps[-1] - stamps[0] >= 55_000_000


class Misuse(Operator):
    def setup(self, spec):
        spec.output("out", type=int)
        spec.param("act")

    def compute(self, op_input, op_output, context):
        self.act(op_input, op_output)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda ins, outs: outs.emit("text", "out"), "emitted str on output 'out'"),
        (lambda ins, outs: outs.emit(1, "elsewhere"), r"no output 'elsewhere'; it has \['out'\]"),
        (lambda ins, outs: ins.receive("in"), r"no input 'in'; it has \[\]"),
    ],
)
def test_misused_ports_are_errors(kit, runner, act, message):
    app = kit.Wired(lambda app: app.chain(Misuse(app, CountCondition(app, 1), act=act), kit.Collect(app)))
    with pytest.raises(OperatorFailed, match=message) as caught:
        runner(app)
    assert isinstance(caught.value.__cause__, PortError)


def test_operators_find_each_other(kit, runner):
    found = []

    class Finder(Operator):
        def compute(self, op_input, op_output, context):
            found.extend([context.find_operator("peer"), context.find_operator(), context.find_operator("nobody")])

    def wire(app):
        finder, peer = Finder(app, CountCondition(app, 1)), Finder(app, CountCondition(app, 0), name="peer")
        app.add_operator(finder)
        app.add_operator(peer)
        return peer, finder

    app = kit.Wired(wire)
    runner(app)
    assert found == [*app.ops, None]
