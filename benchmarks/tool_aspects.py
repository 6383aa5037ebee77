"""Measure the built-in tool mask on pictures of unusual aspect ratios, made of recorded frames.

One JSON line per aspect ratio, kind of picture and half of the recordings, and one per recording. `iou` (tool class) is the mean over recordings of the mean over
pictures with a tool, `false_share` the share of tissue called tool; `whole_iou` and `whole_false_share` are those of the mask of the frame from which the picture
was made, on the same pixels. Remedies are chosen on the recordings `choose` and reported on `report`. Kinds:

- `crop`: three crops of each frame of a recording without a round view.
- `round`: a round view on black. Frames without a round view are cut to a square and given a round view first.

The frames are those of `tool_annotations.json`, every 13th of `cutting` with its recorded masks, and frames of recordings without tools.

Usage: python benchmarks/tool_aspects.py FOLDER_OF_RECORDINGS [--out LOG.jsonl]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from run_facts import run_facts
from tool_mask import ANNOTATIONS, FOLDERS, frames, truth

from gsplat_core.endoscope.tools import NetworkToolFinder

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.gsplat_core.endoscope.unusual import round_view

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]
ASPECTS = {"9:19.5": 9 / 19.5, "9:16": 9 / 16, "3:4": 3 / 4, "21:9": 21 / 9, "32:9": 32 / 9}
"""Width over height of the pictures, by name."""
HALVES = {
    "choose": ("laparoscopy", "cutting", "resting_bowel", "scared_pair", "colonoscopy_a"),
    "report": (
        *("stereomis_like", "pelvis_stills", "heart", "colon", "organ_still", "hamlyn_pair", "colonoscopy_b", "sinus"),
    ),
}
ROUND = ("colonoscopy_a", "colonoscopy_b", "sinus")
"""Recordings whose frames have a round or octagonal view."""
WITHOUT_TOOLS = {
    "scared_pair": "scared_pair/left.png",
    "colon": "colon/video.mp4",
    "organ_still": "others/organ_still/images",
    "hamlyn_pair": "hamlyn_pair/f7_dynamic_deint_L_0100.png",
}
"""Files of recordings without tools or annotations; every 15th frame is used."""
LEAST_TOOL = 0.005
"""Share of a picture that tools must cover for it to count in the IoU."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    lines = [json.dumps({"header": run_facts()})]
    print(lines[0], flush=True)
    for half, names in HALVES.items():
        examples = {name: list(annotated(arguments.recordings, name)) for name in names}
        for kind in ("crop", "round"):
            for aspect in ASPECTS:
                for line in measured(examples, kind, aspect):
                    lines.append(json.dumps({"half": half, "kind": kind, "aspect": aspect, **line}))
                    print(lines[-1], flush=True)
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text("\n".join(lines) + "\n")
    return 0


def annotated(folder: Path, name: str) -> Iterator[tuple[Image, Mask, Mask]]:
    """Yield frames of a recording with the masks [H, W] of their tools and of the pixels that count."""
    if name in WITHOUT_TOOLS:
        path = folder / WITHOUT_TOOLS[name]
        stills = sorted(path.iterdir())[:1] if path.is_dir() else [path]
        for image, _ in islice((pair for still in stills for pair in frames(still)), 0, None, 15):
            yield image, np.zeros(image.shape[:2], np.bool_), np.ones(image.shape[:2], np.bool_)
        return
    if name == "cutting":
        for image, mask in islice(frames(folder / name), 0, None, 13):
            assert mask is not None
            tools = cv2.resize(mask, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) == 0
            yield image, tools, np.ones(image.shape[:2], np.bool_)
        return
    wanted = {each["frame"]: each for each in json.loads(ANNOTATIONS.read_text()) if each["recording"] == name}
    path = folder / FOLDERS.get(name, name)
    stills = sorted(path.glob("*.jpg"))
    pictures = (next(frames(still))[0] for still in stills) if stills else (image for image, _ in frames(path))
    for index, image in enumerate(islice(pictures, max(wanted) + 1)):
        if index in wanted:
            yield image, *truth(wanted[index], image.shape[:2])


def measured(examples: dict[str, list[tuple[Image, Mask, Mask]]], kind: str, aspect: str) -> Iterator[dict[str, Any]]:
    """Yield the figures of each recording, then the means over the recordings."""
    finder = NetworkToolFinder()
    found: list[dict[str, float]] = []
    times: list[float] = []
    for name, pictures in examples.items():
        if kind == "crop" and name in ROUND:
            continue
        figures: dict[str, list[float]] = {}
        for frame in pictures:
            whole, tools, known = frame if kind == "crop" or name in ROUND else with_round_view(*frame)
            of_whole = finder.find(whole) == 0
            for image, inside, box in made(whole, kind, ASPECTS[aspect]):
                start = time.thread_time()
                mask = finder.find(image) == 0
                times.append(1e3 * (time.thread_time() - start))
                there, counted = tools[box], known[box]
                for prefix, each in (("", mask[inside]), ("whole_", of_whole[box])):
                    called = each & counted
                    tissue = counted & ~there
                    figures.setdefault(f"{prefix}false_share", []).append(
                        float((called & tissue).sum() / max(1, tissue.sum()))
                    )
                    if there.mean() > LEAST_TOOL:
                        iou = float((called & there).sum() / (called | there).sum())
                        figures.setdefault(f"{prefix}iou", []).append(iou)
        found.append({key: float(np.mean(values)) for key, values in sorted(figures.items())})
        yield {"recording": name, "pictures": len(figures["false_share"])} | rounded(found[-1])
    keys = sorted({key for each in found for key in each})
    means = {key: float(np.mean([each[key] for each in found if key in each])) for key in keys}
    yield {"recording": "mean", **rounded(means), "find_ms_p50": round(float(np.median(times)), 2)}


def rounded(figures: dict[str, float]) -> dict[str, float]:
    """Return the figures rounded to four decimals."""
    return {key: round(value, 4) for key, value in figures.items()}


def made(whole: Image, kind: str, aspect: float) -> Iterator[tuple[Image, Box, Box]]:
    """Yield pictures of an aspect ratio, each with the rows and columns that show the frame in it, and with those of the frame."""
    height, width = whole.shape[:2]
    tall = aspect < width / height
    if kind == "round":
        size = (round(width / aspect), width) if tall else (height, round(height * aspect))
        above, left = (size[0] - height) // 2, (size[1] - width) // 2
        box = slice(above, above + height), slice(left, left + width)
        image = np.zeros((*size, 3), np.uint8)
        image[box] = whole
        yield image, box, (slice(None), slice(None))
        return
    size = (height, round(height * aspect)) if tall else (round(width / aspect), width)
    for place in (0, 0.5, 1):
        top, left = round(place * (height - size[0])), round(place * (width - size[1]))
        box = slice(top, top + size[0]), slice(left, left + size[1])
        yield np.ascontiguousarray(whole[box]), (slice(None), slice(None)), box


def with_round_view(image: Image, tools: Mask, known: Mask) -> tuple[Image, Mask, Mask]:
    """Return the middle square of a frame with a round view, and of its masks."""
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    box = slice(top, top + side), slice(left, left + side)
    rng = np.random.default_rng(0)
    inside = round_view(np.ones((side, side, 1), np.uint8), rng)[..., 0] > 0
    return round_view(np.ascontiguousarray(image[box]), rng), tools[box] & inside, known[box] & inside


if __name__ == "__main__":
    sys.exit(main())
