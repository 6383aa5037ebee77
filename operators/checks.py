"""Checks of endoscopic video: stages that annotate frames, and the gate that withholds pictures from outside of the body.

Each stage finds one kind of fault; operators run the stages in sequence.

`PICTURE_STAGES` lists the stages that need only the picture, in order of execution. A frame is ordinary if its picture is as
expected from the previous ones. To save time, each ordinary frame is checked by some of the stages in rotation. An
unusual frame is checked by every stage. The image analysis is in `gsplat_core.endoscope`.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.artefacts import Deinterlacer, FieldOfView, StripDetector, without_combs
from gsplat_core.endoscope.changes import CutDetector, SharpnessGate
from gsplat_core.endoscope.out_of_body import BodyGate
from gsplat_core.endoscope.sequence import (
    CHECK_EVERY_S,
    OUT_OF_ORDER,
    DepthCheck,
    MaskCheck,
    OrdinaryPictures,
    SequenceCheck,
    StreamClock,
    Turns,
)
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import CUT_IN_DOUBT, Frame, FrameStatus
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.settings import Policy


@dataclass(frozen=True)
class StageCounts:
    """Statistics of a stage in one run. One subclass per stage, because `OutcomeBuilder` stores one part per class."""

    frames: int
    """Number of frames the stage ran on."""
    found: Mapping[str, int] = field(default_factory=dict)
    """Number of frames with a finding, by reason."""

    @property
    def name(self) -> str:
        """Name of the stage in reports: the class name without `Counts`, in lower case."""
        return type(self).__name__.removesuffix("Counts").lower()


class Stage(ABC):
    """Annotates the frames of one stream in order.

    A subclass sets `counts_type`, creates its state in `reset` and implements `annotate`, which
    must not raise for any picture content. A stage that does not run on every frame must add its
    lasting results to the skipped frames in `carried`.
    """

    counts_type: ClassVar[type[StageCounts]] = StageCounts

    def __init__(self) -> None:
        self.frames = 0
        self.found: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:  # noqa: B027 - stateless stages do not override it
        """Clear the state, at the start of a stream."""

    @abstractmethod
    def annotate(self, frame: Frame) -> Frame:
        """Return a frame with the check's findings in its fields."""

    def carried(self, frame: Frame) -> Frame:
        """Return a frame that skips `annotate`, with results that stay valid between frames, such as a loss mask."""
        return frame

    def apply(self, frame: Frame) -> Frame:
        """Count a frame, and return it with the check's findings in its fields."""
        self.frames += 1
        return self.annotate(frame)

    def withhold(self, frame: Frame, reason: str) -> Frame:
        """Return the frame marked as excluded from training, and count the reason. An earlier reason is kept."""
        self.found[reason] += 1
        return frame if frame.withheld is not None else frame.with_fields(withheld=reason)

    def counts(self) -> StageCounts:
        """Return the statistics since the start of the run."""
        return self.counts_type(self.frames, {what: count for what, count in sorted(self.found.items()) if count})

    def start(self) -> None:
        """Reset the statistics and the state, at the start of a run."""
        self.frames = 0
        self.found.clear()
        self.reset()


class StageOp(Operator):
    """Runs stages in sequence on each frame, including withheld ones.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: stages in order of execution. They have state and must not be shared between operators.
    """

    def __init__(self, fragment: Any, *args: Any, stages: Sequence[Stage], **kwargs: Any) -> None:
        self.stages = tuple(stages)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        for stage in self.stages:
            stage.start()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        for stage in self.stages:
            frame = stage.apply(frame)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the counts of the checks to the run's outcome."""
        for stage in self.stages:
            outcome.add(stage.counts())


@dataclass(frozen=True)
class OrdinaryFrames:
    """Number of unusual frames, checked by every stage (`looked`), and of ordinary frames, checked by some stages."""

    looked: int
    ordinary: int


