"""Measure the cost of recording a session: processor time and bytes per frame by part, and waits of the graph thread.

A frame arrives with its masks and leaves with another loss mask, then its picture is shown. First each part is written in this thread, then all of it through
`SessionRecorder` at the recording's rate, in its own thread.

Usage: python benchmarks/recording_cost.py RECORDING [--frames 100] [--scale 1.0]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import av
import numpy as np

from gsplat_core.io.frame_codec import camera_record
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.sessions import SessionInfo, SessionReader, SessionWriter
from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.frames import Frame
from operators.sinks.session_recorder import SessionRecorder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--scale", type=float, default=1.0)
    arguments = parser.parse_args()
    recording = open_recording(arguments.recording, scale=arguments.scale)
    frames = list(islice(recording, arguments.frames))
    info = SessionInfo(source="benchmark", utc="", fps=recording.fps, camera=camera_record(recording.camera))
    report(
        av=av.__version__,
        cores=os.cpu_count(),
        frames=len(frames),
        width=frames[0].width_px,
        height=frames[0].height_px,
    )
    bare = [replace(frame, mask=None, depth=None, right_image=None) for frame in frames]
    by_itself("image", info, bare, lambda writer, frame: writer.frame(frame))
    by_itself("image and what lies beside it", info, frames, lambda writer, frame: writer.frame(frame))
    prepared = {frame.seq: with_loss_mask(frame) for frame in bare}
    by_itself("loss mask", info, bare, lambda writer, frame: writer.prepared(prepared[frame.seq], frame))
    by_itself("shown", info, frames, lambda writer, frame: writer.shown(Shown(frame, frame.image, 1)))
    beside_a_graph(info, frames, recording.fps)
    return 0


def by_itself(
    name: str,
    info: SessionInfo,
    frames: list[Frame],
    write: Callable[[SessionWriter, Frame], None],
) -> None:
    """Measure one part of a recording in this thread."""
    with tempfile.TemporaryDirectory() as folder:
        writer = SessionWriter(Path(folder) / "session", info)
        begin = time.process_time()
        for frame in frames:
            write(writer, frame)
        writer.close("end")
        spent = time.process_time() - begin
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    report(part=name, cpu_ms_per_frame=round(1e3 * spent / len(frames), 2), bytes_per_frame=size // len(frames))


def beside_a_graph(info: SessionInfo, frames: list[Frame], fps: float) -> None:
    """Measure the whole recording at the stream's rate; `handed_over_us` is the time spent by the graph's threads."""
    handed: list[float] = []
    given = [with_loss_mask(frame) for frame in frames]
    with tempfile.TemporaryDirectory() as folder:
        recorder = SessionRecorder(Path(folder) / "session", info)
        recorder.open()
        begin, spent = time.monotonic(), time.process_time()
        for k, (frame, prepared) in enumerate(zip(frames, given, strict=True)):
            time.sleep(max(0.0, begin + k / fps - time.monotonic()))
            now = time.perf_counter()
            recorder.frame(frame)
            recorder.prepared(prepared)
            recorder.shown(Shown(prepared, frame.image, 1))
            handed.append(time.perf_counter() - now)
        behind_s = time.monotonic()
        recorder.close()
        behind_s = time.monotonic() - behind_s
        recorded = recorder.recorded
        begin_read = time.process_time()
        read = sum(1 for _ in SessionReader(Path(folder) / "session").prepared())
        read_s = time.process_time() - begin_read
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    report(
        part=f"all, at {fps:g} frames/s",
        cpu_ms_per_frame=round(1e3 * (time.process_time() - spent - read_s) / len(frames), 2),
        bytes_per_frame=size // len(frames),
        handed_over_us_p50=round(1e6 * float(np.median(handed))),
        handed_over_us_max=round(1e6 * max(handed)),
        lost=recorded.lost,
        behind_at_the_end_s=round(behind_s, 2),
        read_ms_per_frame=round(1e3 * read_s / max(1, read), 2),
    )


def with_loss_mask(frame: Frame) -> Frame:
    """Return the frame with highlights excluded from the loss, as in live training."""
    return frame.with_fields(loss_mask=(frame.image.min(axis=2) < 200).astype(np.uint8))


def report(**values: object) -> None:
    """Print one line of JSON."""
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    sys.exit(main())
