"""A few frames, evenly spread, whatever the stream's length."""

from __future__ import annotations

import itertools

import pytest

from operators.metrics import MetricsOp
from operators.sinks.keyframes import KeyframesOp


def keep(count, length, rendered, compute, worst=None):
    metrics, operator = MetricsOp(None), KeyframesOp(None, count=count)
    metrics.start()
    operator.start()
    held = 0
    for k in range(length):
        (scored,) = compute(metrics, rendered=rendered(k, offset=40 if k == worst else 2))
        compute(operator, scored=scored)
        held = max(held, len(operator._kept))
    return operator, held


@pytest.mark.parametrize("length", [1, 2, 5, 11, 64, 130])
def test_first_last_and_evenly_between(length, rendered, compute):
    operator, held = keep(5, length, rendered, compute)
    seqs = [f.rendered.frame.seq for f in operator.keyframes]
    assert seqs == sorted(set(seqs)) and len(seqs) == min(5, length)
    assert seqs[0] == 0 and seqs[-1] == length - 1
    assert held <= 10, "memory is bounded"
    gaps = [b - a for a, b in itertools.pairwise(seqs)]
    assert max(gaps, default=0) <= max(1, length / 2)


def test_the_worst_frame_is_among_them(rendered, compute):
    operator, _ = keep(5, 50, rendered, compute, worst=37)
    assert operator.worst_seq == 37
    assert 37 in [f.rendered.frame.seq for f in operator.keyframes]


def test_without_a_frame_there_are_none():
    operator = KeyframesOp(None)
    operator.start()
    assert operator.keyframes == [] and operator.worst_seq is None
