"""What `rasterization` returns beside the image: a mapping, some of whose values are computed when they are first read."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable
from typing import Any


class Deferred:
    """A value that is computed when it is first read from a `Meta`."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        self.compute = compute


class Meta(UserDict[str, Any]):
    """A dict in all but type that replaces a `Deferred` by its value when it is read."""

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if isinstance(value, Deferred):
            value = self.data[key] = value.compute()
        return value
