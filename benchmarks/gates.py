"""Count the frames that the gates withhold, by reason, for recordings from inside, altered copies of them, and pictures from outside.

One JSON line per recording and alteration: `frames`, `withheld` (by reason; for the out-of-body gate with its evidence), and `longest_s`, the longest stretch of
withheld frames in seconds. Every frame of a recording is examined unchanged, the first --frames of it altered. The gates are those of a live run, in the same
order, with the built-in tool mask.

With --margins, one line per alteration, also the hard ones, with the number of pictures and those with evidence, by recording, for the whole pictures and for
their middle quarters; one line per sample from outside, with crops and reduced copies; and one line per threshold of the out-of-body gate: the most extreme value of frames from inside whose other measure exceeds its own threshold, by
recording; and the number of frames of each recording withheld by a threshold chosen on the others alone, half-way to the pictures from outside.

Usage: python benchmarks/gates.py FOLDER_OF_RECORDINGS [--frames 60] [--only NAME] [--change NAME [--outside]] [--margins]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import date
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.out_of_body import (
    COLD_BESIDE_LIGHT,
    COOL_BESIDE_STRAIGHT,
    ROOM_LIGHT,
    STRAIGHT,
    BodyGate,
    Evidence,
    evidence_of,
)
from gsplat_core.io.recordings import open_recording
from gsplat_core.scene.frames import Frame
from operators.checks import MaskAndDepthStage, picture_stages
from operators.tool_mask import built_in_finder

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.gsplat_core.endoscope.outside import OUTSIDE
from tests.gsplat_core.endoscope.unusual import HARD, UNUSUAL, Change

Image = NDArray[np.uint8]
INSIDE = {
    **{name: name for name in ("cutting", "sinus", "colon")},
    "heart": "heart/left.mp4",
    "hamlyn_pair": "hamlyn_pair/f7_dynamic_deint_L_0100.png",
    "scared_pair": "scared_pair/left.png",
    "scared_raw": "scared_raw/Left_Image.png",
    "inside_0001": "out_of_body/0001.png",
    "inside_0007": "out_of_body/0007.png",
    **{name: f"others/{name}/video.mp4" for name in ("laparoscopy", "stereomis_like", "resting_bowel")},
    **{name: f"others/{name}/images" for name in ("colonoscopy_a", "colonoscopy_b", "organ_still")},
    "pelvis_stills": "others/pelvis_stills",
}
"""Recordings and single pictures from inside, by name."""
FROM_OUTSIDE = ("0008", "0009", "0010")
STILL_NS = 40_000_000
WIDEST_PX = 400
PARTS: dict[str, Callable[[Image], Image]] = {
    "whole": lambda image: image,
    "middle": lambda image: np.ascontiguousarray(
        image[len(image) // 4 : 3 * len(image) // 4, image.shape[1] // 4 : 3 * image.shape[1] // 4]
    ),
}
VIEWS: dict[str, Callable[[Image], Image]] = {
    "whole": lambda image: image,
    "without border": lambda image: image[30:1040, 330:1590],
    "a third as large": lambda image: np.asarray(cv2.resize(image, (640, 360), interpolation=cv2.INTER_AREA), np.uint8),
    "upper left": lambda image: image[30:630, 330:1030],
    "lower right": lambda image: image[430:1040, 930:1590],
    "middle": lambda image: image[230:830, 630:1330],
}
"""Crops and a reduced copy of the samples from outside."""
MEASURES: dict[str, Callable[[Evidence], float]] = {
    "straight": lambda evidence: evidence.straight,
    "light": lambda evidence: evidence.even + evidence.smooth,
    "cool": lambda evidence: evidence.cool,
    "cold": lambda evidence: evidence.cold,
}
PAIRS = {
    "straight": (STRAIGHT, "cool", COOL_BESIDE_STRAIGHT),
    "light": (ROOM_LIGHT, "cold", COLD_BESIDE_LIGHT),
}
"""Thresholds of the gate's two kinds of evidence, each with the colour that is required too."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--only", choices=sorted(INSIDE))
    parser.add_argument("--change", choices=sorted(UNUSUAL), help="only this alteration, and no pictures from outside")
    parser.add_argument("--outside", action="store_true", help="pictures from outside also with --change")
    parser.add_argument("--margins", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    names = [arguments.only] if arguments.only else list(INSIDE)
    if arguments.margins:
        report_margins(arguments.recordings, names, arguments.frames)
        return 0
    for name in names:
        for change in [arguments.change] if arguments.change else UNUSUAL:
            count = None if change == "unchanged" else arguments.frames
            pictures = islice(frames(arguments.recordings / INSIDE[name]), count)
            say({"recording": name, "change": change, **withheld(changed(pictures, UNUSUAL[change]))})
    if arguments.outside or (arguments.only is None and arguments.change is None):
        for number in FROM_OUTSIDE:
            (picture,) = frames(arguments.recordings / f"out_of_body/{number}.png")
            say({"outside": number, "evidence": evidence_words(picture[0])})
        for name, draw in OUTSIDE.items():
            found = Counter(evidence_words(draw(np.random.default_rng(seed))) for seed in range(20))
            say({"outside": f"drawn: {name}", "pictures": 20, "evidence": dict(found)})
    return 0


def frames(path: Path) -> Iterator[tuple[Image, int]]:
    """Yield pictures and times of a recording, a folder of stills, or one picture file."""
    pictures = sorted(path.glob("[0-9]*.*")) if path.is_dir() else [path] if path.suffix in (".png", ".jpg") else []
    if pictures:
        for index, file in enumerate(pictures):
            read = cv2.imread(str(file))
            assert read is not None, file
            yield np.ascontiguousarray(read[..., ::-1]), index * STILL_NS
        return
    for frame in open_recording(path):
        yield frame.image, frame.pts_ns


def changed(pictures: Iterable[tuple[Image, int]], change: Change) -> Iterator[tuple[Image, int]]:
    """Yield the pictures with the same alteration applied to each."""
    for image, pts_ns in pictures:
        yield change(image, np.random.default_rng(0)), pts_ns


def withheld(pictures: Iterable[tuple[Image, int]]) -> dict[str, object]:
    """Run the gates of a live run over a stream; count the frames that they withhold."""
    gate, finder = BodyGate(), built_in_finder()
    before, after = picture_stages(), [MaskAndDepthStage()]
    reasons: Counter[str] = Counter()
    count, longest_ns, newest_ns = 0, 0, None
    for seq, (image, pts_ns) in enumerate(pictures):
        count += 1
        reason = gate.judge(image)
        if reason is not None:
            reason = f"out of body: {reason}"
            image = np.zeros_like(image)
        frame = Frame(seq=seq, pts_ns=pts_ns, image=image, withheld=reason)
        for stage in before:
            frame = stage.apply(frame)
        if frame.new_scene is not None:
            finder.reset()
        frame = frame.with_fields(mask=finder.find(frame.image))
        for stage in after:
            frame = stage.apply(frame)
        newest_ns = pts_ns if newest_ns is None or frame.withheld is None else newest_ns
        longest_ns = max(longest_ns, pts_ns - newest_ns)
        if frame.withheld is not None:
            reasons[frame.withheld] += 1
    return {"frames": count, "withheld": dict(reasons.most_common()), "longest_s": round(longest_ns * 1e-9, 2)}


def evidence_words(image: Image) -> str:
    """Return the gate's evidence against a picture, as text."""
    evidence = evidence_of(image)
    return "none" if evidence is None or evidence.outside is None else evidence.outside


def report_margins(folder: Path, names: list[str], count: int) -> None:
    """Measure every picture; report evidence by alteration, and the distance of pictures from inside to each threshold."""
    spread = {name: spread_frames(folder / INSIDE[name], count) for name in names}
    inside: dict[str, list[Evidence]] = {name: [] for name in names}
    for change, make in {**UNUSUAL, **HARD}.items():
        for part, cut in PARTS.items():
            found: Counter[str] = Counter()
            pictures = 0
            for name, images in spread.items():
                for image in images:
                    pictures += 1
                    evidence = evidence_of(make(cut(image), np.random.default_rng(0)))
                    found[name] += evidence is not None and evidence.outside is not None
                    if evidence is not None and change in UNUSUAL and part == "whole":
                        inside[name].append(evidence)
            say({"change": change, "part": part, "pictures": pictures, "evidence": dict(+found)})
    samples = [next(frames(folder / f"out_of_body/{number}.png"))[0] for number in FROM_OUTSIDE]
    for number, sample in zip(FROM_OUTSIDE, samples, strict=True):
        words = {name: evidence_words(np.ascontiguousarray(view(sample))) for name, view in VIEWS.items()}
        say({"outside": number, "evidence": words})
    pictures_outside = [
        *samples,
        *(draw(np.random.default_rng(seed)) for draw in OUTSIDE.values() for seed in range(3)),
    ]
    outside = [measures for each in pictures_outside if (measures := evidence_of(each)) is not None]
    for name, (limit, colour, colour_limit) in PAIRS.items():
        for measure, its, other, others in ((name, limit, colour, colour_limit), (colour, colour_limit, name, limit)):
            threshold = measure if measure == name else f"{colour} beside {name}"
            say({"threshold": threshold, "value": its, **margins(inside, outside, measure, its, other, others)})


def spread_frames(path: Path, count: int) -> list[Image]:
    """Return up to `count` evenly spaced frames, at most `WIDEST_PX` wide and high."""
    pictures = []
    for image, _ in frames(path):
        scale = min(1.0, WIDEST_PX / max(image.shape))
        pictures.append(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    spread = np.unique(np.linspace(0, len(pictures) - 1, min(count, len(pictures))).astype(int))
    return [np.asarray(pictures[index], np.uint8) for index in spread]


def margins(
    inside: Mapping[str, list[Evidence]],
    outside: list[Evidence],
    measure: str,
    limit: float,
    other: str,
    other_limit: float,
) -> dict[str, object]:
    """Return extreme values of one measure among pictures whose other measure exceeds its threshold, and the leave-one-recording-out count."""
    value, beside = MEASURES[measure], MEASURES[other]
    values = {name: [value(each) for each in found if beside(each) >= other_limit] for name, found in inside.items()}
    extremes = {name: max(each, default=0.0) for name, each in values.items()}
    beyond = min(value(each) for each in outside if beside(each) >= other_limit and value(each) >= limit)
    left_out = {}
    for name in inside:
        others = max((extremes[each] for each in inside if each != name), default=0.0)
        chosen = 0.5 * (others + beyond)
        left_out[name] = {"chosen": round(chosen, 3), "withheld": sum(each >= chosen for each in values[name])}
    return {
        "inside_most": {name: round(extreme, 3) for name, extreme in extremes.items()},
        "outside_least": round(beyond, 3),
        "left_out": left_out,
    }


def say(line: Mapping[str, object]) -> None:
    """Print a result line with the facts needed to repeat it."""
    origin = {
        "command": " ".join(
            ["python", "benchmarks/gates.py", *("RECORDINGS" if Path(each).is_dir() else each for each in sys.argv[1:])]
        ),
        "commit": COMMIT,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "date": date.today().isoformat(),
    }
    print(json.dumps({**line, **origin}), flush=True)


def _commit() -> str:
    found = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


COMMIT = _commit()

if __name__ == "__main__":
    raise SystemExit(main())
