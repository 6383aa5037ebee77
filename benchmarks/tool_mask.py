"""Measure tool segmentation (hits and false positives), the out-of-body gate, and the processor time of both.

One JSON line per recording, on one core: `iou` (tool class, mean and minimum over the frames with a tool, if the recording has masks), `recall`, `found_share` (share of
pixels called tool: false ones if there is no tool), `withheld` (frames that the gate withheld) and processor time per frame. With --copies also for altered copies of
the first recording: tint, brightness, noise, smoke, size. With --inside only pixels in the field of view count, for masks that include the surround of a round view.

With --annotations, RECORDING is the folder of all recordings, and the frames in `tool_annotations.json` are measured: outlines of tools that were drawn by hand. Clips
and threads that stay in the body are no tools. `unsure` regions are left out. `missed` are tools of more than 2 % of the picture of which less than 30 % is found;
`false_share` is the share of tissue called tool. The frames before an annotated one are given to the detector first.

Usage: python benchmarks/tool_mask.py RECORDING... [--frames 200] [--method builtin|full_view|classical|onnx:PATH|trained:FOLDER]
    [--inside] [--copies | --annotations]
`full_view` is the network of `builtin` for pictures without a round view, used for all.
FOLDER is the output of `tool_network/train.py`.
A picture file is a recording of one frame.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx import OnnxToolFinder
from gsplat_core.endoscope.out_of_body import BodyGate
from gsplat_core.endoscope.tools import NETWORK, NetworkToolFinder, ToolFinder, field_of_view, round_view
from gsplat_core.io.recordings import open_recording
from operators.tool_mask import MaskFinder

Image = NDArray[np.uint8]
Change = Callable[[Image], Image]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--method", default="builtin")
    parser.add_argument("--inside", action="store_true")
    parser.add_argument("--copies", action="store_true")
    parser.add_argument("--annotations", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    finder: MaskFinder = ToolFinder() if arguments.method == "classical" else NetworkToolFinder()
    if arguments.method == "full_view":
        finder = NetworkToolFinder(NETWORK)
    if arguments.method.startswith("trained:"):
        trained = Path(arguments.method.removeprefix("trained:"))
        training = json.loads((trained / "training.json").read_text())
        height, width = training["input_px"]
        finder = NetworkToolFinder(trained / "tool_network.onnx", (width, height), training.get("inputs", 5))
    if arguments.method.startswith("onnx:"):
        finder = OnnxToolFinder(Path(arguments.method.removeprefix("onnx:")))
    if arguments.annotations:
        report_annotated(arguments.recordings[0], finder)
        return 0
    for path in arguments.recordings:
        report(
            path.name if path.is_file() else path.resolve().name,
            measured(path, arguments.frames, finder, inside=arguments.inside),
        )
    for name, change in (changes() if arguments.copies else {}).items():
        path = arguments.recordings[0]
        report(f"{path.resolve().name}, {name}", measured(path, arguments.frames, finder, change))
    return 0


def frames(path: Path) -> Iterator[tuple[Image, Image | None]]:
    """Yield pictures with their recorded masks, or None."""
    if path.is_file() and path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        read = cv2.imread(str(path))
        assert read is not None, path
        yield np.ascontiguousarray(read[..., ::-1]), None
        return
    for frame in open_recording(path):
        yield frame.image, frame.mask


def measured(
    path: Path, count: int, finder: MaskFinder, change: Change = lambda image: image, inside: bool = False
) -> dict[str, object]:
    """Return the figures of one recording. `inside` leaves out pixels outside of the field of view."""
    finder.reset()
    gate = BodyGate()
    ious, recalls, shares, find_ms, judge_ms, withheld, round_views = [], [], [], [], [], 0, 0
    for image, mask in islice(frames(path), count):
        image = change(image)
        start = time.thread_time()
        found = finder.find(image) == 0
        middle = time.thread_time()
        withheld += gate.judge(image) is not None
        judge_ms.append(1e3 * (time.thread_time() - middle))
        find_ms.append(1e3 * (middle - start))
        view = field_of_view(np.asarray(image.max(axis=2))) > 0 if inside else np.ones_like(found)
        found &= view
        round_views += round_view(image)
        shares.append(float(found.mean()))
        # A mask with the field of view's border in it is no tool mask; the synthetic recordings' and `masks/` are.
        if mask is not None and (mask == 0).any() and has_tool_masks(path):
            tool = cv2.resize(mask, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) == 0
            tool &= view
            if inside and tool.mean() < RIM:
                continue
            ious.append(float((found & tool).sum() / (found | tool).sum()))
            recalls.append(float((found & tool).sum() / tool.sum()))
    figures: dict[str, object] = {"frames": len(shares), "found_share": round(float(np.mean(shares)), 4)}
    if ious:
        figures |= {"iou": round(float(np.mean(ious)), 3), "iou_min": round(min(ious), 3)}
        figures["recall"] = round(float(np.mean(recalls)), 3)
    figures |= {"round_views": round_views, "withheld": withheld, "find_ms_p50": round(float(np.median(find_ms)), 2)}
    return figures | {
        "find_ms_p95": round(float(np.quantile(find_ms, 0.95)), 2),
        "judge_ms_p50": round(float(np.median(judge_ms)), 2),
    }


RIM = 0.003
"""Share of the picture below which masked pixels in the field of view count as its rim, not as a tool."""


def has_tool_masks(path: Path) -> bool:
    """Return true if the recording has a folder of tool masks."""
    return (path / "masks").is_dir()


ANNOTATIONS = Path(__file__).resolve().parent / "tool_annotations.json"
FRAMES_BEFORE = 10
"""Frames that a detector sees before an annotated one."""
LARGE, MISSED = 0.02, 0.3
"""Share of the picture from which a tool counts as large, and the found share of a tool below which it counts as missed."""
FOLDERS = {name: f"others/{name}" for name in ("laparoscopy", "stereomis_like", "pelvis_stills", "resting_bowel")} | {
    f"colonoscopy_{part}": f"others/colonoscopy_{part}" for part in "ab"
}


def report_annotated(recordings: Path, finder: MaskFinder) -> None:
    """Print the figures of the annotated frames, by recording, and their mean over the recordings with tools."""
    wanted: dict[str, dict[int, dict[str, Any]]] = {}
    for annotation in json.loads(ANNOTATIONS.read_text()):
        wanted.setdefault(annotation["recording"], {})[annotation["frame"]] = annotation
    means = []
    for name, frames_of in wanted.items():
        figures = measured_annotated(recordings / FOLDERS.get(name, name), frames_of, finder)
        if "iou" in figures:
            means.append(figures["iou"])
        report(name, figures)
    report("mean of recordings", {"iou": round(float(np.mean(means)), 3), "iou_min": min(means)})


def measured_annotated(path: Path, wanted: dict[int, dict[str, Any]], finder: MaskFinder) -> dict[str, Any]:
    """Return the figures of a recording's annotated frames."""
    ious, false_shares, times, missed, large = [], [], [], 0, 0
    before: list[Image] = []
    stills = sorted(path.glob("*.jpg"))
    pictures = (next(frames(still))[0] for still in stills) if stills else (image for image, _ in frames(path))
    for index, image in enumerate(islice(pictures, max(wanted) + 1)):
        if stills:
            before = []
        before = [*before[-FRAMES_BEFORE:], image]
        if index not in wanted:
            continue
        finder.reset()
        for earlier in before:
            start = time.thread_time()
            found = finder.find(earlier) == 0
            times.append(1e3 * (time.thread_time() - start))
        tools, known = truth(wanted[index], image.shape[:2])
        found &= known
        false_shares.append(float((found & ~tools).mean()))
        if not tools.any():
            continue
        ious.append(float((found & tools).sum() / (found | tools).sum()))
        count, labels = cv2.connectedComponents(tools.astype(np.uint8))
        for label in range(1, count):
            if (labels == label).mean() > LARGE:
                large += 1
                missed += bool(found[labels == label].mean() < MISSED)
    figures: dict[str, Any] = {"frames": len(wanted), "false_share": round(float(np.mean(false_shares)), 4)}
    if ious:
        figures |= {
            "iou": round(float(np.mean(ious)), 3),
            "iou_min": round(min(ious), 3),
            "large": large,
            "missed": missed,
        }
    return figures | {"find_ms_p50": round(float(np.median(times)), 2)}


