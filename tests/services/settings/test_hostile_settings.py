"""Malformed settings files are refused in one sentence, without a hang and without implicit conversion."""

from __future__ import annotations

import os

import pytest

from services.errors import SettingsInvalid
from services.settings import ServiceSettings, load_settings, yaml_value


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch):
    for name in [name for name in os.environ if name.startswith("INTRASPLAT_")]:
        monkeypatch.delenv(name)


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1: 2", "names in sections are text"),
        ("true: 2", "names in sections are text"),
        ("server:\n  null: 2", "line 2: 'null' is not text"),
        ("? [a]\n: 1", "names in sections are text"),
        ("server:\n  port: " + "9" * 5000, "not YAML that settings may have"),
        ("server:\n  port: 10000000000000000000000", "less than or equal to 65535"),
        ("a: " + "[" * 50_000, "more than 16 deep"),
        ("[" * 50_000 + "]" * 50_000, "more than 16 deep"),
        ("a:\n" + "".join("  " * k + "- \n" for k in range(1, 40)) + "b: {" * 40, "not YAML"),
        (BOMB, "more than 100000 values"),
        ("a: &a [*a]", "contains itself"),
        ("a: &a\n  b: *a", "contains itself"),
        ("server: {port: 1, port: 2}", "'port' occurs twice"),
        ('paths: {data: "a\\0b"}', "zero byte"),
        ("a: 2001-99-99", "not YAML"),
        ("\x00", "not YAML"),
    ],
)
def test_load_settings_rejects_malformed_file_with_short_error(tmp_path, text, said):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(SettingsInvalid, match=said) as refused:
        load_settings(path)
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize("text", ["[" * 50_000, BOMB, "1: 2", "9" * 5000])
def test_load_settings_rejects_malformed_flag_values(text):
    with pytest.raises(SettingsInvalid):
        load_settings(None, {"server.port": text})


def test_load_settings_rejects_deeply_nested_environment_variable(monkeypatch):
    monkeypatch.setenv("INTRASPLAT_SERVER", "[" * 20_000)
    with pytest.raises(SettingsInvalid):
        load_settings()


def _numbers(kind: str) -> list[str]:
    """Return the names of all settings of a kind."""
    wanted = {"number": (int, float), "flag": (bool,)}[kind]
    found = []
    for section, field in ServiceSettings.model_fields.items():
        fields = getattr(field.annotation, "model_fields", {})
        for name, inner in fields.items():
            kinds = {inner.annotation, *getattr(inner.annotation, "__args__", ())}
            if any(each in kinds for each in wanted) and not (kind == "number" and bool in kinds):
                found.append(f"{section}.{name}")
    assert found
    return found


@pytest.mark.parametrize("place", _numbers("number"))
@pytest.mark.parametrize("value", ["true", "false", ".inf", ".nan", "1e300", "'x'"])
def test_number_settings_reject_other_types_and_non_finite_values(place, value):
    with pytest.raises(SettingsInvalid, match=place):
        load_settings(None, {place: value})


@pytest.mark.parametrize("place", _numbers("flag"))
@pytest.mark.parametrize("value", ["1", "0", "1.0", "[]"])
def test_boolean_settings_reject_numbers_and_lists(place, value):
    with pytest.raises(SettingsInvalid, match=place):
        load_settings(None, {place: value})


def test_integer_setting_rejects_float():
    with pytest.raises(SettingsInvalid, match="whole number"):
        load_settings(None, {"server.port": "8000.0"})


def test_load_settings_accepts_yaml_aliases_and_variables(monkeypatch, tmp_path):
    monkeypatch.setenv("INTRASPLAT_SERVER__PORT", "8001")
    path = tmp_path / "s.yaml"
    path.write_text("streams:\n  a: &s {source: 'synthetic:'}\n  b: *s\n")
    settings = load_settings(path)
    assert settings.server.port == 8001
    assert settings.streams["b"].source == "synthetic:"
    assert yaml_value("[1, {a: null}]") == [1, {"a": None}]
