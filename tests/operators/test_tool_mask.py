"""Masks are taken from the recording, found or omitted, and the report states which."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper

from gsplat_core.endoscope.tools import NetworkToolFinder
from gsplat_core.errors import InvalidSetting
from operators.outcome import OutcomeBuilder
from operators.tool_mask import (
    BELIEVED_FRAMES,
    LEAST_TISSUE,
    TOOL_MASKS,
    FoundMasks,
    FoundToolMaskOp,
    RecordedToolMaskOp,
    built_in_finder,
    check_tool_mask,
    new_tool_mask,
)
from tests.gsplat_core.endoscope.tool_pictures import with_rod


def notes(operator):
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome.notes


def test_recorded_tool_mask_is_unchanged(frame, compute):
    mask = np.zeros((16, 24), np.uint8)
    operator = RecordedToolMaskOp(None)
    operator.start()
    (passed,) = compute(operator, frame=frame(0, mask=mask))
    assert passed.mask is mask
    assert notes(operator) == ()


def test_missing_recorded_mask_counts_all_pixels_as_tissue_with_one_note(frame, compute, caplog):
    operator = RecordedToolMaskOp(None)
    operator.start()
    with caplog.at_level(logging.WARNING):
        for k in range(3):
            (passed,) = compute(operator, frame=frame(k))
            assert passed.mask.shape == (16, 24) and passed.mask.all()
    assert len(caplog.records) == 1 and "frame 0 has no tool mask" in caplog.text
    assert notes(operator) == ("3 frames had no tool mask; all of their pixels counted as tissue",)


class FakeFinder:
    """Finds the whole upper half, and says what it was asked."""

    def __init__(self) -> None:
        self.calls: list[object] = []

    def find(self, image):
        self.calls.append(image)
        mask = np.ones(image.shape[:2], np.uint8)
        mask[: len(mask) // 2] = 0
        return mask

    def reset(self):
        self.calls.append("reset")


def found_masks(operator):
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome.find(FoundMasks)


def test_found_tool_mask_keeps_recorded_mask(frame, compute):
    finder = FakeFinder()
    operator = FoundToolMaskOp(None, make_finder=lambda: finder, method="fake")
    operator.start()
    recorded = np.zeros((16, 24), np.uint8)
    (kept,) = compute(operator, frame=frame(0, mask=recorded))
    assert kept.mask is recorded and finder.calls == []
    source = frame(1)
    (found,) = compute(operator, frame=source)
    assert found.mask.mean() == 0.5 and found.image is source.image
    assert found_masks(operator) == FoundMasks("fake", found=1, recorded=1, tool_share=0.5)


def test_tool_finder_resets_at_new_scene_and_start(frame, compute):
    finder = FakeFinder()
    operator = FoundToolMaskOp(None, make_finder=lambda: finder, method="fake")
    operator.start()
    compute(operator, frame=frame(0))
    compute(operator, frame=frame(1, new_scene="cut", mask=np.ones((16, 24), np.uint8)))
    assert finder.calls[1:] == ["reset"]
    operator.start()
    assert found_masks(operator) == FoundMasks("fake", 0, 0, 0.0)


def test_tool_mask_none_ignores_recorded_mask(frame, compute):
    (passed,) = compute(new_tool_mask(None, "none"), frame=frame(0, mask=np.zeros((16, 24), np.uint8)))
    assert passed.mask.all()


@pytest.mark.parametrize("method", ["builtin", "classical"])
def test_tool_detectors_find_grey_tool(frame, compute, method):
    image = np.full((128, 160, 3), (190, 90, 70), np.uint8)
    image[50:90, 60:] = (120, 124, 128)
    operator = new_tool_mask(None, method)
    operator.start()
    (found,) = compute(operator, frame=frame(0, image=image))
    assert found.mask[55:85, 65:].max() == 0 and found.mask[:40].min() == 1
    assert found_masks(operator).method == method


def test_builtin_tool_mask_falls_back_to_colour_without_network(frame, compute, monkeypatch, caplog):
    monkeypatch.setattr("gsplat_core.endoscope.tools.NETWORK", Path("missing.onnx"))
    operator = new_tool_mask(None, "builtin")
    with caplog.at_level(logging.WARNING):
        operator.start()
    assert "the tool network cannot be loaded on cpu" in caplog.text and "found by colour" in caplog.text
    (found,) = compute(operator, frame=frame(0, image=np.full((64, 64, 3), (190, 90, 70), np.uint8)))
    assert found.mask.all()


@pytest.mark.parametrize(
    "error", [RuntimeError("CUDA error: out of memory"), InvalidSetting("its operator Mish is not supported")]
)
def test_tool_network_falls_back_to_cpu_on_gpu_error(frame, compute, monkeypatch, caplog, error):
    asked = []

    def fail(path, device):
        asked.append(str(device))
        raise error

    monkeypatch.setattr("gsplat_core.endoscope.tool_network_torch.TorchToolNetwork", fail)
    operator = new_tool_mask(None, "builtin", device="cuda")
    with caplog.at_level(logging.WARNING):
        operator.start()
    assert asked == ["cuda"] and f"the tool network cannot be loaded on cuda: {error}" in caplog.text
    assert "found by colour" not in caplog.text
    image = with_rod(256, 320)[0]
    (found,) = compute(operator, frame=frame(0, image=image))
    assert (found.mask == NetworkToolFinder().find(image)).all() and not found.mask.all()


def test_tool_network_is_loaded_at_initialize_and_reloaded_at_restart():
    made = []
    operator = FoundToolMaskOp(
        None, name="tool_mask", make_finder=lambda: made.append(FakeFinder()) or made[-1], method="fake"
    )
    operator.initialize()
    assert len(made) == 1
    operator.start()
    assert len(made) == 1 and operator._finder is made[0]
    operator.stop()
    operator.start()
    assert len(made) == 2 and operator._finder is made[1]


def test_tool_network_programming_error_is_raised(monkeypatch):
    def fail(path, device):
        raise TypeError("a bug")

    monkeypatch.setattr("gsplat_core.endoscope.tool_network_torch.TorchToolNetwork", fail)
    with pytest.raises(TypeError, match="a bug"):
        new_tool_mask(None, "builtin", device="cuda").start()


def test_tool_network_runs_on_cpu_by_default(monkeypatch):
    devices = []

    def made(*, device):
        devices.append(device)
        return FakeFinder()

    monkeypatch.setattr("operators.tool_mask.NetworkToolFinder", made)
    new_tool_mask(None, "builtin").start()
    new_tool_mask(None, "builtin", device="cuda").start()
    built_in_finder()
    assert devices == ["cpu", "cuda", "cpu"]


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ("magic", "unknown tool mask 'magic'; known are recorded, builtin, classical, onnx, none"),
        ("", "unknown tool mask ''"),
        ("onnx", "tool mask 'onnx' needs the path of a model: onnx:PATH"),
        ("onnx:missing.onnx", "tool network missing.onnx cannot be read"),
        ("builtin:fast", "tool mask 'builtin' takes nothing after its name, got 'fast'"),
    ],
)
def test_tool_mask_refuses_unknown_choice(choice, sentence):
    for refuse in (check_tool_mask, lambda choice: new_tool_mask(None, choice)):
        with pytest.raises(InvalidSetting, match=sentence):
            refuse(choice)


def test_every_tool_mask_operator_has_frame_ports():
    for choice in TOOL_MASKS:
        if choice != "onnx":
            operator = new_tool_mask(None, choice, "mask")
            assert operator.name == "mask"
            assert list(operator.spec.inputs) == list(operator.spec.outputs) == ["frame"]


def network(path: Path, *nodes: Any) -> Path:
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 16, 24])
    mask = helper.make_tensor_value_info("mask", TensorProto.FLOAT, None)
    graph = helper.make_graph(list(nodes), "tools", [image], [mask])
    opset = [helper.make_opsetid("", 17)]
    path.write_bytes(helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString())
    return path


def test_onnx_tool_mask_loads_network_from_path(frame, compute, tmp_path):
    """The network marks the pixels that are brightest in blue as tool."""
    path = network(tmp_path / "my:net.onnx", helper.make_node("Softmax", ["image"], ["mask"], axis=1))
    check_tool_mask(f"onnx:{path}")
    operator = new_tool_mask(None, f"onnx:{path}")
    operator.start()
    image = np.full((16, 24, 3), (200, 60, 50), np.uint8)
    image[:, 12:] = (50, 60, 200)
    (found,) = compute(operator, frame=frame(0, image=image))
    assert found.mask[:, :10].all() and not found.mask[:, 14:].any()
    assert found_masks(operator).method == "onnx"
    operator.stop()
    operator.start()
    assert found_masks(operator).found == 0


def test_onnx_tool_mask_notes_nan_frames(frame, compute, tmp_path):
    """Log gives NaN for a negative number, which the picture's values less one are."""
    path = tmp_path / "net.onnx"
    (tmp_path / "net.onnx.json").write_text('{"mean": [1.5, 1.5, 1.5]}')
    operator = new_tool_mask(None, f"onnx:{network(path, helper.make_node('Log', ['image'], ['mask']))}")
    operator.start()
    (found,) = compute(operator, frame=frame(0))
    assert not found.mask.any()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.notes == ("the tool network gave NaN for 1 frames; all of their pixels counted as tool",)


