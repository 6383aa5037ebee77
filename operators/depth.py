"""Depth maps of frames: recorded with the stream, estimated from the frames, or absent.

During a live stream, depth is estimated in a background thread, and the stream never waits for it. Late estimates are passed to the model after training on
their frames.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2

from gsplat_core.depth.maps import DepthFinder, check_depth, evidence, keeps_recorded
from gsplat_core.machine import step_back, usable_cores, use_one_thread
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.placement import LateDepth
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class FoundDepth:
    """Origins and coverage of the depth maps of one run."""

    frames: Mapping[str, int]
    """Number of frames with depth, by its origin (a name in `DEPTH_ORIGINS`)."""
    known_share: float
    """Share of pixels with trusted depth, 0..1; mean over the frames that have depth."""
    metric: bool
    """True if the depth of every frame has the calibration's unit rather than an unknown scale."""
    doubts: Mapping[str, int]
    """Number of frames for which depth estimation was attempted and rejected, by reason (a sentence)."""
    passed_over: int = 0
    """Number of frames without depth estimation because a newer frame replaced them in the queue of the live estimator."""


class DepthCounts:
    """Running totals of depth origins in a stream, from which `FoundDepth` is computed."""

    def __init__(self) -> None:
        self.passed_over = 0
        self._frames: Counter[str] = Counter()
        self._known, self._relative, self._dropped = 0.0, 0, 0
        self._estimated = 0

    def __add__(self, other: DepthCounts) -> DepthCounts:
        both = DepthCounts()
        both.passed_over = self.passed_over + other.passed_over
        both._frames = self._frames + other._frames
        both._known, both._relative = self._known + other._known, self._relative + other._relative
        both._dropped = self._dropped + other._dropped
        both._estimated = self._estimated + other._estimated
        return both

    def take(self, frame: Frame, given: Frame) -> None:
        """Count the origin of one frame's depth.

        Args:
            frame: the frame as it arrived, with its recorded depth if any.
            given: the same frame with the depth that is passed on downstream.
        """
        if given.depth is not None and given.depth_origin is not None:
            self._frames[given.depth_origin.name] += 1
            self._estimated += not given.depth_origin.is_recorded
            sure = given.depth if given.depth_confidence is None else given.depth * (given.depth_confidence >= BELIEVED)
            self._known += cv2.countNonZero(sure) / sure.size
            self._relative += not given.depth_is_metric
        self._dropped += given.depth is None and frame.depth is not None

    def contribute(self, outcome: OutcomeBuilder, choice: str, finder: DepthFinder | None) -> None:
        """Add `FoundDepth` and the notes on depth to the outcome.

        Args:
            outcome: the outcome of the run.
            choice: the setting `depth`, quoted in the notes.
            finder: the estimator, for its remarks and rejections; None if the run never started one.
        """
        total = sum(self._frames.values())
        doubts = finder.doubts.counted() if finder else {}
        share, metric = self._known / total if total else 0.0, self._relative == 0
        outcome.add(FoundDepth(dict(sorted(self._frames.items())), share, metric, doubts, self.passed_over))
        if self._estimated:
            unit = "its unit is that of the calibration" if metric else "it is relative: its unit is not known"
            outcome.note(
                f"depth was estimated from the pictures for {self._estimated} frames, in {share:.0%} of their pixels; {unit}"
            )
        if self.passed_over:
            outcome.note(f"depth was not estimated for {self.passed_over} frames, because newer ones had arrived")
        for remark in finder.remarks.counted() if finder else ():
            outcome.note(remark)
        for doubt, frames in doubts.items():
            outcome.note(f"{frames} frames got no depth: {doubt}")
        if self._dropped:
            outcome.note(f"the depth delivered with {self._dropped} frames was not used (depth is {choice!r})")


