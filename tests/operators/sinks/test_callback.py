"""A function as a sink."""

from __future__ import annotations

from operators.sinks.sink import CallbackSinkOp


def test_callback_sink_calls_function_with_each_message(rendered, compute):
    seen = []
    operator = CallbackSinkOp(None, callback=seen.append)
    operator.start()
    messages = [rendered(k) for k in range(3)]
    for message in messages:
        compute(operator, message=message)
    assert seen == messages and operator.received == 3
