"""Depth estimation in a background thread during a live stream. The stream never waits for it."""

from __future__ import annotations

import threading
import time
from typing import Any

from gsplat_core.depth.registry import DepthFinder, check_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.threads import use_one_thread
from gsplat_core.training.placement import LateDepth
from operators.depth import DepthCounts
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.side_thread import step_back, usable_cores

FEW_CORES = 4
"""Largest number of cores at which depth estimation is throttled, because training uses them
all.
"""
SHARE_OF_FEW = 0.25
"""Share of one core's time for depth estimation on a throttled machine."""
KEEPS = ("auto", "recorded")
"""Values of the setting `depth` with which a frame keeps its recorded depth."""


class DepthBeside:
    """Estimates depth in a background thread of lower priority. `offer` and `take` never block.

    The queue holds one pending frame. A newer frame replaces the pending one, which is counted in
    `DepthCounts.passed_over`.
    """

    def __init__(self, choice: str, camera: Camera, *, share: float | None = None, device: str = "cpu") -> None:
        """Check the settings. The thread begins with `start`.

        Args:
            choice: the setting `depth`.
            camera: camera of the frames.
            share: largest share of one core's time, in (0, 1]; None selects it by the number of
                cores.
            device: device of estimators that are not limited to the CPU.

        Raises:
            InvalidSetting: `choice` is rejected by `check_depth`.
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
        """Reset the counts and start the thread for a new stream."""
        self.counts = DepthCounts()
        self.finder = DepthFinder(self.choice, self._camera, device=self._device)
        self._offered = self._found = self._failure = None
        self._over = False
        self._begun.clear()
        self._thread = threading.Thread(target=self._run, args=(self.finder,), name="depth", daemon=True)
        self._thread.start()
        self._begun.wait()  # `use_one_thread` must take effect before other threads compute

    def stop(self) -> None:
        """Stop the thread after its current frame. Raises the exception of the thread, if any."""
        thread, self._thread = self._thread, None
        with self._changed:
            self._over = True
            self._changed.notify_all()
        if thread is not None:
            thread.join()
        self.raise_failure()

    def offer(self, frame: Frame) -> None:
        """Queue a frame for depth estimation if it has no depth and the estimator accepts it."""
        if frame.depth is not None or self.finder is None or not self.finder.seeks_in(frame):
            return
        with self._changed:
            self.counts.passed_over += self._offered is not None
            self._offered = frame
            self._changed.notify_all()

    def take(self) -> tuple[Frame, LateDepth] | None:
        """Return and clear the newest result: the frame with its depth, and the training data made
        from it.
        """
        with self._changed:
            found, self._found = self._found, None
        return found

    def _run(self, finder: DepthFinder) -> None:
        """Estimate depth of pending frames until `stop`, sleeping between frames to keep the time
        share.
        """
        step_back()
        if self._share < 1:
            use_one_thread()
        self._begun.set()
        scene, placed = 0, -1
        try:
            while (frame := self._next()) is not None:
                began_s = time.thread_time()
                # The first frame of the scene may have been dropped.
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
        """Wait for the next pending frame. Return None once `stop` was called."""
        with self._changed:
            self._changed.wait_for(lambda: self._over or self._offered is not None)
            frame, self._offered = self._offered, None
            return None if self._over else frame

    def _put(self, found: Frame, places: bool) -> None:
        self.counts.take(found, found)
        # Prepared in this thread, because the training thread has no spare time between two frames.
        late = LateDepth.of(found, self._device, places=places)
        with self._changed:
            self._found = found, late

    def _rest(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._over, seconds)

    def raise_failure(self) -> None:
        """Raise the exception that ended the thread, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


def share_of(cores: int) -> float:
    """Return the largest share of one core's time for depth estimation in a process with `cores`
    cores.
    """
    return SHARE_OF_FEW if cores <= FEW_CORES else 1.0


class DepthBesideOp(Operator):
    """Passes frames on with or without their recorded depth, and owns the depth estimation thread.

    Frames are passed on immediately. `LiveReconstructOp` offers the frames that it trains on to the
    thread and takes the results.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`; its depth is removed unless `beside.choice` is in `KEEPS`.

    Params:
        beside: the background depth estimator; started and stopped with this operator.
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