class PictureStagesOp(StageOp):
    """Runs its first stage on each frame. The other stages run on unusual frames, and in rotation on ordinary ones.

    A stage that is skipped on an ordinary frame reuses its previous result (`Stage.carried`). If a stage changes more
    than masks or withholds the frame, all later stages run on this frame, and all stages run on the next frame.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: stages that use no field but the picture; the first compares each picture with the previous one.
    """

    def __init__(self, fragment: Any, *args: Any, stages: Sequence[Stage], **kwargs: Any) -> None:
        super().__init__(fragment, *args, stages=stages, **kwargs)
        self.pictures = OrdinaryPictures()
        self._reset()

    def _reset(self) -> None:
        self.pictures.reset()
        self._turns = Turns(len(self.stages) - 1, CHECK_EVERY_S)
        self._settled = False
        """True if the previous frame allows the next to be ordinary: no stage changed its picture or withheld it, and it did not
        begin a scene."""
        self._counts = [0, 0]

    def start(self) -> None:
        super().start()
        self._reset()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        came: Frame = op_input.receive("frame")
        ordinary = self.pictures.is_ordinary(came.image, came.pts_ns) and self._settled
        frame = self.stages[0].apply(came)
        ordinary = ordinary and _settled(frame, came)
        self._counts[ordinary] += 1
        due: Collection[int] = ()
        if ordinary:
            due = self._turns.due(frame.pts_ns)
        else:
            self._turns.all_ran(frame.pts_ns)
        for number, stage in enumerate(self.stages[1:]):
            frame = stage.carried(frame) if ordinary and number not in due else stage.apply(frame)
            ordinary = ordinary and _settled(frame, came)
        self._settled = _settled(frame, came)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the counts of the checks to the run's outcome."""
        super().contribute(outcome)
        outcome.add(OrdinaryFrames(*self._counts))


def _settled(frame: Frame, came: Frame) -> bool:
    """Return True if the stages kept picture and timestamp of the incoming frame `came`, and `frame` is usable and begins no
    scene."""
    unchanged = frame.image is came.image and frame.pts_ns == came.pts_ns
    return unchanged and frame.new_scene is None and frame.unusable is None


@dataclass(frozen=True)
class SequenceCounts(StageCounts):
    """Number of withheld frames by reason (black, one colour, noise, duplicate, frozen, torn, out of order), and of clock jumps
    and gaps.
    """


class SequenceStage(Stage):
    """Withholds pictures that are black, uniform, noise, repeated, torn or late, and removes clock jumps.

    It must run first. After a clock jump `Frame.pts_ns` is shifted. A late frame gets the newest timestamp.
    """

    counts_type = SequenceCounts

    def reset(self) -> None:
        self._check = SequenceCheck()
        self._clock = StreamClock()

    def annotate(self, frame: Frame) -> Frame:
        timing = self._clock.observe(frame.pts_ns, frame.arrived_ns)
        if timing.pts_ns != frame.pts_ns:
            frame = frame.with_fields(pts_ns=timing.pts_ns)
        if timing.finding == OUT_OF_ORDER:
            # `SequenceCheck` compares consecutive pictures, so a late picture must not reach it.
            return self.withhold(frame, OUT_OF_ORDER)
        if timing.finding is not None:
            self.found[timing.finding] += 1
        if frame.status is FrameStatus.DAMAGED:
            return frame
        fault = self._check.fault(frame.image, frame.pts_ns)
        return frame if fault is None else self.withhold(frame, fault)


@dataclass(frozen=True)
class MaskAndDepthCounts(StageCounts):
    """Number of frames withheld because of their tool mask, and of frames whose depth was repaired or removed."""


class MaskAndDepthStage(Stage):
    """Withholds frames whose tool mask shows no tissue or suddenly lacks the tool, and removes invalid depth.

    It must run after the stage that sets `Frame.mask`. A frame without valid depth is trained on without it.
    """

    counts_type = MaskAndDepthCounts

    def reset(self) -> None:
        self._mask, self._depth = MaskCheck(), DepthCheck()

    def annotate(self, frame: Frame) -> Frame:
        if frame.depth is not None:
            checked = self._depth.checked(frame.depth)
            if checked.finding is not None:
                self.found[checked.finding] += 1
                frame = frame.with_fields(depth=checked.depth)
        fault = None if frame.mask is None else self._mask.fault(frame.mask, frame.image, frame.pts_ns)
        return frame if fault is None else self.withhold(frame, fault)


@dataclass(frozen=True)
class InterlacingCounts(StageCounts):
    """Number of de-interlaced frames."""


