"""Sentences about a recording that a reader of the results must know."""

from __future__ import annotations

from pathlib import Path

import pytest

from operators.sinks.session_recorder import Recorded, stated


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, []),
        ({"lost": {}}, []),
        ({"lost": {"shown: too slow": 2, "frame: too slow": 3}}, ["3 times the recording in .*frame: too slow", "2 times .*shown: too slow"]),
        ({"lost": {"frame: the recording has ended": 4}}, []),
        ({"ended": "the disk is full", "bytes": 2**20}, ["ended before the session, with 1.0 MiB: the disk is full"]),
        ({"deleted_segments": 1}, ["1 older segments"]),
        ({"deleted_sessions": 2}, ["earlier recordings next to .*: 2$"]),
    ],
)  # fmt: skip
def test_stated_gives_one_sentence_per_recording_loss(fields, said):
    import re

    found = stated(Recorded(Path("/session"), **fields))
    assert len(found) == len(said) and all(re.search(part, each) for part, each in zip(said, found, strict=True))
