"""Finished model that can be rendered at any time of a stream."""

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
from services.errors import CommandRefused
from services.supervisor.layer_drawing import LayerScene


class NotFinite(InvalidInput):
    """A rendered picture contains non-finite values."""


class FinishedModel:
    """Model from a bundle, with its own renderer. For use by one thread at a time.

    The constructor renders a picture as warm-up.

    Raises:
        BundleError: if the bundle cannot be loaded.
        CommandRefused: if the warm-up picture is not finite.
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
        """Map a stream time to the model's time window, looping.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            Model time in seconds.
        """
        start_s, end_s = self._model.time_window_s
        return start_s + math.fmod(max(0.0, stream_s), end_s - start_s) if end_s > start_s else start_s

    def scene(self, stream_s: float, header: Mapping[str, Any]) -> LayerScene:
        """Return the scene at a stream time for the layer pictures. Not metric, because bundles
        state no unit."""
        return LayerScene(self._model, self._camera, self.at(stream_s), header)

    def picture(self, stream_s: float) -> NDArray[np.uint8]:
        """Render the model through its own camera.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            RGB uint8 [H, W, 3].

        Raises:
            NotFinite: if the picture or the Gaussians have non-finite values.
        """
        time_s = self.at(stream_s)
        with torch.inference_mode():
            image = self._renderer.render(self._camera, time_s, ("image",)).result().image
            # The renderer skips non-finite Gaussians, so the picture alone would not show them.
            drawn = (image, *self._model.at(time_s).tensors().values())
            if not all(bool(torch.isfinite(values).all()) for values in drawn):
                raise NotFinite(
                    f"{self.name} {self.version} has values that are not finite at {time_s:.3f} s of its time"
                )
            return displayed(image).copy()
