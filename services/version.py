"""Version of the product."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def product_version() -> str:
    """Return the installed version, or `0+source` in a source tree without installation."""
    try:
        return version("intrasplat")
    except PackageNotFoundError:
        return "0+source"
