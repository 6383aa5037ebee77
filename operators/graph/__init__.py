"""Operator graph with the Python interface of NVIDIA's Holoscan SDK.

Operators written for the SDK run on the schedulers of this package and on the SDK. The SDK is
imported only by `run(app, engine="holoscan")`.
"""

from operators.graph.application import Application, Engine, Fragment, run
from operators.graph.graph import RunResult, StopReason
from operators.graph.operator import (
    DISABLE_BRANCH,
    STOP_GRAPH,
    ExecutionContext,
    Fault,
    FaultAction,
    FaultPolicy,
    InputContext,
    MetadataPolicy,
    Operator,
    OutputContext,
)
from operators.graph.ports import (
    REQUIRED,
    AsynchronousCondition,
    AsynchronousEventState,
    BooleanCondition,
    Clock,
    Condition,
    ConditionType,
    ConnectorType,
    CountCondition,
    DownstreamMessageAffordableCondition,
    EdgeStats,
    IOSpec,
    ManualClock,
    MessageAvailableCondition,
    MessageOrTimeoutCondition,
    OperatorSpec,
    PeriodicCondition,
    PeriodicConditionPolicy,
    QueuePolicy,
    RealtimeClock,
    SchedulingStatus,
)
from operators.graph.schedulers import GreedyScheduler, MultiThreadScheduler
from operators.graph.tracking import DurationSummary, FlowTracker

__all__ = [
    "DISABLE_BRANCH",
    "REQUIRED",
    "STOP_GRAPH",
    "Application",
    "AsynchronousCondition",
    "AsynchronousEventState",
    "BooleanCondition",
    "Clock",
    "Condition",
    "ConditionType",
    "ConnectorType",
    "CountCondition",
    "DownstreamMessageAffordableCondition",
    "DurationSummary",
    "EdgeStats",
    "Engine",
    "ExecutionContext",
    "Fault",
    "FaultAction",
    "FaultPolicy",
    "FlowTracker",
    "Fragment",
    "GreedyScheduler",
    "IOSpec",
    "InputContext",
    "ManualClock",
    "MessageAvailableCondition",
    "MessageOrTimeoutCondition",
    "MetadataPolicy",
    "MultiThreadScheduler",
    "Operator",
    "OperatorSpec",
    "OutputContext",
    "PeriodicCondition",
    "PeriodicConditionPolicy",
    "QueuePolicy",
    "RealtimeClock",
    "RunResult",
    "SchedulingStatus",
    "StopReason",
    "run",
]
