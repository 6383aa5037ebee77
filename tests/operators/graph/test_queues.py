"""Edges keep their bounds and account for every message."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.errors import EngineError, QueueFull
from operators.graph import QueuePolicy
from operators.graph.ports import CarriedEdge, Edge, Message

OPERATIONS = st.lists(st.sampled_from(["push", "push", "push", "pop", "pop", "close"]), max_size=60)


@given(OPERATIONS, st.integers(1, 4), st.sampled_from(QueuePolicy))
def test_edge_statistics_account_for_every_message(operations, capacity, policy):
    edge, expected, seen = Edge("a -> b", capacity, policy), [], []
    for number, operation in enumerate(operations):
        if operation == "push":
            full = len(expected) == capacity and not edge.closed
            if full and policy is QueuePolicy.BLOCK:
                with pytest.raises(QueueFull):
                    edge.push(Message(number, None, ()))
                continue
            edge.push(Message(number, None, ()))
            if edge.closed or (full and policy is QueuePolicy.DROP_NEW):
                continue
            expected = (expected[1:] if full else expected) + [number]
        elif operation == "pop":
            message = edge.pop()
            seen.append(message)
            assert (None if message is None else message.value) == (expected.pop(0) if expected else None)
        else:
            edge.close()
            expected = []
        stats = edge.stats()
        assert stats.queued == len(expected) <= capacity
        assert stats.sent == stats.received + stats.queued + sum(stats.dropped.values())


def carried(policy):
    """An edge carried by a list that stands for the engine."""
    import threading

    wire = []
    edge = CarriedEdge("a -> b", 1, policy, threading.RLock())
    edge.sender = SimpleNamespace(emit=lambda message, port: wire.append(message))
    edge.receiver = SimpleNamespace(receive=lambda port: wire.pop(0) if wire else None)
    return edge, wire


def test_carried_edge_keeps_engine_queue_within_capacity():
    edge, wire = carried(QueuePolicy.DROP_OLDEST)
    for number in range(5):
        edge.push(Message(number, None, ()))
    assert len(wire) == 1
    assert edge.pop().value == 4 and edge.pop() is None
    assert edge.stats().dropped == {"drop_oldest": 4}


def test_carried_edge_raises_on_message_out_of_order():
    edge, wire = carried(QueuePolicy.BLOCK)
    edge.push(Message(1, None, ()))
    wire[0] = Message(2, None, ())
    with pytest.raises(EngineError, match="another message on a -> b"):
        edge.pop()