class InterlacingStage(Stage):
    """Removes combing artefacts from interlaced video of both eyes, which changes `Frame.image`.

    Progressive video is passed unchanged. The stage must run before stages that measure sharpness and before training.
    """

    counts_type = InterlacingCounts

    def reset(self) -> None:
        self._deinterlacer = Deinterlacer()

    def annotate(self, frame: Frame) -> Frame:
        image = self._deinterlacer.process(frame.image)
        if image is frame.image:
            return frame
        self.found["de-interlaced"] += 1
        right = frame.right_image
        if right is not None:
            right = without_combs(right)
        return frame.with_fields(image=image, right_image=right, deinterlaced=True)


@dataclass(frozen=True)
class FieldOfViewCounts(StageCounts):
    """Number of frames whose field of view does not fill the picture."""


class FieldOfViewStage(Stage):
    """Excludes pixels outside of the field of view from the loss. Withheld and damaged frames keep the previous field."""

    counts_type = FieldOfViewCounts

    def reset(self) -> None:
        self._view = FieldOfView()

    def annotate(self, frame: Frame) -> Frame:
        if frame.unusable is None:
            self._view.observe(frame.image)
        masked = self.carried(frame)
        self.found["limited"] += masked is not frame
        return masked

    def carried(self, frame: Frame) -> Frame:
        return frame.excluding(self._view.mask)


@dataclass(frozen=True)
class StripCounts(StageCounts):
    """Number of frames with a status bar or text at the border."""


class StripStage(Stage):
    """Excludes status bars and text at the borders from the loss. Withheld and damaged frames keep the previous mask."""

    counts_type = StripCounts

    def reset(self) -> None:
        self._detector = StripDetector()

    def annotate(self, frame: Frame) -> Frame:
        if frame.unusable is None:
            self._detector.observe(frame.image)
        masked = self.carried(frame)
        self.found["strip or text"] += masked is not frame
        return masked

    def carried(self, frame: Frame) -> Frame:
        return frame.excluding(self._detector.mask)


@dataclass(frozen=True)
class SharpnessCounts(StageCounts):
    """Number of frames withheld for blur and for smoke."""


class SharpnessStage(Stage):
    """Withholds frames with blur or smoke, relative to the usual sharpness of the scene.

    Damaged frames, and frames withheld by an earlier stage, are not examined. The stage must run after `CutStage` and
    `InterlacingStage`.
    """

    counts_type = SharpnessCounts

    def reset(self) -> None:
        self._gate = SharpnessGate()
        self._deinterlaced = False

    def annotate(self, frame: Frame) -> Frame:
        if frame.unusable is not None:
            return frame
        if frame.new_scene is not None or frame.deinterlaced != self._deinterlaced:
            # Pictures with combs are sharper than the same ones without.
            self._gate.start_scene()
        self._deinterlaced = frame.deinterlaced
        fault = self._gate.fault(frame.image, frame.pts_ns, frame.tissue)
        return frame if fault is None else self.withhold(frame, fault)


@dataclass(frozen=True)
class CutCounts(StageCounts):
    """Number of new scenes by reason (cut, returned, resized, frame rate), and of frames withheld as possible cuts."""


@dataclass(frozen=True)
class SceneCounts(StageCounts):
    """Number of frames that `SceneNumberStage` has numbered; `CutCounts` has the reasons for new scenes."""


class SceneNumberStage(Stage):
    """Sets `Frame.scene`, the number of scenes before the current one.

    It must run on every frame, after all stages that set `Frame.new_scene`.
    """

    counts_type = SceneCounts

    def reset(self) -> None:
        self._scene = 0

    def annotate(self, frame: Frame) -> Frame:
        if frame.new_scene is not None:
            self._scene += 1
        return frame if self._scene == 0 else frame.with_fields(scene=self._scene)


class CutStage(Stage):
    """Sets `Frame.new_scene` on the first usable frame after a cut, never on a withheld or damaged frame.

    It must run after all stages that withhold pictures. A frame that may be a cut is withheld, and
    the next frame decides.
    """

    counts_type = CutCounts

    def reset(self) -> None:
        self._detector = CutDetector()

    def annotate(self, frame: Frame) -> Frame:
        if frame.unusable is not None:
            self._detector.skip()
            return frame
        verdict = self._detector.observe(frame.image, frame.seq, frame.pts_ns)
        if verdict.in_doubt:
            return self.withhold(frame, CUT_IN_DOUBT)
        if verdict.new_scene is None:
            return frame
        self.found[verdict.new_scene] += 1
        return frame if frame.new_scene is not None else frame.with_fields(new_scene=verdict.new_scene)


