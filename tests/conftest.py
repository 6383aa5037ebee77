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


@pytest.fixture
def sdk() -> None:
    """The Holoscan SDK, an extra: without it the test is skipped, unless INTRASPLAT_REQUIRE_HOLOSCAN says that it must be there."""
    from operators.errors import EngineMissing
    from operators.graph.sdk import load_sdk

    try:
        load_sdk()
    except EngineMissing as error:
        if os.environ.get("INTRASPLAT_REQUIRE_HOLOSCAN") == "1":
            pytest.fail(f"the Holoscan SDK is required here: {error}")
        pytest.skip(str(error))
