"""Tools found by a network of the user's, an ONNX model."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx_file import read_model
from gsplat_core.endoscope.onnx_settings import NetworkSettings, read_settings
from gsplat_core.errors import InvalidInput, InvalidSetting

log = logging.getLogger(__name__)

LONG_SIDE_PX, MULTIPLE_PX = 640, 32
"""Pictures for a network that takes any size, and for which no size is stated: at most this long, a multiple of this."""
TRIAL_SIZE_PX = (256, 320)
SMALLEST_MASK_PX = 4
"""What is smaller is the answer of a network that says what a picture shows, not where."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxToolFinder:
    """Runs an ONNX model on each picture, on the processor.

    The model has one input, a float picture [1, 3, h, w], and an output that says where tools are: [1, 1, h', w'] logits or probabilities,
    [1, K, h', w'] a score for each of K >= 2 classes, or [1, h', w'] or [h', w'], integers for a class each and otherwise as one channel.
    `NetworkSettings` says the rest. A picture whose output has a NaN is tool everywhere.
    """

    def __init__(self, path: Path) -> None:
        """Loads the model and tries it out. Raises InvalidSetting, with a sentence, for what cannot be used."""
        self.path = path
        self._session, self.settings = _load(path)
        self._input = self._checked_input()
        self._output = self._checked_output()
        self._probability = self._tried_out()
        self.not_finite = 0
        """Pictures for which a NaN came out."""

    def reset(self) -> None:
        """Nothing is remembered from picture to picture."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The mask of a picture: RGB uint8 [H, W, 3] to uint8 [H, W], 1 = tissue, 0 = tool.

        Raises InvalidInput for another array, InvalidSetting where the network fails on it.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
        height, width = image.shape[:2]
        score = self._score(self._run(image))
        if np.isnan(score).any():
            if self.not_finite == 0:
                log.warning("tool network %s gave NaN; such pictures count as tool everywhere", self.path)
            self.not_finite += 1
            return np.zeros((height, width), np.uint8)
        large = np.asarray(cv2.resize(score, (width, height), interpolation=cv2.INTER_LINEAR))
        return (large < 0).astype(np.uint8)

    def _run(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """The raw output for a picture."""
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
            raise self._refused(f"failed on a picture of {height}x{width} ({_first_line(error)})") from error
        return np.asarray(output)

    def _score(self, output: NDArray[Any]) -> NDArray[np.float32]:
        """[h, w], 0 or more where there is a tool; NaN where the network gave NaN."""
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
        # Infinite scores, as of a mask inside the network, would cancel to NaN.
        planes = np.clip(planes, -1e30, 1e30)
        ahead = planes[chosen].max(axis=0) - planes[~chosen].max(axis=0)
        return np.asarray(ahead - np.float32(np.log(threshold / (1 - threshold))), np.float32)

    def _size(self, height: int, width: int) -> tuple[int, int]:
        """What a picture is resized to."""
        fixed = self._input.shape[2:]
        if all(isinstance(side, int) and side > 0 for side in fixed):
            return fixed[0], fixed[1]
        if self.settings.size is not None:
            return self.settings.size
        scale = min(1.0, LONG_SIDE_PX / max(height, width))
        rows, columns = (max(1, round(side * scale / MULTIPLE_PX)) * MULTIPLE_PX for side in (height, width))
        return rows, columns

    def _checked_input(self) -> Any:
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise self._refused(f"has {len(inputs)} inputs; it must have one, the picture")
        (only,) = inputs
        shape = list(only.shape)
        fits = len(shape) == 4 and shape[0] in (1, None) + ((shape[0],) if isinstance(shape[0], str) else ())
        if not fits or (isinstance(shape[1], int) and shape[1] != 3) or only.type not in _TYPES:
            raise self._refused(f"takes {only.type} {shape}; it must take one picture, float [1, 3, height, width]")
        if any(isinstance(side, int) and side > 4096 for side in shape[2:]):
            raise self._refused(f"takes pictures of {shape[2]}x{shape[3]}; at most 4096x4096 are given")
        return only

    def _checked_output(self) -> str:
        names = [output.name for output in self._session.get_outputs()]
        wanted = self.settings.output
        if wanted is not None and wanted not in names:
            raise self._refused(f"has no output {wanted!r}, only {', '.join(names)}")
        return str(wanted or names[0])

    def _tried_out(self) -> bool:
        """Whether an output with one channel is a probability, after three trial pictures have shown that the network gives a mask."""
        noise = np.random.default_rng(0).integers(0, 256, (*TRIAL_SIZE_PX, 3), np.uint8)
        outputs = [self._run(picture) for picture in (noise, np.zeros_like(noise), np.full_like(noise, 255))]
        shape = outputs[0].shape
        classes = shape[1] if len(shape) == 4 else 1
        fits = (len(shape) in (3, 4) and shape[0] == 1) or len(shape) == 2
        kind = outputs[0].dtype
        sides = shape[-2:] if len(shape) > 1 else (0,)
        if not fits or min(sides) < SMALLEST_MASK_PX or max(shape) > 4096 or not np.issubdtype(kind, np.number):
            raise self._refused(
                f"gives {kind} {list(shape)}; it must give a mask: [1, 1, h, w], [1, classes, h, w], [1, h, w] or [h, w]"
            )
        if np.issubdtype(kind, np.integer):
            if classes != 1:
                raise self._refused(f"gives {kind} {list(shape)}; scores of classes must be floats")
        else:
            self._check_classes(max(2, classes))
        if self.settings.values != "auto":
            return self.settings.values == "probability"
        finite = [output[np.isfinite(output)] for output in outputs]
        return all(not part.size or (part.min() >= 0 and part.max() <= 1) for part in finite)

    def _check_classes(self, count: int) -> None:
        tools = set(self.settings.tool_classes or (1,))
        if max(tools) >= count or len(tools) == count:
            raise self._refused(
                f"has {count} classes and tool_classes are {sorted(tools)}; name at least one of 0 to {count - 1} and not all"
            )

    def _refused(self, what: str) -> InvalidSetting:
        return InvalidSetting(f"tool network {self.path} {what}")


def _load(path: Path) -> tuple[Any, NetworkSettings]:
    """A session of the runtime for a file, and its settings."""
    try:
        import onnxruntime
    except ImportError as error:
        raise InvalidSetting(
            f"a tool network needs the package onnxruntime ({error}); install intrasplat with the extra `onnx`"
        ) from error
    data = read_model(path)
    try:
        # The settings, the number of threads among them, may be in the model: it is opened with one thread to read them.
        session = _session(onnxruntime, data, 1)
        settings = read_settings(path, session.get_modelmeta().custom_metadata_map)
        if settings.threads > 1:
            session = _session(onnxruntime, data, settings.threads)
    except InvalidSetting:
        raise
    except Exception as error:
        raise InvalidSetting(f"tool network {path} cannot be loaded ({_first_line(error)}); export it again") from error
    return session, settings


def _session(onnxruntime: Any, data: bytes, threads: int) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Waiting threads sleep: the processor is shared with training.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Named, because one of the providers that are there by default sends what it is given to a service.
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
