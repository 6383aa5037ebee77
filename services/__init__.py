"""The service and the programs of IntraSplat, and the version of the product."""

from __future__ import annotations

from functools import cache


@cache
def product_version() -> str:
    """Return the installed version, or `0+source` in a source tree without installation."""
    from importlib.metadata import PackageNotFoundError, version  # takes a while, and most processes need no version

    try:
        return version("intrasplat")
    except PackageNotFoundError:
        return "0+source"
