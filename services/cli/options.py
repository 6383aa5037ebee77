"""Options of `intrasplat` commands and their shared groups."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer


def _path(text: str) -> Path:
    if "\0" in text:
        raise typer.BadParameter(f"{text!r} holds a zero byte, which no name of a file can")
    return Path(text)


def path_argument(name: str, help_text: str) -> Any:
    return typer.Argument(parser=_path, metavar=name, help=help_text, show_default=False)


def path_option(name: str, help_text: str) -> Any:
    return typer.Option(name, parser=_path, metavar="<path>", help=help_text, show_default=False)


RecordingArgument = Annotated[
    Path, path_argument("RECORDING", "A video, or a folder with video.mp4, images/, cameras.json or session.json.")
]
SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="A recording, which is played in real time, or an address such as rtsp://host/path.",
        show_default=False,
    ),
]
ModelArgument = Annotated[
    Path,
    path_argument(
        "MODEL",
        "A model folder that replay or reconstruct wrote; render, view, export and measure also take a scene.ply or .splat of other programs.",
    ),
]
PackedFileArgument = Annotated[Path, path_argument("FILE", "The packed file, which ends in .isplat.")]
MeshArgument = Annotated[Path, path_argument("MESH", "A triangle mesh: .ply, .stl or .obj.")]
ExportedFileArgument = Annotated[Path, path_argument("FILE", "The exported file.")]
OutOption = Annotated[Path, path_option("--out", "Folder for the results: new, empty, or left by an earlier run.")]
FolderArgument = Annotated[Path, path_argument("FOLDER", "A folder of recordings: videos, and folders of their own.")]
BatchOutOption = Annotated[
    Path | None,
    path_option("--out", "Folder for the results, one folder each. Default: FOLDER with -replays behind its name."),
]
LiveOutOption = Annotated[
    Path | None, path_option("--out", "Folder for the report and the model; without it nothing is kept.")
]
EvaluatedArgument = Annotated[Path, path_argument("MODEL|RUN", "A model folder, or the output folder of a run.")]
EvaluationOutOption = Annotated[
    Path | None,
    path_option("--out", "Folder for evaluation.json and evaluation.html: new, empty, or left by an earlier run."),
]
PosesOption = Annotated[
    Path | None,
    path_option(
        "--poses", "For geometry: a poses.npy that the model was made with. Default: the recording's own poses."
    ),
]
PlaceOption = Annotated[
    list[str] | None,
    typer.Option(
        "--place",
        metavar="<s:s,s:s>",
        help="Two stays at one place, in seconds (0:2,60:62), for retention; more than once for several.",
        show_default="found by the poses",
    ),
]
RecordKeepOption = Annotated[
    list[str] | None,
    typer.Option(
        "--record-keep",
        metavar="<size|time>",
        help="Keep so much (20GiB), or what is not older (48h), of all recordings in --out, and remove the oldest; once for each.",
        show_default="everything",
    ),
]
RenderOutOption = Annotated[Path, path_option("--out", "A video (name.mp4) or a folder of images.")]
DeviceOption = Annotated[str, typer.Option(help="cpu or cuda.")]
RendererOption = Annotated[str, typer.Option(help="How Gaussians become a picture: alpha.")]
FieldOption = Annotated[str, typer.Option(help="Deformation field: auto, basis or hexplane.")]
DepthOption = Annotated[
    str,
    typer.Option(
        help="Depth of the frames: auto, recorded, stereo (from the two eyes), parallax (of a moving scope with poses), light (of one fixed eye; relative), onnx:FILE (by a network of yours; relative) or none."
    ),
]
PosesFromOption = Annotated[
    str,
    typer.Option(
        help="Where the scope was: given (by the recording), or estimated from the pictures, frame by frame (relative; never by default, since tissue that moves looks like a scope that does)."
    ),
]
SeedOption = Annotated[int, typer.Option(help="The same seed gives the same bytes.")]
EYES = "Pictures of a stereo scope that are trained on: left or both."
EyesOption = Annotated[str | None, typer.Option(help=EYES, show_default="left")]
ScaleOption = Annotated[float, typer.Option(help="Resize the frames by this factor.")]
MaxFramesOption = Annotated[int | None, typer.Option(help="Stop after this many frames.", show_default=False)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON to stdout, and nothing else.")]


@dataclass(frozen=True)
class RunOptions:
    """Options common to `replay` and `reconstruct`, named as in `ReplaySettings`."""

    device: DeviceOption = "cpu"
    field: FieldOption = "auto"
    renderer: RendererOption = "alpha"
    seed: SeedOption = 0
    max_frames: MaxFramesOption = None
    scale: ScaleOption = 1.0
    depth: DepthOption = "auto"
    eyes: EyesOption = None

    def settings(self) -> dict[str, Any]:
        """Return the options by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of `evaluate`."""

    protocol: Annotated[
        list[str] | None,
        typer.Option(
            help="heldout, live, retention, second_eye, geometry or causal (which learns from the recording again); more than once for several.",
            show_default="all but causal",
        ),
    ] = None
    device: DeviceOption = "cpu"
    renderer: RendererOption = "alpha"
    scale: Annotated[
        float | None, typer.Option(help="Resize the frames by this factor.", show_default="the model's")
    ] = None
    max_frames: MaxFramesOption = None
    steps_per_frame: Annotated[
        int | None, typer.Option(help="Optimiser steps per frame of causal.", show_default="the run's")
    ] = None
    motion_prior: Annotated[
        str | None, typer.Option(help="What causal assumes about motion: bumps, flow or learned.", show_default="bumps")
    ] = None
    place: PlaceOption = None
    poses: PosesOption = None


@dataclass(frozen=True)
class SynthesizeOptions:
    """Options of `synthesize`."""

    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60
    width: Annotated[int, typer.Option(help="Width in pixels.")] = 320
    height: Annotated[int, typer.Option(help="Height in pixels.")] = 256
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 30.0
    seed: SeedOption = 0
    moving_camera: Annotated[bool, typer.Option("--moving-camera/--fixed-camera", help="Let the scope move.")] = False
    scene: Annotated[
        str, typer.Option(help="open (a sheet of tissue with a tool) or colon (a tube along its axis).")
    ] = "open"
    third: Annotated[
        bool, typer.Option("--third", help="A third camera in views/third, which training never gets.")
    ] = False
    flow: Annotated[bool, typer.Option("--flow", help="Optical flow and scene flow to the next frame.")] = False
    tracks: Annotated[bool, typer.Option("--tracks", help="Which of the followed points each frame sees.")] = False
    behind: Annotated[bool, typer.Option("--behind", help="Pictures and depth of the tissue behind the tool.")] = False
    smoke: Annotated[float, typer.Option(help="Smoke that comes and goes: 0 none, 1 dense.")] = 0.0
    depth_noise: Annotated[
        float, typer.Option(metavar="MM", help="Noise of the depth at 74 mm; the true one is kept in true_depth.")
    ] = 0.0
    exposure_changes: Annotated[bool, typer.Option("--exposure-changes", help="Let the exposure go up and down.")] = (
        False
    )
    breathing_ratio: Annotated[
        float, typer.Option(help="Duration of expiration over that of inspiration; 2 is usual at rest.")
    ] = 1.0
    rate_wander: Annotated[
        float, typer.Option(help="Largest deviation of the breathing rate, as a share of it: 0.15 is ±15 %.")
    ] = 0.0
    scope_path: Annotated[
        str, typer.Option(help="Way of a moving scope: usual (of every seed) or seeded (another one for each seed).")
    ] = "usual"


@dataclass(frozen=True)
class LiveOptions(RunOptions):
    """Additional options of `live`, named as in `LiveSettings`."""

    scale: Annotated[
        float | None,
        typer.Option(
            help="Resize the frames by this factor.", show_default="1; on a CPU what this machine keeps up with"
        ),
    ] = None  # type: ignore[assignment]
    eyes: Annotated[str, typer.Option(help=EYES)] = "left"
    seconds: Annotated[
        float | None, typer.Option(help="End after so many seconds.", show_default="when the source ends")
    ] = None
    tool_mask: Annotated[
        str, typer.Option(help="Tools in frames without a mask: builtin, none, or another way to find them.")
    ] = "builtin"
    poses: PosesFromOption = "given"
    out_of_body: Annotated[
        str, typer.Option(help="Pictures from outside of the body: withhold, or off to let them pass.")
    ] = "withhold"
    loop: Annotated[bool, typer.Option("--loop", help="Play a recording again and again.")] = False
    fps: Annotated[float | None, typer.Option(help="Play a recording at this rate.", show_default="its own")] = None


def takes_run_options(command: Callable[..., int]) -> Callable[..., int]:
    """Wrap a command whose parameter `options` is a dataclass: each field becomes a command line
    option."""
    kind: Any = get_type_hints(command, include_extras=True)["options"]
    shared = [
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default) for field in fields(kind)
    ]

    @functools.wraps(command)
    def call(**values: Any) -> int:
        options = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        return command(options=options, **values)

    parameters = list(inspect.signature(command).parameters.values())
    place = [parameter.name for parameter in parameters].index("options")
    hints = get_type_hints(command, include_extras=True) | get_type_hints(kind, include_extras=True)
    both = [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[each.name])
        for each in [*parameters[:place], *shared, *parameters[place + 1 :]]
    ]
    call.__signature__ = inspect.Signature(both)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in both}
    del call.__dict__["__wrapped__"]  # otherwise typer inspects the wrapped command's signature
    return call
