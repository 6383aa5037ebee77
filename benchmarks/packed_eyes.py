"""Measure how similar the halves of pictures are, and the pictures of the two eyes of stereo recordings.

    python benchmarks/packed_eyes.py RECORDINGS [MORE...]

`_SAME_ABOVE` of `gsplat_core/io/recordings/packed_eyes.py` lies between the two. Prints one JSON line per recording, with every 15th of the
first 150 frames: the highest similarity of two halves, left and right or upper and lower, and the lowest similarity of the two eyes. MORE are
folders of further recordings, such as synthesised ones.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.packed_eyes import halves, similarity

FRAMES, STEP = 150, 15


def folders(arguments: list[str]) -> Iterator[Path]:
    first, *more = map(Path, arguments)
    for parent in (first, first / "others"):
        yield from sorted(path for path in parent.iterdir() if path.is_dir() and path.name != "others")
    yield from more


def main() -> None:
    for path in folders(sys.argv[1:]):
        between_halves, between_eyes = [], []
        for frame in islice(open_recording(path), 0, FRAMES, STEP):
            between_halves += [similarity(*halves(frame.image, layout)) for layout in ("side_by_side", "top_bottom")]
            if frame.right_image is not None:
                between_eyes.append(similarity(frame.image, frame.right_image))
        line = {"recording": path.name, "frames": len(between_halves) // 2, "halves": round(max(between_halves), 2)}
        print(json.dumps(line | ({"eyes": round(min(between_eyes), 2)} if between_eyes else {})), flush=True)


if __name__ == "__main__":
    main()
