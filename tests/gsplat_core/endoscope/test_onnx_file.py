"""Untrusted ONNX files: no access to other files, no custom libraries, and bounded reading."""

from __future__ import annotations

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from gsplat_core.endoscope import onnx
from gsplat_core.endoscope.onnx import OnnxToolFinder, has_external_data, read_model
from gsplat_core.errors import InvalidSetting

from .networks import external_weights, grey_network


@pytest.mark.parametrize("location", ["weights.bin", "../weights.bin", "/etc/hostname", ""])
def test_onnx_weights_in_external_file_rejected(tmp_path, location):
    (tmp_path / "weights.bin").write_bytes(np.zeros(3, np.float32).tobytes())
    path = external_weights(tmp_path / "net.onnx", location)
    with pytest.raises(InvalidSetting, match=r"keeps data in other files, which are not opened;.*external_data=False"):
        OnnxToolFinder(path)


def external() -> TensorProto:
    tensor = numpy_helper.from_array(np.zeros(3, np.float32), "w")
    tensor.external_data.add(key="location", value="elsewhere")
    return tensor


def inside_attribute() -> bytes:
    node = helper.make_node("Constant", [], ["c"], value=external())
    return helper.make_model(helper.make_graph([node], "g", [], [])).SerializeToString()


def inside_branch() -> bytes:
    branch = helper.make_graph([], "branch", [], [], initializer=[external()])
    node = helper.make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch)
    return helper.make_model(helper.make_graph([node], "g", [], [])).SerializeToString()


def inside_function() -> bytes:
    node = helper.make_node("Constant", [], ["c"], value=external())
    function = helper.make_function("local", "F", [], ["c"], [node], [helper.make_opsetid("", 17)])
    return helper.make_model(helper.make_graph([], "g", [], []), functions=[function]).SerializeToString()


def inside_sparse() -> bytes:
    model = helper.make_model(helper.make_graph([], "g", [], []))
    model.graph.sparse_initializer.add().values.CopyFrom(external())
    return model.SerializeToString()


@pytest.mark.parametrize("make", [inside_attribute, inside_branch, inside_function, inside_sparse])
def test_has_external_data_finds_every_location_in_model(make):
    assert has_external_data(make())


def test_has_external_data_false_for_self_contained_model(tmp_path):
    assert not has_external_data(grey_network(tmp_path / "net.onnx").read_bytes())


def test_onnx_operators_of_custom_domain_rejected(tmp_path):
    node = helper.make_node("Steal", ["image"], ["mask"], domain="my.ops")
    graph = helper.make_graph(
        [node],
        "g",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 32, 32])],
        [helper.make_tensor_value_info("mask", TensorProto.FLOAT, None)],
    )
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("my.ops", 1)]
    path = tmp_path / "net.onnx"
    path.write_bytes(helper.make_model(graph, opset_imports=opsets, ir_version=8).SerializeToString())
    with pytest.raises(InvalidSetting, match=r"cannot be loaded \(.*my\.ops"):
        OnnxToolFinder(path)


def test_read_model_rejects_oversized_file(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx, "MOST_BYTES", 1000)
    path = tmp_path / "net.onnx"
    path.write_bytes(bytes(1001))
    with pytest.raises(InvalidSetting, match="it is larger than 1000 bytes"):
        read_model(path, "tool network")


@pytest.mark.parametrize(
    "data", [b"", b"\x00", b"hello world", b"\x3a\xff", b"\x3a\x05ab", b"\xff" * 40, b"\x0b", bytes(200)]
)
def test_onnx_finder_rejects_invalid_model_bytes(tmp_path, data):
    path = tmp_path / "net.onnx"
    path.write_bytes(data)
    with pytest.raises(InvalidSetting, match=r"is no ONNX model|cannot be loaded"):
        OnnxToolFinder(path)


def test_onnx_finder_rejects_truncated_model(tmp_path):
    data = grey_network(tmp_path / "net.onnx").read_bytes()
    path = tmp_path / "cut.onnx"
    for end in range(0, len(data) - 1, 7):
        path.write_bytes(data[:end])
        with pytest.raises(InvalidSetting):
            OnnxToolFinder(path)


def field(number: int, payload: bytes) -> bytes:
    """A field of a protobuf message, with its length."""
    length, coded = len(payload), b""
    while length > 0x7F:
        coded += bytes([length & 0x7F | 0x80])
        length >>= 7
    return bytes([number << 3 | 2]) + coded + bytes([length]) + payload


def test_has_external_data_rejects_deeply_nested_graphs():
    graph = b""
    for _ in range(80):
        graph = field(1, field(5, field(6, graph)))  # a node's attribute that is a graph
    with pytest.raises(ValueError, match="graphs inside each other more than 64 deep"):
        has_external_data(field(7, graph))


def test_onnx_finder_names_missing_file(tmp_path):
    with pytest.raises(
        InvalidSetting, match=r"tool network .*missing\.onnx cannot be read \(No such file or directory\)"
    ):
        OnnxToolFinder(tmp_path / "missing.onnx")
    with pytest.raises(InvalidSetting, match="cannot be read"):
        OnnxToolFinder(tmp_path)


