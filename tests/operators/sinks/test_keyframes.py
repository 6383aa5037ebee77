"""A few frames, evenly spread, whatever the stream's length."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from operators.metrics import MetricsOp
from operators.outcome import OutcomeBuilder
from operators.sinks.sink import KeyframesOp, KeyframesResult


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
def test_keyframes_include_first_and_last_and_are_evenly_spaced(length, rendered, compute):
    operator, held = keep(5, length, rendered, compute)
    seqs = [f.rendered.frame.seq for f in operator.keyframes]
    assert seqs == sorted(set(seqs)) and len(seqs) == min(5, length)
    assert seqs[0] == 0 and seqs[-1] == length - 1
    assert held <= 10, "memory is bounded"
    gaps = [b - a for a, b in itertools.pairwise(seqs)]
    assert max(gaps, default=0) <= max(1, length / 2)


def test_keyframes_include_worst_frame(rendered, compute):
    operator, _ = keep(5, 50, rendered, compute, worst=37)
    assert operator.worst_seq == 37
    assert 37 in [f.rendered.frame.seq for f in operator.keyframes]


def test_keyframes_are_empty_without_frames():
    operator = KeyframesOp(None)
    operator.start()
    assert operator.keyframes == [] and operator.worst_seq is None


def test_keyframes_drop_right_image_and_measured_depth(rendered, frame, compute):
    image = frame(0).image
    full = frame(
        0, right_image=image, depth=np.ones(image.shape[:2], np.float32), mask=np.ones(image.shape[:2], np.uint8)
    )
    metrics, operator, outcome = MetricsOp(None), KeyframesOp(None), OutcomeBuilder()
    metrics.start()
    operator.start()
    (scored,) = compute(metrics, rendered=rendered(frame=full))
    compute(operator, scored=scored)
    operator.contribute(outcome)
    (kept,) = outcome.find(KeyframesResult).keyframes
    assert kept.rendered.frame.right_image is None and kept.rendered.frame.depth is None
    assert kept.rendered.frame.mask is full.mask and kept.rendered.depth is scored.rendered.depth
    assert scored.rendered.frame.depth is full.depth, "the message that others see is not changed"
