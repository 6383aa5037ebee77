"""Parts of an outcome are found by their type, and two of one type are refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from gsplat_core.errors import InvalidInput
from operators.outcome import Contributor, OutcomeBuilder


@dataclass(frozen=True)
class Drops:
    count: int


def test_outcome_returns_parts_outputs_and_notes():
    outcome = OutcomeBuilder()
    outcome.add(Drops(3))
    outcome.output("video", Path("v.mp4"))
    outcome.note("one")
    outcome.note("two")
    assert outcome.find(Drops) == Drops(3) and outcome.find(int) is None
    assert dict(outcome.parts) == {Drops: Drops(3)}
    assert outcome.outputs == {"video": Path("v.mp4")} and outcome.notes == ("one", "two")


def test_outcome_refuses_two_parts_of_one_type():
    outcome = OutcomeBuilder()
    outcome.add(Drops(3))
    with pytest.raises(InvalidInput, match="two operators of one run contribute a Drops"):
        outcome.add(Drops(3))


def test_outcome_refuses_two_outputs_of_one_name():
    outcome = OutcomeBuilder()
    outcome.output("video", Path("a.mp4"))
    outcome.output("video", Path("a.mp4"))
    with pytest.raises(InvalidInput, match=r"two outputs of one run are named 'video': a\.mp4 and b\.mp4"):
        outcome.output("video", Path("b.mp4"))


def test_outcome_outputs_returns_copy():
    outcome = OutcomeBuilder()
    outcome.outputs["video"] = Path("v.mp4")
    assert outcome.outputs == {}


def test_contributor_protocol_requires_contribute():
    class Silent:
        pass

    class Telling:
        def contribute(self, outcome):
            outcome.add(Drops(1))

    assert not isinstance(Silent(), Contributor) and isinstance(Telling(), Contributor)
