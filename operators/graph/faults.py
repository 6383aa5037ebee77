"""Fault policies: reactions of the graph to an exception in an operator."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from operators.errors import OperatorFailed


class FaultAction(Enum):
    """Reaction to one fault."""

    STOP_GRAPH = "stop_graph"
    RESTART = "restart"
    DISABLE_BRANCH = "disable_branch"


@dataclass(frozen=True)
class FaultPolicy:
    """Reaction of an operator to its own exceptions. Messages in work at that time are lost and
    counted as a fault.
    """

    action: FaultAction = FaultAction.STOP_GRAPH
    restarts: int = 0
    """Maximum number of restarts, each by `stop` and `start`."""
    afterwards: FaultAction = FaultAction.STOP_GRAPH
    """Reaction after the last restart."""

    def __post_init__(self) -> None:
        if self.restarts < 0 or (self.action is FaultAction.RESTART) != (self.restarts > 0):
            raise ValueError(f"FaultPolicy: {self.action.value} does not go with {self.restarts} restarts")
        if self.afterwards is FaultAction.RESTART:
            raise ValueError("FaultPolicy: afterwards must be stop_graph or disable_branch")

    @classmethod
    def restart(cls, restarts: int, afterwards: FaultAction = FaultAction.STOP_GRAPH) -> FaultPolicy:
        """Return a policy that restarts the operator up to `restarts` times."""
        return cls(FaultAction.RESTART, restarts, afterwards)

    def action_after(self, restarts_done: int) -> FaultAction:
        """Return the reaction to the next fault after `restarts_done` restarts."""
        if self.action is not FaultAction.RESTART:
            return self.action
        return FaultAction.RESTART if restarts_done < self.restarts else self.afterwards


STOP_GRAPH = FaultPolicy()
"""Stop the graph; `run()` raises (default)."""
DISABLE_BRANCH = FaultPolicy(FaultAction.DISABLE_BRANCH)
"""Finish the operator and all operators fed only by it. The rest of the graph continues."""


@dataclass(frozen=True)
class Fault:
    """An exception of an operator and the reaction to it."""

    error: OperatorFailed
    action: FaultAction

    @property
    def operator(self) -> str:
        """Name of the operator."""
        return self.error.operator
