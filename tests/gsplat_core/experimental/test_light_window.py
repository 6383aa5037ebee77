"""Looks by the same light: which are taken, and when the relief is found anew."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.experimental import light
from gsplat_core.experimental.light import LightWindow


def look(name, followed=True):
    return SimpleNamespace(shading=name, followed=followed)


@pytest.fixture
def solved(monkeypatch):
    """Numbers of looks of each full solution. It finds 10 for the key and adds the number of a look; a single change adds 0.5."""
    counts = []

    class Follower:
        def __init__(self, key):
            self.key = key

        def change_to(self, other):
            return SimpleNamespace(is_followed=other.followed)

    def find_reliefs(grid, shadings, changes):
        assert changes[0] is None and len(changes) == len(shadings)
        counts.append(len(shadings))
        return SimpleNamespace(key=np.array([10.0]), changes=np.arange(len(shadings), dtype=float)[:, None])

    monkeypatch.setattr(light, "Follower", Follower)
    monkeypatch.setattr(light, "find_reliefs", find_reliefs)
    monkeypatch.setattr(light, "find_change", lambda grid, key, change: np.array([0.5]))
    return counts


def test_the_relief_is_found_anew_at_1_2_4_8_and_12_looks(solved):
    window = LightWindow(None, look("key"))
    for number in range(13):
        assert window.add(look(number))
    assert solved == [1, 2, 4, 8, 12]


def test_between_solutions_a_look_gets_the_key_and_its_own_change(solved):
    looks = [look(number) for number in range(3)]
    window = LightWindow(None, looks[0])
    assert window.relief_of(looks[0]) == [10.0]
    window.add(looks[1])
    assert window.relief_of(looks[1]) == [11.0]
    window.add(looks[2])
    assert window.relief_of(looks[2]) == [10.5]
    window.solve()
    assert window.relief_of(looks[2]) == [12.0]
    assert window.relief_of(look("another")) is None


def test_a_look_that_is_not_followed_changes_nothing(solved):
    window = LightWindow(None, look("key"))
    assert not window.add(look("elsewhere", followed=False))
    assert len(window.looks) == 1 and solved == [1]


def test_earlier_looks_are_taken_back_to_the_first_that_is_not_followed(solved):
    before = [look("a"), look("b", followed=False), look("c"), look("d")]
    window = LightWindow(None, look("key"), before)
    assert [each.shading for each in window.looks] == ["key", "d", "c"]
    assert solved == [3]
