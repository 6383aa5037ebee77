"""Loading, checking and running of a user's ONNX model that takes one picture, on the CPU, and tool segmentation by such a model.

Files are read without the onnx package and bounded in size. A model can store weights in other files named by path.
Loading them would let a foreign model read any file of the machine. Such models are rejected, and the runtime gets
bytes instead of a path. Input and output conventions come from the model's metadata or from a JSON file next to it.

Protobuf messages are read without their schema.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.files import read_regular

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Wire types of protobuf fields: how the bytes of a value are encoded."""


def fields(message: memoryview) -> Iterator[tuple[int, int | bytes | memoryview]]:
    """Yield number and value of a message's fields, in order.

    Values are integers, `bytes` for fields of 4 and 8 bytes, and a `memoryview` for length-delimited fields.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    at = 0
    while at < len(message):
        tag, at = varint(message, at)
        field, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            number, at = varint(message, at)
            yield field, number
            continue
        if wire == _BYTES:
            length, at = varint(message, at)
        elif wire in (_FIXED64, _FIXED32):
            length = 8 if wire == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if field == 0 or at + length > len(message):
            raise ValueError("it ends too early")
        value = message[at : at + length]
        yield field, value if wire == _BYTES else bytes(value)
        at += length


def values(message: memoryview, *path: int) -> list[Any]:
    """Return the values of all fields at a path of field numbers, of which all but the last are messages.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    found: list[Any] = [message]
    for number in path:
        found = [value for each in found for field, value in fields(each) if field == number]
    return found


def varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return the integer of variable length at position `at`, and the position after it.

    Raises:
        ValueError: if it does not end, or has more than 64 bits.
    """
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("it ends too early")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number of more than 64 bits")


MOST_BYTES = 512 * 2**20
MOST_NESTING = 64
_EXTERNAL_DATA, _DATA_LOCATION, _EXTERNAL = 13, 14, 1
"""Field numbers in onnx.proto of a tensor's external data and its location, and the location value for external data.
"""
_PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
"""Field numbers that lead from an ONNX message to nested messages with tensors, with the type of the nested message, by message
type (onnx.proto, IR version 13).
"""


def read_model(path: Path, what: str) -> bytes:
    """Read an ONNX file.

    Args:
        path: the file.
        what: description of the model for error messages, such as "tool network".

    Raises:
        InvalidSetting: for an unreadable or invalid file, one that is too large, or one with external data.
    """
    try:
        data = read_regular(path, MOST_BYTES)
    except OSError as error:
        raise InvalidSetting(f"{what} {path} cannot be read ({error.strerror or error}); give an ONNX file") from error
    try:
        external = has_external_data(data)
    except ValueError as error:
        raise InvalidSetting(f"{what} {path} is no ONNX model ({error}); export it again") from error
    if external:
        raise InvalidSetting(
            f"{what} {path} keeps data in other files, which are not opened;"
            " export it as one file (torch.onnx.export(..., external_data=False))"
        )
    return data


def has_external_data(data: bytes) -> bool:
    """Return True if a tensor of a model has external data.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    waiting: list[tuple[str, memoryview, int]] = [("model", memoryview(data), 0)]
    while waiting:
        kind, message, depth = waiting.pop()
        if depth > MOST_NESTING:
            raise ValueError(f"graphs inside each other more than {MOST_NESTING} deep")
        for field, value in fields(message):
            if kind == "tensor":
                if field == _EXTERNAL_DATA or (field == _DATA_LOCATION and value == _EXTERNAL):
                    return True
            elif field in _PARTS[kind] and isinstance(value, memoryview):
                waiting.append((_PARTS[kind][field], value, depth + 1))
    return False


METADATA_KEY = "intrasplat"
"""Metadata key whose value is a JSON object with the fields of the settings."""
MOST_SETTINGS_BYTES = 1 << 16
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=16, le=4096)]
ClassIndex = Annotated[int, Field(ge=0, lt=4096)]


