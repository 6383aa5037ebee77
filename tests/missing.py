"""Skip a test if this machine lacks a requirement; fail instead in CI, where all of them are installed."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def missing(message: str) -> NoReturn:
    """Skip the test, or fail it in CI, with the reason."""
    if os.environ.get("CI"):
        pytest.fail(message)
    pytest.skip(message)