PICTURE_STAGES: dict[str, Callable[[], Stage]] = {
    "sequence": SequenceStage,
    "interlacing": InterlacingStage,
    "cuts": CutStage,
    "strip": StripStage,
    "field of view": FieldOfViewStage,
    "sharpness": SharpnessStage,
}
"""Stages that need only the picture and run before the tool mask."""


def picture_stages() -> list[Stage]:
    """Create the stages of `PICTURE_STAGES` in order."""
    return [make() for make in PICTURE_STAGES.values()]


log = logging.getLogger(__name__)

WITHHELD = "out of body"
"""Value of `Frame.withheld` for frames that the gate replaced."""
NOT_EXAMINED = "could not be examined"


class Gate(Protocol):
    """Classifier that judges each picture of a stream as taken inside or outside of the body."""

    def judge(self, image: NDArray[np.uint8]) -> str | None:
        """Return None for a picture taken inside of the body, otherwise the reason. image: uint8 RGB [H, W, 3]."""
        ...

    def close(self) -> None:
        """Reset to the state after a picture outside of the body, so that following pictures are withheld at first."""
        ...


@dataclass(frozen=True)
class OutOfBodyFrames:
    """Statistics of the out-of-body gate."""

    policy: Policy
    passed: int
    """Number of frames that the gate passed unchanged."""
    withheld: Mapping[str, int] = field(default_factory=dict)
    """Number of frames whose picture the gate replaced by black, by reason."""


class OutOfBodyGateOp(Operator):
    """Replaces pictures that were not clearly taken inside of the body. Connect it directly to the source.

    A withheld frame is black in both eyes, has no depth or pose, counts as tissue everywhere, and is excluded from
    every loss. Black is used rather than pixelation, because a moving scene can be recovered from blocks that change
    with every frame. A picture that cannot be examined is withheld.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`; with `withheld` set if its picture was replaced.

    Params:
        policy: "withhold" or "off".
    """

    policy: Policy

    def __init__(self, fragment: Any, *args: Any, gate: Gate | None = None, **kwargs: Any) -> None:
        self._given = gate
        self._gate: Gate = gate or BodyGate()
        self._passed = 0
        self._withheld: Counter[str] = Counter()
        super().__init__(fragment, *args, **kwargs)
        if self.policy not in get_args(Policy):
            raise InvalidSetting(f"out-of-body policy is {self.policy!r}; choose {' or '.join(get_args(Policy))}")

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)
        spec.param("policy", "withhold")

    def start(self) -> None:
        self._gate = self._given or BodyGate()
        self._passed, self._withheld = 0, Counter()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        reason = None if self.policy == "off" else self._judge(frame)
        if reason is None:
            self._passed += 1
        else:
            self._withheld[reason] += 1
            frame = withheld(frame)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        outcome.add(OutOfBodyFrames(self.policy, self._passed, dict(self._withheld)))
        if self.policy == "off":
            outcome.note("no picture was examined for showing the outside of the body: the gate was off")
        if self._withheld:
            reasons = ", ".join(f"{reason}: {count}" for reason, count in self._withheld.most_common())
            outcome.note(
                f"{self._withheld.total()} frames were withheld because they may show the outside of the body ({reasons})"
            )

    def _judge(self, frame: Frame) -> str | None:
        try:
            return self._gate.judge(frame.image)
        except Exception:
            if NOT_EXAMINED not in self._withheld:
                log.warning("frame %d could not be examined and is withheld", frame.seq, exc_info=True)
            self._gate.close()
            return NOT_EXAMINED


def withheld(frame: Frame) -> Frame:
    """Return a copy of the frame with black pictures, without depth and pose, and with no pixel that counts in the loss."""
    size = frame.image.shape[:2]
    right = None if frame.right_image is None else np.zeros_like(frame.right_image)
    return frame.with_fields(
        image=np.zeros_like(frame.image),
        right_image=right,
        depth=None,
        mask=np.ones(size, np.uint8),
        loss_mask=np.zeros(size, np.uint8),
        pose=None,
        withheld=WITHHELD,
    )
