"""Capture process of a stream, `python -m services.supervisor.capture --spec FILE`, and the frame source that receives its frames.

The capture process owns the source and publishes raw frames. The engine process reads them by `CapturedSource`.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from gsplat_core.errors import InvalidInput, UserError
from gsplat_core.io.frame_codec import InvalidMessage
from gsplat_core.scene.frames import Frame, resized_frame
from operators.errors import SourceError, SourceUnavailable
from operators.sources.address import SourceOptions
from operators.sources.derived import scaled_description
from operators.sources.live import Backoff, FrameOrder, LiveSource
from operators.sources.registry import STUCK_AFTER_S, open_source, split_address
from operators.sources.source import FrameSource, ReportingSource, SourceDescription, SourceState
from services.bus.messages import PicturePublisher, ask, frame_from, parsed_json, subscribe
from services.bus.runtime import StreamFolder
from services.errors import BadMessage, BusError, CommandRefused
from services.private_files import keep_files_private
from services.supervisor.launcher import FAILED, NO_USE
from services.supervisor.worker import ProcessSpec, SourceSpec, Worker

POLL_MS = 50
ASK_AGAIN_S = 0.1
SILENT_S = 1.0
"""Seconds without a heartbeat after which the engine treats the capture process as ended or hung."""
WAITING = 4


class CapturedSource(LiveSource):
    """Live source that receives frames from a capture process, with their arrival times there.

    The source never ends. While no frames arrive, `state` and `state_sentence` report the cause in the capture process
    or its source. Sequence numbers and timestamps continue after a reconnect.
    """

    def __init__(
        self,
        folder: StreamFolder,
        stop_requested: Callable[[], bool] = lambda: False,
        scale_for: Callable[[SourceDescription], float] = lambda about: 1.0,
    ) -> None:
        """Block until the capture process has opened its source.

        Args:
            folder: runtime folder of the stream.
            stop_requested: polled while waiting.
            scale_for: returns the scale of the frames for a source description.

        Raises:
            SourceUnavailable: if a stop is requested before the source is open.
        """
        super().__init__(waiting=WAITING, order=FrameOrder(trusted=True))
        self._folder = folder
        self._reported: tuple[SourceState, str] | None = None
        self._heard_s = time.monotonic()
        about = self._described(stop_requested)
        self._scale = scale_for(about)
        self.description = scaled_description(about, self._scale)

    @property
    def state(self) -> SourceState:
        """Current state of the source, by the calls of `lost` and the time since the last frame, as in `LiveSource`.

        If that state is `LIVE` and no frame waits for `read`, a state that the capture process reported since the last
        frame replaces it.
        """
        state, reported = super().state, self._reported
        if state is SourceState.LIVE and reported is not None and not self._ready:
            return reported[0]
        return state

    @property
    def state_sentence(self) -> str:
        """State of the source as a sentence, with the reason from the capture process."""
        reported = self._reported
        return reported[1] if reported is not None and self.state is reported[0] else super().state_sentence

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the capture process, also after its restarts."""
        context: zmq.Context = zmq.Context.instance()
        pictures = subscribe(context.socket(zmq.SUB), self._folder.pictures("capture"), waiting=WAITING)
        status = subscribe(context.socket(zmq.SUB), self._folder.status("capture"), waiting=8)
        ended = pictures.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        poller = zmq.Poller()
        for socket in (pictures, status, ended):
            poller.register(socket, zmq.POLLIN)
        run: Any = None
        self._heard_s = time.monotonic()  # no heartbeat could arrive before the subscription
        try:
            while not self.wait(0):
                found = dict(poller.poll(POLL_MS))
                if ended in found:
                    recv_monitor_message(ended)
                    self.lost("the capture process has ended; it is being started again")
                if status in found:
                    self._note(status.recv())
                elif time.monotonic() - self._heard_s > SILENT_S:
                    self.lost("the capture process does not respond; it is being restarted")
                if pictures not in found:
                    continue
                received = self._frame(pictures.recv_multipart(copy=False))
                if received is None:
                    continue
                header, frame = received
                if run is not None and header.get("run") != run:
                    self._begin_anew()
                run = header.get("run")
                self._reported = None
                yield frame
        finally:
            pictures.disable_monitor()
            for socket in (ended, pictures, status):
                socket.close(0)

    def _begin_anew(self) -> None:
        """Let the next frame continue the sequence, although the restarted capture process or source numbers its frames from 0."""
        if self._order is not None:
            self._order.restart()

    def _frame(self, parts: list[zmq.Frame]) -> tuple[dict[str, Any], Frame] | None:
        try:
            header, frame = frame_from(parts)
            size = (max(1, round(side * self._scale)) for side in (frame.width_px, frame.height_px))
            return header, resized_frame(frame, *size)
        except (BadMessage, InvalidInput):
            self.count("bad_messages")
            return None

    def _note(self, data: bytes) -> None:
        """Update the reported source state from a heartbeat of the capture process."""
        try:
            said = parsed_json(data)
        except BadMessage:
            self.count("bad_messages")
            return
        self._heard_s = time.monotonic()
        state, reason = said.get("state"), str(said.get("reason", ""))
        if state == "live":
            self._reported = None
        elif state == SourceState.ENDED.value:
            # An ended source is reported as stalled, because a played recording may start again.
            self._reported = SourceState.STALLED, reason
        elif state == SourceState.STALLED.value:
            self._reported = SourceState.STALLED, reason
        else:
            self._reported = SourceState.RECONNECTING, reason

    def _described(self, stop_requested: Callable[[], bool]) -> SourceDescription:
        while True:
            try:
                answer = ask(self._folder.commands("capture"), "describe", timeout_s=1.0)
                return SourceDescription.from_json(answer.get("description"))
            except (BusError, InvalidMessage) as error:
                if stop_requested():
                    raise SourceUnavailable(f"the capture process has not opened its source: {error}") from error
                time.sleep(ASK_AGAIN_S)


