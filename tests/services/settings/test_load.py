"""Settings from file, environment and flags, and their error messages."""

from __future__ import annotations

import json
import os

import pytest
from pydantic import ValidationError

from services.errors import SettingsInvalid
from services.settings import ServiceSettings, load_settings, masked_address


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch):
    for name in [name for name in os.environ if name.startswith("INTRASPLAT_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def file(tmp_path):
    def write(text: str):
        path = tmp_path / "service.yaml"
        path.write_text(text)
        return path

    return write


def test_flags_override_environment_file_and_defaults(file, monkeypatch):
    path = file("server: {port: 1, host: 127.0.0.2, drain_s: 3}\nlog: {level: debug}\n")
    monkeypatch.setenv("INTRASPLAT_SERVER__PORT", "2")
    monkeypatch.setenv("INTRASPLAT_SERVER__HOST", "127.0.0.3")
    monkeypatch.setenv("INTRASPLAT_ISA", "avx2")  # not a setting of the service
    settings = load_settings(path, {"server.port": "3"})
    server = settings.server
    assert (server.port, server.host, server.drain_s) == (3, "127.0.0.3", 3.0)
    assert (settings.log.level, settings.limits.uploads) == ("debug", 8)
    assert type(settings) is ServiceSettings
    assert "endoscope" in settings.streams


def test_default_settings_use_loopback_and_synthetic_stream():
    settings = load_settings()
    assert (settings.server.host, settings.server.port) == ("127.0.0.1", 8000)
    assert settings.streams["endoscope"].source.startswith("synthetic:")
    assert settings.sources.networks == () and settings.server.trusted_proxies == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("server:\n  prt: 5", "service.yaml, line 2: there is no key 'prt' in server; the nearest is 'port'"),
        ("servr: {}", "service.yaml, line 1: there is no key 'servr'; the nearest is 'server'"),
        ("\nserver:\n  port: 70000", "service.yaml, line 3: server.port: Input should be less than or equal to 65535"),
        ("streams:\n  a:\n    sorce: x\n    source: y", "line 3: there is no key 'sorce' in streams.a; the nearest is 'source'"),
        ("streams:\n  A b: {source: x}", "line 2: streams.A b.[key]: String should match"),
        ("server:\n  port: 1\n  port: 2", "line 3: 'port' occurs twice, first in line 2"),
        ("server: {certfile: a.pem}", "certfile and keyfile belong together"),
        ("server: {trusted_proxies: [everybody]}", "'everybody' is no network"),
        ("version: 2", "version: Input should be 1"),
        ("[1, 2]", "holds a list"),
        ("a: [", "is not YAML"),
        ("a: !!python/object/apply:os.system [id]", "is not YAML"),
    ],
)  # fmt: skip
def test_settings_error_names_line_and_key_of_file(file, text, said):
    with pytest.raises(SettingsInvalid) as refused:
        load_settings(file(text))
    assert said in str(refused.value)


def test_settings_error_lists_all_mistakes(file):
    with pytest.raises(SettingsInvalid) as refused:
        load_settings(file("server: {prt: 1}\nlimits: {uploads: 0}\n"))
    assert len(str(refused.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("INTRASPLAT_SERVER__PRT", "1", "INTRASPLAT_SERVER__PRT: there is no key 'prt' in server; the nearest is 'port'"),
        ("INTRASPLAT_SERVR__PORT", "1", "INTRASPLAT_SERVR__PORT: there is no key 'servr'; the nearest is 'server'"),
        ("INTRASPLAT_SERVER__PORT", "many", "INTRASPLAT_SERVER__PORT: server.port: Input should be a valid integer"),
        ("INTRASPLAT_SERVER__TRUSTED_PROXIES", "10.0.0.1", "give lists and tables as JSON"),
    ],
)  # fmt: skip
def test_settings_error_names_environment_variable(monkeypatch, name, value, said):
    monkeypatch.setenv(name, value)
    with pytest.raises(SettingsInvalid) as refused:
        load_settings()
    assert said in str(refused.value)


def test_settings_error_names_flag_or_missing_file(tmp_path):
    for flags, said in (
        ({"server.prt": "1"}, "--set server.prt: there is no key 'prt' in server"),
        ({"server": "1", "server.port": "2"}, "--set server.port: server is given as a value, too"),
        ({"log.level": "["}, "is not YAML"),
    ):
        with pytest.raises(SettingsInvalid) as refused:
            load_settings(None, flags)
        assert said in str(refused.value)
    with pytest.raises(SettingsInvalid, match="No such file"):
        load_settings(tmp_path / "none.yaml")


