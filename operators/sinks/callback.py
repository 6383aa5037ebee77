"""Sink that calls a function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from operators.graph import Operator, OperatorSpec


class CallbackSinkOp(Operator):
    """Calls a function with each message, in the operator's thread. Its exceptions fail the operator.

    Inputs:
        message: any value.

    Params:
        callback: called with the message.
    """

    def __init__(self, fragment: Any, *args: Any, callback: Callable[[Any], None], **kwargs: Any) -> None:
        self.callback = callback
        self.received = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("message")

    def start(self) -> None:
        self.received = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        self.callback(op_input.receive("message"))
        self.received += 1