log = logging.getLogger(__name__)
POLL_S = 0.1
"""Read timeout in seconds; the source state is reported at this interval while no frame arrives."""


class Capture:
    """Reads the source, publishes its frames, and reopens the source after errors."""

    def __init__(self, spec: SourceSpec) -> None:
        self.spec = spec
        self._lock = threading.Lock()
        self._source: FrameSource | None = None
        self._run = time.time_ns()
        """Run id in the frame headers. Readers detect by a new id that sequence numbers and timestamps restart."""
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
            return {"description": self._source.description.as_json()}

    def figures(self) -> dict[str, Any]:
        """Return frame counts for the heartbeats."""
        with self._lock:
            source = self._source
            counts: dict[str, int] = dict(source.counts()) if isinstance(source, ReportingSource) else {}
        return {"frames": self.frames, "last_frame_ns": self._last_ns, "counts": counts}

    def publish(self, worker: Worker, publisher: PicturePublisher) -> None:
        """Publish frames until a stop of the process is requested.

        Raises:
            UserError: if the address is invalid, so that reopening cannot succeed.
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
        # This process runs only the source. If the source hangs or dies, the supervisor restarts the process.
        return SourceOptions(scale=spec.given_scale, fps=spec.fps, loop=spec.loop, realtime=True, process=False)

    def _publish(self, source: FrameSource, worker: Worker, publisher: PicturePublisher, backoff: Backoff) -> None:
        source.open()
        stuck_after_s = STUCK_AFTER_S.get(split_address(self.spec.address)[0], math.inf)
        given_s = time.monotonic()
        while not worker.stop_requested():
            frame = source.read(POLL_S)
            if frame is not None:
                given_s = time.monotonic()
                self._send(frame, publisher)
                backoff.worked()
                worker.say("live", f"{source.description.name} delivers frames")
            else:
                state = source.state
                worker.say(state.value, _sentence(source))
                if state is SourceState.ENDED:
                    worker.wait(POLL_S)
                elif time.monotonic() - given_s > stuck_after_s:
                    log.error(
                        "the camera's driver has delivered nothing for %g s; the process exits and is restarted",
                        stuck_after_s,
                    )
                    os._exit(FAILED)  # the thread blocked in the driver cannot be ended otherwise

    def _send(self, frame: Frame, publisher: PicturePublisher) -> None:
        publisher.publish_frame({"run": self._run}, frame)
        self.frames += 1
        self._last_ns = time.monotonic_ns()


def _sentence(source: FrameSource) -> str:
    return source.state_sentence if isinstance(source, ReportingSource) else f"the source is {source.state.value}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the capture process until a stop is requested. Return the exit code: 0, or `NO_USE` after a UserError."""
    keep_files_private()
    parser = argparse.ArgumentParser(description="Capture process of a stream.")
    parser.add_argument("--spec", required=True, help="file with the specification")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        path = Path(os.path.abspath(parser.parse_args(arguments).spec))
        spec = ProcessSpec.read(path, "capture")
        assert spec.capture is not None
        folder = StreamFolder(path.parent)
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
