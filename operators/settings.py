"""Options of the engine. Each option is declared once, here.

Sections group the options; `ReplayOptions`, `LiveOptions` and the other classes at the end combine the sections for one use.
An option is a field with its type, range, unit, description and the commands that it applies to. The arguments of
`intrasplat`, the streams of the settings file, the requests of the REST API, stored jobs, the specifications of stream
processes and the forms of the console are derived from these fields.

A new option is one field of a section, and its use in the operator or application that needs it. An option whose name is a
field of `ReconstructorConfig` reaches the reconstructor without further code.

`TOOL_MASKS` and `SINKS` are the registries of the operators that a user selects by name.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from gsplat_core.choices import (
    DEPTHS,
    DEPTHS_WITH_ADDRESS,
    FIELDS,
    LOSSES,
    OUTPUTS,
    RENDERERS,
    STANDARD,
    STRATEGIES,
    Eyes,
    check_losses,
    check_outputs,
    check_renderer_options,
    check_strategy,
)
from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry
from operators.graph.application import Engine
from operators.options import Command, Declared, Names, Option, Section, for_callers, listed, options_for, options_of

if TYPE_CHECKING:
    from gsplat_core.rendering.renderer import RendererOptions
    from operators.graph import Operator

TOOL_MASKS: Registry[Callable[[Any, str, str], Operator]] = Registry(
    "tool mask",
    {
        "recorded": "operators.tool_mask:recorded_tool_mask",
        "builtin": "operators.tool_mask:builtin_tool_mask",
        "classical": "operators.tool_mask:classical_tool_mask",
        "onnx": "operators.tool_mask:onnx_tool_mask",
        "none": "operators.tool_mask:no_tool_mask",
    },
)
"""Factories of tool mask operators, by method.

A factory takes the fragment, the operator's name and the text after the colon of the setting, or "". It raises a
UserError for an invalid text. Input and output of the operator are named `frame`.
"""
TOOL_MASKS_WITH_ADDRESS = {"onnx": "onnx:FILE"}
"""Tool mask methods that are followed by a colon and an address, with an example of the syntax."""

SINKS: Registry[Callable[[Any, str, Any], Operator]] = Registry(
    "sink",
    {
        "video": "operators.sinks.video:video_sink",
        "keyframes": "operators.sinks.sink:keyframes_sink",
    },
)
"""Factories of sinks for the frames of a run, by name.

