"""Deformation of the model to a frame's timestamp, rendering from the frame's camera, and prediction of frames before training on them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import RENDERERS
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.renderer import STANDARD_OUTPUTS, Renderer, RendererOptions, new_renderer, standard_outputs
from gsplat_core.scene.frames import Frame
from gsplat_core.transfers import HostCopy
from operators.graph import Operator, OperatorSpec
from operators.messages import DeformedScene, Prediction, Reconstruction, RenderedFrame


class DeformOp(Operator):
    """Deforms the model to its frame's timestamp and sets the camera to the frame's pose.

    On a GPU the renderer's captured graph performs the deformation, so this operator only selects the camera.

    Inputs:
        reconstruction: `Reconstruction`.

    Outputs:
        scene: `DeformedScene`.
    """

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("reconstruction", type=Reconstruction)
        spec.output("scene", type=DeformedScene)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        message: Reconstruction = op_input.receive("reconstruction")
        frame, model = message.frame, message.model
        camera = model.camera if frame.pose is None else model.camera.with_pose(frame.pose)
        if model.device.type == "cpu":
            with torch.inference_mode():
                model.at(frame.time_s)  # caches the deformed Gaussians inside the model; the renderer reuses them
        op_output.emit(DeformedScene(frame, model, camera, message.trained, message), "scene")


def displayed(image: torch.Tensor) -> NDArray[np.uint8]:
    """Convert a float image [H, W, 3] in 0..1 to uint8 RGB on the host, clipped and rounded to nearest."""
    return _displayed(image).numpy()


def _displayed(image: torch.Tensor) -> HostCopy:
    # Converted on the device, to transfer one byte per channel instead of four.
    return HostCopy((image.clamp(0, 1) * 255).round().to(torch.uint8))


def without_surround(picture: NDArray[np.uint8], frame: Frame) -> NDArray[np.uint8]:
    """Return a picture of a frame's view, black outside of the field of view and under a recorder's overlay.

    Nothing is trained there, so a rendered picture has arbitrary colours.
    """
    if frame.loss_mask is None or frame.withheld is not None:
        return picture
    return np.asarray(cv2.bitwise_and(picture, picture, mask=frame.loss_mask), np.uint8)


class Rasterizer:
    """Renders colour, depth and opacity. Not thread-safe.

    On a GPU, work is queued on a high-priority stream, ahead of training queued for later frames.
    The calling thread blocks until the picture is in page-locked host memory.
    """

    def __init__(self, renderer: str, options: RendererOptions | None = None, outputs: Sequence[str] = ()) -> None:
        """Create the operator for one renderer.

        Args:
            renderer: name in `gsplat_core.choices.RENDERERS`.
            options: options of the renderer; None for its defaults.
            outputs: outputs in addition to the standard ones.
        """
        self.renderer, self._options = renderer, options
        self._further = tuple(name for name in outputs if name not in STANDARD_OUTPUTS)
        self._made: Renderer | None = None
        self._made_for: tuple[int, int, str, torch.device] | None = None
        self._stream: torch.cuda.Stream | None = None

    def draw(self, scene: DeformedScene) -> RenderedFrame:
        """Render a scene. Blocks until picture, depth and opacity are on the host."""
        with torch.inference_mode(), self._own_stream(scene.model):
            picture, found = self._render(scene, (*STANDARD_OUTPUTS, *self._further))
            output = standard_outputs(found)
            # Queue all three copies before waiting for the first.
            image, depth, alpha = _displayed(picture), HostCopy(output.depth), HostCopy(output.alpha)
            made_from = scene.reconstruction
            return RenderedFrame(
                frame=scene.frame,
                image=without_surround(image.numpy(), scene.frame),
                depth=depth.numpy(),
                alpha=alpha.numpy(),
                model_version=scene.model.version,
                trained=scene.trained,
                steps=0 if made_from is None else made_from.steps,
                content=None if made_from is None else made_from.content,
                taken_ns=None if made_from is None else made_from.taken_ns,
                published_ns=None if made_from is None else made_from.published_ns,
                outputs={name: HostCopy(found[name].float()).numpy() for name in self._further},
            )

    def picture(self, scene: DeformedScene) -> NDArray[np.uint8]:
        """Render only the picture of a scene, uint8 RGB [H, W, 3]."""
        with torch.inference_mode(), self._own_stream(scene.model):
            return without_surround(_displayed(self._render(scene, ("image",))[0]).numpy(), scene.frame)

    def _render(self, scene: DeformedScene, outputs: Iterable[str]) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Render a scene. Return the image and all outputs."""
        renderer = self._renderer_for(scene)
        reads_snapshots = RENDERERS[self.renderer].capabilities.reads_snapshots
        renderer.prepare(scene.model if reads_snapshots else scene.model.as_model())
        found = renderer.render(scene.camera, scene.time_s, outputs).outputs()
        return found["image"], found

    def _renderer_for(self, scene: DeformedScene) -> Renderer:
        camera = scene.camera
        wanted = camera.width_px, camera.height_px, camera.model, scene.model.device
        if self._made is None or self._made_for != wanted:
            self._made = new_renderer(self.renderer, camera, scene.model.device, options=self._options)
            self._made_for = wanted
        return self._made

    def _own_stream(self, model: Model | Snapshot) -> AbstractContextManager[Any]:
        if model.device.type != "cuda":
            return nullcontext()
        if self._stream is None:
            self._stream = torch.cuda.Stream(model.device, priority=-1)
        if isinstance(model, Model):
            # A `Model` has no CUDA event for its completion, so wait for the whole stream. A snapshot synchronises by
            # itself.
            self._stream.wait_stream(torch.cuda.current_stream(model.device))
        return cast(AbstractContextManager[Any], torch.cuda.stream(self._stream))


