"""Interface of all renderers of published models, their creation by name, and their additional outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Literal, Protocol, cast, get_args

import torch
from torch import Tensor

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.models import Model, Snapshot, TrainedBy
from gsplat_core.ops.arguments import require_shape
from gsplat_core.rendering.rasterization import RenderOutput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

Precision = Literal["fp32", "fp16"]
STANDARD_OUTPUTS = RenderOutput._fields
"""Default outputs of a frame: `image`, `alpha`, `depth`."""
DepthOrder = Literal["splat", "pixel"]
Storage = Literal["raw", "prepared", "quantised"]
MOST_SAMPLES = 1 << 20
MOST_SUPERSAMPLING = 8
PROGRESSIVE_SAMPLES = 4096
"""Number of samples per sub-pixel after which a progressive picture is complete and gains none."""


@dataclass(frozen=True)
class RendererOptions:
    """Options of individual renderers; `Capabilities.options` names those that a renderer has.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    samples: int = 16
    """Random samples per pixel of a frame."""
    supersampling: int = 1
    """Sub-pixels per pixel and axis."""
    order: DepthOrder = "splat"
    """Depth that decides which splat is in front: of the splat's centre, or of its plane at each pixel."""
    seed: int = 0
    """Seed of all random numbers; equal seeds give equal bytes."""
    progressive: bool = False
    """True adds the samples of consecutive frames of the same model, camera and time, up to `PROGRESSIVE_SAMPLES`."""
    storage: Storage = "raw"
    """Format of the splats that the renderer reads.

    `raw` shares the model's memory and is the only one for moving models. `prepared` has precomputed covariances and no
    splats of an opacity below 1/255. `quantised` takes 16 bytes per splat and one per further colour coefficient.
    """

    def __post_init__(self) -> None:
        for name, most in (("samples", MOST_SAMPLES), ("supersampling", MOST_SUPERSAMPLING)):
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise InvalidSetting(f"{name} must be from 1 to {most}, got {value}")
        for name, known in (("order", get_args(DepthOrder)), ("storage", get_args(Storage))):
            if getattr(self, name) not in known:
                raise InvalidSetting(f"unknown {name} {getattr(self, name)!r}; choose {' or '.join(known)}")
        if not 0 <= self.seed < 1 << 63:
            raise InvalidSetting(f"seed must be from 0 to 2^63 - 1, got {self.seed}")

    def changed(self) -> tuple[str, ...]:
        """Return the names of the options whose values are not the defaults."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) != field.default)


@dataclass(frozen=True)
class Capabilities:
    """Features of a renderer, available before it is created."""

    outputs: tuple[str, ...]
    """Names of the outputs, including `image`.

    Those of `RenderOutput` have its shapes and units. A renderer documents its other outputs.
    """
    precisions: Mapping[str, tuple[Precision, ...]]
    """Supported device types (`cpu`, `cuda`) with their precisions, the most exact one first."""
    differentiable: bool
    """True if the renderer trains scenes: its registry entry is a `TrainableRenderer`."""
    deterministic: bool
    """True if equal model, camera and time give bit-identical results on one device."""
    reads_snapshots: bool = False
    """True if `prepare` accepts a `Snapshot`; otherwise it receives an immutable `Model` copy."""
    options: tuple[str, ...] = ()
    """Fields of `RendererOptions` that the renderer has.

    A renderer with at least one receives the `RendererOptions` as the keyword argument `options`.
    """

    @property
    def devices(self) -> tuple[str, ...]:
        """Supported device types."""
        return tuple(self.precisions)


class PendingFrame(Protocol):
    """Requested frame, on a GPU possibly still in flight; holds its source data while referenced."""

    def outputs(self) -> Mapping[str, Tensor]:
        """Return the requested outputs by name; waits for the frame on a GPU.

        The renderer owns the memory and may reuse it for its next frame. Copy outputs that must persist.
        """

    def result(self) -> RenderOutput:
        """Return the three standard outputs; outputs that were not requested are 0 (unknown)."""


class Renderer(Protocol):
    """Interface of renderers for published models, with one camera size and projection per instance.

    Create with `new_renderer`. Call `prepare` for every published model, then `render` any number of times. Not
    thread-safe.
    """

    capabilities: ClassVar[Capabilities]

    def __init__(
        self, camera: Camera, device: torch.device, *, precision: Precision = "fp32", background: Tensor | None = None
    ) -> None:
        """Create a renderer.

        Args:
            camera: size and projection of every frame.
            device: device of the model's tensors.
            precision: arithmetic precision.
            background: colour [3] behind the Gaussians; None for black.
        """

    def prepare(self, model: Model | Snapshot) -> None:
        """Set the model of the following frames.

        Work that does not depend on camera and time is done here, without host synchronisation.
        """

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        """Enqueue the picture of the prepared model on the current stream.

        Args:
            camera: camera with the size and projection given at construction.
            time_s: time in seconds, clamped to the model's window.
            outputs: names of the requested outputs.

        Raises:
            InvalidSetting: if the renderer does not have an output.
            InvalidInput: for a camera of another size or projection, or without a prepared model.
        """


class RendererKind(Protocol):
    """Registry entry of a renderer, usually its class."""

    @property
    def capabilities(self) -> Capabilities:
        """Features, available before a renderer is created."""

    def __call__(
        self, camera: Camera, device: torch.device, *, precision: Precision = "fp32", background: Tensor | None = None
    ) -> Renderer:
        """Create a renderer; the caller has checked the arguments against `capabilities`."""


class TrainableRenderer(RendererKind, Protocol):
    """Registry entry of a renderer that trains scenes by autograd."""

    @property
    def rates(self) -> Mapping[str, float]:
        """Learning rates, by name, of the renderer's tensors in `Gaussians.extra` and of the logarithms of its scene-wide
        scalars (`first_values`).
        """

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the renderer's tensors in `extra`. Tensors that are already there stay unchanged."""

    def first_values(self, distance: float) -> Mapping[str, float]:
        """Return initial values, all positive, of the renderer's scalars for the whole scene, by name.

        Args:
            distance: typical distance from the camera to the scene, in the scene's unit.
        """

    def picture(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor | None,
        values: Mapping[str, Tensor],
        depth: bool = True,
    ) -> RenderOutput:
        """Render a picture that is differentiable in the Gaussians' tensors and in the scene-wide scalars `values`.

        Args:
            gaussians: scene, `extended`.
            camera: camera of the picture.
            background: colour [3]; None for black.
            values: values of the whole scene by name.
            depth: False skips the depth, which is then 0 (unknown).
        """


