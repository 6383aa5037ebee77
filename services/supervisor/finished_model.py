"""A finished model, ready to be shown at any time of a stream."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.bundle import load_bundle
from gsplat_core.rendering.registry import new_renderer
from operators.applications.limits import check_picture
from operators.rasterize import displayed
from services.bus.errors import CommandRefused
from services.supervisor.layer_drawing import LayerScene


class NotFinite(InvalidInput):
    """A picture of a model holds values that are no numbers."""


class FinishedModel:
    """A model from a bundle with a renderer of its own, which one thread at a time uses.

    Making it draws a picture, so that the first one that is shown takes no longer than others. Raises BundleError, CommandRefused.
    """

    def __init__(self, folder: Path, name: str, version: int, *, device: str, renderer: str) -> None:
        self.name, self.version = name, version
        self._model = load_bundle(folder).to(device)
        self._camera = self._model.camera
        check_picture(self._camera, 1.0)
        self._renderer = new_renderer(renderer, self._camera, torch.device(device))
        self._renderer.prepare(self._model)
        try:
            self.picture(0.0)
        except NotFinite as error:
            raise CommandRefused(str(error)) from None

    def at(self, stream_s: float) -> float:
        """The model's time at a time of the stream: its window over and over."""
        start_s, end_s = self._model.time_window_s
        return start_s + math.fmod(max(0.0, stream_s), end_s - start_s) if end_s > start_s else start_s

    def scene(self, stream_s: float, header: Mapping[str, Any]) -> LayerScene:
        """What the picture of that time shows, for drawing more of it. A bundle does not say what its unit is."""
        return LayerScene(self._model, self._camera, self.at(stream_s), header)

    def picture(self, stream_s: float) -> NDArray[np.uint8]:
        """RGB uint8 [H, W, 3] by the model's camera. Raises NotFinite."""
        time_s = self.at(stream_s)
        with torch.inference_mode():
            image = self._renderer.render(self._camera, time_s, ("image",)).result().image
            # A renderer leaves out what is not finite: the Gaussians themselves tell more than the picture.
            drawn = (image, *self._model.at(time_s).tensors().values())
            if not all(bool(torch.isfinite(values).all()) for values in drawn):
                raise NotFinite(
                    f"{self.name} {self.version} has values that are not finite at {time_s:.3f} s of its time"
                )
            return displayed(image).copy()
