"""Partition of an image into tiles, shared by the compiled ops and the reference."""

from __future__ import annotations

from typing import NamedTuple


class TileGrid(NamedTuple):
    """Grid of square tiles covering an image; the fields are in the argument order of `isect_tiles`."""

    tile_size: int
    """Side of a tile in pixels."""
    tile_width: int
    """Number of tiles per row."""
    tile_height: int
    """Number of tiles per column."""
