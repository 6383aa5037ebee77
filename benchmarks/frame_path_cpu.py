"""Measure the processor time per live frame of one thread outside training: analysis, display and scoring.

One JSON line per stage: milliseconds per frame (p50, p95, maximum) over all frames after the first second. `analysis` is the sum of its chains, which live runs in
parallel. The displayed picture is the previous frame. Recorded masks are ignored, so that tools are detected.

Usage: python benchmarks/frame_path_cpu.py RECORDING_OR_ADDRESS... [--frames 150]
For example ../shared/recordings/cutting "synthetic:?width=1280&height=1024"
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import reduce

import cv2
import numpy as np
import torch

from gsplat_core.scene.frames import Frame, FrameStatus
from operators.display import DisplayOp
from operators.frame_clock import ClockSettings, FrameClock
from operators.graph import Application
from operators.messages import PictureState, RenderedFrame, ShownPicture
from operators.metrics import MetricsOp
from operators.pipeline import analysis_operator, through, with_findings
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState

SETTLED_AFTER = 30
"""Warm-up frames, not counted."""


class FramePath:
    """The operators of a live run that see each frame, without training and drawing between them."""

    def __init__(self) -> None:
        graph = Application(name="frame path")
        self._analysis = analysis_operator(graph, "builtin", "withhold")
        clock = FrameClock(ClockSettings(), 30.0)
        self._display = DisplayOp(graph, name="display", clock=clock, source_state=lambda: SourceState.LIVE)
        self._score = MetricsOp(graph, name="metrics", on_screen=True)
        for operator in (self._analysis, self._display, self._score):
            operator.initialize()
            operator.start()
        self._display.prepare_thread()
        self._before: Frame | None = None
        self.spent: dict[str, list[float]] = defaultdict(list)

    def take(self, frame: Frame) -> None:
        """Run and time the host's work for one frame."""
        analysis, start = self._analysis, time.thread_time()
        with self._timed("out-of-body gate"):
            gated = through(analysis.gate, frame)
        with self._timed("checks of the picture"):
            decided = through(analysis.first, frame)
        with self._timed("tool mask and highlights"):
            found = [through(each, frame) for each in analysis.beside]
        with self._timed("checks of the tissue"):
            decided = reduce(with_findings, found, decided) if gated.withheld is None else gated
            decided = through(analysis.then, decided)
        self.spent["analysis"].append(1e3 * (time.thread_time() - start))
        before, self._before = self._before, decided
        if before is None:
            return
        alpha = np.ones(frame.image.shape[:2], np.float32)
        rendered = RenderedFrame(decided, before.image, alpha, alpha, 0, True, content=decided)
        with self._timed("display"):
            image, remembered = self._display._drawn(rendered, PictureState.LIVE, 15e6)
        shown = ShownPicture(rendered, image, PictureState.LIVE, 0, decided.arrived_ns or 0, True, remembered)
        port = _Port({"shown": [shown], "frame": [decided]})
        with self._timed("scoring"):
            self._score.compute(port, port, port)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.thread_time()
        yield
        self.spent[stage].append(1e3 * (time.thread_time() - start))


class _Port:
    """Inputs of an operator, and an output that discards messages."""

    def __init__(self, messages: dict[str, list[object]]) -> None:
        self._messages = messages

    def receive(self, name: str) -> object | None:
        """Return the next message, or None."""
        return self._messages[name].pop() if self._messages[name] else None

    def emit(self, message: object, name: str) -> None:
        """Discard the message."""


def frames(address: str, count: int) -> Iterator[Frame]:
    """Return the first frames of a source, as delivered in a live run, without masks."""
    source = open_source(address, SourceOptions(loop=True))
    source.open()
    try:
        k = 0
        while k < count:
            frame = source.read(1.0)
            if frame is None:
                if source.state is SourceState.ENDED:
                    return
                continue
            yield replace(frame, mask=None, status=FrameStatus.LIVE, arrived_ns=frame.pts_ns)
            k += 1
    finally:
        source.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--frames", type=int, default=150)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    for address in arguments.sources:
        path = FramePath()
        kept = list(frames(address, arguments.frames))
        for frame in kept:
            path.take(frame)
        for stage, spent in path.spent.items():
            p50, p95, most = np.percentile(spent[SETTLED_AFTER:], [50, 95, 100]).round(2).tolist()
            size = f"{kept[0].width_px}x{kept[0].height_px}"
            print(
                json.dumps(
                    {"source": address, "size": size, "stage": stage, "p50_ms": p50, "p95_ms": p95, "most_ms": most}
                )
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
