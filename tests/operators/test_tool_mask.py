"""Recorded masks stay with their frames; a frame without one is all tissue, and that is said."""

from __future__ import annotations

import logging

import numpy as np

from operators.outcome import OutcomeBuilder
from operators.tool_mask import RecordedToolMaskOp


def notes(operator):
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome.notes


def test_a_recorded_mask_stays_as_it_is(frame, compute):
    mask = np.zeros((16, 24), np.uint8)
    operator = RecordedToolMaskOp(None)
    operator.start()
    (passed,) = compute(operator, frame=frame(0, mask=mask))
    assert passed.mask is mask
    assert notes(operator) == ()


def test_without_a_mask_every_pixel_is_tissue_and_it_is_stated_once(frame, compute, caplog):
    operator = RecordedToolMaskOp(None)
    operator.start()
    with caplog.at_level(logging.WARNING):
        for k in range(3):
            (passed,) = compute(operator, frame=frame(k))
            assert passed.mask.shape == (16, 24) and passed.mask.all()
    assert len(caplog.records) == 1 and "frame 0 has no tool mask" in caplog.text
    assert notes(operator) == ("3 frames had no tool mask; all of their pixels counted as tissue",)
