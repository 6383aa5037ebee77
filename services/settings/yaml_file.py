"""YAML file with the line number of each key."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gsplat_core.io.files import read_regular
from services.settings.errors import SettingsInvalid

MOST_BYTES = 2**20
MOST_NESTING = 16
MOST_VALUES = 100_000
_NAME_TAGS = ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge")


@dataclass(frozen=True)
class YamlFile:
    """Values of a settings file."""

    values: dict[str, Any]
    lines: dict[tuple[str, ...], int]
    """Line number of each key, by its path of keys."""
    name: str

    @classmethod
    def read(cls, path: Path) -> YamlFile:
        """Read a file.

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
        """Return the line of a key or of the nearest enclosing section."""
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
        raise ValueError(f"line {line}: {key.value[:60]!r} is there twice, first in line {seen[key.value]}")
    seen[key.value] = line


def _collect(node: yaml.Node, place: tuple[str, ...], lines: dict[tuple[str, ...], int]) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*place, str(key.value))
        lines[here] = key.start_mark.line + 1
        _collect(value, here, lines)
