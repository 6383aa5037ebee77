"""Tool networks in torch, on an NVIDIA GPU as one CUDA graph.

`TorchToolNetwork` reads the ONNX files of this package without the package onnx and interprets their operators.
Convolutions are matrix products of unfolded patches. cuDNN is not used: loading it would delay the start of a stream,
and torch can disable it only for all threads.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from gsplat_core.endoscope.onnx import read_model, values
from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.alpha import CapturedSequence, GraphMemory

PRIORITY = -1
"""Priority of the CUDA stream, above that of training (0), which uses the GPU at the same time."""


class TorchToolNetwork:
    """Tool network in float32, with the input size of its file.

    Equal inputs give equal bytes on the same device. Calls of one object must not overlap; other threads may use the
    GPU meanwhile. Matrix products follow torch's setting for TF32, which is off by default.
    """

    def __init__(self, path: Path, device: torch.device) -> None:
        """Load a network and, on a GPU, capture its graph. Errors of torch and CUDA are raised unchanged.

        Args:
            path: file written by `benchmarks/tool_network/train.py`.
            device: CPU or NVIDIA GPU.

        Raises:
            InvalidSetting: if the file cannot be read, or contains an unknown operator or attribute.
        """
        self._graph = read_graph(path)
        self._device = device
        on_gpu = device.type == "cuda"
        self._planes = torch.zeros(self._graph.input_shape, pin_memory=on_gpu)
        self._logits = torch.zeros(self._graph.output_shape, pin_memory=on_gpu)
        self._stream = torch.cuda.Stream(device, priority=PRIORITY) if on_gpu else None
        self._launch: Callable[[], None] = self._run
        with self._own_stream():
            self._weights = {name: torch.from_numpy(array).to(device) for name, array in self._graph.weights.items()}
            if on_gpu:
                memory = GraphMemory(device)
                self._launch = CapturedSequence(self._run, device, memory, warm_up=True, priority=PRIORITY).replay

    def logits(self, planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run the network and wait for its output.

        Args:
            planes: `features` of a picture, [1, inputs, h, w].

        Returns:
            Logits of tool, [h / 2, w / 2].
        """
        self._planes.numpy()[:] = planes
        with self._own_stream():
            self._launch()
        if self._stream is not None:
            self._stream.synchronize()
        return self._logits[0, 0].numpy().copy()

    def _own_stream(self) -> AbstractContextManager[Any]:
        return nullcontext() if self._stream is None else torch.cuda.stream(self._stream)

    def _run(self) -> None:
        """Enqueue the copy of the input, the operators and the copy of the output."""
        graph = self._graph
        known: dict[str, Any] = {"": None, **self._weights}
        known[graph.input] = self._planes.to(self._device, non_blocking=True)
        for node in graph.nodes:
            run = OPERATORS[node.operator].run
            known[node.output] = run(*(known[name] for name in node.inputs), **node.options)
        self._logits.copy_(known[graph.output], non_blocking=True)


@dataclass(frozen=True)
class Node:
    """Call of an operator in an ONNX graph."""

    operator: str
    """Name of the operator, a key of `OPERATORS`."""
    inputs: tuple[str, ...]
    """Names of the operator's input values, in order; an omitted optional input has the name ""."""
    output: str
    options: Mapping[str, Any]
    """Values of the ONNX attributes that are passed to `Operator.run`, by name."""


@dataclass(frozen=True)
class Graph:
    """Network of an ONNX file: constant tensors, and operator calls in order of execution."""

    nodes: tuple[Node, ...]
    """Operators in an order in which each follows the operators whose outputs it reads."""
    weights: Mapping[str, NDArray[Any]]
    input: str
    input_shape: tuple[int, ...]
    output: str
    output_shape: tuple[int, ...]


@dataclass(frozen=True)
class Operator:
    """Implementation of an ONNX operator for one combination of attributes."""

    run: Callable[..., Any]
    options: frozenset[str] = frozenset()
    """Names of the attributes that are passed to `run` as keyword arguments."""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    """Attributes of which only one value is supported, with that value."""


