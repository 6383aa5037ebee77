"""Loading, checking and running of a user's ONNX model that takes one picture, on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Generic

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx_file import read_model
from gsplat_core.endoscope.onnx_settings import Settings, read_settings
from gsplat_core.errors import InvalidInput, InvalidSetting

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
        """Return the error for an unusable network; `why` continues the sentence after its name."""
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
    # Waiting threads sleep, since the CPU is shared with training.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Named explicitly, because one of the default providers sends its input to a remote service.
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
