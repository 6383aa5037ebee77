"""Implementation of `intrasplat serve` and `intrasplat schema`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import typer

from services.api.app import new_app
from services.api.assembly import assembled
from services.api.health import bind_probe
from services.api.observability import log_to_stderr, say_start
from services.api.server import bind, certificate_of, serve
from services.cli.exit_codes import OK
from services.private_files import keep_files_private, make_state_private
from services.settings import ServiceSettings, SettingsInvalid, load_settings


def serve_command(
    config: Path | None, host: str | None, port: int | None, data: Path | None, setting: Sequence[str]
) -> int:
    """Serve until asked to stop."""
    keep_files_private()
    named = {"server.host": host, "server.port": port, "paths.data": data}
    flags = {name: json.dumps(str(value)) for name, value in named.items() if value is not None}
    settings = load_settings(config, {**_assigned(setting), **flags})
    log_to_stderr(settings.log)
    listener = bind(settings)  # before anything is created or started
    make_state_private(settings.data_dir, settings.uploaded_recordings.folder, settings.jobs.folder)
    parts = assembled(settings)
    certificate = certificate_of(settings, parts.events)
    if certificate is not None:
        parts = replace(
            parts,
            background=[*parts.background, certificate.watched],
            checks={**parts.checks, "certificate": certificate.check},
            collectors=[*parts.collectors, certificate],
        )
    app = new_app(settings, parts)
    probes = bind_probe(settings)
    serve(app, settings, listener, lambda address: _say(address, settings), certificate, probes)
    return OK


def schema_command() -> int:
    """Print the JSON schema of the settings file."""
    typer.echo(json.dumps(ServiceSettings.model_json_schema(), indent=2))
    return OK


def _assigned(setting: Sequence[str]) -> dict[str, str]:
    flags = {}
    for each in setting:
        name, equals, value = each.partition("=")
        if not equals or not name:
            raise SettingsInvalid(f"--set {each!r:.80} has no value; write --set section.key=value")
        flags[name] = value
    return flags


def _say(address: str, settings: ServiceSettings) -> None:
    say_start(f"IntraSplat is on {address}/", f"the administrator's key is in {settings.admin_key_file}")
