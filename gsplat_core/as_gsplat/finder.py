"""Import hook that serves the modules of `names.MODULES`."""

from __future__ import annotations

import functools
import importlib
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

from gsplat_core.as_gsplat.names import MODULES
from gsplat_core.errors import InvalidInput

CONSTANTS = ("1.6", "1.5.3")
_OLD_CONSTANTS: Mapping[str, Mapping[str, Any]] = {
    "accumulate": {"max_alpha": 0.999},
    "fully_fused_projection": {"compensation_floor": 0.0},
    "rasterization": {"constants": "1.5.3"},
    "rasterize_to_indices_in_range": {"max_alpha": 0.999},
    "rasterize_to_pixels": {"max_alpha": 0.999},
}
"""Functions whose option defaults change to the constants of gsplat 1.5.3, with those options; see
`gsplat_core.rendering.settings.CONSTANTS`.
"""


class AliasModule(ModuleType):
    """Module whose attributes are imported from the modules that define them when first used."""

    __all__: list[str]

    def __init__(self, name: str, homes: Mapping[str, str], options: Mapping[str, Mapping[str, Any]]) -> None:
        super().__init__(name, f"`gsplat_core` under the name {name}.")
        self._options = options
        self._homes = dict(homes)
        self._children = [each for each in MODULES if each.rpartition(".")[0] == name]
        self.__all__ = sorted(homes)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__version__":
            raise AttributeError(name)
        full = f"{self.__name__}.{name}"
        if name in self._homes:
            home, _, known_as = self._homes[name].partition(":")
            value = _with_options(getattr(importlib.import_module(home), known_as or name), self._options.get(name))
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


@functools.cache
def _bound(function: Any, options: tuple[tuple[str, Any], ...]) -> Any:
    @functools.wraps(function)
    def call(*arguments: Any, **given: Any) -> Any:
        return function(*arguments, **dict(options) | given)

    return call


def _with_options(value: Any, options: Mapping[str, Any] | None) -> Any:
    """Return a function with other default values of its options; the same wrapper object at every call."""
    return value if options is None else _bound(value, tuple(options.items()))


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Import hook that finds the modules of `MODULES` before any installed gsplat."""

    def __init__(self, constants: str) -> None:
        self.constants = constants

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
        """Create the module object without importing the modules that define its attributes."""
        return AliasModule(spec.name, MODULES[spec.name], _OLD_CONSTANTS if self.constants == "1.5.3" else {})

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: attributes are imported when they are used."""


def install(constants: str = "1.6") -> None:
    """Make `import gsplat` find this package, in this process, before any installed gsplat.

    Args:
        constants: version of gsplat whose numerical constants its functions have, "1.6" or "1.5.3". On CUDA, those of 1.6 are
            faster.

    Raises:
        ImportError: if another gsplat has been imported already, or this one with other constants.
        InvalidInput: for an unknown version.
    """
    if constants not in CONSTANTS:
        raise InvalidInput(f"unknown constants {constants!r}; the versions are {', '.join(CONSTANTS)}")
    for name in MODULES:
        loaded = sys.modules.get(name)
        if loaded is not None and not isinstance(loaded, AliasModule):
            raise ImportError(
                f"{name} has been imported from {getattr(loaded, '__file__', 'elsewhere')}; call install() before the"
                " first import of gsplat"
            )
    present = [each for each in sys.meta_path if isinstance(each, Finder)]
    if any(each.constants != constants for each in present):
        raise ImportError(f"gsplat has been installed with other constants than {constants}; call install() once")
    if not present:
        sys.meta_path.insert(0, Finder(constants))
