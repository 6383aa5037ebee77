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


def test_parts_outputs_and_notes_come_back():
    outcome = OutcomeBuilder()
    outcome.add(Drops(3))
    outcome.output("video", Path("v.mp4"))
    outcome.note("one")
    outcome.note("two")
    assert outcome.find(Drops) == Drops(3) and outcome.find(int) is None
    assert dict(outcome.parts) == {Drops: Drops(3)}
    assert outcome.outputs == {"video": Path("v.mp4")} and outcome.notes == ("one", "two")


def test_two_parts_of_one_type_are_refused_even_when_they_are_equal():
    outcome = OutcomeBuilder()
    outcome.add(Drops(3))
    with pytest.raises(InvalidInput, match="two operators of one run contribute a Drops"):
        outcome.add(Drops(3))


def test_one_name_is_one_output():
    outcome = OutcomeBuilder()
    outcome.output("video", Path("a.mp4"))
    outcome.output("video", Path("a.mp4"))
    with pytest.raises(InvalidInput, match=r"two outputs of one run are named 'video': a\.mp4 and b\.mp4"):
        outcome.output("video", Path("b.mp4"))


def test_what_was_handed_out_does_not_change_the_outcome():
    outcome = OutcomeBuilder()
    outcome.outputs["video"] = Path("v.mp4")
    assert outcome.outputs == {}


def test_only_what_can_contribute_is_a_contributor():
    class Silent:
        pass

    class Telling:
        def contribute(self, outcome):
            outcome.add(Drops(1))

    assert not isinstance(Silent(), Contributor) and isinstance(Telling(), Contributor)
