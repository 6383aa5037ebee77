"""Commands of `intrasplat ctl`: delete, keys, audit log, health, and a refreshing status."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from services.cli.ctl_client import DEFAULT_URL, CaOption, KeyFileOption, UrlOption, print_found, with_client
from services.cli.exit_codes import OK
from services.cli.options import JsonOption
from services.cli.streams import printable
from services.cli.tables import KEY_COLUMNS, Columns, table

if TYPE_CHECKING:
    from services.client import Client
    from services.schemas.service import AuditPage
    from services.schemas.streams import StreamView

YesOption = Annotated[bool, typer.Option("--yes", help="Do not ask.")]
AUDIT: Columns = {
    "seq": "NUMBER", "at": "WHEN", "event": "ACTION", "actor": "BY", "subject": "ON", "outcome": "OUTCOME", "detail": "DETAILS",
}  # fmt: skip
HEALTH: Columns = {"name": "CHECK", "ok": "WELL", "needed": "NEEDED", "detail": "DETAILS"}
MYSELF: Columns = {"name": "NAME", "key_id": "ID", "role": "ROLE", "streams": "STREAMS", "expires_at": "EXPIRES"}
WATCHED: Columns = {
    "name": "STREAM", "state": "STATE", "capture_hz": "CAMERA/S", "shown_hz": "SHOWN/S", "age_ms": "AGE MS",
    "psnr_db": "TRAINING PSNR DB", "previous_psnr_db": "PREVIOUS FRAME DB", "restarts": "RESTARTS", "displays": "DISPLAYS", "reason": "REASON",
}  # fmt: skip
CLEAR = "\x1b[H\x1b[2J"
SPAN = re.compile(r"(\d{1,6})([smhd])", re.ASCII)
UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}

delete = typer.Typer(help="Delete something, after asking.", no_args_is_help=True)
keys = typer.Typer(help="API keys of the service.", no_args_is_help=True)


def add_to(ctl: typer.Typer) -> None:
    """Add these commands to `intrasplat ctl`."""
    ctl.add_typer(delete, name="delete")
    ctl.add_typer(keys, name="keys")
    for name, command in (("audit", audit), ("watch", watch), ("health", health), ("whoami", whoami)):
        ctl.command(name)(command)


def check_sure(what: str, yes: bool) -> None:
    """Ask for confirmation of a deletion.

    Raises:
        InvalidSetting: if it is declined, or there is neither a terminal nor `--yes`.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise InvalidSetting(f"{what} would be gone for good; give --yes where nobody can be asked")
    if not typer.confirm(f"Delete {what}? This cannot be undone.", default=False, err=True):
        raise InvalidSetting("nothing was deleted")


def _deleted(
    url: str,
    key_file: Any,
    ca: Any,
    yes: bool,
    what: str,
    find: Callable[[Client], object],
    act: Callable[[Client], None],
) -> int:
    """Delete an existing resource. The lookup comes first, so a mistyped name fails before the
    confirmation."""

    def look_and_act(client: Client) -> None:
        find(client)
        check_sure(what, yes)
        act(client)

    with_client(url, key_file, ca, look_and_act)
    typer.echo(f"deleted {what}")
    return OK