class PictureSettings(BaseModel):
    """Settings of a picture network that cannot be derived from its tensor shapes."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    white: Positive = 1.0
    """Value of a white pixel before normalisation by `mean` and `std`, usually 1 or 255."""
    mean: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Mean that is subtracted from each channel after scaling to `white`, red first."""
    std: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    channels: Literal["rgb", "bgr"] = "rgb"
    """Channel order of the network's input."""
    size: tuple[Side, Side] | None = None
    """Input height and width in pixels if the network has no fixed size; None to derive them from the picture's size."""
    output: str | None = None
    """Name of the output; None for the first one."""
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    """Number of CPU threads for running the network."""


class ToolSettings(PictureSettings):
    """Settings of a tool segmentation network."""

    values: Literal["auto", "logits", "probability"] = "auto"
    """Kind of a single-channel output. `auto` is probability if three trial pictures give no value outside 0..1."""
    tool_classes: Annotated[tuple[ClassIndex, ...], Field(min_length=1)] | None = None
    """Tool classes; None for all but 0. A single channel is the score of class 1; [0] declares it as tissue."""
    threshold: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Probability from which a pixel is tool. With several classes it compares the most likely tool class with the most
    likely other class. Below 0.5 fewer tools are missed and more tissue is lost.
    """


Settings = TypeVar("Settings", bound=PictureSettings)


def read_settings(path: Path, metadata: Mapping[str, str], kind: type[Settings]) -> Settings:
    """Read the settings of the network at `path` from `path` + `.json`, else from its metadata, else return defaults.

    Raises:
        InvalidSetting: for unreadable or invalid settings.
    """
    beside = path.with_name(path.name + ".json")
    if beside.exists():
        try:
            text = read_regular(beside, MOST_SETTINGS_BYTES)
        except OSError as error:
            raise InvalidSetting(f"{beside} cannot be read ({error.strerror or error})") from error
        where = str(beside)
    elif METADATA_KEY in metadata:
        text, where = metadata[METADATA_KEY].encode(), f"{path}: metadata {METADATA_KEY!r}"
    else:
        return kind()
    if len(text) > MOST_SETTINGS_BYTES:
        raise InvalidSetting(f"{where} is larger than {MOST_SETTINGS_BYTES >> 10} KiB; it should be a few lines")
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the object"
        raise InvalidSetting(f"{where}: {place}: {first['msg']}") from error


LONG_SIDE_PX = 640
"""Longest side in pixels for networks without a fixed or configured input size."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxNetwork(Generic[Settings]):
    """ONNX model with one input, a float picture [1, 3, h, w]. Callers check the output.

    Pictures are RGB uint8 arrays [H, W, 3] of any size.
    """

    def __init__(self, path: Path, what: str, settings: type[Settings], *, multiple_px: int = 32) -> None:
        """Load a model.

        Args:
            path: the file.
            what: description for error messages, such as "tool network".
            settings: type of the settings.
            multiple_px: granularity of the input size for models that accept any size.

        Raises:
            InvalidSetting: for a model that cannot be used.
        """
        self.path, self.what, self.multiple_px = path, what, multiple_px
        self._session, self.settings = self._load(settings)
        self._input = self._checked_input()
        self._output = self._checked_output()

    def run(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """Run the network on a picture and return its raw output.

        Raises:
            InvalidInput: for an array that is no picture.
            InvalidSetting: if the network fails on it.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
        height, width = self._size(*image.shape[:2])
        smaller = height * width < image.shape[0] * image.shape[1]
        picture = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        settings = self.settings
        values = picture.astype(np.float32) * np.float32(settings.white / 255)
        scaled: Any = (values - np.array(settings.mean, np.float32)) / np.array(settings.std, np.float32)
        if settings.channels == "bgr":
            scaled = scaled[..., ::-1]
        planes = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None], _TYPES[self._input.type])
        try:
            (output,) = self._session.run([self._output], {self._input.name: planes})
        except Exception as error:
            raise self.refused(f"failed on a picture of {height}x{width} ({_first_line(error)})") from error
        return np.asarray(output)

    def refused(self, why: str) -> InvalidSetting:
        """Return the exception for an unusable network. `why` is the predicate of the message's sentence, such as "has two inputs"."""
        return InvalidSetting(f"{self.what} {self.path} {why}")

    def _size(self, height: int, width: int) -> tuple[int, int]:
        """Return the height and width to which a picture is resized."""
        fixed = self._input.shape[2:]
        if all(isinstance(side, int) and side > 0 for side in fixed):
            return fixed[0], fixed[1]
        if self.settings.size is not None:
            return self.settings.size
        scale, step = min(1.0, LONG_SIDE_PX / max(height, width)), self.multiple_px
        rows, columns = (max(1, round(side * scale / step)) * step for side in (height, width))
        return rows, columns

    def _checked_input(self) -> Any:
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise self.refused(f"has {len(inputs)} inputs; it must have one, the picture")
        (only,) = inputs
        shape = list(only.shape)
        fits = len(shape) == 4 and shape[0] in (1, None) + ((shape[0],) if isinstance(shape[0], str) else ())
        if not fits or (isinstance(shape[1], int) and shape[1] != 3) or only.type not in _TYPES:
            raise self.refused(f"takes {only.type} {shape}; it must take one picture, float [1, 3, height, width]")
        if any(isinstance(side, int) and side > 4096 for side in shape[2:]):
            raise self.refused(f"takes pictures of {shape[2]}x{shape[3]}; at most 4096x4096 are supported")
        return only

    def _checked_output(self) -> str:
        names = [output.name for output in self._session.get_outputs()]
        wanted = self.settings.output
        if wanted is not None and wanted not in names:
            raise self.refused(f"has no output {wanted!r}, only {', '.join(names)}")
        return str(wanted or names[0])

    def _load(self, kind: type[Settings]) -> tuple[Any, Settings]:
        """Create a runtime session and read the settings."""
        try:
            import onnxruntime
        except ImportError as error:
            raise InvalidSetting(
                f"a {self.what} needs the package onnxruntime ({error}); install intrasplat with the extra `onnx`"
            ) from error
        data = read_model(self.path, self.what)
        try:
            # The settings, including the number of threads, may be inside the model, so it is first
            # opened with one thread.
            session = _session(onnxruntime, data, 1)
            settings = read_settings(self.path, session.get_modelmeta().custom_metadata_map, kind)
            if settings.threads > 1:
                session = _session(onnxruntime, data, settings.threads)
        except InvalidSetting:
            raise
        except Exception as error:
            raise self.refused(f"cannot be loaded ({_first_line(error)}); export it again") from error
        return session, settings


def _session(onnxruntime: Any, data: bytes, threads: int) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Let waiting threads sleep, because training uses the same CPU.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Name the provider explicitly. One of the default providers sends its input to a remote service.
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


log = logging.getLogger(__name__)

TRIAL_SIZE_PX = (256, 320)
SMALLEST_MASK_PX = 4
"""Smallest side of an output mask in pixels; smaller outputs are those of a classifier."""


class OnnxToolFinder:
    """Tool segmentation with an ONNX model on the CPU.

    The model has one input, a float picture [1, 3, h, w]. Its output is [1, 1, h', w'] logits or probabilities, [1, K,
    h', w'] scores of K >= 2 classes, or [1, h', w'] or [h', w'] with integer classes or a single float channel.
    `ToolSettings` describes the conventions. A picture whose output contains NaN counts as tool everywhere.
    """

    def __init__(self, path: Path) -> None:
        """Load a tool model and run it once on trial pictures.

        Raises:
            InvalidSetting: for a model that cannot be used.
        """
        self._network = OnnxNetwork(path, "tool network", ToolSettings)
        self.settings = self._network.settings
        self._probability = self._tried()
        self.not_finite = 0
        """Number of pictures with NaN in the output."""

    def reset(self) -> None:
        """Do nothing, since no state is kept between pictures."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment a picture RGB uint8 [H, W, 3]. Returns uint8 [H, W], 1 = tissue, 0 = tool; 0 everywhere if the network
        gives NaN.

        Raises:
            InvalidInput: for an array that is no picture.
            InvalidSetting: if the network fails on it.
        """
        score = self._score(self._network.run(image))
        height, width = image.shape[:2]
        if np.isnan(score).any():
            if self.not_finite == 0:
                log.warning("tool network %s gave NaN; such pictures count as tool everywhere", self._network.path)
            self.not_finite += 1
            return np.zeros((height, width), np.uint8)
        large = np.asarray(cv2.resize(score, (width, height), interpolation=cv2.INTER_LINEAR))
        return (large < 0).astype(np.uint8)

    def _score(self, output: NDArray[Any]) -> NDArray[np.float32]:
        """Return a score [h, w], at least 0 on tools; NaN where the network returned NaN."""
        planes = output[0] if output.ndim == 4 else output.reshape(1, *output.shape[-2:])
        tools = self.settings.tool_classes
        if np.issubdtype(planes.dtype, np.integer):
            is_tool = planes[0] != 0 if tools is None else np.isin(planes[0], tools)
            return np.where(is_tool, 1, -1).astype(np.float32)
        planes = planes.astype(np.float32)
        threshold = self.settings.threshold
        if len(planes) == 1:
            sign = -1 if tools == (0,) else 1
            if self._probability:
                chance = planes[0] if sign > 0 else 1 - planes[0]
                return np.asarray(chance - np.float32(threshold), np.float32)
            return np.asarray(sign * planes[0] - np.float32(np.log(threshold / (1 - threshold))), np.float32)
        chosen = np.zeros(len(planes), np.bool_)
        chosen[list(range(1, len(planes)) if tools is None else tools)] = True
        if np.isnan(planes).any():
            return np.full(planes.shape[1:], np.nan, np.float32)
        # The difference of two infinite scores, for example of a mask inside the network, would be NaN.
        planes = np.clip(planes, -1e30, 1e30)
        ahead = planes[chosen].max(axis=0) - planes[~chosen].max(axis=0)
        return np.asarray(ahead - np.float32(np.log(threshold / (1 - threshold))), np.float32)

    def _tried(self) -> bool:
        """Try the network on three pictures, check its output shape, and return True if a single
        channel is a probability.
        """
        noise = np.random.default_rng(0).integers(0, 256, (*TRIAL_SIZE_PX, 3), np.uint8)
        outputs = [self._network.run(picture) for picture in (noise, np.zeros_like(noise), np.full_like(noise, 255))]
        shape = outputs[0].shape
        classes = shape[1] if len(shape) == 4 else 1
        fits = (len(shape) in (3, 4) and shape[0] == 1) or len(shape) == 2
        kind = outputs[0].dtype
        sides = shape[-2:] if len(shape) > 1 else (0,)
        if not fits or min(sides) < SMALLEST_MASK_PX or max(shape) > 4096 or not np.issubdtype(kind, np.number):
            raise self._network.refused(
                f"gives {kind} {list(shape)}; it must give a mask: [1, 1, h, w], [1, classes, h, w], [1, h, w] or [h, w]"
            )
        if np.issubdtype(kind, np.integer):
            if classes != 1:
                raise self._network.refused(f"gives {kind} {list(shape)}; scores of classes must be floats")
        else:
            self._check_classes(max(2, classes))
        if self.settings.values != "auto":
            return self.settings.values == "probability"
        finite = [output[np.isfinite(output)] for output in outputs]
        return all(not part.size or (part.min() >= 0 and part.max() <= 1) for part in finite)

    def _check_classes(self, count: int) -> None:
        tools = set(self.settings.tool_classes or (1,))
        if max(tools) >= count or len(tools) == count:
            raise self._network.refused(
                f"has {count} classes and tool_classes are {sorted(tools)}; name at least one of 0 to {count - 1} and not all"
            )