A factory takes the fragment, the operator's name and `SinkOptions`. The input of the operator takes `RenderedFrame` or
`ScoredFrame`.
"""

Device = Literal["cpu", "cuda"]
"""Devices for training and rendering."""
Poses = Literal["given", "auto", "estimated"]
"""Camera poses: recorded with the frames; as recorded or, while the scope moves, estimated; or estimated from the pictures."""
Policy = Literal["withhold", "off"]
"""Pictures from outside of the body: replace them by black, or pass all frames without a check."""

TRAINING_RUNS: tuple[Command, ...] = ("replay", "batch", "reconstruct", "job")
REPLAYS: tuple[Command, ...] = ("replay", "batch", "job")
LIVE: tuple[Command, ...] = ("live", "stream")
COMMANDS: tuple[Command, ...] = (*TRAINING_RUNS, "live")


MAX_SEED = 2**63 - 1
"""Largest seed that all random generators accept."""

Scale = Annotated[
    float | None,
    Option(
        "Factor by which the frames are resized",
        null="1; live on a CPU the size that this machine keeps up with",
        gt=0,
        le=64,
        callers_le=4,
    ),
]


@dataclass(frozen=True, kw_only=True)
class SourceSection(Section):
    """Option for the size of the frames."""

    scale: Scale = 1.0

    @property
    def given_scale(self) -> float:
        """Return the requested scale of the frames; 1 if the option `scale` is None."""
        return 1.0 if self.scale is None else self.scale


@dataclass(frozen=True, kw_only=True)
class LengthSection(Section):
    """Options that limit the length of a run."""

    max_frames: Annotated[
        int | None,
        Option("Largest number of frames", COMMANDS, null="all", ge=1, le=10**9, callers_le=10_000_000),
    ] = None


Loop = Annotated[bool, Option("Play a recording again and again", LIVE)]


@dataclass(frozen=True, kw_only=True)
class PlaybackSection(Section):
    """Options for the playback of a recording in real time."""

    fps: Annotated[
        float | None,
        Option("Rate at which a recording is played", LIVE, unit="frames/s", null="its own", gt=0, le=1000),
    ] = None
    loop: Loop = False


@dataclass(frozen=True, kw_only=True)
class SeedSection(Section):
    """Option for random numbers."""

    seed: Annotated[
        int,
        Option(
            "Seed of all random numbers; the same seed gives the same bytes", ge=0, le=MAX_SEED, callers_le=2**31 - 1
        ),
    ] = 0


@dataclass(frozen=True, kw_only=True)
class ReconstructSection(Section):
    """Options of the model and its training."""

    device: Annotated[Device, Option("Processor that trains and renders", COMMANDS)] = "cpu"
    field: Annotated[str, Option("Deformation field; auto is the better one"), Names(FIELDS)] = "auto"
    losses: Annotated[
        tuple[Annotated[str, Names(LOSSES, weighted=True)], ...],
        Option("Losses in addition to photometric and depth, each as name or name:weight, or none"),
    ] = ()
    eyes: Annotated[Eyes | None, Option("Pictures of a stereo scope that are trained on", null="left")] = None


@dataclass(frozen=True, kw_only=True)
class DepthSection(Section):
    """Options for the depth and poses of the frames."""

    depth: Annotated[
        str,
        Option(
            "Depth of the frames: stereo from the two eyes, parallax of a moving scope with poses, onnx by a network of yours"
            " (relative). Experimental: light of one fixed eye, breathing tissue before a moving scope (both relative)"
        ),
        Names(DEPTHS, DEPTHS_WITH_ADDRESS, ("auto",)),
    ] = "auto"
    poses: Annotated[
        Poses,
        Option(
            "Poses of the scope: given by the recording, estimated from the pictures (relative; moving tissue looks like a"
            " moving scope), or auto, which estimates missing ones while a moving scope explains the pictures."
            " reconstruct estimates missing poses where that helps, with given too",
            (*TRAINING_RUNS, *LIVE),
        ),
    ] = "given"


@dataclass(frozen=True, kw_only=True)
class DisplaySection(Section):
    """Options for pictures of the model.

    Raises:
        InvalidSetting: if the renderer does not have an option or output.
    """

    renderer: Annotated[str, Option("Method that turns Gaussians into a picture"), Names(RENDERERS)] = "alpha"
    samples: Annotated[
        int | None,
        Option("Random samples per pixel of a renderer that has them", null="16", ge=1, le=2**20, callers_le=1024),
    ] = None
    supersampling: Annotated[
        int | None,
        Option("Sub-pixels per pixel and axis of a renderer that has them", null="1", ge=1, le=8, callers_le=4),
    ] = None
    order: Annotated[
        Literal["splat", "pixel"] | None,
        Option(
            "Depth that decides what is in front: splat (of its centre) or pixel (of its plane at each pixel)",
            null="splat",
        ),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_display(self.options())

    @property
    def renderer_options(self) -> RendererOptions:
        """Return the options of the renderer; the seed of the run is its seed if it has one."""
        from gsplat_core.rendering.renderer import RendererOptions

        given = {name: value for name in RENDERER_OPTIONS if (value := getattr(self, name, None)) is not None}
        if "seed" in RENDERERS[self.renderer].capabilities.options:
            given["seed"] = getattr(self, "seed", 0)
        return RendererOptions(**given)


RENDERER_OPTIONS = ("samples", "supersampling", "order", "progressive", "storage")
"""Options that only some renderers have."""


def check_display(options: Mapping[str, Any]) -> None:
    """Check the combination of the options `renderer`, those of the renderer, `outputs`, `losses` and `strategy`.

    Args:
        options: values by name; an absent one has its default.

    Raises:
        InvalidSetting: if the combination does not work.
    """
    renderer = options.get("renderer") or "alpha"
    check_renderer_options(renderer, [name for name in RENDERER_OPTIONS if options.get(name)])
    check_outputs(renderer, listed(options.get("outputs")) or ())
    check_losses(renderer, listed(options.get("losses")) or ())
    check_strategy(renderer, options.get("strategy") or "streaming")


@dataclass(frozen=True, kw_only=True)
class StillSection(Section):
    """Options for pictures of a model that stands still."""

    progressive: Annotated[
        bool,
        Option(
            "Add the samples of consecutive pictures while camera and scene stand still, up to 4096 per pixel",
            ("stream", "render"),
        ),
    ] = False
    storage: Annotated[
        Literal["raw", "prepared", "quantised"] | None,
        Option(
            "Format of the splats that a renderer of samples reads; prepared and quantised (16 bytes and the colours) are for"
            " models that do not move",
            ("stream", "render"),
            null="raw",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class RenderSection(Section):
    """Options for pictures of a finished model."""

    outputs: Annotated[
        tuple[Annotated[str, Names(OUTPUTS, more=STANDARD)], ...],
        Option("Outputs to show, side by side; those without colours in false colours", ("render",)),
    ] = ("image",)
    fps: Annotated[
        float, Option("Frames rendered per second of model time", ("render",), gt=0, le=1000, callers_le=120)
    ] = 30.0
    scale: Annotated[
        float, Option("Factor by which the pictures are resized", ("render",), gt=0, le=64, callers_le=4)
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class OutputSection(Section):
    """Options for files that a run writes in addition to its report and its model."""

    sinks: Annotated[
        tuple[Annotated[str, Names(SINKS)], ...], Option("Outputs for the report, or none", TRAINING_RUNS)
    ] = (
        "video",
        "keyframes",
    )
    outputs: Annotated[
        tuple[Annotated[str, Names(OUTPUTS, more=STANDARD)], ...],
        Option("Outputs of the renderer to write as one video each, in false colours, or none", TRAINING_RUNS),
    ] = ()


@dataclass(frozen=True, kw_only=True)
class ScheduleSection(Section):
    """Options for the work per frame of a replay."""

    steps_per_frame: Annotated[
        int | None,
        Option("Optimiser steps per frame", REPLAYS, null="the field's", ge=1, le=100_000_000, callers_le=10_000),
    ] = None
    heldout: Annotated[
        bool,
        Option(
            "Show frames 1, 9, 17, ... without training on them, and score them separately",
            REPLAYS,
            flag="--heldout/--no-heldout",
        ),
    ] = False
    ignore_schedule: Annotated[
        bool, Option("Replay a recorded session as a plain recording, without its schedule of steps", REPLAYS)
    ] = False


@dataclass(frozen=True, kw_only=True)
class GraphSection(Section):
    """Option for the engine that executes a replay's operators."""

    engine: Annotated[Engine, Option("Engine that executes the operators", ("replay",))] = "embedded"