class RasterizeOp(Operator):
    """Renders colour, depth and opacity of each scene.

    On a GPU this operator's thread blocks until the picture is on the host (see `Rasterizer`). With
    `predict_every` the previous scene's model is also rendered at the time and pose of the current
    frame, which that model was not trained on. Each picture is emitted before its prediction.

    Inputs:
        scene: `DeformedScene`.

    Outputs:
        rendered: `RenderedFrame`.
        predicted: `Prediction` for each frame, if `predict_every` is set; its image may be None.

    Params:
        renderer: name in `gsplat_core.choices.RENDERERS`.
        renderer_options: `RendererOptions`; None for the renderer's defaults.
        outputs: outputs of `RenderedFrame.outputs`.
        predict_every: predict one in this many frames; 0 disables prediction.
        rasterizer: warm rasterizer owned by this operator from now on; None creates one.
    """

    renderer: str
    renderer_options: RendererOptions | None
    outputs: tuple[str, ...]
    predict_every: int

    def __init__(self, fragment: Any, *args: Any, rasterizer: Rasterizer | None = None, **kwargs: Any) -> None:
        self._rasterizer = rasterizer
        self._before: DeformedScene | None = None
        self._drawn = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("scene", type=DeformedScene)
        spec.output("rendered", type=RenderedFrame)
        spec.output("predicted", type=Prediction, optional=True)
        spec.param("renderer", "alpha")
        spec.param("renderer_options", None)
        spec.param("outputs", ())
        spec.param("predict_every", 0)

    def start(self) -> None:
        self._before, self._drawn = None, 0

    def stop(self) -> None:
        # Release the model and the GPU memory that both reference.
        self._rasterizer = self._before = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        if self._rasterizer is None:
            self._rasterizer = Rasterizer(self.renderer, self.renderer_options, self.outputs)
        scene: DeformedScene = op_input.receive("scene")
        op_output.emit(self._rasterizer.draw(scene), "rendered")
        if self.predict_every:
            op_output.emit(self._prediction(scene, self._rasterizer), "predicted")

    def _prediction(self, scene: DeformedScene, rasterizer: Rasterizer) -> Prediction:
        before, self._before = self._before, scene
        self._drawn += 1
        if before is None or self._drawn % self.predict_every or not _is_predictable(before, scene):
            return Prediction(scene.frame, None)
        return Prediction(scene.frame, rasterizer.picture(replace(scene, model=before.model, reconstruction=None)))


def _is_predictable(before: DeformedScene, scene: DeformedScene) -> bool:
    """Return True if a prediction from `before` can be scored on the frame of `scene`.

    The frame must belong to the same scene as that of `before` and have the same picture size, and must be neither
    withheld nor damaged.
    """
    frame, earlier = scene.frame, before.frame
    continues = frame.new_scene is None and frame.scene == earlier.scene and frame.image.shape == earlier.image.shape
    return frame.unusable is None and continues
