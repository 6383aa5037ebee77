"""Options of `intrasplat` commands and their shared groups."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.value_ranges import is_plain, plain_float
from operators.options import Command, Declared, Section, options_for, options_of
from operators.settings import RenderOptions, ReplayOptions


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
EvaluatedRecordingArgument = Annotated[
    Path | None, path_argument("RECORDING", "The recording to evaluate on; with --scene there is none.")
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
        "A model folder that replay or reconstruct wrote, or a .ply, .splat or .spz file of another program.",
    ),
]
ModelFolderArgument = Annotated[Path, path_argument("MODEL", "A model folder that replay or reconstruct wrote.")]
PackedFileArgument = Annotated[Path, path_argument("FILE", "The packed file, which ends in .isplat.")]
MeshArgument = Annotated[Path, path_argument("MESH", "A triangle mesh: .ply, .stl or .obj.")]
ExportedFileArgument = Annotated[Path, path_argument("FILE", "The exported file.")]
OutOption = Annotated[Path, path_option("--out", "Folder for the results: new, empty, or left by an earlier run.")]
SceneArgument = Annotated[
    Path,
    path_argument("SCENE", "A folder in COLMAP's format: images/, and sparse/0/ with cameras, images and points3D."),
]
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
CameraPathOption = Annotated[
    Path | None,
    path_option("--path", "A camera path (.json), or the cameras.json of another trainer."),
]
BenchVideoOption = Annotated[Path | None, path_option("--out", "A video (name.mp4) of the measured frames.")]
EditedOption = Annotated[Path, path_option("--out", "A folder for the model, or a .ply, .splat or .spz file.")]
MergedOption = Annotated[Path | None, path_option("--merge", "A model whose Gaussians are added, at its last time.")]
RenderOutOption = Annotated[Path, path_option("--out", "A video (name.mp4) or a folder of images.")]


def renderer_options(renderer: str, samples: int | None, supersampling: int | None, order: str | None) -> Any:
    """Return the `RendererOptions` of command line options; None stands for a renderer's default.

    Raises:
        InvalidSetting: if a value is out of range, or the renderer does not have the option.
    """
    return RenderOptions(renderer=renderer, samples=samples, supersampling=supersampling, order=order).renderer_options  # type: ignore[arg-type]  # checked


def help_of(each: Declared) -> str:
    """Return the help text of an option: description, unit and choices."""
    unit = "" if each.option.unit is None else f", in {each.option.unit}"
    choices = f" One of: {', '.join(each.choices)}." if each.choices else ""
    return f"{each.option.description}{unit}.{choices}"


def _annotation(each: Declared) -> Any:
    """Return the annotation from which typer makes a command line option."""
    plain = each.plain if each.option.word is None else str
    flags = (each.option.flag or f"--{each.name.replace('_', '-')}",) if plain is bool else ()
    shown: Any = True if each.default is not None or each.option.word else each.option.null or False
    kind = plain if each.default is not None or each.option.word else plain | None
    return Annotated[kind, typer.Option(*flags, help=help_of(each), show_default=shown)]


def _shared(name: str, null: str | None = None) -> Any:
    """Return the typer declaration of an engine option, for a command whose other options are declared in this
    module. `null` is the meaning of None where the command has another than the engine."""
    each = options_of(ReplayOptions)[name]
    return typer.Option(help=help_of(each), show_default=null or each.option.null or True)


VIEW_SAMPLES = 1
"""Samples per pixel that `view` adds to a picture at a time; the picture gains samples while the camera stands still."""
DeviceOption = Annotated[str, _shared("device")]
RendererOption = Annotated[str, _shared("renderer")]
SamplesOption = Annotated[int | None, _shared("samples")]
ViewSamplesOption = Annotated[int | None, _shared("samples", null=str(VIEW_SAMPLES))]
SupersamplingOption = Annotated[int | None, _shared("supersampling")]
OrderOption = Annotated[str | None, _shared("order")]
SeedOption = Annotated[int, _shared("seed")]
ScaleOption = Annotated[float, _shared("scale")]
MaxFramesOption = Annotated[int | None, _shared("max_frames")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON to stdout, and nothing else.")]


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
    scene: Annotated[
        Path | None,
        path_option("--scene", "Evaluate on the held-out images of a scene in COLMAP's format, without a recording."),
    ] = None
    images: Annotated[str | None, typer.Option(help="With --scene: folder of its images.", show_default="images")] = (
        None
    )
    every: Annotated[int | None, typer.Option(help="With --scene: hold out every k-th image.", show_default="8")] = None
    samples: SamplesOption = None
    supersampling: SupersamplingOption = None
    order: OrderOption = None


@dataclass(frozen=True)
class SynthesizeOptions:
    """Options of `synthesize`."""

    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60
    width: Annotated[int, typer.Option(help="Width in pixels.")] = 320
    height: Annotated[int, typer.Option(help="Height in pixels.")] = 256
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 30.0
    seed: SeedOption = 0
    random: Annotated[
        bool,
        typer.Option(
            "--random",
            help="Draw every property of tissue, scope, tools, camera and air from the seed; options fix one.",
        ),
    ] = False
    moving_camera: Annotated[
        bool | None,
        typer.Option("--moving-camera/--fixed-camera", help="Motion of the scope; fixed, or drawn by --random."),
    ] = None
    stereo: Annotated[
        bool | None,
        typer.Option("--stereo/--mono", help="Second eye; written, or drawn by --random. --mono may have distortion."),
    ] = None
    scene: Annotated[
        str, typer.Option(help="open (a sheet of tissue with a tool) or colon (a tube along its axis).")
    ] = "open"
    third: Annotated[
        bool, typer.Option("--third", help="A third camera in views/third, which training never gets.")
    ] = False
    flow: Annotated[bool, typer.Option("--flow", help="Optical flow and scene flow to the next frame.")] = False
    tracks: Annotated[bool, typer.Option("--tracks", help="Which of the followed points each frame sees.")] = False
    behind: Annotated[bool, typer.Option("--behind", help="Pictures and depth of the tissue behind the tool.")] = False
    smoke: Annotated[
        float | None, typer.Option(help="Smoke that comes and goes: 0 none, 1 dense; none, or drawn by --random.")
    ] = None
    depth_noise: Annotated[
        float, typer.Option(metavar="MM", help="Noise of the depth at 74 mm; the true one is kept in true_depth.")
    ] = 0.0
    exposure_changes: Annotated[
        bool | None,
        typer.Option(
            "--exposure-changes/--constant-exposure", help="Changes of the exposure; none, or drawn by --random."
        ),
    ] = None
    breathing_ratio: Annotated[
        float | None,
        typer.Option(
            help="Duration of expiration over that of inspiration; 2 is usual at rest. 1, or drawn by --random."
        ),
    ] = None
    rate_wander: Annotated[
        float | None,
        typer.Option(help="Largest deviation of the breathing rate, as a share of it: 0.15 is ±15 %. 0, or drawn."),
    ] = None
    scope_path: Annotated[
        str | None,
        typer.Option(
            help="Path of a moving scope: usual (of every seed), seeded (another one for each seed); with --random also"
            " hand-held, translation, rotation or insertion."
        ),
    ] = None


def takes_options(kind: type[Section], command: Command) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Decorate a command that has a mapping parameter `options`. Each option of the class `kind` that applies to
    `command` becomes a command line option. The mapping receives the option values by name."""
    declared = options_for(kind, command)
    annotations = {name: _annotation(each) for name, each in declared.items()}
    defaults = {name: _default(each) for name, each in declared.items()}

    def made(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: _value(each, values[name]) for name, each in declared.items()}

    return lambda function: _with_parameters(function, annotations, defaults, made)