@dataclass(frozen=True, kw_only=True)
class OfflineSection(Section):
    """Options of offline training."""

    steps: Annotated[
        int | None,
        Option(
            "Optimiser steps over all training frames",
            ("reconstruct",),
            null="the number that is best for frames kept for validation, within the time limit",
            word="auto",
            ge=1,
            le=100_000_000,
        ),
    ] = None
    minutes: Annotated[
        float | None,
        Option(
            "Time limit of the training if its steps are chosen automatically",
            ("reconstruct",),
            unit="min",
            null="0.75 on a GPU, 10 on a CPU",
            gt=0,
            le=100_000,
        ),
    ] = None
    strategy: Annotated[
        str,
        Option(
            "Change of the Gaussians between steps: streaming splits those with large errors, adc those with large gradients,"
            " mcmc moves transparent ones, birth_death draws deaths and copies from the gradients of the opacities",
            ("reconstruct",),
        ),
        Names(STRATEGIES),
    ] = "streaming"


@dataclass(frozen=True, kw_only=True)
class ChecksSection(Section):
    """Options for tool masks and for pictures from outside the body."""

    tool_mask: Annotated[
        str,
        Option("Tools in frames without a mask", (*REPLAYS, *LIVE)),
        Names(TOOL_MASKS, TOOL_MASKS_WITH_ADDRESS),
    ] = "builtin"
    out_of_body: Annotated[
        Policy,
        Option("Pictures from outside of the body: withhold them, or off to let them pass", (*REPLAYS, *LIVE)),
    ] = "withhold"


