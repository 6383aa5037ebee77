"""Service commands of `intrasplat` and their options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from services.cli.ctl import ExpiresOption, KeyName, KeyStreamOption, RoleOption, ctl
from services.cli.options import (
    DeviceOption,
    JsonOption,
    OrderOption,
    SamplesOption,
    SupersamplingOption,
    path_argument,
    path_option,
    renderer_options,
)

ConfigOption = Annotated[Path | None, path_option("--config", "Settings file (YAML). Default: built-in settings.")]
DataOption = Annotated[Path | None, path_option("--data", "Data folder (paths.data).")]

keys = typer.Typer(help="API keys of the service.", no_args_is_help=True)
audit = typer.Typer(help="The service's audit log.", no_args_is_help=True)


def add_to(app: typer.Typer) -> None:
    """Add the service commands, such as `serve` and `keys`, to the command line program."""
    app.command()(serve)
    app.command()(schema)
    app.command()(backup)
    app.command()(restore)
    app.command()(igtl)
    app.command()(view)
    app.add_typer(keys, name="keys")
    app.add_typer(audit, name="audit")
    app.add_typer(ctl, name="ctl")


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


def schema() -> int:
    """Print the JSON schema of the service's settings file."""
    from services.cli.serve import schema_command

    return schema_command()


def backup(
    target: Annotated[Path, path_argument("TARGET", "New folder for the backup.")],
    config: ConfigOption = None,
    data: DataOption = None,
    json: JsonOption = False,
) -> int:
    """Copy all data of the service into a new folder, whether it runs or not."""
    from services.cli.serve import backup_command

    return backup_command(target, config, data, as_json=json)


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
    from services.cli.view import igtl_command

    return igtl_command(
        stream, config, runtime, kind=kind, host=host, port=port, name=name, spacing_mm=spacing_mm, plaintext=plaintext
    )


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
    samples: SamplesOption = None,
    supersampling: SupersamplingOption = None,
    order: OrderOption = None,
    device: DeviceOption = "cpu",
) -> int:
    """Show a model in browsers, with free viewpoint and playback."""
    from services.cli.view import view_command

    sampled = renderer is not None and renderer in RENDERERS and "samples" in RENDERERS[renderer].capabilities.options
    if sampled and samples is None:
        samples = 1  # the picture gains samples while the camera stands still
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
