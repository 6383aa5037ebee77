"""Depth beside a live stream: found for the newest frame whenever that is possible, and never waited for."""

from __future__ import annotations

import threading
import time
from typing import Any

from gsplat_core.geometry.registry import DepthFinder, check_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.threads import use_one_thread
from gsplat_core.training.late_depth import LateDepth
from operators.depth import DepthCounts
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.side_thread import step_back, usable_cores

FEW_CORES = 4
"""With so many cores or fewer training needs all of them ..."""
SHARE_OF_FEW = 0.25
"""... and depth gets so much of the time of one."""
KEEPS = ("auto", "recorded")
"""Values of the setting `depth` with which a frame keeps the depth that it came with."""


class DepthBeside:
    """Finds depth in a thread of its own, which steps back behind the others. Whoever hands over a frame, or asks for what was found, never waits.

    Of the frames that are handed over while it is at work the newest is next; the others are passed over and counted.
    """

    def __init__(self, choice: str, camera: Camera, *, share: float | None = None, device: str = "cpu") -> None:
        """choice: the setting `depth`. camera: that of the frames. share: of one core's time, which it takes at most; None: as suits the machine. device:
        where an estimator works that need not work on the CPU.

        Raises InvalidSetting as `check_depth`.
        """
        check_depth(choice)
        self.choice, self._camera, self._device = choice, camera, device
        self._share = share if share is not None else share_of(usable_cores())
        self.counts = DepthCounts()
        self.finder: DepthFinder | None = None
        self._changed = threading.Condition()
        self._offered: Frame | None = None
        self._found: tuple[Frame, LateDepth] | None = None
        self._failure: BaseException | None = None
        self._over = False
        self._begun = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin with another stream."""
        self.counts = DepthCounts()
        self.finder = DepthFinder(self.choice, self._camera, device=self._device)
        self._offered = self._found = self._failure = None
        self._over = False
        self._begun.clear()
        self._thread = threading.Thread(target=self._run, args=(self.finder,), name="depth", daemon=True)
        self._thread.start()
        self._begun.wait()  # before others compute: see `use_one_thread`

    def stop(self) -> None:
        """Wait until the frame under work is done, and look for nothing more. Raises what went wrong in the thread."""
        thread, self._thread = self._thread, None
        with self._changed:
            self._over = True
            self._changed.notify_all()
        if thread is not None:
            thread.join()
        self.raise_failure()

    def offer(self, frame: Frame) -> None:
        """A frame that is trained on now."""
        if frame.depth is not None or self.finder is None or not self.finder.seeks_in(frame):
            return
        with self._changed:
            self.counts.passed_over += self._offered is not None
            self._offered = frame
            self._changed.notify_all()

    def take(self) -> tuple[Frame, LateDepth] | None:
        """The newest frame whose depth was found since the last call, with it, and what of it is learned."""
        with self._changed:
            found, self._found = self._found, None
        return found

    def _run(self, finder: DepthFinder) -> None:
        """The life of the thread."""
        step_back()
        if self._share < 1:
            use_one_thread()
        self._begun.set()
        scene, placed = 0, -1
        try:
            while (frame := self._next()) is not None:
                began_s = time.thread_time()
                # The frame that began the scene may have been passed over.
                is_new = frame.scene != scene and frame.new_scene is None
                scene = frame.scene
                found = finder.find(frame.with_fields(new_scene="passed over") if is_new else frame)
                if found is not None:
                    fields = {"depth": found.kept, "depth_confidence": found.confidence, "depth_origin": found.origin}
                    self._put(frame.with_fields(**fields), places=scene != placed)
                    placed = scene
                self._rest((time.thread_time() - began_s) * (1 / self._share - 1))
        except BaseException as error:  # noqa: BLE001 - carried to the operator of this thread
            self._failure = error

    def _next(self) -> Frame | None:
        """The newest frame, when there is one; None: it is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._over or self._offered is not None)
            frame, self._offered = self._offered, None
            return None if self._over else frame

    def _put(self, found: Frame, places: bool) -> None:
        self.counts.take(found, found)
        # Made ready here: between two pictures there is no time for it.
        late = LateDepth.of(found, self._device, places=places)
        with self._changed:
            self._found = found, late

    def _rest(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._over, seconds)

    def raise_failure(self) -> None:
        """Raise what went wrong in the thread, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


def share_of(cores: int) -> float:
    """How much of one core's time looking for depth takes at most, where the process has so many cores."""
    return SHARE_OF_FEW if cores <= FEW_CORES else 1.0


class DepthBesideOp(Operator):
    """Lets each frame keep the depth that it came with, or drops that, as the setting `depth` says; a frame without goes on at once. Starts and stops the
    thread that looks for it, which is told by `LiveReconstructOp` what is trained on.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: the same, or without depth.

    Params:
        beside: what finds depth.
    """

    def __init__(self, fragment: Any, *args: Any, beside: DepthBeside, **kwargs: Any) -> None:
        self.beside = beside
        self._given = DepthCounts()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._given = DepthCounts()
        self.beside.start()

    def stop(self) -> None:
        self.beside.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = given = op_input.receive("frame")
        if frame.depth is not None and self.beside.choice not in KEEPS:
            given = frame.with_fields(depth=None, depth_confidence=None, depth_origin=None)
        self._given.take(frame, given)
        self.beside.raise_failure()
        op_output.emit(given, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        (self._given + self.beside.counts).contribute(outcome, self.beside.choice, self.beside.finder)