def check_trained_by(name: str, model: Model | Snapshot, shown: str = "alpha") -> None:
    """Check that the renderer `name` can show a model, which must have been trained by the renderer `shown`.

    Raises:
        InvalidSetting: otherwise.
    """
    trained_by = model.trained_by.renderer if isinstance(model, Model) else TrainedBy().renderer
    if trained_by != shown:
        raise InvalidSetting(
            f"renderer {name!r} cannot show this model, which was trained by {trained_by!r}; choose renderer {trained_by!r}"
        )


@dataclass(frozen=True)
class FinishedFrame:
    """`PendingFrame` that is complete on creation."""

    _outputs: Mapping[str, Tensor]

    def outputs(self) -> Mapping[str, Tensor]:
        """Return the rendered images of the frame by output name."""
        return self._outputs

    def result(self) -> RenderOutput:
        """Return the three standard outputs of the frame."""
        return standard_outputs(self._outputs)


def standard_outputs(outputs: Mapping[str, Tensor]) -> RenderOutput:
    """Return the three standard outputs, with zeros for missing ones; `image` is required."""
    image = outputs["image"]
    unknown = image.new_zeros(image.shape[:2])
    return RenderOutput(image, outputs.get("alpha", unknown), outputs.get("depth", unknown))


def checked_outputs(name: str, asked: Iterable[str], capabilities: Capabilities) -> tuple[str, ...]:
    """Return `image` and the requested outputs in the renderer's order.

    Raises:
        InvalidSetting: if the renderer does not have an output.
    """
    wanted = {"image", *asked}
    for output in sorted(wanted - set(capabilities.outputs)):
        raise InvalidSetting(f"renderer {name!r} has no output {output!r}; it has {', '.join(capabilities.outputs)}")
    return tuple(output for output in capabilities.outputs if output in wanted)


def check_choice(name: str, capabilities: Capabilities, device: torch.device, precision: str) -> None:
    """Raise InvalidSetting if the renderer does not support the device or precision."""
    if precision not in get_args(Precision):
        raise InvalidSetting(f"unknown precision {precision!r}; choose {' or '.join(get_args(Precision))}")
    if device.type not in capabilities.precisions:
        raise InvalidSetting(
            f"renderer {name!r} does not run on {device.type}, only on {', '.join(capabilities.devices)}"
        )
    known = capabilities.precisions[device.type]
    if precision not in known:
        raise InvalidSetting(
            f"renderer {name!r} does not render in {precision} on {device.type}, only in {', '.join(known)}"
        )


