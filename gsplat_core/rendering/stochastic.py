"""Stochastic transparency (StochasticSplats, ICCV 2025): a `Renderer` without sorting, for very large models."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.models.model import Model
from gsplat_core.models.snapshots import Snapshot
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.stochastic import Method, SplatScene, new_sums, picture_of, sample_splats
from gsplat_core.rendering.prepared import prepared_splats, quantised_splats, raw_splats
from gsplat_core.rendering.renderer import (
    PROGRESSIVE_SAMPLES,
    STANDARD_OUTPUTS,
    Capabilities,
    FinishedFrame,
    PendingFrame,
    Precision,
    RendererOptions,
    Storage,
    check_camera,
    check_trained_by,
    checked_outputs,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

STORAGES: dict[Storage, Callable[[Gaussians], SplatScene]] = {
    "raw": raw_splats,
    "prepared": prepared_splats,
    "quantised": quantised_splats,
}


class SampledRenderer:
    """Renderer that averages random samples of a scene; base of `StochasticRenderer` and `PointRenderer`.

    The outputs are `image`, `alpha` (share of samples that hit a splat) and `depth` (mean z of these samples). Memory in
    addition to the model is the frame buffer and a queue of fixed size, for any number of Gaussians.
    """

    name: ClassVar[str]
    method: ClassVar[Method]
    capabilities: ClassVar[Capabilities]

    def __init__(
        self,
        camera: Camera,
        device: torch.device,
        *,
        precision: Precision = "fp32",
        background: Tensor | None = None,
        options: RendererOptions | None = None,
    ) -> None:
        self._options = options or RendererOptions()
        if self._options.order == "pixel" and camera.model != "pinhole":
            raise InvalidSetting(f"order pixel needs a pinhole camera, not {camera.model}; choose order splat")
        if device.type == "cuda" and CUDA_MISSING is not None:
            raise InvalidSetting(f"renderer {self.name!r} needs the CUDA kernels, which are {CUDA_MISSING}")
        self._camera, self._device, self._background = camera, device, background
        self._model: Model | None = None
        self._scene: SplatScene | None = None
        """Splats of a model that does not move, in the chosen storage."""
        self._sums: Tensor | None = None
        """Sums of the samples so far, for progressive frames."""
        self._drawn = 0
        """Number of samples in the sums."""
        self._shown: tuple[Model, Camera, float] | None = None

    @property
    def samples_drawn(self) -> int:
        """Number of samples per sub-pixel in the last frame."""
        return self._drawn

    def prepare(self, model: Model | Snapshot) -> None:
        """Set the model of the following frames. Raises InvalidInput for a model on another device or trained by
        another renderer.
        """
        if model.device.type != self._device.type:
            raise InvalidInput(f"this renderer is made for {self._device.type}, the model is on {model.device}")
        check_trained_by(self.name, model)
        model = model.as_model()
        if self._options.storage != "raw" and model.field is not None:
            raise InvalidSetting(
                f"storage {self._options.storage} needs a model that does not move; choose storage raw"
            )
        self._model, self._scene = model, None
        if model.field is None:
            with torch.no_grad():
                self._scene = STORAGES[self._options.storage](model.gaussians)

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        """Enqueue the sampled picture of the prepared model; see `Renderer.render`."""
        asked = checked_outputs(self.name, outputs, self.capabilities)
        check_camera(self._camera, camera)
        if self._model is None:
            raise InvalidInput("no model was prepared; call prepare(model) before render()")
        with torch.no_grad():
            static = self._model.field is None
            shown = self._model, camera, 0.0 if static else self._model.clamp_time(time_s)
            if self._sums is None or not self._options.progressive or shown != self._shown:
                self._sums, self._drawn, self._shown = new_sums(camera, self._model.device), 0, shown
            if self._drawn < PROGRESSIVE_SAMPLES or not self._options.progressive:
                self._sample(self._scene or raw_splats(self._model.at(time_s)), camera, self._sums)
                self._drawn += self._options.samples
            factor = self._options.supersampling
            picture = picture_of(self._sums, self._drawn * factor * factor, self._background)
        return FinishedFrame({name: tensor for name, tensor in picture._asdict().items() if name in asked})

    def _sample(self, scene: SplatScene, camera: Camera, sums: Tensor) -> None:
        options = self._options
        sample_splats(
            scene,
            camera,
            sums,
            method=self.method,
            first_sample=self._drawn,
            samples=options.samples,
            supersampling=options.supersampling,
            seed=options.seed,
            pixel_order=options.order == "pixel",
        )


class StochasticRenderer(SampledRenderer):
    """Renderer in which every covered pixel draws against each splat's alpha; its expectation is alpha blending.

    The standard error halves with four times the samples. `order="pixel"` orders splats by their planes' depth at each
    pixel, which removes popping.
    """

    name = "stochastic"
    method = "fragments"
    capabilities = Capabilities(
        outputs=STANDARD_OUTPUTS,
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "supersampling", "order", "seed", "progressive", "storage"),
    )
