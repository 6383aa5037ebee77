"""Outcome of a run, collected from its operators."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, TypeVar, cast, runtime_checkable

from gsplat_core.errors import InvalidInput

Part = TypeVar("Part")


class OutcomeBuilder:
    """Collects parts of the outcome, output files by name, and notes for the user.

    A part is a frozen dataclass defined in the module of the operator that contributes it. There is
    at most one part per class, and readers look it up by its class.
    """

    def __init__(self) -> None:
        self._parts: dict[type, object] = {}
        self._outputs: dict[str, Path] = {}
        self._notes: list[str] = []

    def add(self, part: object) -> None:
        """Add a part: results of one contributor, as a dataclass. Raises InvalidInput if a part of the same class exists."""
        kind = type(part)
        if kind in self._parts:
            raise InvalidInput(
                f"two operators of one run contribute a {kind.__name__} to its outcome; leave one of them out"
            )
        self._parts[kind] = part

    def output(self, name: str, path: Path) -> None:
        """Register a written file or folder. Raises InvalidInput if another path has the name."""
        if self._outputs.setdefault(name, path) != path:
            raise InvalidInput(f"two outputs of one run are named {name!r}: {self._outputs[name]} and {path}")

    def note(self, text: str) -> None:
        """Add a note on the run for the user, one sentence."""
        self._notes.append(text)

    def find(self, kind: type[Part]) -> Part | None:
        """Return the part of this class; None if no operator contributed it."""
        return cast("Part | None", self._parts.get(kind))

    @property
    def parts(self) -> Mapping[type, object]:
        """Return the parts added so far, by class."""
        return dict(self._parts)

    @property
    def outputs(self) -> dict[str, Path]:
        """Return the paths of the registered outputs, by name."""
        return dict(self._outputs)

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(self._notes)


@runtime_checkable
class Contributor(Protocol):
    """An operator or a graph that contributes to the outcome of its run."""

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add this contributor's current results to `outcome`. Called before the run, to detect conflicts early, and after it."""
        ...
