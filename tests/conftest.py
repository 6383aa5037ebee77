"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recordings_dir() -> Path:
    """The real recordings. They are not part of the repository: absent, the test is skipped, but in CI it fails."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "recordings"
    folder = Path(os.environ.get("INTRASPLAT_RECORDINGS") or default)
    if not folder.is_dir():
        message = f"no real recordings in {folder}; set INTRASPLAT_RECORDINGS to their folder"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return folder
