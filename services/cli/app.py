"""Commands of `intrasplat` and their options. Each command imports its dependencies when it runs."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from operators.settings import JobOptions, LiveOptions, ReconstructOptions, RenderOptions, ReplayOptions, TrainOptions
from services.cli.ctl import ExpiresOption, KeyName, KeyStreamOption, RoleOption, ctl
from services.cli.options import (
    VIEW_SAMPLES,
    BatchOutOption,
    BenchVideoOption,
    CameraPathOption,
    DeviceOption,
    EditedOption,
    EvaluatedArgument,
    EvaluatedRecordingArgument,
    EvaluateOptions,
    EvaluationOutOption,
    ExportedFileArgument,
    FolderArgument,
    JsonOption,
    LiveOutOption,
    MergedOption,
    MeshArgument,
    ModelArgument,
    ModelFolderArgument,
    OrderOption,
    OutOption,
    PackedFileArgument,
    RecordingArgument,
    RecordKeepOption,
    RendererOption,
    RenderOutOption,
    SamplesOption,
    SceneArgument,
    SourceArgument,
    SupersamplingOption,
    SynthesizeOptions,
    ViewSamplesOption,
    path_argument,
    path_option,
    renderer_options,
    require_plain_numbers,
    takes_options,
    takes_run_options,
)
from services.cli.terminal import BAD_INPUT, INTERRUPTED, OK, exit_code_of, sentence

# Base class of usage errors. Its module differs between typer releases; its subclasses do not.
_USAGE_ERRORS: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")
app = typer.Typer(
    name="intrasplat",
    help="Live, deforming 3D reconstruction from endoscopic video. Research use only, not a medical device.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def run(arguments: list[str]) -> int:
    """Run a command line. Every error is converted to an exit code here.

    Args:
        arguments: arguments without the program's name.

    Returns:
        The exit code.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    empty = [word or f"argument {at}" for at, word in enumerate(arguments, 1) if _is_empty(word)]
    if empty:
        typer.echo(f"error: {sentence(empty[0])} is empty; a variable of the shell may be unset", err=True)
        return BAD_INPUT
    try:
        code = _whole_command().main(arguments, prog_name="intrasplat", standalone_mode=False)
    except typer.Abort:
        return INTERRUPTED
    except _USAGE_ERRORS as error:
        return _say_usage(error)
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the single place where errors become exit codes
        return exit_code_of(error, arguments)
    return code if isinstance(code, int) else OK


@cache
def _whole_command() -> Any:
    """Build the tree of all commands, once per process."""
    command = typer.main.get_command(app)
    require_plain_numbers(command)
    return command


def _is_empty(word: str) -> bool:
    """Return True for an empty argument, or an option with an empty value (`--out=`), which has no meaning."""
    return not word or (word.startswith("--") and word.endswith("=") and word.count("=") == 1)


def _say_usage(error: Any) -> int:
    """Print a usage error in one sentence, or the help if the command is missing. Returns the exit code."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return BAD_INPUT
    command = error.ctx.command_path if getattr(error, "ctx", None) is not None else "intrasplat"
    said = " ".join(error.format_message().split()).rstrip(".")
    typer.echo(f"error: {sentence(said)}; `{command} --help` lists what there is", err=True)
    return BAD_INPUT


def _print_version(wanted: bool) -> None:
    if wanted:
        from services import product_version

        typer.echo(f"intrasplat {product_version()}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
@takes_options(ReplayOptions, "replay")
def replay(recording: RecordingArgument, out: OutOption, options: Mapping[str, Any], json: JsonOption = False) -> int:
    """Reconstruct a recording as if it were live: train on each frame as it arrives, display it, score it."""
    from operators.applications.replay import ReplaySettings
    from services.cli.runs import replay_command

    return replay_command(ReplaySettings(recording, out, **options), as_json=json)


@app.command()
@takes_options(JobOptions, "batch")
def batch(
    folder: FolderArgument,
    options: Mapping[str, Any],
    out: BatchOutOption = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=256, help="Number of concurrent replays.", show_default="half of the cores")
    ] = None,
    json: JsonOption = False,
) -> int:
    """Replay every recording of a folder. A repeated call continues an interrupted batch."""
    from services.cli.batch import batch_command

    return batch_command(folder, out, workers, options, as_json=json)


@app.command()
@takes_options(LiveOptions, "live")
def live(
    source: SourceArgument,
    options: Mapping[str, Any],
    out: LiveOutOption = None,
    record: Annotated[
        bool,
        typer.Option(
            "--record",
            help="Record incoming frames, training schedule and displayed pictures into recordings/ in --out.",
        ),
    ] = False,
    record_keep: RecordKeepOption = None,
    json: JsonOption = False,
) -> int:
    """Reconstruct a stream live: train on each frame for a limited time, then show the result and the frame's age."""
    from services.cli.runs import live_command, live_settings

    with live_settings(source, out, record, record_keep or (), **options) as settings:
        return live_command(settings, keep=out is not None, as_json=json)


