"""What the graph does when an operator raises."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from operators.errors import OperatorFailed


class FaultAction(Enum):
    """The answer to one fault."""

    STOP_GRAPH = "stop_graph"
    RESTART = "restart"
    DISABLE_BRANCH = "disable_branch"


@dataclass(frozen=True)
class FaultPolicy:
    """An operator's answer to its own exceptions. What it was working on when it raised is lost, and counted as a fault."""

    action: FaultAction = FaultAction.STOP_GRAPH
    restarts: int = 0
    """How often `stop` and `start` are called to go on."""
    afterwards: FaultAction = FaultAction.STOP_GRAPH
    """The answer once the restarts are used up."""

    def __post_init__(self) -> None:
        if self.restarts < 0 or (self.action is FaultAction.RESTART) != (self.restarts > 0):
            raise ValueError(f"FaultPolicy: {self.action.value} does not go with {self.restarts} restarts")
        if self.afterwards is FaultAction.RESTART:
            raise ValueError("FaultPolicy: afterwards must be stop_graph or disable_branch")

    @classmethod
    def restart(cls, restarts: int, afterwards: FaultAction = FaultAction.STOP_GRAPH) -> FaultPolicy:
        """Restart the operator up to `restarts` times."""
        return cls(FaultAction.RESTART, restarts, afterwards)

    def action_after(self, restarts_done: int) -> FaultAction:
        """The answer to the next fault."""
        if self.action is not FaultAction.RESTART:
            return self.action
        return FaultAction.RESTART if restarts_done < self.restarts else self.afterwards


STOP_GRAPH = FaultPolicy()
"""The graph stops and run() raises (the default)."""
DISABLE_BRANCH = FaultPolicy(FaultAction.DISABLE_BRANCH)
"""The operator is done, what only it feeds finishes, the rest goes on."""


@dataclass(frozen=True)
class Fault:
    """One exception of an operator and what was done about it."""

    error: OperatorFailed
    action: FaultAction

    @property
    def operator(self) -> str:
        """Name of the operator."""
        return self.error.operator