def test_settings_errors_and_output_hide_secrets(file):
    with pytest.raises(SettingsInvalid) as refused:
        load_settings(file("registry: {database: [pa55word]}"))
    assert "pa55word" not in str(refused.value)
    settings = load_settings(file("registry: {database: 'postgresql://u:pa55word@db/x'}"))
    assert "pa55word" not in json.dumps(settings.shown()) + repr(settings)
    assert settings.registry.database is not None
    assert settings.registry.database.get_secret_value().endswith("@db/x")


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://user:pass@10.0.0.5/s", "rtsp://**********@10.0.0.5/s"),
        ("rtsp://10.0.0.5/s?user=a&password=b#transport=udp", "rtsp://10.0.0.5/s?user=a&password=**********#transport=udp"),
        ("stereo:rtsp://a:b@h/x|rtsp://c:d@h/y", "stereo:rtsp://**********@h/x|rtsp://**********@h/y"),
        ("synthetic:?moving=1", "synthetic:?moving=1"),
    ],
)  # fmt: skip
def test_masked_address_hides_credentials(address, shown):
    assert masked_address(address) == shown


def test_settings_schema_describes_every_key():
    schema = ServiceSettings.model_json_schema()
    assert set(schema["properties"]) == set(ServiceSettings.model_fields)
    assert schema["$defs"]["ServerSettings"]["additionalProperties"] is False
    for section in schema["$defs"].values():
        for key, value in section["properties"].items():
            assert "description" in value or section["title"] in ("LogSettings",), key


MIB = 2**20
NUMBERS = {
    "server.port": (8000, (0, 65_535), (-1, 65_536)),
    "server.probe_port": (None, (0, 65_535), (-1, 65_536)),
    "server.drain_s": (10, (0, 600), (-0.1, 600.1)),
    "server.takeover_s": (0, (0, 3600), (-0.1, 3600.1)),
    "auth.ticket_s": (30, (0.1, 300), (0, 300.1)),
    "audit.segment_bytes": (16 * MIB, (65_536,), (65_535,)),
    "audit.keep_segments": (None, (1,), (0,)),
    "audit.keep_days": (None, (0.1,), (0,)),
    "limits.body_bytes": (MIB, (1024,), (1023,)),
    "limits.model_bytes": (2048 * MIB, (MIB,), (MIB - 1,)),
    "limits.recording_bytes": (16_384 * MIB, (MIB,), (MIB - 1,)),
    "limits.uploads": (8, (1, 64), (0, 65)),
    "limits.uploads_per_key": (2, (1, 64), (0, 65)),
    "limits.stall_s": (10, (0.1,), (0,)),
    "limits.slowest_bytes_per_s": (4096, (0,), (-1,)),
    "limits.head_s": (10, (0.1,), (0,)),
    "limits.requests_per_s": (100, (0.1,), (0,)),
    "limits.address_requests_per_s": (300, (0.1,), (0,)),
    "limits.burst_s": (2, (0.1, 60), (0.09, 60.1)),
    "limits.connections": (512, (8,), (7,)),
    "limits.connections_per_address": (128, (0,), (-1,)),
    "limits.streams": (16, (1, 1000), (0, 1001)),
    "limits.viewers": (100, (1,), (0,)),
    "limits.viewer_stall_s": (15, (0.1,), (0,)),
    "uploaded_recordings.unpacked_bytes": (65_536 * MIB, (MIB,), (MIB - 1,)),
    "uploaded_recordings.keep_days": (None, (0.1,), (0,)),
    "uploaded_recordings.keep_bytes": (None, (MIB,), (MIB - 1,)),
    "jobs.workers": (1, (1, 256), (0, 257)),
    "jobs.threads": (None, (1, 256), (0, 257)),
    "jobs.attempts": (5, (1, 100), (0, 101)),
    "jobs.lease_s": (15, (2, 3600), (1.9, 3600.1)),
    "jobs.keep_days": (None, (0.1,), (0,)),
    "jobs.keep_results": (None, (1,), (0,)),
}
"""Default, accepted and refused numbers of each setting."""


@pytest.mark.parametrize("name", NUMBERS)
def test_number_settings_have_documented_defaults_and_limits(name):
    usual, accepted, refused = NUMBERS[name]
    section, key = name.split(".")
    assert getattr(getattr(ServiceSettings(), section), key) == usual
    for value in accepted:
        assert getattr(getattr(ServiceSettings(**{section: {key: value}}), section), key) == value
    for value in refused:
        with pytest.raises(ValidationError, match=key):
            ServiceSettings(**{section: {key: value}})


def test_recordings_folder_variable_of_tests_is_not_a_setting(monkeypatch):
    monkeypatch.setenv("INTRASPLAT_RECORDINGS", "/somewhere/recordings")
    assert load_settings(None, {}).uploaded_recordings == ServiceSettings().uploaded_recordings


def test_data_dir_follows_xdg_data_home(tmp_path, monkeypatch):
    """$XDG_DATA_HOME, or ~/.local/share if it is not set or empty (XDG Base Directory Specification)."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert load_settings(None).data_dir == tmp_path / "data" / "intrasplat"
    for unset in (lambda: monkeypatch.setenv("XDG_DATA_HOME", ""), lambda: monkeypatch.delenv("XDG_DATA_HOME")):
        unset()
        assert load_settings(None).data_dir == tmp_path / "home" / ".local" / "share" / "intrasplat"