@app.command()
@takes_options(ReconstructOptions, "reconstruct")
def reconstruct(
    recording: RecordingArgument, out: OutOption, options: Mapping[str, Any], json: JsonOption = False
) -> int:
    """Reconstruct offline: train on all training frames, then evaluate the held-out ones."""
    from operators.applications.reconstruct import ReconstructSettings
    from services.cli.runs import reconstruct_command

    return reconstruct_command(ReconstructSettings(recording, out, **options), as_json=json)


@app.command()
@takes_run_options
def evaluate(
    model: EvaluatedArgument,
    options: EvaluateOptions,
    recording: EvaluatedRecordingArgument = None,
    out: EvaluationOutOption = None,
    json: JsonOption = False,
) -> int:
    """Evaluate a model or a run on a recording, next to trivial baselines, or a model on a scene in COLMAP's format."""
    from services.cli.runs import evaluate_command, evaluate_scene_command, evaluation_settings, scene_settings

    if recording is None:
        return evaluate_scene_command(model, scene_settings(options), out, as_json=json)
    return evaluate_command(model, evaluation_settings(recording, options), out, as_json=json)


@app.command()
@takes_options(TrainOptions, "train")
def train(scene: SceneArgument, out: OutOption, options: Mapping[str, Any], json: JsonOption = False) -> int:
    """Train a static scene from posed images in COLMAP's format, and evaluate it on held-out images."""
    from services.cli.runs import train_command

    return train_command(scene, out, TrainOptions(**options), as_json=json)


@app.command()
@takes_run_options
def synthesize(out: OutOption, options: SynthesizeOptions, json: JsonOption = False) -> int:
    """Create a recording with exact ground truth: tissue, tool, stereo, depth, masks and poses,
    with optional extras."""
    from services.cli.recordings import synthesize_command

    return synthesize_command(out, options, as_json=json)


@app.command()
def doctor(json: JsonOption = False) -> int:
    """Report the capabilities of this machine, missing components and remedies."""
    from services.cli.doctor import doctor_command

    return doctor_command(as_json=json)


