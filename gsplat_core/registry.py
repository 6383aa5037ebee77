"""Registry of implementations that a user selects by name, such as deformation fields, renderers, sources and sinks."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any, Generic, TypeVar, cast

from gsplat_core.errors import InvalidInput, InvalidSetting

Kind = TypeVar("Kind")


class Registry(Generic[Kind]):
    """Mapping from names to implementations, iterated in order of registration.

    An entry is either the implementation or its import path `"package.module:attribute"`. The
    module is imported when the name is first looked up, so listing the names imports nothing.
    """

    def __init__(self, what: str, entries: Mapping[str, Kind | str] | None = None) -> None:
        """Create a registry.

        Args:
            what: noun for one entry in error messages, such as "renderer".
            entries: initial entries by name.
        """
        self.what = what
        self._entries: dict[str, Any] = dict(entries or {})

    def add(self, name: str, kind: Kind | str) -> None:
        """Register `kind` as `name`.

        Raises:
            InvalidInput: if the name is taken.
        """
        if name in self._entries:
            raise InvalidInput(f"a {self.what} named {name!r} already exists; choose another name")
        self._entries[name] = kind

    def remove(self, name: str) -> None:
        """Remove the entry of `name`.

        Raises:
            InvalidSetting: if the name is not registered.
        """
        self.check(name)
        del self._entries[name]

    def __getitem__(self, name: str) -> Kind:
        """Return the implementation registered under `name`.

        Raises:
            InvalidSetting: if the name is not registered; the message lists the known names.
        """
        self.check(name)
        entry = self._entries[name]
        if isinstance(entry, str):
            module, attribute = entry.split(":")
            entry = self._entries[name] = getattr(importlib.import_module(module), attribute)
        return cast(Kind, entry)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def check(self, name: str) -> None:
        """Check that a name is registered.

        Raises:
            InvalidSetting: if not; the message lists the known names.
        """
        if name not in self._entries:
            raise InvalidSetting(f"unknown {self.what} {name!r}; known are {', '.join(self._entries) or 'none'}")