@delete.command("stream")
def delete_stream(
    name: Annotated[str, typer.Argument(metavar="STREAM", show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Stop and delete a stream. Its live reconstruction is lost unless a snapshot was taken."""
    return _deleted(
        url, key_file, ca, yes, f"the stream {name}", lambda client: client.stream(name), lambda client: client.delete_stream(name)
    )  # fmt: skip


@delete.command("version")
def delete_version(
    model: Annotated[str, typer.Argument(metavar="MODEL", show_default=False)],
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Delete a version of a model. The active version cannot be deleted."""
    return _deleted(
        url, key_file, ca, yes, f"version {version} of the model {model}",
        lambda client: client.version(model, version), lambda client: client.delete_version(model, version),
    )  # fmt: skip


@delete.command("recording")
def delete_recording(
    name: Annotated[str, typer.Argument(metavar="RECORDING", show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Delete a recording that no replay uses."""
    return _deleted(
        url, key_file, ca, yes, f"the recording {name}",
        lambda client: client.recording(name), lambda client: client.delete_recording(name),
    )  # fmt: skip


@delete.command("replay")
def delete_replay(
    job_id: Annotated[str, typer.Argument(metavar="REPLAY", help="As `ctl replays` shows it.", show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Delete an ended replay with its results."""
    return _deleted(
        url, key_file, ca, yes, f"the replay {job_id} and its results",
        lambda client: client.replay(job_id), lambda client: client.delete_replay(job_id),
    )  # fmt: skip


@delete.command("snapshot")
def delete_snapshot(
    stream: Annotated[str, typer.Argument(metavar="STREAM", show_default=False)],
    snapshot_id: Annotated[str, typer.Argument(metavar="SNAPSHOT", show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Delete a snapshot of a stream."""

    def find(client: Client) -> None:
        if all(each.id != snapshot_id for each in client.snapshots(stream)):
            raise InvalidSetting(f"{stream} has no snapshot {snapshot_id!r:.60}; `ctl snapshots {stream}` lists them")

    return _deleted(
        url, key_file, ca, yes, f"the snapshot {snapshot_id} of {stream}",
        find, lambda client: client.delete_snapshot(stream, snapshot_id),
    )  # fmt: skip


@keys.command("list")
def keys_list(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """List the keys, without their secrets."""
    return print_found(with_client(url, key_file, ca, lambda client: client.keys()), KEY_COLUMNS, json)


@keys.command("add")
def keys_add(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Who it is for, not a person.", show_default=False)],
    role: Annotated[str, typer.Option(help="viewer, operator or admin.")] = "viewer",
    expires_days: Annotated[
        float | None, typer.Option(help="Refused after so many days.", show_default="valid until it is revoked")
    ] = None,
    stream: Annotated[
        list[str] | None,
        typer.Option("--stream", metavar="<name>", help="Limit it to this stream; more than once for several."),
    ] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Create a key and print its token, which is not stored and cannot be shown again."""
    from services.cli.keys import expiry_in

    expires_at = expiry_in(expires_days)
    made = with_client(
        url, key_file, ca, lambda client: client.make_key(name, role, expires_at=expires_at, streams=stream or None)
    )
    typer.echo(printable(made.key))
    return OK


@keys.command("revoke")
def keys_revoke(
    key_id: Annotated[str, typer.Argument(metavar="ID", help="As `ctl keys list` shows it.", show_default=False)],
    yes: YesOption = False,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Revoke a key. It is refused from the next request on."""

    def find(client: Client) -> None:
        if all(each.id != key_id for each in client.keys()):  # noqa: SIM118
            raise InvalidSetting(f"there is no key {key_id!r:.60}; `ctl keys list` shows them")

    return _deleted(url, key_file, ca, yes, f"the key {key_id}", find, lambda client: client.revoke_key(key_id))


def audit(
    event: Annotated[
        str | None, typer.Option(help="As model.activate, or model for all of its events.", show_default=False)
    ] = None,
    actor: Annotated[str | None, typer.Option(help="Part of who did it.", show_default=False)] = None,
    subject: Annotated[str | None, typer.Option(help="Part of what it was done to.", show_default=False)] = None,
    outcome: Annotated[str | None, typer.Option(help="done, refused or failed.", show_default=False)] = None,
    since: Annotated[str | None, typer.Option(help="A time, or how long ago: 30m, 2h, 7d.", show_default=False)] = None,
    until: Annotated[str | None, typer.Option(help="A time, or how long ago.", show_default=False)] = None,
    count: Annotated[int, typer.Option(min=1, max=500, help="So many of the newest, for a table.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", help="Go on with what is done from now on.")] = False,
    format: Annotated[str, typer.Option(help="table, or all that fits as jsonl or csv, the oldest first.")] = "table",
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Show audit log entries, oldest first."""
    wanted: dict[str, Any] = {
        "event": event, "actor": actor, "subject": subject, "outcome": outcome, "since": moment(since), "until": moment(until),
    }  # fmt: skip
    if format not in ("table", "csv", "jsonl"):
        raise InvalidSetting(f"--format is {format!r:.40}; choose table, csv or jsonl")
    if format != "table":
        if follow:
            raise InvalidSetting("--follow goes with --format table; leave one of them out")

        def save(client: Client) -> None:
            for line in client.export_audit(format, **wanted):
                typer.echo(line)

        with_client(url, key_file, ca, save)
        return OK
    with_client(url, key_file, ca, lambda client: _show_audit(client, wanted, count, follow))
    return OK


FOLLOW_S = 2.0


def _show_audit(client: Client, wanted: Mapping[str, Any], count: int, follow: bool) -> None:
    page = _filled(client, wanted, count)
    seen = page.head_seq
    lines = table(AUDIT, [entry.model_dump() for entry in reversed(page.entries)])
    typer.echo("\n".join(lines))
    while follow:
        time.sleep(FOLLOW_S)
        newer = []
        page = client.audit(500, **wanted)
        head = page.head_seq
        while True:
            newer += [entry for entry in page.entries if entry.seq > seen]
            if page.next_before is None or page.next_before <= seen + 1:
                break
            page = client.audit(500, page.next_before, **wanted)
        seen = max(seen, head)
        if newer:
            typer.echo("\n".join(table(AUDIT, [entry.model_dump() for entry in reversed(newer)])[1:]))


def _filled(client: Client, wanted: Mapping[str, Any], count: int) -> AuditPage:
    """Collect up to `count` entries. Several requests may be needed, because the server searches
    the log in parts."""
    page = first = client.audit(count, **wanted)
    entries = list(page.entries)
    while page.next_before is not None and len(entries) < count:
        page = client.audit(count - len(entries), page.next_before, **wanted)
        entries += page.entries
    return first.model_copy(update={"entries": entries})


def moment(text: str | None) -> datetime | None:
    """Parse a time: ISO 8601, in this machine's zone by default, or a span such as 2h before now.

    Raises:
        InvalidSetting: if the text is neither.
    """
    if text is None:
        return None
    try:
        if (span := SPAN.fullmatch(text)) is not None:
            return datetime.now(UTC) - timedelta(**{UNITS[span[2]]: int(span[1])})
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidSetting(
            f"{text!r:.60} is no time; write it as 2026-11-23T20:30:00+01:00, or as 30m, 2h or 7d before now"
        ) from error


def health(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """Show each readiness check of the service. Exit code 2 if it is not ready."""
    ready = with_client(url, key_file, ca, lambda client: client.ready())
    if json:
        typer.echo(ready.model_dump_json(indent=2))
    else:
        rows = [{"name": name, **check.model_dump()} for name, check in (ready.checks or {}).items()]
        typer.echo("\n".join([f"the service is {ready.status}", *table(HEALTH, rows)]))
    if ready.status == "not ready":
        raise InvalidSetting("the service is not ready; the checks above say why")
    return OK


def whoami(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """Show name, role and limits of the key in use."""
    return print_found([with_client(url, key_file, ca, lambda client: client.myself())], MYSELF, json)


def watch(
    stream: Annotated[str | None, typer.Argument(metavar="[STREAM]", show_default=False)] = None,
    every: Annotated[float, typer.Option(min=0.2, max=3600, help="Seconds between two looks.")] = 2.0,
    looks: Annotated[int | None, typer.Option(min=1, help="End after so many.", show_default="go on")] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Show the streams periodically: state, rates, age, restarts and displays. Ends with Ctrl-C."""
    from services.client import ClientError

    def look(client: Client) -> None:
        done = 0
        while True:
            try:
                lines = _status(client, stream)
            except ClientError as error:
                if done == 0:
                    raise
                lines = [f"no answer since the last look: {error}"]
            typer.echo((CLEAR if sys.stdout.isatty() else "") + "\n".join(lines))
            done += 1
            if done == looks:
                return
            time.sleep(every)

    with_client(url, key_file, ca, look)
    return OK


def _status(client: Client, stream: str | None) -> list[str]:
    streams = client.streams() if stream is None else [client.stream(stream)]
    ready = client.ready()
    unwell = [f"{name}: {check.detail}" for name, check in (ready.checks or {}).items() if not check.ok]
    head = f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S %z}  {client.url}  {ready.status}"
    return [printable(head), *map(printable, unwell), *table(WATCHED, [stream_row(each) for each in streams])]


def stream_row(stream: StreamView) -> dict[str, Any]:
    """Convert a stream to a table row: frame rates, the newest picture's age and training PSNR,
    restarts and displays."""
    capture, engine = (stream.processes.get(role) or {} for role in ("capture", "engine"))
    figures = engine.get("figures")
    picture = figures.get("picture") if isinstance(figures, Mapping) else None
    shown = picture if isinstance(picture, Mapping) else {}
    restarts = [each["restarts"] for each in (capture, engine) if isinstance(each.get("restarts"), int)]
    return {
        **stream.model_dump(include={"name", "state", "show", "source", "reason"}),
        "capture_hz": _figure(capture.get("rate_hz")),
        "shown_hz": _figure(engine.get("rate_hz")),
        "age_ms": _figure(shown.get("age_ms")),
        "psnr_db": _figure(shown.get("psnr_db")),
        "previous_psnr_db": _figure(shown.get("previous_frame_psnr_db", shown.get("previous_frame_psnr"))),
        "restarts": sum(restarts) if restarts else None,
        "displays": ", ".join(f"{count} {kind}" for kind, count in stream.viewers.items() if count),
    }


def _figure(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