def truth(annotation: dict[str, Any], shape: tuple[int, int]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the tools [H, W] and the pixels that count [H, W] of an annotation."""
    scale = np.array([shape[1], shape[0]]) / annotation["size"]

    def filled(polygons: list[list[list[float]]]) -> NDArray[np.bool_]:
        mask = np.zeros(shape, np.uint8)
        for polygon in polygons:
            cv2.fillPoly(mask, [np.round((np.array(polygon) + 0.5) * scale * 16).astype(np.int32)], 1, shift=4)
        return mask > 0

    known = ~filled(annotation["unsure"])
    return filled(annotation["tools"]) & ~filled(annotation["holes"]) & known, known


def changes() -> dict[str, Change]:
    """Return image changes that imitate another scope's picture of the same scene."""
    noise = np.random.default_rng(0)
    return {
        "hue +12 degrees": lambda image: hue(image, 6),
        "hue -12 degrees": lambda image: hue(image, -6),
        "half as bright": gains(0.5, 0.5, 0.5),
        "a third as bright": gains(0.3, 0.3, 0.3),
        "brighter by 1.4": gains(1.4, 1.4, 1.4),
        "gamma 0.7": lambda image: gamma(image, 0.7),
        "gamma 1.5": lambda image: gamma(image, 1.5),
        "warm": gains(1.15, 1.0, 0.85),
        "cold": gains(0.75, 1.0, 1.1),
        "green": gains(0.95, 1.1, 0.95),
        "magenta": gains(1.05, 0.9, 1.05),
        "half size": lambda image: resized(image, 0.5),
        "1.5 times the size": lambda image: resized(image, 1.5),
        "noise": lambda image: np.clip(image + noise.normal(0, 12, image.shape), 0, 255).astype(np.uint8),
        "blurred": lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 4), np.uint8),
        "smoke 40 %": lambda image: (0.6 * image + 0.4 * 170).astype(np.uint8),
        "smoke 60 %": lambda image: (0.4 * image + 0.6 * 170).astype(np.uint8),
    }


def gains(red: float, green: float, blue: float) -> Change:
    """Return a function that multiplies each channel by a factor."""
    return lambda image: np.clip(image * np.array([red, green, blue]), 0, 255).astype(np.uint8)


def gamma(image: Image, exponent: float) -> Image:
    """Return a function that applies a gamma curve."""
    return (255 * (image / 255) ** exponent + 0.5).astype(np.uint8)


def hue(image: Image, steps: int) -> Image:
    """Shift all hues, in units of two degrees."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.int16)
    hsv[..., 0] = (hsv[..., 0] + steps) % 180
    return np.asarray(cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB), np.uint8)


def resized(image: Image, factor: float) -> Image:
    """Return a function that resizes pictures."""
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)


def report(recording: str, figures: dict[str, object]) -> None:
    print(json.dumps({"recording": recording, **figures}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
