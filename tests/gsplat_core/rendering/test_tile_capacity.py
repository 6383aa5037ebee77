"""How much room the lists of a frame get."""

from __future__ import annotations

import math

from gsplat_core.ops.frame.frame import MAX_SEGMENT
from gsplat_core.rendering.tile_capacity import HEADROOM, TILE_STEP, ListRoom, capacity_for


def test_tiles_have_rooms_of_their_own_with_some_to_spare():
    room = ListRoom.for_frame(needed=2_000_000, most=313)
    assert room.per_tile
    assert 313 * HEADROOM <= room.capacity < 313 * HEADROOM + TILE_STEP


def test_lists_share_one_room_where_a_tile_has_too_many():
    most = math.floor(MAX_SEGMENT / HEADROOM)
    assert ListRoom.for_frame(needed=120_000, most=most) == ListRoom(MAX_SEGMENT, per_tile=True)
    room = ListRoom.for_frame(needed=120_000, most=most + 1)
    assert room == ListRoom(capacity_for(120_000), per_tile=False)
    assert room.capacity >= 120_000


def test_nothing_to_show_still_has_room():
    assert ListRoom.for_frame(0, 0).capacity > 0
    assert ListRoom.at_first(0, 640, 512).capacity > 0


def test_the_first_guess_holds_four_tiles_a_gaussian():
    room = ListRoom.at_first(50_000, 640, 512)
    assert room.per_tile
    assert room.capacity * 40 * 32 >= 4 * 50_000
