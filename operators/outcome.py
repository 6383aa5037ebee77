"""What a run has reached, put together from what its operators have to say."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, TypeVar, cast, runtime_checkable

from gsplat_core.errors import InvalidInput

Part = TypeVar("Part")


class OutcomeBuilder:
    """Takes parts of the outcome: at most one of each type, files by name, notes in sentences.

    A part is a value of a class of its own (a frozen dataclass), defined beside the operator that contributes it; whoever reads the outcome
    asks for that class.
    """

    def __init__(self) -> None:
        self._parts: dict[type, object] = {}
        self._outputs: dict[str, Path] = {}
        self._notes: list[str] = []

    def add(self, part: object) -> None:
        """Take a part. Raises InvalidInput when there is one of its type."""
        kind = type(part)
        if kind in self._parts:
            raise InvalidInput(
                f"two operators of one run contribute a {kind.__name__} to its outcome; leave one of them out"
            )
        self._parts[kind] = part

    def output(self, name: str, path: Path) -> None:
        """Say that the file or folder `path` was written. Raises InvalidInput when another one has the name."""
        if self._outputs.setdefault(name, path) != path:
            raise InvalidInput(f"two outputs of one run are named {name!r}: {self._outputs[name]} and {path}")

    def note(self, text: str) -> None:
        """Say something about the run, in a sentence."""
        self._notes.append(text)

    def find(self, kind: type[Part]) -> Part | None:
        """The part of this type; None where nobody contributed one."""
        return cast("Part | None", self._parts.get(kind))

    @property
    def parts(self) -> Mapping[type, object]:
        """The parts so far, by type."""
        return dict(self._parts)

    @property
    def outputs(self) -> dict[str, Path]:
        """What was written so far, by name."""
        return dict(self._outputs)

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes so far, in order."""
        return tuple(self._notes)


@runtime_checkable
class Contributor(Protocol):
    """An operator, or a whole graph, that has something to say about its run."""

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add what is known now. Called once the run is over, and once before it starts, so that a conflict is found before any work."""
        ...
