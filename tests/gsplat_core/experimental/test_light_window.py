"""`LightWindow`: which pictures are accepted, and when the relief is solved again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.experimental import light
from gsplat_core.experimental.light import LightWindow


def picture(name, followed=True):
    return SimpleNamespace(shading=name, followed=followed)


@pytest.fixture
def solved(monkeypatch):
    """Numbers of pictures of each full solution. It finds 10 for the key and adds the number of a picture; a single change adds 0.5."""
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


def test_light_window_solves_at_1_2_4_8_and_12_images(solved):
    window = LightWindow(None, picture("key"))
    for number in range(13):
        assert window.add(picture(number))
    assert solved == [1, 2, 4, 8, 12]


def test_light_window_adds_image_change_between_solutions(solved):
    pictures = [picture(number) for number in range(3)]
    window = LightWindow(None, pictures[0])
    assert window.relief_of(pictures[0]) == [10.0]
    window.add(pictures[1])
    assert window.relief_of(pictures[1]) == [11.0]
    window.add(pictures[2])
    assert window.relief_of(pictures[2]) == [10.5]
    window.solve()
    assert window.relief_of(pictures[2]) == [12.0]
    assert window.relief_of(picture("another")) is None


def test_light_window_rejects_unfollowed_image(solved):
    window = LightWindow(None, picture("key"))
    assert not window.add(picture("elsewhere", followed=False))
    assert len(window.pictures) == 1 and solved == [1]


def test_light_window_takes_earlier_images_until_unfollowed(solved):
    before = [picture("a"), picture("b", followed=False), picture("c"), picture("d")]
    window = LightWindow(None, picture("key"), before)
    assert [each.shading for each in window.pictures] == ["key", "d", "c"]
    assert solved == [3]