def without_depth(choice: str, fields: frozenset[str], config: ReconstructorConfig) -> str | None:
    """Return a note for a run whose frames carry no usable recorded depth; None if the recorded depth is used.

    Args:
        choice: the setting `depth`.
        fields: names of the fields that the recording's frames have.
        config: reconstruction settings; its `default_depth_mm` is quoted in the note.
    """
    if "depth" in fields and keeps_recorded(choice):
        return None
    ways = evidence(choice, fields)
    if config.depth_of_recording is not None:
        ways += [each for each in evidence(config.depth_of_recording, fields) if each not in ways]
    found = f"unless {' or '.join(ways)} show how far away it is, " if ways else ""
    lacking = (
        f"the recording's depth is not used (depth is {choice!r})"
        if "depth" in fields
        else "the recording has no depth"
    )
    return (
        f"{lacking}: {found}the scene starts on a plane {config.default_depth_mm:g} mm away, and its"
        " depth has no measured scale"
    )


def without_right_eye(depth: str, eyes: str | None, fields: frozenset[str], name: str) -> str | None:
    """Return a note for a run that asks for the right eye of frames that have one eye; None otherwise.

    Args:
        depth: the setting `depth`.
        eyes: the setting `eyes`.
        fields: names of the fields that the frames have.
        name: name of the recording or stream, quoted in the note.
    """
    asked = [
        f"{key} is {value!r}"
        for key, value, both in (("depth", depth, "stereo"), ("eyes", eyes, "both"))
        if value == both
    ]
    if not asked or "right_image" in fields:
        return None
    return f"{' and '.join(asked)}, but {name} has one eye, so that this has no effect"


FEW_CORES = 4
"""Largest number of cores at which depth estimation is throttled, because training uses them all."""
SHARE_OF_FEW = 0.25
"""Largest share of one core's time for depth estimation on a machine with at most `FEW_CORES` cores."""


class BackgroundDepth:
    """Estimates depth in a background thread of lower priority. `offer` and `take` never block.

    The queue holds one pending frame. A newer frame replaces the pending one, which is counted in
    `DepthCounts.passed_over`.
    """

    def __init__(self, choice: str, camera: Camera, *, share: float | None = None, device: str = "cpu") -> None:
        """Check the settings. The thread begins with `start`.

        Args:
            choice: the setting `depth`.
            camera: camera of the frames.
            share: largest share of one core's time, in (0, 1]; None selects it by the number of cores.
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
        """Put a frame into the queue for depth estimation if it has no depth and the estimator accepts it. Never
        blocks."""
        if frame.depth is not None or self.finder is None or not self.finder.seeks_in(frame):
            return
        with self._changed:
            self.counts.passed_over += self._offered is not None
            self._offered = frame
            self._changed.notify_all()

    def take(self) -> tuple[Frame, LateDepth] | None:
        """Remove and return the newest estimate: the frame with its depth, and the training data computed from
        both; None without a new estimate."""
        with self._changed:
            found, self._found = self._found, None
        return found

    def _run(self, finder: DepthFinder) -> None:
        """Main function of the background thread: estimate depth of pending frames until `stop`. Sleep between
        frames to stay within the CPU time share."""
        step_back()
        if self._share < 1:
            use_one_thread()
        self._begun.set()
        scene, placed = 0, -1
        try:
            while (frame := self._next()) is not None:
                began_s = time.thread_time()
                # The frame with `new_scene` may have been dropped from the queue, so the scene number is compared.
                is_new = frame.scene != scene and frame.new_scene is None
                scene = frame.scene
                found = finder.find(frame.with_fields(new_scene="passed over") if is_new else frame)
                if found is not None:
                    given = frame.with_fields(
                        depth=found.kept,
                        depth_confidence=found.confidence,
                        depth_origin=found.origin,
                        depth_error=found.error,
                    )
                    self._put(given, places=scene != placed)
                    placed = scene
                self._rest((time.thread_time() - began_s) * (1 / self._share - 1))
        except BaseException as error:  # noqa: BLE001 - raised again in the operator's thread by `raise_failure`
            self._failure = error

    def _next(self) -> Frame | None:
        """Wait for the next pending frame. Return None once `stop` was called."""
        with self._changed:
            self._changed.wait_for(lambda: self._over or self._offered is not None)
            frame, self._offered = self._offered, None
            return None if self._over else frame

    def _put(self, found: Frame, places: bool) -> None:
        self.counts.take(found, found)
        # The training data is computed in the background thread, because the training thread has no spare time between
        # two frames.
        late = LateDepth.of(found, self._device, places=places)
        with self._changed:
            self._found = found, late

    def _rest(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._over, seconds)

    def raise_failure(self) -> None:
        """Raise the exception that ended the background thread; later calls do nothing."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


