"""Commands of `intrasplat` and their options. Each command imports its dependencies when it runs."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from operators.settings import JobOptions, LiveOptions, ReconstructOptions, ReplayOptions
from services.cli import model_commands, recording_commands, service
from services.cli.exit_codes import BAD_INPUT, INTERRUPTED, OK, exit_code_of
from services.cli.options import (
    BatchOutOption,
    EvaluatedArgument,
    EvaluateOptions,
    EvaluationOutOption,
    FolderArgument,
    JsonOption,
    LiveOutOption,
    OutOption,
    RecordingArgument,
    RecordKeepOption,
    SourceArgument,
    SynthesizeOptions,
    require_plain_numbers,
    takes_options,
    takes_run_options,
)
from services.cli.streams import sentence

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
        command = typer.main.get_command(app)
        require_plain_numbers(command)
        code = command.main(arguments, prog_name="intrasplat", standalone_mode=False)
    except typer.Abort:
        return INTERRUPTED
    except _USAGE_ERRORS as error:
        return _say_usage(error)
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the single place where errors become exit codes
        return exit_code_of(error, arguments)
    return code if isinstance(code, int) else OK


def _is_empty(word: str) -> bool:
    """Detect an empty argument, or an option with an empty value (`--out=`). No option means anything by one."""
    return not word or (word.startswith("--") and word.endswith("=") and word.count("=") == 1)


def _say_usage(error: Any) -> int:
    """Print a usage error in one sentence, or the help if the command is missing."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return BAD_INPUT
    command = error.ctx.command_path if getattr(error, "ctx", None) is not None else "intrasplat"
    said = " ".join(error.format_message().split()).rstrip(".")
    typer.echo(f"error: {sentence(said)}; `{command} --help` lists what there is", err=True)
    return BAD_INPUT


def _print_version(wanted: bool) -> None:
    if wanted:
        from services.version import product_version

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
    """Reconstruct a recording as if it were live: train on each frame as it arrives, display it,
    score it."""
    from operators.applications.replay import ReplaySettings
    from services.cli.replay import replay_command

    return replay_command(ReplaySettings(recording, out, **options), as_json=json)


@app.command()
@takes_options(JobOptions, "batch")
def batch(
    folder: FolderArgument,
    options: Mapping[str, Any],
    out: BatchOutOption = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=256, help="Replays at one time.", show_default="half of the cores")
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
            "--record", help="Record what comes in, what is trained and what is shown: into recordings/ in --out."
        ),
    ] = False,
    record_keep: RecordKeepOption = None,
    json: JsonOption = False,
) -> int:
    """Reconstruct a stream live: display each frame's reconstruction within its time budget, with
    its age."""
    from services.cli.live import live_command, live_settings

    with live_settings(source, out, record, record_keep or (), **options) as settings:
        return live_command(settings, keep=out is not None, as_json=json)


@app.command()
@takes_options(ReconstructOptions, "reconstruct")
def reconstruct(
    recording: RecordingArgument, out: OutOption, options: Mapping[str, Any], json: JsonOption = False
) -> int:
    """Reconstruct offline: train on all training frames, then evaluate the held-out ones."""
    from operators.applications.replay import ReplaySettings
    from services.cli.reconstruct import reconstruct_command

    chosen = ReconstructOptions(**options)
    return reconstruct_command(ReplaySettings(recording, out, **chosen.options(JobOptions)), chosen.steps, as_json=json)


@app.command()
@takes_run_options
def evaluate(
    model: EvaluatedArgument,
    recording: RecordingArgument,
    options: EvaluateOptions,
    out: EvaluationOutOption = None,
    json: JsonOption = False,
) -> int:
    """Evaluate a model or a run on a recording, next to trivial baselines."""
    from services.cli.evaluate import evaluate_command, evaluation_settings

    return evaluate_command(model, evaluation_settings(recording, options), out, as_json=json)


@app.command()
@takes_run_options
def synthesize(out: OutOption, options: SynthesizeOptions, json: JsonOption = False) -> int:
    """Create a recording with exact ground truth: tissue, tool, stereo, depth, masks and poses,
    with optional extras."""
    from services.cli.synthesize import synthesize_command

    return synthesize_command(out, options, as_json=json)


@app.command()
def doctor(json: JsonOption = False) -> int:
    """Report the capabilities of this machine, missing components and remedies."""
    from services.cli.doctor import doctor_command

    return doctor_command(as_json=json)


model_commands.add_to(app)
recording_commands.add_to(app)
service.add_to(app)
