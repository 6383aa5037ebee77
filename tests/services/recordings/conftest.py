"""A small recording, packed, and stores to put it into."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gsplat_core.io.recordings import synthesize
from services.recordings.store import RecordingStore


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three synthetic frames of 48x32 px; not to be changed."""
    folder = tmp_path_factory.mktemp("recordings") / "case"
    return synthesize(folder, frames=3, width_px=48, height_px=32, stereo=False)


@pytest.fixture
def packed(recording: Path, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that packs the recording as a new zip archive, with its files below `top`."""

    def pack(top: str = "", name: str = "upload.zip") -> Path:
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(recording.rglob("*")):
                archive.write(path, f"{top}{path.relative_to(recording)}")
        return tmp_path / name

    return pack


@pytest.fixture
def new_store(tmp_path: Path) -> Iterator[Callable[..., RecordingStore]]:
    """Return a function that opens the test's store, repeatedly if needed."""
    opened = []

    def new(**options: Any) -> RecordingStore:
        url = options.pop("database_url", None) or f"sqlite:///{tmp_path / 'registry.sqlite'}"
        opened.append(RecordingStore(tmp_path / "store", url, **options))
        return opened[-1]

    yield new
    for store in opened:
        store.close()


@pytest.fixture
def add(new_store) -> Callable[..., Any]:
    """Return a function that adds a file to a store."""

    def put(store: RecordingStore, name: str, file: Path):
        return store.add(name, file, hashlib.sha256(file.read_bytes()).hexdigest(), "operator (1)")

    return put
