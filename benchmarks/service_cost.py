"""Measure CPU time and delay of each process hop of a stream's frames and pictures, against reading the source alone.

    python benchmarks/service_cost.py --width 640 --height 512 --frames 300

Prints one JSON object. Everything runs in one process, whose CPU time includes sender, receiver and ZeroMQ's threads. Nothing is trained, so other load has little effect.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from service_watchers import quantiles

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.live import LiveSource
from operators.sources.source import SourceDescription
from services.bus.messages import CommandServer, Heartbeats, PicturePublisher, picture_from, subscribe
from services.bus.runtime import RuntimeFolder
from services.display import encoded
from services.supervisor.capture import CapturedSource


class Pattern(LiveSource):
    """Source of noise pictures at a fixed rate."""

    def __init__(self, width_px: int, height_px: int, fps: float, frames: int) -> None:
        super().__init__(waiting=4)
        camera = Camera.from_focal(float(width_px), width_px, height_px)
        self.description = SourceDescription("pattern", width_px, height_px, fps, camera, frame_count=frames)
        self._image = np.random.default_rng(0).integers(0, 256, (height_px, width_px, 3), np.uint8)

    def frames(self):
        for seq in range(self.description.frame_count or 0):
            if self.wait(1 / self.description.fps):
                return
            yield Frame(seq, round(seq * 1e9 / self.description.fps), self._image, status=FrameStatus.LIVE)


def measured(what: Callable[[], int]) -> tuple[float, int]:
    """Return the CPU time per frame in ms and the number of frames."""
    began_s = time.process_time()
    frames = what()
    return 1e3 * (time.process_time() - began_s) / max(1, frames), frames


def read_all(source: Any, each: Callable[[Frame], None], frames: int) -> int:
    """Read a source to its end, or until nothing arrives for a second."""
    source.open()
    count = 0
    while count < frames and (frame := source.read(1.0)) is not None:
        count += 1
        each(frame)
    source.close()
    return count


def raw_hop(options: argparse.Namespace, runtime: RuntimeFolder) -> dict[str, Any]:
    """Measure the hop from capture to engine."""
    folder = runtime.stream("raw")
    pattern = Pattern(options.width, options.height, options.fps, options.frames)
    alone_ms, _ = measured(lambda: read_all(pattern, lambda frame: None, options.frames))
    publisher = PicturePublisher(folder.pictures("capture"))
    about = {"description": pattern.description.as_json()}
    commands = CommandServer(folder.commands("capture"), {"describe": lambda _: about})
    heartbeats = Heartbeats(folder.status("capture"), lambda: {"state": "live", "reason": ""})
    delays_ms: list[float] = []

    def send(frame: Frame) -> None:
        publisher.publish_frame({"run": 1}, frame)

    def both() -> int:
        captured = CapturedSource(folder)
        taken = lambda frame: delays_ms.append((time.monotonic_ns() - frame.arrived_ns) * 1e-6)
        reader = threading.Thread(target=read_all, args=(captured, taken, options.frames))
        reader.start()
        time.sleep(0.3)
        sent = read_all(pattern, send, options.frames)
        reader.join()
        return sent

    through_ms, _ = measured(both)
    for each in (publisher, commands, heartbeats):
        each.close()
    return {
        "source_alone_cpu_ms": round(alone_ms, 3),
        "through_the_bus_cpu_ms": round(through_ms, 3),
        "added_cpu_ms": round(through_ms - alone_ms, 3),
        "received": len(delays_ms),
        "delay_ms": quantiles(delays_ms),
    }


def shown_hop(options: argparse.Namespace, runtime: RuntimeFolder) -> dict[str, Any]:
    """Measure the hop from engine to display, including one JPEG."""
    endpoint = runtime.stream("shown").pictures("engine")
    publisher = PicturePublisher(endpoint)
    image = np.random.default_rng(0).integers(0, 256, (options.height, options.width, 3), np.uint8)
    delays_ms: list[float] = []
    over = threading.Event()

    def receive() -> None:
        socket = subscribe(zmq.Context.instance().socket(zmq.SUB), endpoint)
        while not over.is_set():
            if socket.poll(100):
                header = picture_from(socket.recv_multipart(copy=False)).header
                delays_ms.append((time.monotonic_ns() - int(header["sent_ns"])) * 1e-6)
        socket.close()

    def both() -> int:
        reader = threading.Thread(target=receive)
        reader.start()
        time.sleep(0.3)
        for _ in range(options.frames):
            time.sleep(1 / options.fps)
            publisher.publish({"sent_ns": time.monotonic_ns()}, image)
        over.set()
        reader.join()
        return options.frames

    cpu_ms, _ = measured(both)
    jpeg_ms, _ = measured(lambda: sum(bool(encoded(image, 80)) for _ in range(50)))
    publisher.close()
    return {
        "cpu_ms": round(cpu_ms, 3),
        "received": len(delays_ms),
        "delay_ms": quantiles(delays_ms),
        "jpeg_of_noise_cpu_ms": round(jpeg_ms, 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--frames", type=int, default=300)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        runtime = RuntimeFolder(Path(folder))
        result = {"raw": raw_hop(options, runtime), "shown": shown_hop(options, runtime)}
    print(json.dumps({"size": [options.width, options.height], "fps": options.fps, **result}, indent=2))


if __name__ == "__main__":
    main()