class Says:
    """Tool finder whose masks have prepared tissue shares, one per frame."""

    def __init__(self, *shares):
        self.shares = list(shares)

    def reset(self): ...

    def find(self, image):
        mask = np.zeros(image.shape[:2], np.uint8)
        mask[: round(self.shares.pop(0) * len(mask))] = 1
        return mask


def tissue_shares(frame, compute, *shares, **fields):
    operator = FoundToolMaskOp(None, make_finder=lambda: Says(*shares), method="fake", doubts=True)
    operator.start()
    frames = [frame(k, image=np.zeros((100, 60, 3), np.uint8), **fields.get(str(k), {})) for k in range(len(shares))]
    found = [float(compute(operator, frame=each)[0].mask.mean()) for each in frames]
    return found, operator


def test_all_tool_mask_is_disbelieved_from_start_of_stream(frame, compute):
    found, operator = tissue_shares(frame, compute, *[0.0] * 5, 0.01)
    assert found == [1.0] * 6
    assert found_masks(operator) == FoundMasks("fake", 6, 0, 0.0, 6)
    assert "in 6 frames everything looked like a tool" in " ".join(notes(operator))


def test_all_tool_mask_after_tissue_is_believed_for_limited_frames(frame, compute):
    found, operator = tissue_shares(frame, compute, 0.5, *[0.0] * BELIEVED_FRAMES, 0.0, 0.0, 0.02, 0.0)
    assert found == [0.5] + [0.0] * BELIEVED_FRAMES + [1.0, 1.0, 0.02, 0.0]
    assert found_masks(operator).disbelieved == 2


