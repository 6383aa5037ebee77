from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from services.bus.runtime import RuntimeFolder


@pytest.fixture
def runtime():
    """A runtime folder whose path is short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        yield RuntimeFolder(Path(folder))