def takes_run_options(command: Callable[..., int], parameter: str = "options") -> Callable[..., int]:
    """Decorate a command with a parameter whose type is a dataclass: each field becomes a command line option."""
    kind: Any = get_type_hints(command, include_extras=True)[parameter]
    hints = get_type_hints(kind, include_extras=True)
    annotations = {field.name: hints[field.name] for field in fields(kind)}
    defaults = {field.name: field.default for field in fields(kind)}
    return _with_parameters(command, annotations, defaults, lambda values: kind(**values), parameter)


def _default(each: Declared) -> Any:
    if each.option.word and each.default is None:
        return each.option.word
    return (",".join(each.default) or "none") if isinstance(each.default, tuple) else each.default


def _value(each: Declared, given: Any) -> Any:
    """Return the value of an option from the command line.

    Raises:
        InvalidSetting: if a number is neither a number nor the word for None.
    """
    if each.option.word is None or given is None:
        return given
    if given == each.option.word:
        return None
    try:
        number = plain_float(given)
        return int(number) if each.plain is int and number.is_integer() else number
    except ValueError:
        raise InvalidSetting(f"{each.name} is {given!r:.60}; give {each.option.word}, or a number") from None


def _with_parameters(
    command: Callable[..., int],
    annotations: Mapping[str, Any],
    defaults: Mapping[str, Any],
    made: Callable[[Mapping[str, Any]], Any],
    replaced: str = "options",
) -> Callable[..., int]:
    """Return the command with its parameter `replaced` exchanged for the parameters in `annotations`. `made`
    converts their values to the argument for `replaced`."""

    @functools.wraps(command)
    def call(**values: Any) -> int:
        value = made({name: values.pop(name) for name in annotations})
        return command(**{replaced: value}, **values)

    hints = {**get_type_hints(command, include_extras=True), **annotations}
    both = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name != replaced:
            both.append(parameter)
            continue
        both += [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name]) for name in annotations
        ]
    both = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[each.name]) for each in both]
    call.__signature__ = inspect.Signature(both)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in both}
    del call.__dict__["__wrapped__"]  # otherwise typer inspects the wrapped command's signature
    return call


def require_plain_numbers(command: Any) -> None:
    """Make the numeric options and arguments of a command and its subcommands refuse `1_0` and digits of other scripts.

    Args:
        command: a command or group that typer built; its parameters are modified.
    """
    for parameter in command.params:
        parameter.process_value = functools.partial(_processed, parameter, parameter.process_value)
    for each in getattr(command, "commands", {}).values():
        require_plain_numbers(each)


def _processed(parameter: Any, process: Callable[[Any, Any], Any], context: Any, value: Any) -> Any:
    """Convert a parameter's value by `process`. Refuse a text such as `1_0`, which Python converts to a number."""
    found = process(context, value)
    is_number = isinstance(found, int | float) and not isinstance(found, bool)
    if is_number and isinstance(value, str) and not is_plain(value):
        raise typer.BadParameter(
            f"{value!r} is not a plain number; write it with the digits 0 to 9, such as 10 or 0.5",
            ctx=context,
            param_hint=parameter.opts[-1],
        )
    return found


def check_host(host: str, plaintext: bool, why: str) -> None:
    """Check that an address is a loopback address, unless `plaintext` is set.

    Args:
        host: address to listen on.
        plaintext: allow other addresses.
        why: explanation for the error message.

    Raises:
        InvalidSetting: if the address is reachable from other machines.
    """
    from services.settings import is_loopback  # takes longer to import than the options

    if not is_loopback(host) and not plaintext:
        raise InvalidSetting(
            f"{host} is beyond this machine: {why}; give --plaintext on a network that is closed to others"
        )
