"""A small recording on disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsplat_core.io.recordings import synthesize


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """Four synthetic frames of 64x48 px; not to be changed."""
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=4, width_px=64, height_px=48, stereo=False)
