"""`OnnxToolFinder`: output formats of user networks, error messages for unsupported models, and NaN treated as tool."""

from __future__ import annotations

import json
import logging
import sys

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from gsplat_core.endoscope.onnx import OnnxToolFinder
from gsplat_core.errors import InvalidInput, InvalidSetting

from .networks import GREY, conv, grey_network, write

HEIGHT, WIDTH = 64, 80


def picture(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Red tissue with a grey tool on its right half."""
    image = np.full((height, width, 3), (200, 60, 50), np.uint8)
    image[:, width // 2 :] = 128
    return image


def check(mask: np.ndarray, height: int = HEIGHT, width: int = WIDTH) -> None:
    """The left half is tissue, the right one tool, but for a pixel or two between them."""
    assert mask.shape == (height, width) and mask.dtype == np.uint8
    assert mask[:, : width // 2 - 2].min() == 1 and mask[:, width // 2 + 2 :].max() == 0


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (32, 40), (50, 33), ("height", "width")])
@pytest.mark.parametrize("image_size", [(HEIGHT, WIDTH), (512, 640), (31, 47)])
def test_onnx_finder_resizes_logits_to_image(tmp_path, size, image_size):
    finder = OnnxToolFinder(grey_network(tmp_path / "net.onnx", size=size))
    mask = finder.find(picture(*image_size))
    margin = max(2, round(2 * image_size[1] / (size[1] if isinstance(size[1], int) else 32)))
    assert mask[:, : image_size[1] // 2 - margin].all() and not mask[:, image_size[1] // 2 + margin :].any()


def test_onnx_finder_recognises_probabilities_and_applies_threshold(tmp_path):
    nodes, parts = conv(*GREY, output="logits")
    nodes.append(helper.make_node("Sigmoid", ["logits"], ["mask"]))
    check(OnnxToolFinder(write(tmp_path / "a.onnx", nodes, parts)).find(picture()))
    # The tool's probability is sigmoid(3) = 0.95.
    strict = write(tmp_path / "b.onnx", nodes, parts, metadata={"threshold": 0.97})
    assert OnnxToolFinder(strict).find(picture()).all()


def test_onnx_finder_follows_declared_value_type(tmp_path):
    nodes, parts = conv([[-0.1, 0.05, 0.05]], [0.4])
    low = write(tmp_path / "net.onnx", nodes, parts, metadata={"values": "probability"})
    assert OnnxToolFinder(low).find(picture()).all()
    low = write(tmp_path / "net.onnx", nodes, parts, metadata={"values": "logits"})
    assert not OnnxToolFinder(low).find(picture()).any()


@pytest.mark.parametrize(
    ("tools", "expected"), [(None, "not red"), ((1,), "not red"), ((0,), "red"), ((1, 2), "not red")]
)
def test_onnx_finder_selects_tool_classes_by_score(tmp_path, tools, expected):
    nodes, parts = conv([[20, -10, -10], [-20, 10, 10], [0, 0, 0]], [-3, 3, -9])
    metadata = {} if tools is None else {"tool_classes": tools}
    mask = OnnxToolFinder(write(tmp_path / "net.onnx", nodes, parts, metadata=metadata)).find(picture())
    check(mask if expected == "not red" else 1 - mask)


def test_onnx_finder_single_channel_can_mean_tissue(tmp_path):
    check(1 - OnnxToolFinder(grey_network(tmp_path / "net.onnx", metadata={"tool_classes": [0]})).find(picture()))


@pytest.mark.parametrize("squeeze", [False, True])
def test_onnx_finder_accepts_class_map(tmp_path, squeeze):
    nodes, parts = conv([[20, -10, -10], [-20, 10, 10]], [-3, 3], output="scores")
    nodes.append(helper.make_node("ArgMax", ["scores"], ["map" if squeeze else "mask"], axis=1, keepdims=0))
    if squeeze:
        nodes.append(helper.make_node("Squeeze", ["map"], ["mask"]))
    path = write(tmp_path / "net.onnx", nodes, parts, output_type=TensorProto.INT64)
    check(OnnxToolFinder(path).find(picture()))


def test_onnx_finder_accepts_half_precision(tmp_path):
    nodes, parts = conv(*GREY)
    parts = [numpy_helper.from_array(numpy_helper.to_array(part).astype(np.float16), part.name) for part in parts]
    path = write(tmp_path / "net.onnx", nodes, parts, input_type=TensorProto.FLOAT16, output_type=TensorProto.FLOAT16)
    check(OnnxToolFinder(path).find(picture()))


@pytest.mark.parametrize("beside", [False, True])
def test_onnx_finder_reads_normalisation_from_metadata_or_sidecar_file(tmp_path, beside):
    """Settings in the sidecar file override those in the model."""
    settings = {"white": 255, "mean": [10, 20, 30], "std": [2, 4, 5], "channels": "bgr", "values": "logits"}
    # Blue first: the value is zero for one colour, and both sides of it are tried.
    nodes, parts = conv([[1.0, 0.0, 0.0]], [-(150 - 30) / 5])
    path = write(tmp_path / "net.onnx", nodes, parts, metadata={"white": 9.0} if beside else settings)
    if beside:
        (tmp_path / "net.onnx.json").write_text(json.dumps(settings))
    finder = OnnxToolFinder(path)
    assert finder.settings.white == 255
    assert finder.find(np.full((40, 40, 3), (0, 0, 149), np.uint8)).all()
    assert not finder.find(np.full((40, 40, 3), (255, 255, 151), np.uint8)).any()


def test_onnx_finder_uses_declared_size_for_dynamic_input(tmp_path):
    """The used size is visible from the resolution of the mask."""
    finder = OnnxToolFinder(grey_network(tmp_path / "net.onnx", size=("h", "w"), metadata={"size": [16, 16]}))
    image = np.full((160, 160, 3), (200, 60, 50), np.uint8)
    image[100:102, 100:102] = 128  # too small to be seen in a sixteenth
    assert finder.find(image).all()
    assert not OnnxToolFinder(grey_network(tmp_path / "b.onnx", size=("h", "w"))).find(image).all()


@pytest.mark.parametrize("classes", [1, 3])
def test_onnx_finder_treats_nan_as_tool_and_warns_once(tmp_path, caplog, classes):
    rows, bias = [[-20.0, 10.0, 10.0]] * classes, [3.0] * classes
    nodes, parts = conv(rows, bias, output="raw")
    nodes.append(helper.make_node("Sqrt", ["raw"], ["mask"]))  # of a negative number where the picture is red
    finder = OnnxToolFinder(write(tmp_path / "net.onnx", nodes, parts, metadata={"values": "logits"}))
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert not finder.find(picture()).any()
    assert finder.not_finite == 2 and len(caplog.records) == 1 and "gave NaN" in caplog.text
    assert finder.find(np.full((40, 40, 3), 128, np.uint8)).shape == (40, 40) and finder.not_finite == 2


def refused(path) -> str:
    with pytest.raises(InvalidSetting) as caught:
        OnnxToolFinder(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        ([1, 4, 32, 40], r"takes tensor(float) [1, 4, 32, 40]; it must take one picture"),
        ([1, 32, 40, 3], "it must take one picture"),
        ([2, 3, 32, 40], "it must take one picture"),
        ([3, 32, 40], "it must take one picture"),
        ([1, 3, 5000, 40], "takes pictures of 5000x40; at most 4096x4096 are supported"),
    ],
)
def test_onnx_finder_rejects_input_shapes(tmp_path, shape, sentence):
    node = helper.make_node("Identity", ["image"], ["mask"])
    assert sentence in refused(write(tmp_path / "net.onnx", [node], [], input_shape=shape))


def test_onnx_finder_rejects_input_type_and_count(tmp_path):
    node = helper.make_node("Identity", ["image"], ["mask"])
    path = write(tmp_path / "a.onnx", [node], [], input_type=TensorProto.UINT8, output_type=TensorProto.UINT8)
    assert "takes tensor(uint8)" in refused(path)
    two = helper.make_node("Add", ["image", "more"], ["mask"])
    assert "has 2 inputs" in refused(write(tmp_path / "b.onnx", [two], [], more_inputs=["more"]))


@pytest.mark.parametrize(
    ("operator", "options", "sentence"),
    [
        ("GlobalAveragePool", {}, "gives float32 [1, 3, 1, 1]"),
        ("Flatten", {}, "gives float32 [1, 3840]"),
        ("ReduceMean", {"keepdims": 0}, "gives float32 []"),
        ("Shape", {}, "gives int64 [4]"),
    ],
)
def test_onnx_finder_rejects_outputs_without_mask_shape(tmp_path, operator, options, sentence):
    kind = TensorProto.INT64 if operator == "Shape" else TensorProto.FLOAT
    node = helper.make_node(operator, ["image"], ["mask"], **options)
    path = write(tmp_path / "net.onnx", [node], [], output_type=kind)
    assert sentence in refused(path) and "it must give a mask" in refused(path)


@pytest.mark.parametrize(
    ("metadata", "sentence"),
    [
        ({"tool_classes": [1]}, None),
        ({"tool_classes": [2]}, "has 2 classes and tool_classes are [2]"),
        ({"tool_classes": [0, 1]}, "name at least one of 0 to 1 and not all"),
        ({"tool_classes": []}, "tool_classes"),
        ({"std": [0, 1, 1]}, "std.0: Input should be greater than 0"),
        ({"mean": [1]}, "mean"),
        ({"white": "255"}, "white: Input should be a valid number"),
        ({"size": [0, 99999]}, "size.0"),
        ({"threads": 1000}, "threads"),
        ({"treshold": 0.4}, "treshold: Extra inputs are not permitted"),
        ({"output": "depth"}, "has no output 'depth', only mask"),
        ([], "the object"),
    ],
)
def test_onnx_finder_rejects_invalid_settings(tmp_path, metadata, sentence):
    path = grey_network(tmp_path / "net.onnx", metadata=metadata)
    if sentence is None:
        OnnxToolFinder(path)
    else:
        assert sentence in refused(path)


@pytest.mark.parametrize("text", ["", "{", "NaN", '{"mean": [NaN, 0, 0]}', "[" * 10_000, "x" * 100_000])
def test_onnx_finder_rejects_broken_settings_file(tmp_path, text):
    path = grey_network(tmp_path / "net.onnx")
    (tmp_path / "net.onnx.json").write_text(text)
    refused(path)


def test_onnx_finder_reports_inference_failure(tmp_path):
    """The model declares any input size but accepts only one."""
    shape = numpy_helper.from_array(np.array([1, 3, 64, 64], np.int64), "shape")
    node = helper.make_node("Reshape", ["image", "shape"], ["mask"])
    assert "failed on a picture of 256x320" in refused(write(tmp_path / "net.onnx", [node], [shape], size=("h", "w")))


@pytest.mark.parametrize(
    "image", [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3), np.float32), np.zeros((0, 8, 3), np.uint8)]
)
def test_onnx_finder_rejects_arrays_other_than_rgb_uint8(tmp_path, image):
    finder = OnnxToolFinder(grey_network(tmp_path / "net.onnx"))
    with pytest.raises(InvalidInput, match=r"image must be RGB uint8 \[H, W, 3\]"):
        finder.find(image)


def test_onnx_finder_without_onnxruntime_names_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(
        InvalidSetting, match=r"needs the package onnxruntime .*install intrasplat with the extra `onnx`"
    ):
        OnnxToolFinder(grey_network(tmp_path / "net.onnx"))


@pytest.mark.parametrize(("threshold", "tool_at"), [(0.5, 0.0), (0.9, np.log(9)), (0.1, -np.log(9))])
def test_onnx_finder_threshold_compares_best_tool_and_best_other_class(tmp_path, threshold, tool_at):
    """For two classes the probability is the logistic function of the difference of the scores."""
    finder = OnnxToolFinder(grey_network(tmp_path / "net.onnx", metadata={"threshold": threshold, "values": "logits"}))
    for margin, is_tool in ((-0.1, False), (0.1, True)):
        single = np.full((1, 1, 8, 8), tool_at + margin, np.float32)
        assert (finder._score(single) >= 0).all() == is_tool
        scores = np.zeros((1, 4, 8, 8), np.float32)
        scores[0, :, :, :] = np.array([5, 5 + tool_at + margin, -9, 2 - 9 + tool_at])[:, None, None]
        assert (finder._score(scores) >= 0).all() == is_tool


def test_onnx_finder_compares_infinite_scores(tmp_path):
    finder = OnnxToolFinder(grey_network(tmp_path / "net.onnx"))
    scores = np.zeros((1, 3, 4, 4), np.float32)
    scores[0, 0], scores[0, 1:] = -np.inf, -np.inf
    scores[0, 1, :2], scores[0, 0, 2:] = np.inf, np.inf
    assert (finder._score(scores)[:2] > 0).all() and (finder._score(scores)[2:] < 0).all()


@pytest.mark.parametrize(
    ("image", "expected"),
    [((1024, 1280), (512, 640)), ((50, 100), (64, 96)), ((10, 10), (32, 32)), ((1280, 640), (640, 320))],
)
def test_onnx_network_dynamic_input_is_multiple_of_32_up_to_640(tmp_path, image, expected):
    network = OnnxToolFinder(grey_network(tmp_path / "net.onnx", size=("h", "w")))._network
    assert network.run(np.zeros((*image, 3), np.uint8)).shape[2:] == expected


def test_onnx_network_averages_when_reducing_image(tmp_path):
    nodes, parts = conv([[1.0, 0.0, 0.0]], [0.0])
    network = OnnxToolFinder(write(tmp_path / "net.onnx", nodes, parts))._network
    chequers = np.repeat(((np.indices((128, 160)).sum(0) % 2) * 255)[..., None], 3, axis=2).astype(np.uint8)
    np.testing.assert_allclose(network.run(chequers), 0.5, atol=0.01)


def test_onnx_finder_rejects_oversized_settings(tmp_path):
    path = grey_network(tmp_path / "net.onnx", metadata={"values": "logits", "output": 70_000 * "x"})
    assert f"{path}: metadata" in refused(path) and "is larger than 64 KiB" in refused(path)


@pytest.mark.parametrize(("threads", "opened"), [(1, [1]), (2, [1, 2]), (3, [1, 3])])
def test_onnx_session_reopened_only_for_more_threads(tmp_path, monkeypatch, threads, opened):
    import onnxruntime

    made, real = [], onnxruntime.InferenceSession

    def session(data, options, *arguments, **named):
        made.append(options.intra_op_num_threads)
        assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"
        return real(data, options, *arguments, **named)

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    check(OnnxToolFinder(grey_network(tmp_path / "net.onnx", metadata={"threads": threads})).find(picture()))
    assert made == opened
