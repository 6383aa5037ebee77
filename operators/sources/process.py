"""A source in a process of its own: whatever a driver or a decoder does, the reader goes on."""

from __future__ import annotations

import logging
import math
import time
import weakref
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost, SourceUnavailable
from operators.sources.backoff import Backoff
from operators.sources.child_process import ChildLost, ChildProcess, Opening
from operators.sources.live import STALLED_AFTER_S, LiveSource
from operators.sources.options import SourceOptions
from operators.sources.order import FrameOrder
from operators.sources.registry import split_address
from operators.sources.shared_memory import BadHeader
from operators.sources.source import SourceDescription, SourceState
from operators.sources.wire import description_from, finite_counts, frame_from

log = logging.getLogger(__name__)
OPENER = "operators.sources.registry:open_source"
OPEN_TIMEOUT_S = 30.0
"""How long the process may take to start and to open its source."""
HUNG_AFTER_S = 5.0
"""A process that says nothing for so long does not work any more."""
ON_DISK = frozenset({"recording", "realtime"})
"""Sources that do not come back once they are gone."""
MOST_FAILURES = 10
"""So many processes in a row that gave no frame are given up."""
LOOK_S = 0.05


class ProcessSource(LiveSource):
    """Runs the source at an address in a child process, and starts another one when that ends, hangs or fails.

    Its frames come through shared memory, numbers and times go on over a restart. Making the object starts the process, which opens the source:
    what it cannot open is an error here. `close` ends it.
    """

    def __init__(
        self,
        address: str,
        options: SourceOptions | None = None,
        *,
        opener: str = OPENER,
        hung_after_s: float = HUNG_AFTER_S,
        stuck_after_s: float = math.inf,
        open_timeout_s: float = OPEN_TIMEOUT_S,
    ) -> None:
        """opener: `module:function` that makes the source from address and options, in the process. hung_after_s: a process that says nothing
        for so long is replaced. stuck_after_s: so is one whose source stalls for so long. Raises SourceUnavailable with what it said."""
        options = options or SourceOptions()
        # The process knows best whether its source stalls, and counts it; whether the process itself does is asked in `state`.
        super().__init__(waiting=options.waiting, stalled_after_s=math.inf, order=FrameOrder(trusted=True))
        self._opening = Opening(opener, address, options)
        self._scheme = split_address(address)[0]
        self._hung_after_s, self._stuck_after_s, self._open_timeout_s = hung_after_s, stuck_after_s, open_timeout_s
        self._child_state: tuple[SourceState, str] | None = None
        self._child_counts: dict[str, int] = {}
        self._earlier_counts: Counter[str] = Counter()
        self._child: ChildProcess | None = None
        self._finalizer: weakref.finalize | None = None
        try:
            self.description = self._start()
        except ChildLost as error:
            raise SourceUnavailable(f"the process that opens the source failed: {error}") from error

    @property
    def state(self) -> SourceState:
        """See `FrameSource`. What the process says of its source counts as long as the process itself is well."""
        state, told, child = super().state, self._child_state, self._child
        if state is not SourceState.LIVE or self._ready:
            return state
        if child is not None and time.monotonic() - child.heard_s > STALLED_AFTER_S:
            return SourceState.STALLED
        return told[0] if told is not None and told[0] is not SourceState.ENDED else state

    @property
    def state_sentence(self) -> str:
        """See `LiveSource`."""
        told, state = self._child_state, self.state
        if told is not None and state is told[0] and told[1]:
            return told[1]
        if state is SourceState.STALLED:
            return f"the process that reads {self.description.name} says nothing"
        return super().state_sentence

    def counts(self) -> Mapping[str, int]:
        """See `LiveSource`: what was dropped in the process and here."""
        counts = Counter(super().counts())
        counts.update(self._earlier_counts)
        counts.update(self._child_counts)
        return dict(counts)

    def open(self) -> None:
        """See `FrameSource`."""
        if self._thread is None:
            self._earlier_counts.clear()
            self._child_counts = {}
        super().open()

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        self._end()

    def frames(self) -> Iterator[Frame]:
        """The frames of one process after another."""
        backoff, crashes = Backoff(), 0
        try:
            while True:
                try:
                    if self._child is None:
                        self._start()
                    for frame in self._received():
                        backoff.worked()
                        crashes = 0
                        yield frame
                    return
                except (ChildLost, SourceUnavailable) as error:
                    self._end(kill=True)
                    self._earlier_counts.update(self._child_counts)
                    self._child_counts, self._child_state = {}, None
                    name = self.description.name
                    delay_s = backoff.failed()
                    # A camera that is not there may come back; files that are gone, and what ends its process again and again, will not.
                    comes_back = isinstance(error, SourceUnavailable) and self._scheme not in ON_DISK
                    crashes = 0 if comes_back else crashes + 1
                    if crashes >= MOST_FAILURES:
                        raise SourceLost(
                            f"{name} is given up after {crashes} attempts: {error}. Check the source and start again."
                        ) from error
                    self.count("process_restarts")
                    self.lost(f"the process that reads {name} failed ({error}); another one is started")
                    if self.wait(delay_s):
                        return
        finally:
            self._end()

    def _received(self) -> Iterator[Frame]:
        """What the present process gives, until it says that its source has ended. Raises ChildLost."""
        child = self._child
        assert child is not None
        child.say("open")
        last_s = time.monotonic()
        while not self.wait(0):
            told = child.hear(LOOK_S)
            if told is None:
                if time.monotonic() - child.heard_s > self._hung_after_s:
                    raise ChildLost(f"it has said nothing for {self._hung_after_s:g} s")
                continue
            if told["kind"] == "frame":
                last_s = child.heard_s
                yield self._frame(child, told)
            elif told["kind"] == "ended":
                return
            else:
                self._note(told)
                stalls = self._child_state is not None and self._child_state[0] is SourceState.STALLED
                if stalls and child.heard_s - last_s > self._stuck_after_s:
                    raise ChildLost(f"it has given no frame for {self._stuck_after_s:g} s")

    def _frame(self, child: ChildProcess, told: dict[str, Any]) -> Frame:
        try:
            frame = frame_from(told, child.frames.read(told.get("planes")))
        except (BadHeader, TypeError, ValueError) as error:
            raise ChildLost(f"its frame cannot be read: {error}") from error
        child.say("free", slot=told.get("slot"))
        self._child_state = None  # what it said of its state was before this frame
        return frame

    def _note(self, told: dict[str, Any]) -> None:
        """Everything but a frame."""
        kind = told["kind"]
        if kind == "state":
            try:
                self._child_state = SourceState(told.get("state")), str(told.get("sentence", ""))
            except ValueError as error:
                raise ChildLost(f"its state is {told.get('state')!r:.40}") from error
            self._child_counts = finite_counts(told.get("counts"))
        elif kind == "log":
            level = told.get("level")
            log.log(level if isinstance(level, int) else logging.INFO, "%s", told.get("text"))
        elif kind in ("refused", "failed"):
            raise ChildLost(str(told.get("error")))

    def _start(self) -> SourceDescription:
        """A new process, once it has opened its source. Raises SourceUnavailable with what the source says, and ChildLost."""
        child = ChildProcess(self._opening)
        self._child = child
        self._finalizer = weakref.finalize(self, child.end)  # a source that is forgotten leaves no process
        try:
            return self._described(child)
        except BaseException:
            self._end(kill=True)
            raise

    def _described(self, child: ChildProcess) -> SourceDescription:
        until_s = time.monotonic() + self._open_timeout_s
        while not self.wait(0):
            told = child.hear(LOOK_S)
            if told is None:
                if time.monotonic() > until_s:
                    raise ChildLost(f"it has not opened the source within {self._open_timeout_s:g} s")
            elif told["kind"] == "described":
                self._drops = told.get("drops") is not False
                try:
                    return description_from(told.get("description", {}))
                except BadHeader as error:
                    raise ChildLost(str(error)) from error
            elif told["kind"] == "refused":
                raise SourceUnavailable(str(told.get("error")))
            else:
                self._note(told)
        raise ChildLost("it was no longer wanted")

    def _end(self, *, kill: bool = False) -> None:
        """End the present process."""
        child, self._child = self._child, None
        if child is None:
            return
        if self._finalizer is not None:
            self._finalizer.detach()
        if kill:
            child.kill()
        else:
            child.end()
