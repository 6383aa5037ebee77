"""Which version of the product this is."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def product_version() -> str:
    """The installed version; `0+source` when run from a tree that was not installed."""
    try:
        return version("intrasplat")
    except PackageNotFoundError:
        return "0+source"
