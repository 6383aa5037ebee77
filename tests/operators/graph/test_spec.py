"""Ports as operators declare them: sizes, conditions and queues at their borders."""

from __future__ import annotations

import pytest

from operators.errors import GraphInvalid
from operators.graph import ConditionType, IOSpec, OperatorSpec, QueuePolicy


@pytest.mark.parametrize(("size", "capacity", "batched"), [(1, 1, False), (2, 2, True), (IOSpec.ANY_SIZE, 1, True)])
def test_input_capacity_equals_size(size, capacity, batched):
    port = OperatorSpec().input("in", size=size)
    assert (port.capacity, port.min_size, port.batched) == (capacity, capacity, batched)
    assert port.condition_type is ConditionType.MESSAGE_AVAILABLE and port.policy is QueuePolicy.BLOCK


def test_output_min_size_is_one_message():
    port = OperatorSpec().output("out", size=3)
    assert (port.capacity, port.min_size) == (3, 1)
    assert port.condition_type is ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE


@pytest.mark.parametrize("size", [0, -2])
def test_port_size_below_one_is_refused(size):
    with pytest.raises(GraphInvalid, match=f"size must be at least 1, got {size}"):
        OperatorSpec().input("in", size=size)
    with pytest.raises(GraphInvalid, match="size must be at least 1, got -1"):
        OperatorSpec().output("out", size=IOSpec.ANY_SIZE)


def test_port_refuses_condition_or_queue_of_other_direction():
    spec = OperatorSpec("op")
    port, out = spec.input("in"), spec.output("out")
    assert port.condition(ConditionType.NONE) is port and port.condition_type is ConditionType.NONE
    assert port.condition(ConditionType.MESSAGE_AVAILABLE, min_size=1).min_size == 1
    for wrong, condition in (
        (port, ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE),
        (out, ConditionType.MESSAGE_AVAILABLE),
    ):
        with pytest.raises(GraphInvalid, match="does not fit"):
            wrong.condition(condition)
    with pytest.raises(GraphInvalid, match="min_size must be at least 1, got 0"):
        port.condition(ConditionType.NONE, min_size=0)
    port.connector(port.ConnectorType.DEFAULT)
    assert port.capacity == 1 and port.policy is QueuePolicy.BLOCK
    port.connector(port.ConnectorType.DEFAULT, capacity=1, policy="drop_new")
    assert port.capacity == 1 and port.policy is QueuePolicy.DROP_NEW
    with pytest.raises(GraphInvalid, match="capacity must be at least 1, got 0"):
        port.connector(port.ConnectorType.DEFAULT, capacity=0)
    with pytest.raises(GraphInvalid, match="a queue belongs to the input"):
        out.connector(out.ConnectorType.DEFAULT)


def test_spec_refuses_duplicate_names_and_unknown_policy():
    spec = OperatorSpec("op")
    spec.input("a")
    spec.output("a")
    spec.param("a", 1)
    for declare in (spec.input, spec.output):
        with pytest.raises(GraphInvalid, match="op: port 'a' is declared twice"):
            declare("a")
    with pytest.raises(GraphInvalid, match="op: parameter 'a' is declared twice"):
        spec.param("a")
    with pytest.raises(GraphInvalid, match="unknown queue policy 'lifo'; choose one of block, drop_oldest, drop_new"):
        spec.input("b", policy="lifo")
