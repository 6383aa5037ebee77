"""`TorchToolNetwork` equals OpenCV, and rejects unknown operators, attributes and tensors."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode

from gsplat_core.endoscope.reduced import averaged
from gsplat_core.endoscope.tool_network_torch import OPERATORS, TorchToolNetwork
from gsplat_core.endoscope.tools import (
    INPUT_PX,
    NETWORK,
    ROUND_INPUT_PX,
    ROUND_INPUTS,
    ROUND_NETWORK,
    NetworkToolFinder,
    features,
    round_view,
)
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording

from .tool_pictures import in_round_view, tissue, with_rod

CPU = torch.device("cpu")
INPUTS = {NETWORK: (INPUT_PX, 5), ROUND_NETWORK: (ROUND_INPUT_PX, ROUND_INPUTS)}
BOUND = 1e-4
"""Largest difference of logits, and largest share of pixels with another mask."""

both_networks = pytest.mark.parametrize("path", INPUTS, ids=["full", "round"])


@cache
def in_torch(path):
    return TorchToolNetwork(path, CPU)


def in_opencv(path, planes):
    network = cv2.dnn.readNetFromONNX(str(path))
    network.setInput(planes)
    return network.forward()[0, 0]


def noise(path, seed=0):
    (width, height), inputs = INPUTS[path]
    return np.random.default_rng(seed).normal(size=(1, inputs, height, width)).astype(np.float32)


@both_networks
def test_torch_network_logits_of_noise_equal_opencv(path):
    for seed in range(3):
        planes = noise(path, seed)
        wanted = in_opencv(path, planes)
        found = in_torch(path).logits(planes)
        assert found.dtype == np.float32 and found.shape == wanted.shape and np.ptp(wanted) > 1
        np.testing.assert_allclose(found, wanted, rtol=0, atol=BOUND)


@both_networks
@pytest.mark.parametrize("draw", [lambda: tissue(256, 320), lambda: with_rod(256, 320)[0]], ids=["tissue", "rod"])
def test_torch_network_logits_of_drawn_images_equal_opencv(path, draw):
    planes = features(averaged(draw(), INPUTS[path][0]), INPUTS[path][1])
    np.testing.assert_allclose(in_torch(path).logits(planes), in_opencv(path, planes), rtol=0, atol=BOUND)


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["heart", "cutting", "others/colonoscopy_a"])
def test_torch_network_logits_and_masks_of_recordings_equal_opencv(recordings_dir, in_both, name):
    """The colonoscopy has an octagonal view."""
    images = [frame.image for frame in open_recording(recordings_dir / name, max_frames=10)][::3]
    assert round_view(averaged(images[0], INPUT_PX)) == ("colonoscopy" in name)
    by_torch, by_opencv = in_both
    for image in images:
        for path, (input_px, inputs) in INPUTS.items():
            planes = features(averaged(image, input_px), inputs)
            np.testing.assert_allclose(in_torch(path).logits(planes), in_opencv(path, planes), rtol=0, atol=BOUND)
        assert (by_torch.find(image) != by_opencv.find(image)).mean() <= BOUND


@pytest.fixture
def in_both(monkeypatch):
    """Finders with the networks in torch, as on a GPU but on the CPU, and in OpenCV."""
    asked = []

    def network(path, device):
        asked.append((path, device))
        return in_torch(path)

    monkeypatch.setattr("gsplat_core.endoscope.tool_network_torch.TorchToolNetwork", network)
    finder = NetworkToolFinder(device="cuda")
    assert asked == [(NETWORK, torch.device("cuda")), (ROUND_NETWORK, torch.device("cuda"))]
    return finder, NetworkToolFinder()


@pytest.mark.parametrize("change", [lambda image: image, lambda image: in_round_view(image)[0]], ids=["full", "round"])
def test_torch_network_masks_of_drawn_instruments_equal_opencv(in_both, change):
    by_torch, by_opencv = in_both
    image = change(with_rod(256, 320)[0])
    wanted = by_opencv.find(image)
    assert 0.02 < (wanted == 0).mean() < 0.5
    assert (by_torch.find(image) != wanted).mean() <= BOUND


def test_network_finder_runs_custom_network_on_requested_device(in_both):
    finder = NetworkToolFinder(ROUND_NETWORK, ROUND_INPUT_PX, ROUND_INPUTS, device="cuda")
    image = with_rod(256, 320)[0]
    wanted = NetworkToolFinder(ROUND_NETWORK, ROUND_INPUT_PX, ROUND_INPUTS).find(image)
    assert (finder.find(image) != wanted).mean() <= BOUND


@both_networks
def test_torch_network_is_deterministic_and_keeps_earlier_results(path):
    first = in_torch(path).logits(noise(path))
    kept = first.tobytes()
    assert in_torch(path).logits(noise(path, 1)).tobytes() != kept
    assert first.tobytes() == kept == TorchToolNetwork(path, CPU).logits(noise(path)).tobytes()


def test_torch_network_rejects_input_of_different_size():
    with pytest.raises(ValueError, match="broadcast"):
        in_torch(NETWORK).logits(noise(ROUND_NETWORK))


def test_torch_network_calls_no_torch_convolution():
    """Torch's convolutions would load cuDNN on a GPU."""
    called = []

    class Recorded(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            called.append(str(function))
            return function(*args, **(kwargs or {}))

    with Recorded():
        in_torch(NETWORK).logits(noise(NETWORK))
    assert "aten.baddbmm.default" in called and not [name for name in called if "conv" in name or "cudnn" in name]


@pytest.mark.parametrize("group", [1, 2, 4])
@pytest.mark.parametrize(
    ("kernel_shape", "dilations", "padding", "strides"),
    [
        ((3, 3), (1, 1), (1, 1), (1, 1)),
        ((1, 1), (1, 1), (0, 0), (1, 1)),
        ((3, 3), (2, 2), (2, 2), (1, 1)),
        ((3, 3), (1, 1), (1, 1), (2, 2)),
        ((3, 2), (2, 3), (1, 2), (3, 2)),
    ],
)
def test_conv_operator_equals_torch_conv2d(generator, group, kernel_shape, dilations, padding, strides):
    options = {"generator": generator, "dtype": torch.float64}
    planes, bias = torch.randn(1, 8, 13, 16, **options), torch.randn(12, **options)
    weight = torch.randn(12, 8 // group, *kernel_shape, **options)
    found = OPERATORS["Conv"].run(
        planes,
        weight,
        bias,
        dilations=dilations,
        group=group,
        kernel_shape=kernel_shape,
        pads=(*padding, *padding),
        strides=strides,
    )
    wanted = functional.conv2d(planes, weight, bias, strides, padding, dilations, group)
    torch.testing.assert_close(found, wanted)


def test_conv_operator_rejects_asymmetric_padding():
    options = {"dilations": (1, 1), "group": 1, "kernel_shape": (3, 3), "strides": (1, 1)}
    tensors = torch.zeros(1, 1, 5, 5), torch.zeros(1, 1, 3, 3), torch.zeros(1)
    for pads in ((1, 1, 0, 1), (0, 1, 0, 0)):
        with pytest.raises(ValueError, match=r"Conv with the padding .* opposite sides must be equal"):
            OPERATORS["Conv"].run(*tensors, pads=pads, **options)


def changed(tmp_path, change):
    """Return the path of a copy of the network with a changed graph."""
    model = onnx.load(NETWORK)
    change(model.graph)
    path = tmp_path / "changed.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def refused(tmp_path, change, sentence):
    path = changed(tmp_path, change)
    with pytest.raises(InvalidSetting, match=rf"tool network .*changed\.onnx cannot be run by torch: {sentence}"):
        TorchToolNetwork(path, CPU)


def first_of(graph, operator):
    return next(node for node in graph.node if node.op_type == operator)


def attribute_of(node, name):
    return next(attribute for attribute in node.attribute if attribute.name == name)


def test_torch_network_unchanged_by_rewriting_file(tmp_path):
    """Shows that the files of the tests below are rejected because of their changes, not because of rewriting."""
    planes = noise(NETWORK)
    path = changed(tmp_path, lambda graph: None)
    np.testing.assert_array_equal(TorchToolNetwork(path, CPU).logits(planes), in_torch(NETWORK).logits(planes))


def test_torch_network_names_missing_file(tmp_path):
    with pytest.raises(InvalidSetting, match=r"tool network .*missing\.onnx cannot be read"):
        TorchToolNetwork(tmp_path / "missing.onnx", CPU)


def test_torch_network_rejects_file_without_graph(tmp_path):
    path = tmp_path / "empty.onnx"
    path.write_bytes(b"")
    with pytest.raises(InvalidSetting, match=r"tool network .*empty\.onnx cannot be run by torch"):
        TorchToolNetwork(path, CPU)


def test_torch_network_names_unknown_operator(tmp_path):
    def change(graph):
        first_of(graph, "Relu").op_type = "Mish"

    refused(tmp_path, change, "its operator Mish is not supported; supported are Add, Constant, Conv, ")


@pytest.mark.parametrize("operator", OPERATORS)
def test_torch_network_names_unknown_attribute(tmp_path, operator):
    def change(graph):
        first_of(graph, operator).attribute.append(helper.make_attribute("extent", 2))

    refused(tmp_path, change, f"the attribute extent of its operator {operator} is not supported")


ATTRIBUTES = [(operator, name) for operator, known in OPERATORS.items() for name in (*known.options, *known.fixed)]


@pytest.mark.parametrize(("operator", "name"), sorted(ATTRIBUTES))
def test_torch_network_names_missing_attribute(tmp_path, operator, name):
    def change(graph):
        node = first_of(graph, operator)
        node.attribute.remove(attribute_of(node, name))

    refused(tmp_path, change, f"the attribute {name} of its operator {operator} is missing")


@pytest.mark.parametrize(
    ("operator", "name", "value", "supported"),
    [
        ("Gemm", "alpha", 0.5, "1.0"),
        ("Gemm", "beta", 2.0, "1.0"),
        ("Gemm", "transB", 0, "1"),
        ("ReduceMean", "keepdims", 1, "0"),
        ("Resize", "coordinate_transformation_mode", "half_pixel", "asymmetric"),
        ("Resize", "mode", "linear", "nearest"),
        ("Resize", "nearest_mode", "ceil", "floor"),
    ],
)
def test_torch_network_names_unsupported_attribute_value(tmp_path, operator, name, value, supported):
    def change(graph):
        attribute_of(first_of(graph, operator), name).CopyFrom(helper.make_attribute(name, value))

    refused(tmp_path, change, f"{name} of its operator {operator} is {value}; it must be {supported}")


def test_torch_network_names_unsupported_attribute_type(tmp_path):
    def change(graph):
        first_of(graph, "Relu").attribute.append(helper.make_attribute("extents", [0.5, 1.5]))

    refused(tmp_path, change, "the type 6 of an attribute extents is not supported")


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (lambda values: numpy_helper.from_array(values.astype(np.float16), "stem.0.bias"), 10),
        (lambda values: helper.make_tensor("stem.0.bias", onnx.TensorProto.FLOAT, values.shape, values.tolist()), 1),
    ],
    ids=["half precision", "not raw"],
)
def test_torch_network_rejects_unsupported_tensors(tmp_path, make, kind):
    def change(graph):
        (bias,) = (tensor for tensor in graph.initializer if tensor.name == "stem.0.bias")
        bias.CopyFrom(make(numpy_helper.to_array(bias)))

    refused(tmp_path, change, f"the tensor 'stem.0.bias' of type {kind} is not supported; it must be raw float32 or")


def test_network_finder_without_gpu_loads_no_torch_network(monkeypatch):
    def fail(path, device):
        raise AssertionError(path)

    monkeypatch.setattr("gsplat_core.endoscope.tool_network_torch.TorchToolNetwork", fail)
    assert NetworkToolFinder().find(tissue(64, 64)).all()