@app.command()
@takes_options(RenderOptions, "render")
def render(
    model: ModelArgument,
    out: RenderOutOption,
    options: Mapping[str, Any],
    device: DeviceOption = "cpu",
    view: Annotated[
        str, typer.Option(help="Camera: recorded, orbit, stereo (side by side), or a camera path (.json file).")
    ] = "recorded",
    path: CameraPathOption = None,
    baseline: Annotated[
        float | None,
        typer.Option(
            help="Distance between the cameras of stereo, in the model's unit.", show_default="0.06 of the depth"
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing video.")] = False,
    json: JsonOption = False,
) -> int:
    """Render a model over its time window to a video or to images."""
    from operators.applications.render import ViewWish
    from services.cli.models import render_command

    if path is not None and view != "recorded":
        raise InvalidSetting(f"--view is {view!r:.80} and --path {str(path)!r:.80}; give one of them")
    wish = ViewWish(view if path is None else str(path), baseline)
    return render_command(
        model, out, RenderOptions(**options), device=device, view=wish, overwrite=overwrite, as_json=json
    )


@app.command()
def bench(
    model: ModelArgument,
    renderer: RendererOption = "alpha",
    samples: SamplesOption = None,
    supersampling: SupersamplingOption = None,
    order: OrderOption = None,
    device: DeviceOption = "cpu",
    path: CameraPathOption = None,
    width: Annotated[int | None, typer.Option(help="Width in pixels.", show_default="the model's")] = None,
    height: Annotated[int | None, typer.Option(help="Height in pixels.", show_default="the model's")] = None,
    frames: Annotated[int, typer.Option(help="Number of frames, spread evenly over the path.")] = 300,
    out: BenchVideoOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing video.")] = False,
    json: JsonOption = False,
) -> int:
    """Measure frame times and memory of a renderer along a camera path; with --out, also write the video."""
    from operators.applications.bench import BenchSettings
    from services.cli.models import bench_command

    options = renderer_options(renderer, samples, supersampling, order)
    settings = BenchSettings(renderer, options, device, path, width, height, frames)
    return bench_command(model, settings, out, overwrite=overwrite, as_json=json)


@app.command()
def pack(
    model: ModelFolderArgument,
    file: PackedFileArgument,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    json: JsonOption = False,
) -> int:
    """Pack a model into one file for upload to the service."""
    from services.cli.models import pack_command

    return pack_command(model, file, overwrite=overwrite, as_json=json)


@app.command()
def export(
    model: ModelArgument,
    file: ExportedFileArgument,
    format: Annotated[
        str | None,
        typer.Option(
            help="Gaussians: ply, compressed-ply, splat, spz, glb, ply-sequence. Surface: mesh-ply, mesh-glb, points-ply.",
            show_default="by the file's ending",
        ),
    ] = None,
    time: Annotated[
        float | None,
        typer.Option(help="Time within the model's time window, in seconds.", show_default="the end of its window"),
    ] = None,
    times: Annotated[
        int | None,
        typer.Option(help="Number of times in a sequence, spread over the model's time window.", show_default="30"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    json: JsonOption = False,
) -> int:
    """Export a model for other programs: .ply, .splat, .spz, .glb, or a .zip of .ply over time; or its surface."""
    from services.cli.models import export_command

    return export_command(model, file, format, time, times, overwrite=overwrite, as_json=json)


@app.command()
def edit(
    model: ModelArgument,
    out: EditedOption,
    select: Annotated[
        list[str] | None,
        typer.Option(
            metavar="<selection>",
            help="box:X,Y,Z,X,Y,Z, sphere:X,Y,Z,RADIUS or label:NUMBER. More than once: Gaussians in all of them.",
            show_default="all Gaussians",
        ),
    ] = None,
    outside: Annotated[bool, typer.Option("--outside", help="Select the other Gaussians.")] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Remove the selected Gaussians.")] = False,
    recolour: Annotated[str | None, typer.Option(help="New colour as R,G,B, each 0 to 1.")] = None,
    rotate: Annotated[
        str | None, typer.Option(help="Rotation as X,Y,Z,DEGREES: an axis through the origin and an angle.")
    ] = None,
    scale: Annotated[float | None, typer.Option(help="Factor of positions and sizes, from the origin.")] = None,
    translate: Annotated[str | None, typer.Option(help="Shift as X,Y,Z, in the model's unit.")] = None,
    merge: MergedOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    json: JsonOption = False,
) -> int:
    """Select Gaussians of a model and delete, recolour, rotate, scale or move them, or add those of another model."""
    from services.cli.models import Edit, edit_command

    changes = Edit(tuple(select or ()), outside, delete, recolour, rotate, scale, translate, merge)
    return edit_command(model, out, changes, overwrite=overwrite, as_json=json)


@app.command()
def measure(
    model: ModelArgument,
    start: Annotated[str, typer.Option("--from", help="Pixel of the recorded camera, as X,Y.")],
    end: Annotated[
        str | None,
        typer.Option("--to", help="Second pixel, to measure the straight distance and the length along the surface."),
    ] = None,
    time: Annotated[
        float | None,
        typer.Option(help="Time within the model's time window, in seconds.", show_default="the end of its window"),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Measure points, distances and lengths on a model's surface, each with its standard error."""
    from services.cli.models import measure_command

    return measure_command(model, time, start, end, as_json=json)


@app.command()
def compare(
    model: ModelArgument,
    mesh: MeshArgument,
    time: Annotated[
        float | None,
        typer.Option(help="Time within the model's time window, in seconds.", show_default="the end of its window"),
    ] = None,
    pairs: Annotated[
        str | None,
        typer.Option(
            help="Three or more corresponding points, model=mesh, as x,y,z=x,y,z;... They give the initial alignment."
        ),
    ] = None,
    inlier: Annotated[
        float | None,
        typer.Option(
            help="Largest distance of an inlier, in the mesh's unit.", show_default="0.02 of the mesh's extent"
        ),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Align a model's surface rigidly to a mesh (.ply, .stl or .obj, for example from CT) and report the distances."""
    from services.cli.models import compare_command

    return compare_command(model, mesh, time, pairs, inlier, as_json=json)


PosesOutOption = Annotated[
    Path, path_option("--out", "Output file. Put it next to the recording's images as poses.npy.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]


@app.command()
def validate(recording: RecordingArgument, json: JsonOption = False) -> int:
    """Read a recording completely and report its defects."""
    from services.cli.recordings import validate_command

    return validate_command(recording, as_json=json)


@app.command()
def poses(
    recording: RecordingArgument,
    out: PosesOutOption,
    max_frames: Annotated[
        int | None, typer.Option(help="Read at most this number of frames.", show_default="all")
    ] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
) -> int:
    """Estimate the pose of a moving endoscope at each frame, from the pictures alone."""
    from services.cli.recordings import poses_command

    return poses_command(recording, out, max_frames, overwrite=overwrite, as_json=json)


ConfigOption = Annotated[Path | None, path_option("--config", "Settings file (YAML). Default: built-in settings.")]
DataOption = Annotated[Path | None, path_option("--data", "Data folder (paths.data).")]

keys = typer.Typer(help="API keys of the service.", no_args_is_help=True)
audit = typer.Typer(help="The service's audit log.", no_args_is_help=True)
app.add_typer(keys, name="keys")
app.add_typer(audit, name="audit")
app.add_typer(ctl, name="ctl")


@app.command()
def serve(
    config: ConfigOption = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.", show_default="127.0.0.1")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.", show_default="8000")] = None,
    data: DataOption = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="<section.key=value>", help="Override a setting; repeat for several."),
    ] = None,
) -> int:
    """Serve streams, models and their API to browsers and programs, until stopped."""
    from services.cli.serve import serve_command

    return serve_command(config, host, port, data, setting or ())


@app.command()
def schema() -> int:
    """Print the JSON schema of the service's settings file."""
    from services.cli.serve import schema_command

    return schema_command()


@app.command()
def backup(
    target: Annotated[Path, path_argument("TARGET", "New folder for the backup.")],
    config: ConfigOption = None,
    data: DataOption = None,
    json: JsonOption = False,
) -> int:
    """Copy all data of the service into a new folder, whether it runs or not."""
    from services.cli.serve import backup_command

    return backup_command(target, config, data, as_json=json)


@app.command()
def restore(
    backup: Annotated[Path, path_argument("BACKUP", "Folder made by `intrasplat backup`.")],
    config: ConfigOption = None,
    data: DataOption = None,
    check: Annotated[bool, typer.Option("--check", help="Only check the backup; change nothing.")] = False,
    json: JsonOption = False,
) -> int:
    """Check a backup and restore it into the service's folders, which must be empty."""
    from services.cli.serve import restore_command

    return restore_command(backup, config, data, check=check, as_json=json)


@app.command()
def igtl(
    stream: Annotated[
        str, typer.Argument(metavar="STREAM", help="Name of a stream that runs on this machine.", show_default=False)
    ],
    config: ConfigOption = None,
    runtime: Annotated[
        Path | None, path_option("--runtime", "Runtime folder with the sockets (paths.runtime).")
    ] = None,
    kind: Annotated[str, typer.Option(help="Picture: raw, shown, depth, confidence or orbit.")] = "shown",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 18944,
    name: Annotated[str | None, typer.Option(help="OpenIGTLink device name.", show_default="the stream's")] = None,
    spacing_mm: Annotated[float, typer.Option(help="Width and height of a pixel in millimetres.")] = 1.0,
    plaintext: Annotated[
        bool, typer.Option("--plaintext", help="Allow addresses beyond this machine, although nothing is encrypted.")
    ] = False,
) -> int:
    """Send a stream's pictures and the pose of its camera over OpenIGTLink, for example to 3D Slicer."""
    from services.cli.serve import igtl_command

    return igtl_command(
        stream, config, runtime, kind=kind, host=host, port=port, name=name, spacing_mm=spacing_mm, plaintext=plaintext
    )


@app.command()
def view(
    model: Annotated[
        Path,
        path_argument(
            "MODEL", "A model folder, a packed model (.isplat), or a scene of other programs (.ply, .splat, .spz)."
        ),
    ],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8080,
    plaintext: Annotated[
        bool, typer.Option("--plaintext", help="Allow addresses beyond this machine, although nothing is encrypted.")
    ] = False,
    renderer: Annotated[
        str | None,
        typer.Option(
            help=f"Show pictures of this renderer in place of Gaussians. One of: {', '.join(RENDERERS)}.",
            show_default="drawn by the browser, extra viser",
        ),
    ] = None,
    samples: ViewSamplesOption = None,
    supersampling: SupersamplingOption = None,
    order: OrderOption = None,
    device: DeviceOption = "cpu",
) -> int:
    """Show a model in browsers, with free viewpoint and playback."""
    from services.cli.models import view_command

    sampled = renderer is not None and renderer in RENDERERS and "samples" in RENDERERS[renderer].capabilities.options
    if sampled and samples is None:
        samples = VIEW_SAMPLES
    if renderer is None and (samples, supersampling, order) != (None, None, None):
        raise InvalidSetting("the browser draws the model without a renderer; give --renderer with its options")
    options = renderer_options(renderer or "alpha", samples, supersampling, order)
    return view_command(model, host, port, plaintext=plaintext, renderer=renderer, options=options, device=device)


@keys.command("list")
def keys_list(config: ConfigOption = None, data: DataOption = None, json: JsonOption = False) -> int:
    """List the keys, without their secrets."""
    from services.cli.serve import keys_list_command

    return keys_list_command(config, data, as_json=json)


@keys.command("add")
def keys_add(
    name: KeyName,
    role: RoleOption = "viewer",
    expires_days: ExpiresOption = None,
    stream: KeyStreamOption = None,
    config: ConfigOption = None,
    data: DataOption = None,
) -> int:
    """Create a key and print its token, which is not stored and cannot be shown again. A running
    server accepts it at once."""
    from services.cli.serve import keys_add_command

    return keys_add_command(config, data, name, role, expires_days, stream or ())


@keys.command("revoke")
def keys_revoke(
    key_id: Annotated[str, typer.Argument(metavar="ID", help="Id from `keys list`.", show_default=False)],
    config: ConfigOption = None,
    data: DataOption = None,
) -> int:
    """Revoke a key. A running server refuses it at once."""
    from services.cli.serve import keys_revoke_command

    return keys_revoke_command(config, data, key_id)


@audit.command("verify")
def audit_verify(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Audit log to verify.", show_default="audit.jsonl of the service's folder"),
    ] = None,
    config: ConfigOption = None,
    head: Annotated[
        str | None,
        typer.Option(help="Digest of an entry, recorded elsewhere, that the log must contain.", show_default=False),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Detect entries that were changed, removed, inserted or truncated."""
    from services.cli.serve import audit_verify_command

    return audit_verify_command(file, config, head, as_json=json)