@dataclass(frozen=True, kw_only=True)
class LiveSection(Section):
    """Options for the timing of a live run."""

    budget_ms: Annotated[
        float | None,
        Option(
            "Time from the arrival of a frame to its picture",
            LIVE,
            unit="ms",
            null="a share of the frame interval",
            word="auto",
            gt=0,
            le=10_000,
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class JobOptions(
    ReconstructSection,
    SeedSection,
    DepthSection,
    ChecksSection,
    DisplaySection,
    SourceSection,
    LengthSection,
    ScheduleSection,
    OutputSection,
):
    """Options of a replay job, as stored with the job. Options of `intrasplat batch` may contain paths of local
    files."""


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(JobOptions, GraphSection):
    """Options of `intrasplat replay`."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(JobOptions, OfflineSection):
    """Options of `intrasplat reconstruct`."""


@dataclass(frozen=True, kw_only=True)
class EngineOptions(ReconstructSection, SeedSection, DepthSection, ChecksSection, DisplaySection, LiveSection):
    """Options of a live reconstruction, by `intrasplat live` or by a stream's engine process."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(EngineOptions, SourceSection, LengthSection, PlaybackSection):
    """Options of `intrasplat live`."""

    scale: Scale = None
    seconds: Annotated[
        float | None,
        Option("Duration of the run", ("live",), unit="s", null="until the source ends", gt=0, lt=1e9),
    ] = None


@dataclass(frozen=True, kw_only=True)
class RenderOptions(DisplaySection, SeedSection, StillSection, RenderSection):
    """Options of pictures and videos of a finished model."""


def check_images_folder(images: str) -> None:
    """Raise InvalidSetting unless the folder of a scene's images is inside the scene."""
    if Path(images).is_absolute() or ".." in Path(images).parts:
        raise InvalidSetting(f"images is {images!r:.80}; give a folder inside the scene")


@dataclass(frozen=True, kw_only=True)
class TrainOptions(SeedSection):
    """Options of the training of a static scene.

    Raises:
        InvalidSetting: if the images are not inside the scene, or one image in one is held out.
    """

    steps: Annotated[int, Option("Number of optimiser steps", ("train",), ge=1, le=10**7)] = 30_000
    strategy: Annotated[
        Literal["adc", "mcmc", "none"],
        Option(
            "Change of the Gaussians: adc splits those with large gradients, mcmc moves transparent ones, none keeps one per point",
            ("train",),
        ),
    ] = "adc"
    max_gaussians: Annotated[
        int,
        Option("Number of Gaussians at which mcmc stops to add, and after which adc multiplies none", ("train",), ge=1),
    ] = 1_000_000
    absgrad: Annotated[bool, Option("With adc: add up absolute gradients", ("train",))] = False
    device: Annotated[Device, Option("Processor that trains and renders", ("train",))] = "cpu"
    images: Annotated[str, Option("Folder of the scene's images, such as images_4", ("train",))] = "images"
    every: Annotated[
        int,
        Option("Hold out every k-th image, in the order of names, for the evaluation; 0 for none", ("train",), ge=0),
    ] = 8
    scale: Annotated[float, Option("Factor by which the images are resized", ("train",), gt=0, le=64)] = 1.0
    sh_degree: Annotated[int, Option("Degree of the spherical harmonics", ("train",), ge=0, le=4)] = 3
    save_every: Annotated[int, Option("Interval in steps at which the model is saved", ("train",), ge=1)] = 5000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every == 1:
            raise InvalidSetting("every is 1; it must be 0 (hold out no image) or at least 2")
        check_images_folder(self.images)


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(SourceSection, PlaybackSection):
    """Options of a stream's capture process."""

    loop: Loop = True


@dataclass(frozen=True, kw_only=True)
class StreamEngineOptions(EngineOptions, StillSection):
    """Options of a stream's engine process."""

    engine_scale: Annotated[
        float | None,
        Option(
            "Size of the reconstruction relative to the stream's pictures",
            ("stream",),
            null="1; on a CPU the size that keeps up",
            gt=0,
            le=1,
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerJobOptions(JobOptions):
    """Options of a replay job requested through the REST API, with the limits of API callers."""


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerCaptureOptions(CaptureOptions):
    """Options of a stream's capture process, with the limits of REST API callers."""


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerEngineOptions(StreamEngineOptions):
    """Options of a stream's engine process, with the limits of REST API callers."""


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerRenderOptions(RenderOptions):
    """Options of pictures and videos of a finished model, with the limits of REST API callers."""


def stream_options() -> dict[str, Declared]:
    """Return the declared options of a service stream by name."""
    return {**options_for(CallerCaptureOptions, "stream"), **options_for(CallerEngineOptions, "stream")}


def check_stream_options(options: Mapping[str, Any]) -> None:
    """Check a stream's options from a settings file or an API request. None selects the default.

    Raises:
        InvalidSetting: if an option is unknown or out of range.
    """
    known = stream_options()
    for name, value in sorted(options.items()):
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise InvalidSetting(f"a stream has no option {name!r:.60}; the nearest is {near!r}")
        if value is not None:
            known[name].checked(value)
    check_display(options)


def stream_options_schema() -> dict[str, Any]:
    """Return the JSON schema of a stream's options; each accepts null for its default."""
    properties: dict[str, Any] = {}
    for name, each in stream_options().items():
        schema = each.json_schema()
        about = {key: schema.pop(key) for key in ("description", "x-unit") if key in schema}
        kinds = schema.pop("anyOf", [schema])
        kinds = kinds if {"type": "null"} in kinds else [*kinds, {"type": "null"}]
        properties[name] = {"anyOf": kinds, "default": each.default, **about}
    return {"properties": properties, "additionalProperties": False}


def check_option(name: str, value: Any) -> None:
    """Check the value of the option `name` of `replay`, `reconstruct` or `live`.

    Raises:
        InvalidSetting: if the value has another type or is out of range.
    """
    known = {**options_of(LiveOptions), **options_of(ReconstructOptions), **options_of(ReplayOptions)}
    known[name].checked(value)
