"""Commands of `intrasplat ctl` for recordings and replays."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from services.cli.ctl_client import (
    DEFAULT_URL,
    CaOption,
    KeyFileOption,
    OverwriteOption,
    UrlOption,
    check_download,
    print_found,
    with_client,
)
from services.cli.exit_codes import OK
from services.cli.options import JsonOption
from services.cli.tables import Columns

RECORDING: Columns = {
    "name": "RECORDING", "state": "STATE", "kind": "KIND", "description.frames": "FRAMES", "kept_bytes": "SIZE", "uploaded_at": "UPLOADED",
    "uploaded_by": "BY", "reason": "REASON",
}  # fmt: skip
REPLAY: Columns = {
    "id": "ID", "recording": "RECORDING", "state": "STATE", "frames_done": "DONE", "frames": "FRAMES", "psnr_db": "TRAINING PSNR DB",
    "created_at": "STARTED", "reason": "REASON",
}  # fmt: skip
KEPT: Columns = {"name": "MODEL", "version": "VERSION", "state": "STATE"}
RecordingName = Annotated[str, typer.Argument(metavar="RECORDING", show_default=False)]
OptionsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="<name=value>",
        help="An option of the engine, as `intrasplat replay` and `live` have it; more than once for several.",
        show_default=False,
    ),
]
ReplayId = Annotated[str, typer.Argument(metavar="REPLAY", help="As `ctl replays` shows it.", show_default=False)]


def add_to(ctl: typer.Typer) -> None:
    """Add these commands to `intrasplat ctl`."""
    for name, command in (
        ("recordings", recordings), ("add-recording", add_recording), 
        ("replays", replays), ("replay", replay), ("cancel", cancel), ("result", result), ("keep", keep),
    ):  # fmt: skip
        ctl.command(name)(command)


def recordings(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """List the uploaded recordings."""
    return print_found(with_client(url, key_file, ca, lambda client: client.recordings()), RECORDING, json)


def add_recording(
    name: RecordingName,
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="A video, a zip archive, or a recording's folder.", show_default=False),
    ],
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Upload a recording and wait for its check. A folder is packed first."""

    def act(client: Any) -> Any:
        with _packed(path) as file:
            client.upload_recording(name, file)
        return client.checked_recording(name)

    found = with_client(url, key_file, ca, act)
    print_found([found], RECORDING, False)
    if found.state == "rejected":
        raise InvalidSetting(f"{name} was rejected: {found.reason}")
    return OK


def replays(
    batch: Annotated[str | None, typer.Option(help="Of this batch alone.", show_default=False)] = None,
    count: Annotated[int, typer.Option(min=1, max=500, help="So many, the newest first.")] = 20,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    json: JsonOption = False,
) -> int:
    """List the newest replays."""
    found = with_client(url, key_file, ca, lambda client: client.replays(count=count, batch=batch))
    return print_found(found, REPLAY, json)


def replay(
    names: Annotated[list[str], typer.Argument(metavar="RECORDING...", show_default=False)],
    option: OptionsOption = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until it has ended.")] = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Start a replay of each given recording."""
    options = assigned(option or ())

    def act(client: Any) -> Any:
        made = client.start_replays(names, options)
        return [client.ended_replay(one) if wait else client.replay(one) for one in made.ids]

    found = with_client(url, key_file, ca, act)
    print_found(found, REPLAY, False)
    failed = [one for one in found if wait and one.state != "done"]
    if failed:
        raise InvalidSetting(f"{failed[0].recording}: the replay is {failed[0].state}: {failed[0].reason}")
    return OK


def cancel(job_id: ReplayId, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Cancel a replay that has not ended."""
    return print_found([with_client(url, key_file, ca, lambda client: client.cancel_replay(job_id))], REPLAY, False)


def result(
    job_id: ReplayId,
    name: Annotated[str, typer.Argument(metavar="FILE", help="Such as report.html.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="Where to put it.", show_default="its name, in this folder")] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Download a result file of a replay: report.html, report.json, frames.jsonl,
    reconstruction.mp4, model.isplat."""
    target = out or Path(Path(name).name)
    check_download(target, overwrite)
    with_client(url, key_file, ca, lambda client: client.result(job_id, name, target, overwrite=overwrite))
    typer.echo(str(target))
    return OK


def keep(
    job_id: ReplayId,
    model: Annotated[str, typer.Argument(metavar="MODEL", show_default=False)],
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Store a replay's model in the registry, as the next version of a model."""
    found = with_client(url, key_file, ca, lambda client: client.keep_model(job_id, model))
    return print_found([found], KEPT, False)


@contextmanager
def _packed(path: Path) -> Iterator[Path]:
    """Provide a file, packing a folder into a temporary archive. Nothing is deflated, because
    images are already compressed."""
    if not path.is_dir():
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder) / "recording.zip"
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED, strict_timestamps=False) as opened:
            for file in sorted(each for each in path.rglob("*") if each.is_file()):
                if not file.resolve().is_relative_to(path.resolve()):
                    raise InvalidSetting(
                        f"{file} is a link that leads out of {path}; copy the file in place of linking it"
                    )
                try:
                    opened.write(file, file.relative_to(path))
                except UnicodeEncodeError as error:
                    raise InvalidSetting(f"the name of {str(file)!r} is no text; rename it") from error
                except OSError as error:
                    raise InvalidSetting(f"{file} cannot be read: {error.strerror or error}; check it") from error
        yield archive


def assigned(texts: Iterable[str]) -> dict[str, Any]:
    """Parse options of the form `name=value`. Raises InvalidSetting for another form."""
    return dict(_assigned(each) for each in texts)


def _assigned(text: str) -> tuple[str, Any]:
    """Parse `name=value`, with the value as YAML: a number, a boolean or a word."""
    from services.settings.load import yaml_value

    name, equals, value = text.partition("=")
    if not equals or not name:
        raise InvalidSetting(f"--option {text!r:.80} has no value; write --option name=value")
    try:
        read = yaml_value(value)
        if not isinstance(read, str | int | float | None):
            raise ValueError("it is neither a number nor a word")
        return name.replace("-", "_"), read
    except ValueError as error:
        raise InvalidSetting(
            f"--option {text!r:.80} cannot be read ({error!s:.100}); write a number, true, false or a word"
        ) from error
