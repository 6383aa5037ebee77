"""The commands of the service and their options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli import ctl_models
from services.cli.ctl import ctl
from services.cli.options import JsonOption, path_option

ConfigOption = Annotated[Path | None, path_option("--config", "Settings file (YAML); without one: the defaults.")]
DataOption = Annotated[Path | None, path_option("--data", "Folder of what is kept (paths.data).")]

keys = typer.Typer(help="API keys of the service.", no_args_is_help=True)
audit = typer.Typer(help="The service's audit log.", no_args_is_help=True)


def add_to(app: typer.Typer) -> None:
    """Give the program the service's commands."""
    app.command()(serve)
    app.command()(schema)
    app.add_typer(keys, name="keys")
    app.add_typer(audit, name="audit")
    assert ctl_models.ctl is ctl  # it has added its commands
    app.add_typer(ctl, name="ctl")


def serve(
    config: ConfigOption = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.", show_default="127.0.0.1")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.", show_default="8000")] = None,
    data: DataOption = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="<section.key=value>", help="Any setting; more than once for several."),
    ] = None,
) -> int:
    """Serve streams, models and their API to browsers and programs, until it is asked to end."""
    from services.cli.serve import serve_command

    return serve_command(config, host, port, data, setting or ())


def schema() -> int:
    """Print the JSON schema of the service's settings file."""
    from services.cli.serve import schema_command

    return schema_command()


@keys.command("list")
def keys_list(config: ConfigOption = None, data: DataOption = None, json: JsonOption = False) -> int:
    """List the keys, without what makes them keys."""
    from services.cli.keys import keys_list_command

    return keys_list_command(config, data, as_json=json)


@keys.command("add")
def keys_add(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Who it is for, not a person.", show_default=False)],
    role: Annotated[str, typer.Option(help="viewer, operator or admin.")] = "viewer",
    config: ConfigOption = None,
    data: DataOption = None,
) -> int:
    """Make a key and print it; it is not kept and not shown again. A running server takes it at once."""
    from services.cli.keys import keys_add_command

    return keys_add_command(config, data, name, role)


@keys.command("revoke")
def keys_revoke(
    key_id: Annotated[str, typer.Argument(metavar="ID", help="As `keys list` shows it.", show_default=False)],
    config: ConfigOption = None,
    data: DataOption = None,
) -> int:
    """End a key. A running server refuses it at once."""
    from services.cli.keys import keys_revoke_command

    return keys_revoke_command(config, data, key_id)


@audit.command("verify")
def audit_verify(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="The log.", show_default="audit.jsonl of the service's folder")
    ] = None,
    config: ConfigOption = None,
    head: Annotated[
        str | None, typer.Option(help="Digest of an entry, noted elsewhere, that must be there.", show_default=False)
    ] = None,
    json: JsonOption = False,
) -> int:
    """Find entries that were changed, removed, inserted or cut off."""
    from services.cli.audit import audit_verify_command

    return audit_verify_command(file, config, head, as_json=json)
