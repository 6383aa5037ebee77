"""Loading of settings from a YAML file, the environment and flags.

An error message names the origin of the value: line of the file, environment variable or flag. Limits on size, nesting
and aliases are checked before a file is parsed.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsError,
)

from gsplat_core.io.files import read_regular
from services.errors import SettingsInvalid
from services.settings.sections import ServiceSettings

MOST_BYTES = 2**20
MOST_NESTING = 16
MOST_VALUES = 100_000
_NAME_TAGS = ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge")


@dataclass(frozen=True)
class YamlFile:
    """Values of a settings file."""

    values: dict[str, Any]
    lines: dict[tuple[str, ...], int]
    """Line number of each key, by its path of keys. Keys inside lists are not included."""
    name: str

    @classmethod
    def read(cls, path: Path) -> YamlFile:
        """Read a YAML settings file.

        Raises:
            SettingsInvalid: if the file is missing, is not YAML, or repeats a key.
        """
        try:
            data = read_regular(path, MOST_BYTES)
        except OSError as error:
            raise SettingsInvalid(f"{path}: {error.strerror}; give the settings file's path") from error
        try:
            text = data.decode()
        except UnicodeDecodeError as error:
            raise SettingsInvalid(f"{path} is not readable text: {error}") from error
        try:
            values = yaml_value(text)
            root = yaml.compose(text, yaml.SafeLoader)
        except ValueError as error:
            raise SettingsInvalid(f"{path} is not YAML that settings may have: {error}") from error
        lines: dict[tuple[str, ...], int] = {}
        if root is not None:
            _collect(root, (), lines)
        if not isinstance(values or {}, dict):
            raise SettingsInvalid(f"{path} holds a {type(values).__name__}; write `section:` and below it `key: value`")
        return cls(values or {}, lines, path.name)

    def line_of(self, location: tuple[int | str, ...]) -> int | None:
        """Return the line number of a key, or of the nearest enclosing section that is in the file; None without one."""
        for length in range(len(location), 0, -1):
            line = self.lines.get(tuple(str(part) for part in location[:length]))
            if line is not None:
                return line
        return None


def yaml_value(text: str) -> Any:
    """Parse a YAML text. Nesting is limited to MOST_NESTING and the number of values to
    MOST_VALUES, counting each use of an alias. Keys are text.

    Raises:
        ValueError: if the text is not YAML or exceeds a limit; the message has one line.
    """
    try:
        _check_nesting(text)
        root = yaml.compose(text, yaml.SafeLoader)
        if root is not None:
            _count(root, {})
        return yaml.safe_load(text)
    except (yaml.YAMLError, OverflowError, ValueError) as error:  # ValueError: also invalid dates and numbers
        raise ValueError(" ".join(str(error).split())) from error


def _check_nesting(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_NESTING:
            line = event.start_mark.line + 1
            raise ValueError(f"line {line}: lists and sections are more than {MOST_NESTING} deep inside each other")


def _count(node: yaml.Node, counted: dict[int, int]) -> int:
    """Return the number of values of a node.

    Raises:
        ValueError: if there are more than MOST_VALUES, or a key or text is not allowed.
    """
    line = node.start_mark.line + 1
    if isinstance(node, yaml.ScalarNode):
        if "\0" in node.value:
            raise ValueError(f"line {line}: {node.value!r:.60} holds a zero byte")
        return 1
    if id(node) in counted:
        if counted[id(node)] < 0:
            raise ValueError(f"line {line}: a value contains itself")
        return counted[id(node)]
    counted[id(node)] = -1
    total = 1
    pairs = node.value if isinstance(node, yaml.MappingNode) else [(None, each) for each in node.value]
    seen: dict[str, int] = {}
    for key, value in pairs:
        if key is not None:
            _check_name(key, seen)
        total += _count(value, counted)
        if total > MOST_VALUES:
            raise ValueError(f"line {line}: it has more than {MOST_VALUES} values")
    counted[id(node)] = total
    return total


def _check_name(key: yaml.Node, seen: dict[str, int]) -> None:
    line = key.start_mark.line + 1
    if not isinstance(key, yaml.ScalarNode) or key.tag not in _NAME_TAGS:
        shown = repr(key.value)[:60] if isinstance(key, yaml.ScalarNode) else "a list or a section"
        raise ValueError(f"line {line}: {shown} is not text; names in sections are text, put it in quotes")
    if "\0" in key.value:
        raise ValueError(f"line {line}: {key.value!r:.60} holds a zero byte")
    if key.value in seen:
        raise ValueError(f"line {line}: {key.value[:60]!r} occurs twice, first in line {seen[key.value]}")
    seen[key.value] = line


def _collect(node: yaml.Node, place: tuple[str, ...], lines: dict[tuple[str, ...], int]) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*place, str(key.value))
        lines[here] = key.start_mark.line + 1
        _collect(value, here, lines)


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
    """Return the origin of an invalid value as a prefix for the error message: flag, environment variable or line of
    the file.
    """
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
    """Return the valid keys of the section at a location; none if it is no section."""
    kind: Any = ServiceSettings
    for part in location:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            field = kind.model_fields.get(str(part))
            kind = None if field is None else _without_none(field.annotation)
        else:
            kind = (get_args(kind) or (None,))[-1]
    return sorted(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _without_none(kind: Any) -> Any:
    """Return the type without None of a section that may be None."""
    kinds = [each for each in get_args(kind) if each is not type(None)]
    return kinds[0] if len(kinds) == 1 and type(None) in get_args(kind) else kind


def _dotted(location: Location) -> str:
    return ".".join(str(part) for part in location)
