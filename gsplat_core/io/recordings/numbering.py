"""What the numbers in image names say about time: evenly spaced, with gaps, or twice the same."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.image_files import frame_number


def frame_times(files: Sequence[Path], findings: Findings) -> tuple[float, ...] | None:
    """When each image was taken, in frame durations from the first one on; None: one after the other.

    The most common step between two numbers is one frame's duration, so that every tenth frame of a longer recording is evenly
    spaced. A gap is kept as a gap in time, with a note. Two images with one number are a problem.
    """
    numbers = [number for path in files if (number := frame_number(path)) is not None]
    if len(numbers) < len(files) or len(set(numbers)) < 2:
        return None  # names without numbers, or one number that is part of every name
    for earlier, later, first, second in zip(numbers, numbers[1:], files, files[1:], strict=False):
        if later <= earlier:
            findings.problem(
                second,
                f"its number {later} does not follow the number {earlier} of {first.name}",
                "Keep one image for each number, in one sequence",
            )
            return None
    steps = [later - earlier for earlier, later in pairwise(numbers)]
    step = Counter(steps).most_common(1)[0][0]
    gaps = [index for index, wide in enumerate(steps) if wide != step]
    if not gaps:
        return None
    first, second = files[gaps[0]], files[gaps[0] + 1]
    findings.warn(
        files[0].parent,
        f"image numbers skip {len(gaps)} time{'s' * (len(gaps) > 1)}, first from {first.name} to {second.name}",
        "The frames that are not there are left out as a gap in time",
    )
    return tuple((number - numbers[0]) / step for number in numbers)