def share_of(cores: int) -> float:
    """Return the largest share of one core's time for depth estimation: `SHARE_OF_FEW` up to `FEW_CORES` cores, else 1."""
    return SHARE_OF_FEW if cores <= FEW_CORES else 1.0


class DepthOp(Operator):
    """Attaches to each frame the depth that `choice` selects. Frames without a result pass without depth.

    With `in_background`, frames are passed on immediately, with their recorded depth or without depth. The
    training operator `UntilDisplay` passes the frames that it trains on to the estimator in the attribute
    `background`, and fetches the finished estimates from it.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with `depth`, `depth_confidence` and `depth_origin` set, or all three None.

    Params:
        choice: `auto` or another value accepted by `check_depth`. Raises InvalidSetting otherwise.
        camera: camera of the frames.
        in_background: estimate depth in a background thread.
        as_recorded: pass frames on as they are, as a live stream did that recorded them.
        has_time: allow `auto` to use estimators slower than the camera's frame rate.
        device: device of estimators that are not limited to the CPU.
        held_out: returns True for evaluation frames, which keep their recorded depth but are never passed to an
            estimator.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        choice: str,
        camera: Camera,
        in_background: bool = False,
        as_recorded: bool = False,
        has_time: bool = False,
        device: str = "cpu",
        held_out: Callable[[Frame], bool] = lambda frame: False,
        **kwargs: Any,
    ) -> None:
        check_depth(choice)
        self.choice, self.camera, self.held_out = choice, camera, held_out
        self.as_recorded, self.has_time, self.device = as_recorded, has_time, device
        self.background = BackgroundDepth(choice, camera, device=device) if in_background else None
        """Estimator whose thread this operator starts and stops; None without `in_background`."""
        self._finder: DepthFinder | None = None
        self._counts = DepthCounts()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._counts = DepthCounts()
        if self.background is not None:
            self.background.start()
        elif not self.as_recorded:
            self._finder = DepthFinder(self.choice, self.camera, has_time=self.has_time, device=self.device)

    def stop(self) -> None:
        if self.background is not None:
            self.background.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = given = op_input.receive("frame")
        if self._finder is not None:
            given = self._finder.with_depth(frame, shown_only=self.held_out(frame))
        elif frame.depth is not None and not keeps_recorded(self.choice):
            given = frame.with_fields(depth=None, depth_confidence=None, depth_origin=None, depth_error=None)
        self._counts.take(frame, given)
        if self.background is not None:
            self.background.raise_failure()
        op_output.emit(given, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        counts, finder = self._counts, self._finder
        if self.background is not None:
            counts, finder = counts + self.background.counts, self.background.finder
        counts.contribute(outcome, self.choice, finder)


@dataclass(frozen=True)
class TakenDepth:
    """Statistics of late depth: estimates used by a live model after it was trained on their frames."""

    frames: int
    """Number of frames whose depth was estimated after training on them, and then used by the model."""
    age_p50_ms: float
    """Median delay from the frame's arrival to the use of its depth, in milliseconds."""
    dropped: int
    """Number of late estimates that the model rejected, for example of an earlier scene or of a frame too old."""
