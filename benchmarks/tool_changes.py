"""Measure how much pictures change where a tool is: between neighbouring frames, and from a frame to another recording.

    python benchmarks/tool_changes.py RECORDINGS

The constant `CHANGED_LEVELS` of `gsplat_core/endoscope/sequence.py` lies between the two. Prints one JSON line per recording. A change
is the median over the tool's pixels of the difference in grey levels, averaged over the colours.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.sequence import LOST_TOOL_SHARE
from gsplat_core.endoscope.tools import NetworkToolFinder
from gsplat_core.io.recordings import open_recording

WITH_TOOLS = ("cutting", "heart", "others/laparoscopy", "others/stereomis_like")
OTHER = "others/resting_bowel"
"""Recording without a tool, to which a cut goes."""
STEP_PX, EVERY_TOOL_FRAME, EVERY_OTHER_FRAME = 4, 10, 20


def change(before: NDArray[Any], after: NDArray[Any], tool: NDArray[np.bool_]) -> float:
    return float(np.median(np.abs(before - after).mean(axis=2)[tool]))


def frames(path: Path) -> list[Any]:
    video = path / "video.mp4"
    return list(open_recording(video if video.is_file() else path, scale=0.5))


def quantiles(values: list[float], shares: tuple[int, ...]) -> dict[str, float]:
    return {f"{share} %": round(float(np.percentile(values, share)), 1) for share in shares}


def main() -> None:
    root = Path(sys.argv[1])
    others = [frame.image[::STEP_PX, ::STEP_PX].astype(np.float32) for frame in frames(root / OTHER)][
        ::EVERY_OTHER_FRAME
    ]
    for name in WITH_TOOLS:
        finder, seen = NetworkToolFinder(), []
        for frame in frames(root / name):
            mask = finder.find(frame.image) if frame.mask is None else frame.mask
            tool = mask[::STEP_PX, ::STEP_PX] == 0
            seen.append((frame.image[::STEP_PX, ::STEP_PX].astype(np.float32), tool, tool.mean() >= LOST_TOOL_SHARE))
        pairs = [(a, b) for a, b in itertools.pairwise(seen) if a[2]]
        neighbours = [change(before, after, tool) for (before, tool, _), (after, _, _) in pairs]
        cuts = [
            change(image, cv2.resize(other, image.shape[1::-1]), tool)
            for image, tool, has_tool in seen[::EVERY_TOOL_FRAME]
            if has_tool
            for other in others
        ]
        line = {
            "recording": name,
            "neighbouring frames": quantiles(neighbours, (50, 99, 100)),
            "cuts": quantiles(cuts, (0, 10, 50)),
        }
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
