"""Delivery of every message in order, by reference, with metadata, on every engine and scheduler."""

from __future__ import annotations

import pytest

from operators.errors import MetadataConflict, OperatorFailed
from operators.graph import (
    MetadataPolicy,
    Operator,
    StopReason,
)


def test_chain_delivers_all_messages_in_order(kit, runner):
    app = kit.Wired(lambda app: _chain(app, kit, 50))
    result = runner(app)
    _, _, sink = app.ops
    assert sink.values == [2 * i for i in range(50)]
    assert sink.seqs == list(range(50))
    assert result.reason is StopReason.FINISHED and result.error is None and app.result is result
    assert result.computes == {"source": 50, "double": 50, "sink": 50}
    assert [(edge.sent, edge.received, edge.queued, edge.dropped) for edge in result.edges] == [(50, 50, 0, {})] * 2


def _chain(app, kit, count):
    operators = (
        app.counted(count, kit.Source, name="source"),
        kit.Apply(app, name="double", function=lambda value: 2 * value),
        kit.Collect(app, name="sink"),
    )
    app.chain(*operators)
    return operators


def test_messages_are_passed_by_reference(kit, runner):
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


def test_second_run_recomposes_application(kit, runner):
    app = kit.Wired(lambda app: _chain(app, kit, 4))
    runner(app)
    first = app.ops
    result = runner(app)
    assert app.ops[0] is not first[0]
    assert app.ops[2].values == first[2].values == [0, 2, 4, 6]
    assert result.computes["sink"] == 4
