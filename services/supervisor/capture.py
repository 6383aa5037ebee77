"""Capture process of a stream, `python -m services.supervisor.capture --spec FILE`.

Owns the source and publishes its frames, independently of the engine and the control plane. Loads
no torch.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from gsplat_core.errors import UserError
from gsplat_core.scene.frames import Frame
from operators.errors import SourceError, SourceUnavailable
from operators.sources.backoff import Backoff
from operators.sources.options import SourceOptions
from operators.sources.registry import STUCK_AFTER_S, open_source, split_address
from operators.sources.source import FrameSource, ReportingSource, SourceState
from operators.sources.wire import description_to, frame_header, planes_of
from operators.sources.zeromq_message import pieces
from services.bus.pictures import PicturePublisher
from services.errors import CommandRefused
from services.private_files import keep_files_private
from services.supervisor.exit_codes import FAILED, NO_USE
from services.supervisor.specs import SourceSpec
from services.supervisor.worker import Worker, stream_folder_of

log = logging.getLogger(__name__)
LOOK_S = 0.1
"""Read timeout in seconds; the source state is reported at this interval while no frame arrives."""


class Capture:
    """Reader of the source that publishes its frames and reopens the source after errors."""

    def __init__(self, spec: SourceSpec) -> None:
        self.spec = spec
        self._lock = threading.Lock()
        self._source: FrameSource | None = None
        self._run = time.time_ns()
        """Run id in the frame headers; a change tells readers that sequence numbers and timestamps
        restart."""
        self.frames = 0
        self._last_ns: int | None = None

    def describe(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Handle the command `describe`: return the source description.

        Raises:
            CommandRefused: if the source is not open.
        """
        with self._lock:
            if self._source is None:
                raise CommandRefused("the source is not open")
            return {"description": description_to(self._source.description)}

    def figures(self) -> dict[str, Any]:
        """Return frame counts for the heartbeats."""
        with self._lock:
            source = self._source
            counts: dict[str, int] = dict(source.counts()) if isinstance(source, ReportingSource) else {}
        return {"frames": self.frames, "last_frame_ns": self._last_ns, "counts": counts}

    def publish(self, worker: Worker, publisher: PicturePublisher) -> None:
        """Publish frames until the process is asked to stop.

        Raises:
            UserError: if the address can never work.
        """
        backoff = Backoff()
        while not worker.stop_requested():
            try:
                source = open_source(self.spec.address, self._options())
            except SourceUnavailable as error:
                worker.say("opening", str(error))
                worker.wait(backoff.failed())
                continue
            with self._lock:
                self._source = source
                self._run += 1
            try:
                self._publish(source, worker, publisher, backoff)
            except SourceError as error:
                worker.say("lost", str(error))
                worker.wait(backoff.failed())
            finally:
                with self._lock:
                    self._source = None
                source.close()

    def _options(self) -> SourceOptions:
        spec = self.spec
        # This process runs only the source. If the source hangs or dies, the supervisor restarts
        # the process.
        return SourceOptions(scale=spec.given_scale, fps=spec.fps, loop=spec.loop, realtime=True, process=False)

    def _publish(self, source: FrameSource, worker: Worker, publisher: PicturePublisher, backoff: Backoff) -> None:
        source.open()
        stuck_after_s = STUCK_AFTER_S.get(split_address(self.spec.address)[0], math.inf)
        given_s = time.monotonic()
        while not worker.stop_requested():
            frame = source.read(LOOK_S)
            if frame is not None:
                given_s = time.monotonic()
                self._send(frame, publisher)
                backoff.worked()
                worker.say("live", f"{source.description.name} gives frames")
            else:
                state = source.state
                worker.say(state.value, _sentence(source))
                if state is SourceState.ENDED:
                    worker.wait(LOOK_S)
                elif time.monotonic() - given_s > stuck_after_s:
                    log.error(
                        "the camera's driver has given nothing for %g s; the process ends to be started again",
                        stuck_after_s,
                    )
                    os._exit(FAILED)  # the thread blocked in the driver cannot be ended otherwise

    def _send(self, frame: Frame, publisher: PicturePublisher) -> None:
        header = {**frame_header(frame), "run": self._run}
        publisher.publish_frame(header, pieces(frame.seq, frame.pts_ns, planes_of(frame)))
        self.frames += 1
        self._last_ns = time.monotonic_ns()


def _sentence(source: FrameSource) -> str:
    return source.state_sentence if isinstance(source, ReportingSource) else f"the source is {source.state.value}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until asked to stop.

    Returns:
        The exit code.
    """
    keep_files_private()
    parser = argparse.ArgumentParser(description="Capture process of a stream.")
    parser.add_argument("--spec", required=True, help="file with the specification")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        folder, spec = stream_folder_of(parser.parse_args(arguments).spec, "capture")
        assert spec.capture is not None
        capture = Capture(spec.capture)
        with Worker(folder, spec, {"describe": capture.describe}) as worker:
            worker.tell_figures("capture", capture.figures)
            publisher = PicturePublisher(folder.pictures("capture"))
            try:
                capture.publish(worker, publisher)
            finally:
                publisher.close()
    except UserError as error:
        logging.getLogger(__name__).error("%s", error)
        return NO_USE
    return 0


if __name__ == "__main__":
    sys.exit(main())
