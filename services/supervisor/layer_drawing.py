"""Renderer of an engine's additional pictures: depth, confidence and virtual camera view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.remembered import share_of
from gsplat_core.rendering.surface import certainty
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.scene.model import Model
from gsplat_core.scene.orbit import Orbit
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.transfers import HostCopy
from operators.display import draw_label
from operators.layer_pictures import DepthColours, confidence_picture, mark_unobserved, mark_virtual
from operators.messages import PictureState
from operators.rasterize import displayed
from operators.remembered import RememberedTissue
from services.bus.runtime import Layer

Picture = tuple[NDArray[np.uint8], dict[str, Any]]
"""RGB uint8 [H, W, 3], and header entries in addition to the scene's header."""


@dataclass(frozen=True)
class LayerScene:
    """Displayed scene, with the data needed to render additional layers."""

    model: Model | Snapshot
    """Model of the scene; referenced only while the scene exists."""
    camera: Camera
    """Camera of the endoscope or of the finished model."""
    time_s: float
    header: Mapping[str, Any]
    """Header of the displayed picture: `seq`, `pts_ns`, `arrived_ns`, `state`, `show`, `new`."""
    metric: bool = False
    """True if the scene's unit is known to be the millimetre."""
    planes: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    """Depth and opacity [H, W] from the camera, if rendered with the picture."""


class LayerDrawing:
    """Layer renderer for use in the thread that creates it. On a GPU it uses its own CUDA stream.

    Renders without CUDA graphs, because capturing a graph blocks other threads, and always by alpha
    blending.
    """

    def __init__(self, device: str) -> None:
        self.orbit = Orbit()
        """Position of the virtual camera; may be replaced from any thread."""
        self._depth = DepthColours()
        self._tissue = RememberedTissue()
        self._stream = torch.cuda.Stream() if device == "cuda" else None

    def draw(self, layer: Layer, scene: LayerScene) -> Picture:
        """Render one layer of a scene."""
        kinds: Mapping[Layer, Callable[[LayerScene], Picture]] = {
            "depth": self._draw_depth,
            "confidence": self._draw_confidence,
            "orbit": self._draw_orbit,
        }
        with torch.inference_mode(), self._own_stream():
            return kinds[layer](scene)

    def _draw_depth(self, scene: LayerScene) -> Picture:
        depth, alpha = self._planes(scene)
        image, legend = self._depth.picture(depth, alpha, scene.metric)
        return image, {"legend": legend.said()}

    def _draw_confidence(self, scene: LayerScene) -> Picture:
        gaussians, unseen_s = _at(scene)
        seen = render(_weighted(gaussians, unseen_s), scene.camera, depth=False)
        confidence, alpha = HostCopy(seen.image[..., 0].contiguous()).numpy(), HostCopy(seen.alpha).numpy()
        image, legend = confidence_picture(confidence, alpha)
        return image, {"legend": {**legend.said(), "counts": _counted(unseen_s)}}

    def _draw_orbit(self, scene: LayerScene) -> Picture:
        orbit = self.orbit
        if self._depth.median is None or scene.planes is not None:
            self._depth.look_at(*self._planes(scene))
        distance = self._depth.median or 1.0
        gaussians, unseen_s = _at(scene)
        camera = orbit.camera(scene.camera, distance)
        output = render(gaussians, camera, depth=False)
        image = np.array(displayed(output.image))
        if unseen_s is not None and bool((unseen_s > 0).any()):
            remembered = HostCopy((share_of(gaussians, unseen_s > 0, camera) > 0.5).to(torch.uint8) * 255).numpy()
            self._tissue.mark(image, remembered)
        unobserved = mark_unobserved(image, HostCopy(output.alpha).numpy())
        where = f"az {orbit.azimuth_deg:+.0f}  el {orbit.elevation_deg:+.0f}  x{orbit.zoom:.1f}"
        mark_virtual(image, f"VIRTUAL VIEW  {where}")
        said = {"azimuth_deg": orbit.azimuth_deg, "elevation_deg": orbit.elevation_deg, "zoom": orbit.zoom}
        return image, {"virtual": said, "unobserved_share": round(unobserved, 4)}

    def _planes(self, scene: LayerScene) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if scene.planes is not None:
            return scene.planes
        output = _rendered(scene)
        return HostCopy(output.depth).numpy(), HostCopy(output.alpha).numpy()

    def _own_stream(self) -> AbstractContextManager[Any]:
        return nullcontext() if self._stream is None else torch.cuda.stream(self._stream)


def label(image: NDArray[np.uint8], layer: Layer, state: PictureState, age_ns: int) -> None:
    """Draw state and age into a picture, in place. A virtual view is never labelled LIVE, because
    no camera observed it."""
    if layer != "orbit" or state is not PictureState.LIVE:
        draw_label(image, state, age_ns)


def _at(scene: LayerScene) -> tuple[Gaussians, torch.Tensor | None]:
    """Return the Gaussians at the scene's time and the unseen time of each in seconds, None if
    unknown."""
    model = scene.model
    unseen_s = model.unseen_s() if isinstance(model, Snapshot) else model.unseen_s
    return model.at(scene.time_s), unseen_s


def _rendered(scene: LayerScene) -> RenderOutput:
    return render(_at(scene)[0], scene.camera)


def _weighted(gaussians: Gaussians, unseen_s: torch.Tensor | None) -> Gaussians:
    """Return the Gaussians with confidence as colour: 1 if visible or unknown, decreasing with the
    unseen time."""
    weight = gaussians.means.new_ones(gaussians.count)
    if unseen_s is not None:
        weight = certainty(unseen_s).to(gaussians.dtype)
    colours = ((weight - 0.5) / SH_C0)[:, None, None].expand(-1, 1, 3).contiguous()
    return replace(gaussians, sh=colours)


def _counted(unseen_s: torch.Tensor | None) -> str:
    return "opacity" if unseen_s is None else "opacity, time since it was seen"
