"""A YAML file with the line of each of its keys."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from services.settings.errors import SettingsInvalid

MOST_BYTES = 2**20


@dataclass(frozen=True)
class YamlFile:
    """The values of a settings file."""

    values: dict[str, Any]
    lines: dict[tuple[str, ...], int]
    """The line of each key, by the keys that lead there."""
    name: str

    @classmethod
    def read(cls, path: Path) -> YamlFile:
        """Read a file; raises SettingsInvalid for one that is not there, not YAML, or names a key twice."""
        try:
            with path.open("rb") as file:
                data = file.read(MOST_BYTES + 1)
        except OSError as error:
            raise SettingsInvalid(f"{path}: {error.strerror}; give the settings file's path") from error
        if len(data) > MOST_BYTES:
            raise SettingsInvalid(f"{path} is longer than {MOST_BYTES} bytes; is it a settings file?")
        lines: dict[tuple[str, ...], int] = {}
        try:
            text = data.decode()
            root = yaml.compose(text, yaml.SafeLoader)
            if root is not None:
                _collect(root, (), lines, path.name)
            values = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise SettingsInvalid(f"{path} is not YAML: {' '.join(str(error).split())}") from error
        except (UnicodeDecodeError, RecursionError) as error:
            raise SettingsInvalid(f"{path} is not readable text: {error}") from error
        if not isinstance(values or {}, dict):
            raise SettingsInvalid(f"{path} holds a {type(values).__name__}; write `section:` and below it `key: value`")
        return cls(values or {}, lines, path.name)

    def line_of(self, location: tuple[int | str, ...]) -> int | None:
        """The line of a key, or of the nearest section around it."""
        for length in range(len(location), 0, -1):
            line = self.lines.get(tuple(str(part) for part in location[:length]))
            if line is not None:
                return line
        return None


def _collect(node: yaml.Node, place: tuple[str, ...], lines: dict[tuple[str, ...], int], name: str) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*place, str(key.value))
        line = key.start_mark.line + 1
        if here in lines:
            raise SettingsInvalid(f"{name}, line {line}: {'.'.join(here)} is there twice, first in line {lines[here]}")
        lines[here] = line
        _collect(value, here, lines, name)
