"""Frame source of an engine process that receives the frames of the stream's capture process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings.frame_files import resized_frame
from gsplat_core.scene.frames import Frame
from operators.errors import SourceUnavailable
from operators.sources.live import FrameOrder, LiveSource
from operators.sources.scaled import scaled_description
from operators.sources.source import SourceDescription, SourceState
from operators.sources.wire import BadHeader, description_from, frame_from
from operators.sources.zeromq_message import BadMessage as BadFrame
from operators.sources.zeromq_message import unpacked_pieces
from services.bus.messages import ask, parsed_json
from services.bus.pictures import split, subscribe
from services.bus.runtime import StreamFolder
from services.errors import BadMessage, BusError

LOOK_MS = 50
ASK_AGAIN_S = 0.1
SILENT_S = 1.0
"""Seconds without a heartbeat after which the capture process counts as gone or hung."""
WAITING = 4


class CapturedSource(LiveSource):
    """Live source that receives frames from a capture process, with their arrival times there.

    The source never ends. While the capture process or its source gives no frames, `state` and
    `state_sentence` report that. Numbering and timestamps continue after a reconnect.
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
        """See `FrameSource`."""
        state, reported = super().state, self._reported
        if state is SourceState.LIVE and reported is not None and not self._ready:
            return reported[0]
        return state

    @property
    def state_sentence(self) -> str:
        """See `LiveSource`."""
        reported = self._reported
        return reported[1] if reported is not None and self.state is reported[0] else super().state_sentence

    def frames(self) -> Iterator[Frame]:
        """See `LiveSource`."""
        context: zmq.Context = zmq.Context.instance()
        pictures = subscribe(context.socket(zmq.SUB), self._folder.pictures("capture"), waiting=WAITING)
        status = subscribe(context.socket(zmq.SUB), self._folder.status("capture"), waiting=8)
        ended = pictures.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        poller = zmq.Poller()
        for socket in (pictures, status, ended):
            poller.register(socket, zmq.POLLIN)
        run: Any = None
        self._heard_s = time.monotonic()  # no subscription existed before, so earlier silence does not count
        try:
            while not self.wait(0):
                found = dict(poller.poll(LOOK_MS))
                if ended in found:
                    recv_monitor_message(ended)
                    self.lost("the capture process has ended; it is being started again")
                if status in found:
                    self._note(status.recv())
                elif time.monotonic() - self._heard_s > SILENT_S:
                    self.lost("the capture process says nothing; it is being started again")
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
        """Restart frame numbering, because the next frame is from another capture process or source
        connection."""
        if self._order is not None:
            self._order.restart()

    def _frame(self, parts: list[zmq.Frame]) -> tuple[dict[str, Any], Frame] | None:
        try:
            header, pixels = split(parts)
            _, _, arrays = unpacked_pieces(pixels)
            frame = frame_from(header, arrays)
            size = (max(1, round(side * self._scale)) for side in (frame.width_px, frame.height_px))
            return header, resized_frame(frame, *size)
        except (BadMessage, BadFrame, BadHeader, InvalidInput):
            self.count("bad_messages")
            return None

    def _note(self, data: bytes) -> None:
        """Evaluate a heartbeat of the capture process."""
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
            # reported as stalled, because a played recording may start again
            self._reported = SourceState.STALLED, reason
        elif state == SourceState.STALLED.value:
            self._reported = SourceState.STALLED, reason
        else:
            self._reported = SourceState.RECONNECTING, reason

    def _described(self, stop_requested: Callable[[], bool]) -> SourceDescription:
        while True:
            try:
                answer = ask(self._folder.commands("capture"), "describe", timeout_s=1.0)
                return description_from(answer.get("description", {}))
            except (BusError, BadHeader) as error:
                if stop_requested():
                    raise SourceUnavailable(f"the capture process has not opened its source: {error}") from error
                time.sleep(ASK_AGAIN_S)
