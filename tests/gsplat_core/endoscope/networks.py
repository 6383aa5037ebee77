"""Small tool networks, written by the test."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Make = Callable[..., Path]


def conv(
    weights: Sequence[Sequence[float]], bias: Sequence[float], output: str = "mask"
) -> tuple[list[Any], list[Any]]:
    """Nodes and weights of a 1x1 convolution from red, green and blue to as many channels as there are rows."""
    kernel = np.array(weights, np.float32).reshape(len(weights), 3, 1, 1)
    parts = [numpy_helper.from_array(kernel, "kernel"), numpy_helper.from_array(np.array(bias, np.float32), "bias")]
    return [helper.make_node("Conv", ["image", "kernel", "bias"], [output])], parts


GREY = ([[-20.0, 10.0, 10.0]], [3.0])
"""Logits that are positive where red does not exceed the other channels by 0.3."""


def write(
    path: Path,
    nodes: list[Any],
    parts: list[Any],
    *,
    size: tuple[Any, Any] = (32, 40),
    input_shape: list[Any] | None = None,
    input_type: int = TensorProto.FLOAT,
    output_type: int = TensorProto.FLOAT,
    metadata: dict[str, Any] | None = None,
    opsets: Sequence[tuple[str, int]] = (("", 17),),
    more_inputs: Sequence[str] = (),
) -> Path:
    """An ONNX file of a graph from `image` to `mask`; its own settings are `metadata`."""
    shape = input_shape or [1, 3, *size]
    inputs = [helper.make_tensor_value_info("image", input_type, shape)]
    inputs += [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in more_inputs]
    mask = helper.make_tensor_value_info("mask", output_type, None)
    graph = helper.make_graph(nodes, "tools", inputs, [mask], parts)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid(*opset) for opset in opsets], ir_version=8)
    if metadata is not None:
        helper.set_model_props(model, {"intrasplat": json.dumps(metadata)})
    path.write_bytes(model.SerializeToString())
    return path


def grey_network(path: Path, **options: Any) -> Path:
    """A network that takes for a tool what is not red; its output are logits."""
    nodes, parts = conv(*GREY)
    return write(path, nodes, parts, **options)


def external_weights(path: Path, location: str) -> Path:
    """Write the grey network with its weights in another file."""
    nodes, parts = conv(*GREY)
    write(path, nodes, parts)
    model = onnx.load(str(path))
    kernel = model.graph.initializer[0]
    kernel.data_location = TensorProto.EXTERNAL
    kernel.ClearField("raw_data")
    kernel.external_data.add(key="location", value=location)
    path.write_bytes(model.SerializeToString())
    return path
