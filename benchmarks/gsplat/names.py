"""Public names of gsplat 1.5.3, their parameters and defaults, next to this package's.

    PYTHONPATH=FOLDERS python benchmarks/gsplat/names.py

FOLDERS hold an unpacked gsplat 1.5.3 and the packages that it imports; it need not be compiled. This package's names are those
that `install` of `gsplat_core.as_gsplat` serves. A parameter is the same if its
name, position and default are. Further parameters of this package after gsplat's are no difference.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import log

from gsplat_core.as_gsplat import install


def parameters(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the defaults of the parameters by name, in order."""
    found = inspect.signature(function).parameters.values()
    return {each.name: each.default for each in found if each.kind is not inspect.Parameter.VAR_KEYWORD}


def differences(theirs: Callable[..., Any], ours: Callable[..., Any]) -> list[str]:
    """Return gsplat's parameters that this package lacks, has at another position, or with another default."""
    wanted, present = parameters(theirs), parameters(ours)
    order = [name for name in present if name in wanted]
    found = [f"lacks {name}" for name in wanted if name not in present]
    found += [
        f"{name} is {present[name]!r} instead of {default!r}"
        for name, default in wanted.items()
        if name in present and repr(present[name]) != repr(default)
    ]
    if not found and (order != list(wanted) or list(present)[: len(wanted)] != list(wanted)):
        found.append(f"the order is {', '.join(present)}")
    return found


def main() -> None:
    chosen = log.options(__doc__.splitlines()[0]).parse_args()
    gsplat: Any = importlib.import_module("gsplat")
    for module in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        del sys.modules[module]
    install()
    served: Any = importlib.import_module("gsplat")
    absent = [name for name in gsplat.all if not hasattr(served, name)]
    different: dict[str, list[str]] = {}
    for name in gsplat.all:
        theirs, ours = getattr(gsplat, name), getattr(served, name, None)
        if ours is not None and callable(theirs) and (found := differences(theirs, ours)):
            different[name] = found
    figures = {"gsplat": gsplat.__version__, "names": len(gsplat.all), "absent": absent, "different": different}
    log.write("names", chosen, figures, "gsplat")


if __name__ == "__main__":
    main()
