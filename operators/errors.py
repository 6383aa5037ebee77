"""Exceptions of the operators. Each message states the problem, the offending value and the remedy.

OperatorsError
├── GraphError
│   ├── GraphInvalid (also ValueError)   invalid names, ports, types or connections
│   ├── PortError (also ValueError)      compute used an unknown port or emitted a wrong type
│   ├── QueueFull                        compute emitted more into a blocking edge than its capacity
│   ├── MetadataConflict                 two messages of one compute disagree (MetadataPolicy.RAISE)
│   ├── OperatorFailed                   an operator raised; names the operator and the frame
│   ├── OperatorStuck                    an operator did not return from compute after the stop
│   ├── GraphDeadlock                    no operator can run although the graph is not finished
│   └── GraphBusy                        run() while the application already runs
├── EngineError (UserError)
│   ├── EngineMissing                    the engine's package is not installed or cannot be loaded
│   └── EngineUnsupported                the engine cannot run this graph faithfully
├── SourceError (UserError)              a frame source is unusable
│   ├── SourceUnavailable                the source cannot be opened
│   └── SourceLost                       the source delivered frames and then failed permanently
├── OutputError (UserError)              results cannot be written
│   ├── OutputFolderInUse                foreign files in the folder, or another run writes into it
│   └── StorageFull                      the disk is full
└── RunError
    ├── DeviceMissing (UserError)        the requested device is missing or not supported
    ├── MemoryTooSmall (UserError)       the run does not fit into memory
    ├── NothingShown (UserError)         the run ended normally without displaying a frame
    └── RunFailed                        the run ended early; carries the results so far
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gsplat_core.errors import UserError


class OperatorsError(Exception):
    """Base class of all exceptions that the operators raise deliberately."""


class GraphError(OperatorsError):
    """An operator graph failed while it was built or run."""


class GraphInvalid(GraphError, ValueError):
    """The graph cannot be built; raised before any operator runs."""


class PortError(GraphError, ValueError):
    """`compute` used a port that does not exist, or emitted a value of the wrong type."""


class QueueFull(GraphError):
    """`compute` emitted more messages into a blocking edge than the edge's capacity."""


class MetadataConflict(GraphError):
    """Two messages of one `compute` call carry different values of a metadata key (`MetadataPolicy.RAISE`)."""


class OperatorFailed(GraphError):
    """An operator raised an exception, which is kept as `__cause__`.

    Attributes:
        operator: name of the operator.
        phase: name of the method that raised.
        seq: sequence number of the frame in work; None if unknown.
    """

    def __init__(self, operator: str, phase: str, cause: BaseException, seq: int | None = None) -> None:
        frame = "" if seq is None else f" on frame {seq}"
        super().__init__(f"operator {operator!r} failed in {phase}{frame}: {type(cause).__name__}: {cause}")
        self.operator, self.phase, self.seq = operator, phase, seq
        self.__cause__ = cause


class OperatorStuck(GraphError):
    """Operators that did not return from `compute` in time; their threads keep running. Names in `operators`."""

    def __init__(self, operators: Iterable[str], timeout_s: float) -> None:
        self.operators = tuple(operators)
        super().__init__(f"still in compute {timeout_s:g} s after the graph stopped: {', '.join(self.operators)}")


class GraphDeadlock(GraphError):
    """No operator can run although the graph is not finished. `waiting` maps each operator to its unmet condition."""

    def __init__(self, waiting: Mapping[str, str]) -> None:
        lines = "; ".join(f"{name} waits for {what}" for name, what in waiting.items())
        super().__init__(f"the graph is in deadlock: {lines}. Enlarge a queue, or make an input optional to compute.")
        self.waiting = dict(waiting)


class GraphBusy(GraphError):
    """`run()` was called while the application was already running."""


class EngineError(OperatorsError, UserError):
    """Base class: the selected graph engine (embedded or Holoscan) cannot run the graph."""


class EngineMissing(EngineError):
    """The engine's package is not installed or cannot be loaded."""


class EngineUnsupported(EngineError):
    """The engine cannot run this graph faithfully."""


class SourceError(OperatorsError, UserError):
    """A frame source is unusable."""


class SourceUnavailable(SourceError):
    """A source cannot be opened: no answer, or an answer without frames."""


class SourceLost(SourceError):
    """A source delivered frames and then failed permanently."""


class OutputError(OperatorsError, UserError):
    """Results of a run cannot be written."""


class OutputFolderInUse(OutputError):
    """The output folder contains foreign files, or another run writes into it."""


class StorageFull(OutputError):
    """The disk has too little free space."""


class RunError(OperatorsError):
    """An application cannot run, or ended early."""


class DeviceMissing(RunError, UserError):
    """The requested device does not exist, or this version does not support it."""


class MemoryTooSmall(RunError, UserError):
    """The run needs more memory than the machine or the process limit allows."""


class NothingShown(RunError, UserError):
    """A run ended normally without displaying a frame: the source was empty or every frame was withheld."""


class RunFailed(RunError):
    """A run ended early; the cause is `__cause__`. `result` is the outcome so far, already saved."""

    def __init__(self, what: str, result: object) -> None:
        super().__init__(what)
        self.result = result
