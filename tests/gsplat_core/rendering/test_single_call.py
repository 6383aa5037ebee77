"""Capacities of the tile lists that the native call is asked for, without a GPU: the native call is replaced."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.rasterization import Rasterized
from gsplat_core.rendering import rasterization as module
from gsplat_core.rendering.rasterization import (
    FEWEST_RESERVED_ENTRIES,
    MOST_RESERVED_ENTRIES,
    SingleCall,
    next_capacity,
)
from gsplat_core.rendering.settings import Arguments, RenderSettings

SETTINGS = RenderSettings(16, 16, sh_degree=0, render_mode="RGB+ED")


def arguments() -> Arguments:
    return Arguments(
        torch.zeros(2, 3), torch.ones(2, 4), torch.ones(2, 3), torch.ones(2), torch.ones(2, 1, 3), torch.eye(4)[None],
        torch.eye(3)[None], None, None,
    )  # fmt: skip


@pytest.fixture
def capacities_for(monkeypatch):
    """Return a function from the lengths of the lists of successive calls to the capacities of these calls."""

    def of(lengths: list[int]) -> list[int]:
        found: list[int] = []

        def rasterize(inputs, view, differentiable):
            length = lengths[len(found)]
            found.append(view.options.capacity)
            empty, ids = torch.empty(0), torch.empty(1, dtype=torch.int32).expand(length)
            return Rasterized(*[empty] * 9, flatten_ids=ids, isect_ids=empty)

        monkeypatch.setattr(module, "rasterize", rasterize)
        call = SingleCall(arguments(), SETTINGS)
        for _ in lengths:
            call(arguments())
        return found

    return of


def test_capacity_zero_at_first_call_then_constant_with_headroom(capacities_for):
    first, *others = capacities_for([100_000] * 4)
    assert first == 0
    assert len(set(others)) == 1 and 110_000 <= others[0] <= 150_000


def test_capacity_raised_after_overflow(capacities_for):
    capacities = capacities_for([10_000, 50_000, 50_000, 55_000])
    assert capacities[1] < 50_000 < 55_000 < capacities[2] == capacities[3]


def test_capacity_reduced_after_sustained_short_lists(capacities_for):
    capacities = capacities_for([100_000, 100_000, *[1000] * 100, *[0] * 100])
    assert capacities[101] < 4000
    assert capacities[-1] == FEWEST_RESERVED_ENTRIES


def test_capacity_suffices_for_alternating_list_lengths(capacities_for):
    lengths = [100_000, 1000] * 20
    capacities = capacities_for(lengths)
    assert all(length <= capacity for length, capacity in zip(lengths[1:], capacities[1:], strict=True))


def test_capacity_zero_for_very_long_lists(capacities_for):
    long = MOST_RESERVED_ENTRIES + 1
    assert capacities_for([long, long, 1000, 1000, long, long])[:3] == [0, 0, 0]
    assert capacities_for([1000, long, long])[2] == 0


@pytest.mark.parametrize("length", [0, 1, 1000, 10**6, MOST_RESERVED_ENTRIES])
def test_next_capacity_is_stable_and_sufficient(length):
    capacity = next_capacity(0, length)
    assert length < capacity <= 2 * length + FEWEST_RESERVED_ENTRIES
    assert next_capacity(capacity, length) == capacity
