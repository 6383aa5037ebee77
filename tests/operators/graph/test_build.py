"""Invalid operators and graphs are refused at construction, before a run."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from operators.errors import GraphInvalid
from operators.graph import (
    Condition,
    ConditionType,
    ConnectorType,
    CountCondition,
    DownstreamMessageAffordableCondition,
    IOSpec,
    MessageAvailableCondition,
    Operator,
    OperatorSpec,
    QueuePolicy,
)
from operators.graph.graph import accepts


class Ports(Operator):
    """Ports as its constructor says."""

    def __init__(self, fragment, *args, ports=lambda spec: None, **kwargs):
        self.ports = ports
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec):
        self.ports(spec)

    def initialize(self):
        raise AssertionError("initialized although the graph is invalid")


def refused(kit, wire, message):
    app = kit.Wired(wire)
    with pytest.raises(GraphInvalid, match=message):
        kit.guarded(app.run)
    assert app.result is None
    app.wire = lambda app: app.add_operator(Idle(app))
    kit.guarded(app.run)  # and can run afterwards


class Idle(Operator):
    def __init__(self, fragment, *args, **kwargs):
        super().__init__(fragment, CountCondition(fragment, 1), *args, **kwargs)

    def compute(self, op_input, op_output, context):
        pass


def out(type=None, **kwargs):
    return lambda spec: spec.output("out", type=type, **kwargs)


def into(type=None, **kwargs):
    return lambda spec: spec.input("in", type=type, **kwargs)


def test_build_lists_all_unconnected_ports(kit):
    def wire(app):
        app.add_operator(Ports(app, name="a", ports=out()))
        app.add_operator(Ports(app, name="b", ports=into()))

    refused(kit, wire, r"not connected: output a.out, input b.in; connect by add_flow, or declare .* optional=True")


def test_build_refuses_connected_ports_with_incompatible_types(kit):
    def wire(app):
        app.add_flow(Ports(app, name="a", ports=out(str)), Ports(app, name="b", ports=into(int)))

    refused(kit, wire, r"a.out -> b.in: the output gives str, the input takes int")


@pytest.mark.parametrize(
    ("taken", "given", "fits"),
    [
        (int, int, True),
        (int, bool, True),
        (bool, int, False),
        (None, int, True),
        (int, None, True),
        (Any, int, True),
        (object, int, True),
        (int | None, int, True),
        (int, int | None, False),
        (int | str, int | str, True),
        (list[int], list, True),
        (np.ndarray, np.ndarray, True),
        (np.ndarray, list[int], False),
    ],
)
def test_accepts_type_compatibility(taken, given, fits):
    assert accepts(taken, given) is fits


def test_build_refuses_duplicate_operator_names(kit):
    def wire(app):
        app.add_operator(Ports(app, name="twin"))
        app.add_operator(Ports(app, name="twin"))

    refused(kit, wire, r"two operators are named 'twin'; taken are \['twin'\]")


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ({("nope", "in")}, r"'a' has no output 'nope'; it has \['out'\]"),
        ({("out", "nope")}, r"'b' has no input 'nope'; it has \['in', 'more'\]"),
        (None, r"say which ports to connect: 'a' has outputs \['out'\], 'b' has inputs \['in', 'more'\]"),
    ],
)
def test_unknown_port_error_lists_valid_ports(kit, pairs, message):
    def two(spec):
        spec.input("in")
        spec.input("more")

    def wire(app):
        app.add_flow(Ports(app, name="a", ports=out()), Ports(app, name="b", ports=two), pairs)

    refused(kit, wire, message)


def test_build_refuses_second_connection_unless_input_is_any_size(kit):
    def wire(app):
        sink = Ports(app, name="sink", ports=into())
        app.add_flow(Ports(app, name="a", ports=out()), sink)
        app.add_flow(Ports(app, name="b", ports=out()), sink)

    refused(kit, wire, r"b.out -> sink.in: the input is already fed by a.out -> sink.in; .*ANY_SIZE")


@pytest.mark.parametrize(("size", "capacity"), [(4, 2), (1, 0)])
def test_build_refuses_capacity_below_port_size(kit, size, capacity):
    def wire(app):
        sink = Ports(app, name="b", ports=into(size=size))
        app.add_flow(Ports(app, name="a", ports=out()), sink, capacity=capacity)

    refused(kit, wire, r"holds 2, but its ports wait for 4|capacity must be at least 1, got 0")


def test_build_refuses_application_without_operators(kit):
    refused(kit, lambda app: None, "composed no operators")


@pytest.mark.parametrize(
    ("declare", "message"),
    [
        (lambda spec: (spec.input("a"), spec.input("a")), "port 'a' is declared twice"),
        (lambda spec: (spec.param("a"), spec.param("a")), "parameter 'a' is declared twice"),
        (lambda spec: spec.input("a", size=0), "size must be at least 1"),
        (lambda spec: spec.output("a", size=IOSpec.ANY_SIZE), "size must be at least 1"),
        (
            lambda spec: spec.input("a", policy="newest"),
            "unknown queue policy 'newest'; choose one of block, drop_oldest",
        ),
        (lambda spec: spec.input("a").condition(ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE), "does not fit"),
        (lambda spec: spec.input("a").condition(ConditionType.MESSAGE_AVAILABLE, min_size=0), "min_size"),
        (lambda spec: spec.input("a").connector(ConnectorType.DOUBLE_BUFFER, capacity=0), "capacity"),
        (lambda spec: spec.output("a").connector(ConnectorType.DOUBLE_BUFFER), "a queue belongs to the input"),
    ],
)
def test_operator_spec_refuses_invalid_declarations(declare, message):
    with pytest.raises(GraphInvalid, match=message):
        declare(OperatorSpec("op"))


def test_port_defaults_equal_holoscan():
    spec = OperatorSpec("op")
    one, batch, many, output = (
        spec.input("one"),
        spec.input("batch", size=3),
        spec.input("many", size=IOSpec.ANY_SIZE),
        spec.output("out"),
    )
    assert (one.condition_type, one.min_size, one.capacity) == (ConditionType.MESSAGE_AVAILABLE, 1, 1)
    assert (batch.condition_type, batch.min_size, batch.capacity) == (ConditionType.MESSAGE_AVAILABLE, 3, 3)
    assert many.min_size == many.capacity == 1
    assert (output.condition_type, output.min_size) == (ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE, 1)
    assert {port.policy for port in (one, batch, many)} == {QueuePolicy.BLOCK}
    assert IOSpec.QueuePolicy.POP is QueuePolicy.DROP_OLDEST and QueuePolicy.REJECT is QueuePolicy.DROP_NEW


def test_parameters_become_attributes(kit):
    def declare(spec):
        spec.param("steps", 4, headline="how many")
        spec.param("path")

    app = kit.Wired(lambda app: None)
    operator = Ports(app, ports=declare, path="here")
    assert (operator.steps, operator.path, operator.name) == (4, "here", "Ports")
    with pytest.raises(GraphInvalid, match="'Ports' needs the parameter 'path'"):
        Ports(app, ports=declare)
    with pytest.raises(GraphInvalid, match=r"has no parameter 'stepz'; it has \['path', 'steps'\]"):
        Ports(app, ports=declare, path="", stepz=1)
    for taken in ("metadata", "start", "fault_policy"):
        with pytest.raises(GraphInvalid, match=f"parameter '{taken}' would hide an attribute"):
            Ports(app, ports=lambda spec, taken=taken: spec.param(taken, None))


def test_operator_takes_conditions_as_positional_arguments(kit):
    app = kit.Wired(lambda app: None)
    count = CountCondition(app, 1)
    assert isinstance(count, Condition) and Ports(app, count).conditions == [count]
    with pytest.raises(GraphInvalid, match="positional arguments are conditions, got int"):
        Ports(app, 3)
    taken = Ports(app, MessageAvailableCondition(app, receiver="in", min_size=2), ports=into(size=4))
    assert taken.spec.inputs["in"].min_size == 2
    given = Ports(app, DownstreamMessageAffordableCondition(app, transmitter="out", min_size=3), ports=out())
    assert given.spec.outputs["out"].min_size == 3
    with pytest.raises(GraphInvalid, match=r"has no input 'nope'; it has \['in'\]"):
        Ports(app, MessageAvailableCondition(app, receiver="nope"), ports=into())


def test_importing_operators_graph_does_not_import_holoscan():
    code = "import sys, operators.graph; sys.exit(any(name.split('.')[0] == 'holoscan' for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], timeout=300, check=False).returncode == 0