def test_new_scene_resets_tool_mask_belief_and_withheld_frames_are_ignored(frame, compute):
    found, _ = tissue_shares(frame, compute, 0.5, 0.0, 0.0, 0.0, **{"2": {"new_scene": "cut"}})
    assert found == [0.5, 0.0, 1.0, 1.0]
    found, operator = tissue_shares(frame, compute, 0.0, 0.0, **{"0": {"withheld": "out of body"}})
    assert found == [0.0, 1.0] and found_masks(operator).disbelieved == 1


@pytest.mark.parametrize(("share", "is_noted"), [(0.4, True), (0.6, False)])
def test_note_on_pictures_taken_mostly_for_tools(frame, compute, share, is_noted):
    _, operator = tissue_shares(frame, compute, *[share] * 4)
    assert any("60% of the pictures were taken for tools" in note for note in notes(operator)) == is_noted


class SaysPixels:
    """Finds a mask with so many tissue pixels of 384."""

    def __init__(self):
        self.tissue, self.resets = 0, 0

    def find(self, image):
        mask = np.zeros(image.shape[:2], np.uint8)
        mask.reshape(-1)[: self.tissue] = 1
        return mask

    def reset(self):
        self.resets += 1


def doubting(doubts=True):
    finder = SaysPixels()
    operator = FoundToolMaskOp(None, make_finder=lambda: finder, method="says", doubts=doubts)
    operator.start()
    return operator, finder


def tissue(operator, compute, frame, **fields):
    (given,) = compute(operator, frame=frame(**fields))
    return int(given.mask.sum())


def test_all_tool_mask_is_believed_for_ten_frames_after_tissue(frame, compute):
    operator, finder = doubting()
    assert BELIEVED_FRAMES == 10
    assert tissue(operator, compute, frame) == 384  # nothing showed tissue before
    finder.tissue = 384
    assert tissue(operator, compute, frame) == 384
    finder.tissue = 0
    assert [tissue(operator, compute, frame) for _ in range(12)] == [0] * 10 + [384] * 2
    finder.tissue = 100
    assert tissue(operator, compute, frame) == 100
    finder.tissue = 0
    assert tissue(operator, compute, frame) == 0
    assert tissue(operator, compute, frame, new_scene="cut") == 384 and finder.resets == 1
    assert tissue(operator, compute, frame, withheld="black") == 0
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    result = outcome.find(FoundMasks)
    assert (result.method, result.found, result.recorded, result.disbelieved) == ("says", 18, 0, 4)
    assert result.tool_share == pytest.approx((10 + 284 / 384 + 1 + 1) / 18)
    note, more = outcome.notes
    assert note.startswith("in 4 frames everything looked like a tool")
    assert more.startswith("71% of the pictures were taken for tools") and "--tool-mask none" in more


def test_tool_mask_with_least_tissue_is_believed(frame, compute):
    least = int(np.ceil(LEAST_TISSUE * 384))
    operator, finder = doubting()
    finder.tissue = least
    assert tissue(operator, compute, frame) == least
    operator, finder = doubting()
    finder.tissue = least - 1
    assert tissue(operator, compute, frame) == 384
    operator, finder = doubting(doubts=False)
    assert tissue(operator, compute, frame) == 0
