"""Errors name the source of the refused setting."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from services.errors import SettingsInvalid
from services.settings import _keys, load_settings


def settings_error(file: Path | None = None, flags: dict[str, str] | None = None) -> str:
    with pytest.raises(SettingsInvalid) as error:
        load_settings(file, flags)
    return str(error.value)


def test_settings_error_names_overriding_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("log:\n  level: x\nserver:\n  port: no\n")
    assert "settings.yaml, line 4: server.port" in settings_error(file)
    monkeypatch.setenv("INTRASPLAT_SERVER__PORT", "seven")
    assert "INTRASPLAT_SERVER__PORT: server.port" in settings_error(file)
    assert "--set server.port: server.port" in settings_error(file, {"server.port": "none"})


@pytest.mark.parametrize("name", ["server", "server.port.more"])
def test_settings_error_names_flag_of_section_or_inner_key(name: str) -> None:
    value = "{port: none}" if name == "server" else "1"
    assert settings_error(None, {name: value}).startswith(f"--set {name}: server.port")


def test_settings_error_names_file_if_flag_has_longer_name(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("server:\n  por: 1\n")
    said = settings_error(file, {"server.port": "8080"})
    assert said.endswith("settings.yaml, line 2: there is no key 'por' in server; the nearest is 'port'")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ({"servr.port": "1"}, "there is no key 'servr'; the nearest is 'server'"),
        ({"server.prt": "1"}, "there is no key 'prt' in server; the nearest is 'port'"),
        ({"auth.oidc": "{isuer: x}"}, "there is no key 'isuer' in auth.oidc; the nearest is 'issuer'"),
        ({"server": "1", "server.port": "2"}, "--set server.port: server is given as a value, too"),
    ],
)  # fmt: skip
def test_settings_error_suggests_nearest_key(flags: dict[str, str], said: str) -> None:
    assert said in settings_error(None, flags)


@pytest.mark.parametrize(
    ("variable", "is_refused"),
    [("INTRASPLAT_SERVR__PORT", True), ("INTRASPLAT_RECORDINGS", False), ("OTHER_SERVR__PORT", False)],
)
def test_only_variables_with_prefix_and_section_are_checked(
    variable: str, is_refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "1")
    if is_refused:
        assert settings_error() == f"{variable}: there is no key 'servr'; the nearest is 'server'"
    else:
        load_settings()


@pytest.mark.parametrize(
    ("location", "keys"),
    [(("auth", "oidc"), "issuer"), (("server",), "port"), (("server", "port"), None), (("auth", "oidc", "roles"), None),
     (("none",), None), (("auth", "oidc", "roles", "more"), None)],
)  # fmt: skip
def test_keys_of_location_are_empty_unless_section(location: tuple[str, ...], keys: str | None) -> None:
    assert _keys(location) == [] if keys is None else keys in _keys(location)


def test_data_and_runtime_dirs_follow_settings_then_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_DATA_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    usual = load_settings(None, {})
    assert usual.data_dir == tmp_path / ".local" / "share" / "intrasplat" and str(os.getuid()) in usual.runtime_dir.name
    for name in ("XDG_DATA_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, f"/{name}")
    desktop = load_settings(None, {})
    assert desktop.data_dir == Path("/XDG_DATA_HOME/intrasplat")
    assert desktop.runtime_dir == Path("/XDG_RUNTIME_DIR/intrasplat")
    given = load_settings(None, {"paths.data": "/data", "paths.runtime": "/run/own"})
    assert (given.data_dir, given.runtime_dir) == (Path("/data"), Path("/run/own"))
    assert given.admin_key_file == Path("/data/admin.key")
    assert load_settings(None, {"auth.admin_key_file": "/keys/admin"}).admin_key_file == Path("/keys/admin")
