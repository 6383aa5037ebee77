"""Errors of the operators. Each says what happened, the value that was seen, and what to do.

OperatorsError
├── GraphError
│   ├── GraphInvalid (also ValueError)     the graph cannot be built: names, ports, types, connections
│   ├── PortError (also ValueError)        compute used a port that is not there, or emitted a value of another type
│   ├── QueueFull                          more was emitted into a blocking edge than it holds
│   ├── MetadataConflict                   two messages of one compute disagree under MetadataPolicy.RAISE
│   ├── OperatorFailed                     an operator raised; names the operator and the frame
│   ├── OperatorStuck                      an operator did not return from compute when the graph stopped
│   ├── GraphDeadlock                      nothing can go on although not everything is done; says who waits on what
│   └── GraphBusy                          run() while the application already runs
├── EngineError (UserError)
│   ├── EngineMissing                      the engine's package is not installed or cannot be loaded
│   └── EngineUnsupported                  the engine cannot run this graph faithfully
├── SourceError (UserError)                a source of frames cannot be used
│   ├── SourceUnavailable                  it cannot be opened
│   └── SourceLost                         it gave frames and is gone for good
├── OutputError (UserError)                what a run writes cannot be written
│   ├── OutputFolderInUse                  the folder holds something that is not ours, or another run writes into it
│   └── StorageFull                        the disk has no room left
└── RunError
    ├── DeviceMissing (UserError)          the device asked for is not there or not supported
    ├── MemoryTooSmall (UserError)         what a run needs does not fit into this machine's memory
    ├── NothingShown (UserError)           a run ended as it should, and no frame was shown
    └── RunFailed                          a run ended early; carries what it had reached
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gsplat_core.errors import UserError


class OperatorsError(Exception):
    """Base of everything the operators raise on purpose."""


class GraphError(OperatorsError):
    """Building or running an operator graph went wrong."""


class GraphInvalid(GraphError, ValueError):
    """The graph cannot be built; raised before any operator runs."""


class PortError(GraphError, ValueError):
    """compute used a port that is not there, or emitted a value of another type than the port declares."""


class QueueFull(GraphError):
    """More was emitted into a blocking edge than it holds."""


class MetadataConflict(GraphError):
    """Two messages of one compute disagree on a key under MetadataPolicy.RAISE."""


class OperatorFailed(GraphError):
    """An operator raised. The original exception is the `__cause__`.

    `operator` is its name, `phase` the method that raised, `seq` the frame it worked on (None when unknown).
    """

    def __init__(self, operator: str, phase: str, cause: BaseException, seq: int | None = None) -> None:
        frame = "" if seq is None else f" on frame {seq}"
        super().__init__(f"operator {operator!r} failed in {phase}{frame}: {type(cause).__name__}: {cause}")
        self.operator, self.phase, self.seq = operator, phase, seq
        self.__cause__ = cause


class OperatorStuck(GraphError):
    """Operators, named in `operators`, did not return from compute in time; they are not stopped."""

    def __init__(self, operators: Iterable[str], timeout_s: float) -> None:
        self.operators = tuple(operators)
        super().__init__(f"still in compute {timeout_s:g} s after the graph stopped: {', '.join(self.operators)}")


class GraphDeadlock(GraphError):
    """Nothing can go on although not everything is done. `waiting` maps each operator to what it waits for."""

    def __init__(self, waiting: Mapping[str, str]) -> None:
        lines = "; ".join(f"{name} waits for {what}" for name, what in waiting.items())
        super().__init__(f"the graph is in deadlock: {lines}. Enlarge a queue, or make an input optional to compute.")
        self.waiting = dict(waiting)


class GraphBusy(GraphError):
    """The application already runs."""


class EngineError(OperatorsError, UserError):
    """An engine cannot run the graph."""


class EngineMissing(EngineError):
    """The engine's package is not installed or cannot be loaded."""


class EngineUnsupported(EngineError):
    """The engine cannot run this graph faithfully."""


class SourceError(OperatorsError, UserError):
    """A source of frames cannot be used."""


class SourceUnavailable(SourceError):
    """A source cannot be opened: nothing answers there, or what answers gives no pictures."""


class SourceLost(SourceError):
    """A source that gave frames is gone for good."""


class OutputError(OperatorsError, UserError):
    """What a run writes cannot be written."""


class OutputFolderInUse(OutputError):
    """The folder holds something that is not ours, or another run writes into it."""


class StorageFull(OutputError):
    """The disk has no room left."""


class RunError(OperatorsError):
    """An application cannot run, or ended early."""


class DeviceMissing(RunError, UserError):
    """The device asked for is not there, or this version cannot use it."""


class MemoryTooSmall(RunError, UserError):
    """What a run needs does not fit into this machine's memory, or into what this process may take."""


class NothingShown(RunError, UserError):
    """A run ended as it should, and no frame was shown: none came, or all were withheld."""


class RunFailed(RunError):
    """A run ended early; the `__cause__` says why. `result` is what it had reached, already saved."""

    def __init__(self, what: str, result: object) -> None:
        super().__init__(what)
        self.result = result
