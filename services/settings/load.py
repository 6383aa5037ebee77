"""Loading of settings from a YAML file, the environment and flags. Errors name the place and the
nearest valid key."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsError,
)

from services.settings.errors import SettingsInvalid
from services.settings.service import ServiceSettings
from services.settings.yaml_file import YamlFile, yaml_value

ENVIRONMENT_PREFIX = "INTRASPLAT_"
Location = tuple[int | str, ...]


def load_settings(file: Path | None = None, flags: Mapping[str, str] | None = None) -> ServiceSettings:
    """Load the settings. `file` overrides the defaults, variables such as INTRASPLAT_SERVER__PORT
    override the file, and flags override all.

    Args:
        file: YAML file, or None.
        flags: values by key, such as {"server.port": "8080"}.

    Raises:
        SettingsInvalid: if a key is unknown, a value is out of range, or the file is unreadable.
    """
    document = YamlFile.read(file) if file is not None else YamlFile({}, {}, "")
    given = _nested(flags or {})
    _refuse_unknown_variables()

    class Settings(ServiceSettings):
        @classmethod
        def settings_customise_sources(
            cls, settings_cls: type[BaseSettings], *_: Any, **__: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return (
                InitSettingsSource(settings_cls, given),
                EnvSettingsSource(settings_cls),
                InitSettingsSource(settings_cls, document.values),
            )

    try:
        return ServiceSettings.model_construct(**dict(Settings()))
    except SettingsError as error:
        raise SettingsInvalid(f"the environment: {error}; give lists and tables as JSON") from error
    except RecursionError as error:
        raise SettingsInvalid("the environment: a value nests lists or tables too deep") from error
    except ValidationError as error:
        said = [_sentence(one["loc"], one, document, flags or {}) for one in error.errors(include_input=False)]
        raise SettingsInvalid("\n".join(said)) from None


def _nested(flags: Mapping[str, str]) -> dict[str, Any]:
    """Convert `{"server.port": "1"}` to `{"server": {"port": "1"}}`; values are parsed as YAML."""
    values: dict[str, Any] = {}
    for name, text in flags.items():
        *sections, key = name.split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise SettingsInvalid(f"--set {name}: {section} is given as a value, too; give one of them")
        try:
            place[key] = yaml_value(text)
        except ValueError as error:
            raise SettingsInvalid(f"--set {name}={text!r:.80} is not YAML ({error!s:.120}); quote it") from error
    return values


def _refuse_unknown_variables() -> None:
    """Refuse environment variables with an unknown section, which pydantic-settings would ignore."""
    for variable in sorted(os.environ):
        section = variable.removeprefix(ENVIRONMENT_PREFIX).partition("__")
        if variable.startswith(ENVIRONMENT_PREFIX) and section[1] and section[0].lower() not in _keys(()):
            raise SettingsInvalid(f"{variable}: {_unknown((section[0].lower(),))}")


def _sentence(location: Location, error: Any, document: YamlFile, flags: Mapping[str, str]) -> str:
    what = _unknown(location) if error["type"] == "extra_forbidden" else f"{_dotted(location)}: {error['msg']}"
    return f"{_place(location, document, flags)}{what}"


def _place(location: Location, document: YamlFile, flags: Mapping[str, str]) -> str:
    """Return the place of a value for an error message: flag, variable or line of the file."""
    dotted = _dotted(location)
    for name in flags:
        if dotted == name or dotted.startswith(f"{name}.") or name.startswith(f"{dotted}."):
            return f"--set {name}: "
    for length in range(len(location), 1, -1):
        variable = ENVIRONMENT_PREFIX + "__".join(str(part) for part in location[:length]).upper()
        if variable in {name.upper() for name in os.environ}:
            return f"{variable}: "
    line = document.line_of(location)
    return "" if line is None else f"{document.name}, line {line}: "


def _unknown(location: Location) -> str:
    keys = _keys(location[:-1])
    wrong = str(location[-1])
    near = difflib.get_close_matches(wrong, keys, n=1, cutoff=0.0)
    inside = f" in {_dotted(location[:-1])}" if len(location) > 1 else ""
    return (
        f"there is no key {wrong!r:.60}{inside}; the nearest is {near[0]!r}"
        if near
        else f"there is no key {wrong!r:.60}{inside}"
    )


def _keys(location: Location) -> list[str]:
    """Return the valid keys of the section at a location."""
    kind: Any = ServiceSettings
    for part in location:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            field = kind.model_fields.get(str(part))
            kind = None if field is None else _without_none(field.annotation)
        else:
            kind = (get_args(kind) or (None,))[-1]
    return sorted(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _without_none(kind: Any) -> Any:
    """Return the section type of an optional section."""
    kinds = [each for each in get_args(kind) if each is not type(None)]
    return kinds[0] if len(kinds) == 1 and type(None) in get_args(kind) else kind


def _dotted(location: Location) -> str:
    return ".".join(str(part) for part in location)