def _convolved(
    planes: Tensor,
    weight: Tensor,
    bias: Tensor,
    *,
    dilations: tuple[int, ...],
    group: int,
    kernel_shape: tuple[int, ...],
    pads: tuple[int, ...],
    strides: tuple[int, ...],
) -> Tensor:
    """Convolve [1, c, h, w]. Raises ValueError unless `pads` are equal at opposite sides."""
    padding = pads[:2]
    if padding != pads[2:]:
        raise ValueError(f"Conv with the padding {pads} is not supported; opposite sides must be equal")
    patches = functional.unfold(planes, kernel_shape, dilations, padding, strides)
    product = torch.baddbmm(
        bias.view(group, -1, 1), weight.view(group, len(weight) // group, -1), patches.view(group, -1, patches.shape[2])
    )
    height, width = (
        (side + 2 * pad - dilation * (kernel - 1) - 1) // stride + 1
        for side, pad, dilation, kernel, stride in zip(
            planes.shape[2:], padding, dilations, kernel_shape, strides, strict=True
        )
    )
    return product.view(1, len(weight), height, width)


def _constant(*, value: NDArray[Any]) -> NDArray[Any]:
    """Return the value of the operator `Constant`, such as axes, as an array on the host."""
    return value


def _means(planes: Tensor, axes: NDArray[np.int64]) -> Tensor:
    return planes.mean(axes.tolist())


def _unsqueezed(tensor: Tensor, axis: NDArray[np.int64]) -> Tensor:
    return tensor.unsqueeze(axis.item())


def _enlarged(planes: Tensor, _: None, scales: NDArray[np.float32]) -> Tensor:
    return functional.interpolate(planes, scale_factor=scales[2:].tolist(), mode="nearest")


OPERATORS: Mapping[str, Operator] = {
    "Add": Operator(torch.add),
    "Constant": Operator(_constant, frozenset({"value"})),
    "Conv": Operator(_convolved, frozenset({"dilations", "group", "kernel_shape", "pads", "strides"})),
    "Gemm": Operator(functional.linear, fixed={"alpha": 1.0, "beta": 1.0, "transB": 1}),
    "ReduceMean": Operator(_means, fixed={"keepdims": 0}),
    "Relu": Operator(torch.relu),
    "Resize": Operator(
        _enlarged,
        fixed={
            "coordinate_transformation_mode": "asymmetric",
            "cubic_coeff_a": -0.75,  # only the mode `cubic` uses it, but the exporter writes it for every mode
            "mode": "nearest",
            "nearest_mode": "floor",
        },
    ),
    "Unsqueeze": Operator(_unsqueezed),
}
"""Implementations of the supported ONNX operators by name. All attributes that torch's exporter writes must be present."""


def read_graph(path: Path) -> Graph:
    """Read an ONNX file.

    Raises:
        InvalidSetting: if it cannot be read, or has operators, attributes or data types that are not supported.
    """
    data = read_model(path, "tool network")
    try:
        (graph,) = values(memoryview(data), 7)
        nodes = tuple(_node(message) for message in values(graph, 1))
        weights = dict(_tensor(message) for message in values(graph, 5))
        (read,), (written,) = _texts(graph, 11, 1), _texts(graph, 12, 1)
        input_shape, output_shape = (tuple(values(graph, end, 2, 1, 2, 1, 1)) for end in (11, 12))
    except ValueError as error:
        raise InvalidSetting(f"tool network {path} cannot be run by torch: {error}") from error
    return Graph(nodes, weights, read, input_shape, written, output_shape)


def _node(message: memoryview) -> Node:
    (name,) = _texts(message, 4)
    if name not in OPERATORS:
        raise ValueError(f"its operator {name} is not supported; supported are {', '.join(OPERATORS)}")
    operator = OPERATORS[name]
    attributes = dict(_attribute(each) for each in values(message, 5))
    for attribute in sorted(attributes.keys() ^ (operator.options | operator.fixed.keys())):
        problem = "not supported" if attribute in attributes else "missing"
        raise ValueError(f"the attribute {attribute} of its operator {name} is {problem}")
    for attribute, value in operator.fixed.items():
        if attributes[attribute] != value:
            raise ValueError(f"{attribute} of its operator {name} is {attributes[attribute]}; it must be {value}")
    (output,) = _texts(message, 2)
    return Node(name, _texts(message, 1), output, {option: attributes[option] for option in operator.options})


_ATTRIBUTES: Mapping[int, tuple[int, Callable[[list[Any]], Any]]] = {
    1: (2, lambda found: struct.unpack("<f", found[0])[0]),
    2: (3, lambda found: found[0]),
    3: (4, lambda found: bytes(found[0]).decode()),
    4: (5, lambda found: _tensor(found[0])[1]),
    7: (8, tuple),
}
"""Decoding of ONNX attributes by their type number (float, integer, text, tensor, integers): the field number of the value, and the
conversion of the field.
"""
_DTYPES = {1: "<f4", 7: "<i8"}


def _attribute(message: memoryview) -> tuple[str, Any]:
    """Return name and value of an attribute."""
    (name,), (kind,) = _texts(message, 1), values(message, 20)
    if kind not in _ATTRIBUTES:
        raise ValueError(f"the type {kind} of an attribute {name} is not supported")
    number, convert = _ATTRIBUTES[kind]
    return name, convert(values(message, number))


def _tensor(message: memoryview) -> tuple[str, NDArray[Any]]:
    """Return name and values of a tensor. Constants have no name."""
    name, (kind,), raw = "".join(_texts(message, 8)), values(message, 2), values(message, 9)
    if kind not in _DTYPES or not raw:
        raise ValueError(f"the tensor {name!r} of type {kind} is not supported; it must be raw float32 or int64")
    return name, np.frombuffer(raw[0], _DTYPES[kind]).reshape(values(message, 1)).copy()


def _texts(message: memoryview, *place: int) -> tuple[str, ...]:
    return tuple(bytes(text).decode() for text in values(message, *place))
