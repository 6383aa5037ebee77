"""Gate that withholds pictures taken outside of the patient's body from all downstream components."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.out_of_body import BodyGate
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.settings import Policy

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
    """Return a copy of the frame without any picture content."""
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