def check_camera(wanted: Camera, camera: Camera) -> None:
    """Raise InvalidInput if `camera` has another size or projection than the renderer."""
    made_for, given = ((c.width_px, c.height_px, c.model) for c in (wanted, camera))
    if given != made_for:
        raise InvalidInput(
            f"this renderer makes {made_for[0]}x{made_for[1]} {made_for[2]} pictures, the camera is"
            f" {given[0]}x{given[1]} {given[2]}; make another renderer for it"
        )


def check_background(background: Tensor | None) -> None:
    """Raise InvalidInput unless the background is None or one colour [3]."""
    if background is not None:
        require_shape("background", background, (3,), "[3]")


def check_renderer(
    name: str,
    device: torch.device | str = "cpu",
    precision: str = "fp32",
    options: RendererOptions | None = None,
) -> None:
    """Check that a renderer exists and supports the device, the precision and all options that are not the defaults.

    Raises:
        InvalidSetting: otherwise.
    """
    capabilities = RENDERERS[name].capabilities
    check_choice(name, capabilities, torch.device(device), precision)
    for option in () if options is None else options.changed():
        if option not in capabilities.options:
            having = [other for other in RENDERERS if option in RENDERERS[other].capabilities.options]
            raise InvalidSetting(
                f"renderer {name!r} has no option {option}; choose {' or '.join(having) or 'the default'}"
            )


def picture_of(
    model: Model, gaussians: Gaussians, camera: Camera, background: Tensor | None = None, depth: bool = True
) -> RenderOutput:
    """Render Gaussians by the renderer that trained a model, with its values. Differentiable in the Gaussians.

    Args:
        model: model whose `trained_by` names the renderer.
        gaussians: the model's Gaussians at one time, or a change of them.
        camera: camera of the picture.
        background: colour [3]; None for black.
        depth: False skips the depth, which is then 0 (unknown).
    """
    kind = cast(TrainableRenderer, RENDERERS[model.trained_by.renderer])
    values = {name: gaussians.means.new_tensor(value) for name, value in model.trained_by.values.items()}
    return kind.picture(gaussians, camera, background, values, depth)


def new_renderer(
    name: str,
    camera: Camera,
    device: torch.device | str = "cpu",
    *,
    precision: Precision = "fp32",
    background: Tensor | None = None,
    options: RendererOptions | None = None,
) -> Renderer:
    """Create a renderer by name for the camera's size and projection.

    Raises:
        InvalidSetting: for an unknown name, or an unsupported device, precision or option.
    """
    check_renderer(name, device, precision, options)
    check_background(background)
    kind: Callable[..., Renderer] = RENDERERS[name]
    own = {"options": options or RendererOptions()} if RENDERERS[name].capabilities.options else {}
    return kind(camera, torch.device(device), precision=precision, background=background, **own)


@dataclass(frozen=True)
class OutputKind:
    """Meaning of an output, one value or vector per pixel."""

    description: str
    unit: str
    """Unit of the values; empty for numbers without a unit."""
    channels: int | None
    """Number of values per pixel; 1 is an image [H, W], 3 is [H, W, 3]. None if it depends on the model."""
    differentiable: bool
    """True if training can use the output: a function of `gsplat_core.rendering` returns it with gradients."""


RAY_DEPTH = OutputKind(
    "Expected depth z where each ray is closest to the centres of the Gaussians' densities; 0 where unobserved",
    "scene unit", 1, True,
)  # fmt: skip
MEDIAN_DEPTH = OutputKind(
    "Depth z of the Gaussian at which transmittance falls to 1/2; 0 if it never does", "scene unit", 1, True
)
NORMALS = OutputKind("Blended shortest axes of the Gaussians, towards the camera", "", 3, True)
DEPTH_NORMALS = OutputKind("Normals of the surface of ray_depth; 0 at edges", "", 3, True)
SPREAD = OutputKind("Standard deviation of depth along the ray", "scene unit", 1, False)
CONFIDENCE = OutputKind("Opacity, reduced where tissue has not been seen for long", "", 1, False)
SEMANTICS = OutputKind("Blended logits of the classes of a model that was trained with labels", "", None, True)
FLOW = OutputKind(
    "Motion of the surface to the right and down within `FLOW_STEP_S`, for a camera at rest", "px", 2, True
)
OCCLUSION = OutputKind(
    "1 where the surface is hidden or outside of the picture after `FLOW_STEP_S`, else 0", "", 1, False
)

FLOW_STEP_S = 1 / 30
"""Interval in seconds over which the outputs `flow` and `occlusion` show motion."""
FLOW_OUTPUTS = ("flow", "occlusion")
"""Names of the outputs that `render_motion` computes."""
SURFACE_OUTPUTS = (
    "ray_depth", "normals", "median_depth", "spread", "confidence", "depth_normals", "semantics",
)  # fmt: skip
"""Names of the outputs that `render_surface` computes, in the order of `Surface`."""