def tagged(number: int, payload: bytes) -> bytes:
    """Encode a length-delimited protobuf field with any field number below 2048."""
    tag = number << 3 | 2
    head = bytes([tag]) if tag < 0x80 else bytes([tag & 0x7F | 0x80, tag >> 7])
    length = len(payload)
    return head + (bytes([length]) if length < 0x80 else bytes([length & 0x7F | 0x80, length >> 7])) + payload


BY_KEY, BY_LOCATION = tagged(13, b""), bytes([14 << 3, 1])
PATHS = {
    "initializer": (7, 5),
    "sparse values": (7, 15, 1),
    "sparse indices": (7, 15, 2),
    "tensor of an attribute": (7, 1, 5, 5),
    "tensors of an attribute": (7, 1, 5, 10),
    "graph of an attribute": (7, 1, 5, 6, 5),
    "graphs of an attribute": (7, 1, 5, 11, 5),
    "sparse tensor of an attribute": (7, 1, 5, 22, 1),
    "sparse tensors of an attribute": (7, 1, 5, 23, 2),
    "training initialization": (20, 1, 5),
    "training algorithm": (20, 2, 5),
    "function node": (25, 7, 5, 5),
    "function attribute": (25, 11, 5),
}
"""Field numbers of onnx.proto from the model to a tensor."""


@pytest.mark.parametrize("tensor", [BY_KEY, BY_LOCATION])
@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize(
    "before", [b"", b"\x09" + bytes(8), b"\x0d" + bytes(4), b"\x08\xff\x01", tagged(9, bytes(300))]
)
def test_has_external_data_finds_tensor_at_every_message_path(path, tensor, before):
    """Fields of every wire type before the tensor are skipped."""
    message = before + tensor
    for number in reversed(path):
        message = before + tagged(number, message)
    assert has_external_data(message)
    assert not has_external_data(message.replace(tensor, tagged(9, bytes(len(tensor) - 2))))


@pytest.mark.parametrize(
    "data", [b"\x09" + bytes(7), b"\x0d" + bytes(3), b"\x0a\x03ab", b"\x08" + b"\xff" * 10, b"\x08\x80"]
)
def test_has_external_data_rejects_truncated_messages(data):
    with pytest.raises(ValueError, match=r"ends too early|more than 64 bits"):
        has_external_data(data)


def test_has_external_data_false_for_embedded_values():
    assert not has_external_data(tagged(7, tagged(5, bytes([14 << 3, 0]))))


def encoded(number: int, length: int = 0) -> bytes:
    """Return a variable-length integer of at least `length` bytes."""
    parts = []
    while number > 0x7F or len(parts) + 1 < length:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, 2**35 + 5, 2**63, 2**64 - 1])
def test_varint_limited_to_64_bits(number):
    assert onnx.varint(memoryview(b"x" + encoded(number) + b"y"), 1) == (number, 1 + len(encoded(number)))
    assert onnx.varint(memoryview(encoded(number, 10)), 0) == (number, 10)
    with pytest.raises(ValueError, match="more than 64 bits"):
        onnx.varint(memoryview(encoded(number, 11)), 0)
    with pytest.raises(ValueError, match="ends too early"):
        onnx.varint(memoryview(encoded(number, 5)[:-1]), 0)


def test_fields_reads_all_wire_types_in_order():
    message = b"".join(
        (
            encoded(3 << 3 | 0), encoded(300), encoded(4 << 3 | 1), b"8 bytes!", encoded(5 << 3 | 2), encoded(4), b"text",
            encoded(200 << 3 | 5), b"4 by",
        )
    )  # fmt: skip
    found = list(onnx.fields(memoryview(message)))
    assert [(number, value if isinstance(value, int) else bytes(value)) for number, value in found] == [
        (3, 300), (4, b"8 bytes!"), (5, b"text"), (200, b"4 by"),
    ]  # fmt: skip
    assert isinstance(found[2][1], memoryview)
    for end in (len(message) - 1, len(message) - 5, 10):
        with pytest.raises(ValueError, match="ends too early"):
            list(onnx.fields(memoryview(message[:end])))
    with pytest.raises(ValueError, match="wire type 3"):
        list(onnx.fields(memoryview(encoded(3 << 3 | 3))))
    with pytest.raises(ValueError, match="ends too early"):
        list(onnx.fields(memoryview(encoded(0 << 3 | 2) + encoded(0))))  # there is no field 0


def test_values_collects_all_messages_on_path():
    inner = encoded(1 << 3) + encoded(5) + encoded(1 << 3) + encoded(6) + encoded(2 << 3) + encoded(9)
    outer = (encoded(7 << 3 | 2) + encoded(len(inner)) + inner) * 2
    assert onnx.values(memoryview(outer), 7, 1) == [5, 6, 5, 6]
    assert onnx.values(memoryview(outer), 7, 3) == onnx.values(memoryview(outer), 6, 1) == []
