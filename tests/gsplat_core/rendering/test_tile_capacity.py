"""The capacity that tile lists get."""

from __future__ import annotations

import math

from gsplat_core.ops.frame import MAX_SEGMENT
from gsplat_core.rendering.alpha import HEADROOM, TILE_STEP, TileListCapacity, capacity_for


def test_tile_capacity_per_tile_with_headroom():
    lists = TileListCapacity.for_frame(needed=2_000_000, most_in_tile=313)
    assert lists.per_tile
    assert 313 * HEADROOM <= lists.capacity < 313 * HEADROOM + TILE_STEP


def test_tile_capacity_shared_buffer_for_overfull_tile():
    most = math.floor(MAX_SEGMENT / HEADROOM)
    assert TileListCapacity.for_frame(needed=120_000, most_in_tile=most) == TileListCapacity(MAX_SEGMENT, per_tile=True)
    lists = TileListCapacity.for_frame(needed=120_000, most_in_tile=most + 1)
    assert lists == TileListCapacity(capacity_for(120_000), per_tile=False)
    assert lists.capacity >= 120_000


def test_tile_capacity_positive_for_empty_scene():
    assert TileListCapacity.for_frame(0, 0).capacity > 0
    assert TileListCapacity.initial(0, 640, 512).capacity > 0


def test_tile_capacity_initially_four_tiles_per_gaussian():
    lists = TileListCapacity.initial(50_000, 640, 512)
    assert lists.per_tile
    assert lists.capacity * 40 * 32 >= 4 * 50_000
