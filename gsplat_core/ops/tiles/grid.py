"""Partition of an image into tiles, shared by the compiled ops and the reference."""

from __future__ import annotations

from typing import NamedTuple


class TileGrid(NamedTuple):
    """Square tiles that cover an image, in the order in which `isect_tiles` takes them."""

    tile_size: int
    """Side of a tile in pixels."""
    tile_width: int
    """Tiles across."""
    tile_height: int
    """Tiles down."""
