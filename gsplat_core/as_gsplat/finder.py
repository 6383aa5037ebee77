"""Import hook that serves the modules of `names.MODULES`."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

from gsplat_core.as_gsplat.names import MODULES


class AliasModule(ModuleType):
    """Module whose attributes are imported from the modules that define them when first used."""

    __all__: list[str]

    def __init__(self, name: str, homes: Mapping[str, str]) -> None:
        super().__init__(name, f"`gsplat_core` under the name {name}.")
        self._homes = dict(homes)
        self._children = [each for each in MODULES if each.rpartition(".")[0] == name]
        self.__all__ = sorted(homes)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__version__":
            raise AttributeError(name)
        full = f"{self.__name__}.{name}"
        if name in self._homes:
            home, _, known_as = self._homes[name].partition(":")
            value = getattr(importlib.import_module(home), known_as or name)
        elif full in self._children:
            value = importlib.import_module(full)
        else:
            raise AttributeError(
                f"module {self.__name__!r} has no attribute {name!r}: gsplat_core has {', '.join(self.__all__) or 'none'}"
            )
        setattr(self, name, value)
        return value

    def __dir__(self) -> list[str]:
        return sorted([*self.__all__, *(child.rpartition(".")[2] for child in self._children)])


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the modules of `MODULES` before any installed gsplat."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of a module of `MODULES`; None for others."""
        if fullname not in MODULES:
            return None
        return importlib.machinery.ModuleSpec(
            fullname, self, is_package=any(each.startswith(f"{fullname}.") for each in MODULES)
        )

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Return the module, without importing what it names."""
        return AliasModule(spec.name, MODULES[spec.name])

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: attributes are imported when they are used."""


def install() -> None:
    """Make `import gsplat` find this package, in this process, before any installed gsplat.

    Raises:
        ImportError: if another gsplat has been imported already.
    """
    for name in MODULES:
        loaded = sys.modules.get(name)
        if loaded is not None and not isinstance(loaded, AliasModule):
            raise ImportError(
                f"{name} has been imported from {getattr(loaded, '__file__', 'elsewhere')}; call install() before the"
                " first import of gsplat"
            )
    if not any(isinstance(each, Finder) for each in sys.meta_path):
        sys.meta_path.insert(0, Finder())
