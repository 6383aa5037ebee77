"""What a test needs and this machine lacks: the test is skipped, saying so; in CI, which installs all of it, it fails."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def missing(message: str) -> NoReturn:
    """End the test for want of something."""
    if os.environ.get("CI"):
        pytest.fail(message)
    pytest.skip(message)
