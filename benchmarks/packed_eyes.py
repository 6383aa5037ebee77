"""Measure how similar the halves of pictures are, and the pictures of the two eyes of stereo recordings.

    python benchmarks/packed_eyes.py RECORDINGS [MORE...]

`_SAME_ABOVE` of `gsplat_core/io/recordings/packed_eyes.py` lies between the two. Prints one JSON line per recording, with every 15th of the
first 150 frames, as they are in the files: the highest similarity of two halves, left and right or upper and lower, and the lowest similarity
of the two eyes, also with the right one shifted down by 2 % of its width. MORE are folders of further recordings, such as synthesised ones.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.contents import FrameImages
from gsplat_core.io.recordings.layouts import inspect
from gsplat_core.io.recordings.packed_eyes import halves, similarity
from gsplat_core.io.recordings.plain_files import Findings

FRAMES, STEP = 150, 15
SHIFT = 0.02


def folders(arguments: list[str]) -> Iterator[Path]:
    first, *more = map(Path, arguments)
    for parent in (first, first / "others"):
        yield from sorted(path for path in parent.iterdir() if path.is_dir() and path.name != "others")
    yield from more


def pictures(images: FrameImages) -> Iterator[NDArray[np.uint8]]:
    """Yield some pictures of one eye as they are in the files, without rectification."""
    for picture in islice(images.frames(Findings(strict=True)), 0, FRAMES, STEP):
        assert picture is not None
        yield picture.image


def main() -> None:
    for path in folders(sys.argv[1:]):
        contents = inspect(path, Findings(strict=True))
        assert contents is not None
        of_halves = [
            similarity(*halves(image, layout)) or 0.0
            for image in pictures(contents.images)
            for layout in ("side_by_side", "top_bottom")
        ]
        line = {"recording": path.name, "frames": len(of_halves) // 2, "halves": round(max(of_halves), 2)}
        if contents.right is not None:
            pairs = list(zip(pictures(contents.images), pictures(contents.right), strict=True))
            shifted = [(left, np.roll(right, round(SHIFT * right.shape[1]), 0)) for left, right in pairs]
            for name, each in (("eyes", pairs), ("shifted", shifted)):
                line[name] = round(min(similarity(*pair) or 0.0 for pair in each), 2)
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
