"""A small session to read and to damage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gsplat_core.io.sessions import SessionWriter, WriterOptions
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.io.sessions.made import FRAMES, PER_SEGMENT, Clock, new_frame, session_info, write_frames


@pytest.fixture(scope="session")
def frames() -> list[Frame]:
    return [new_frame(seq) for seq in range(FRAMES)]


@pytest.fixture
def record(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Record frames and training calls into a folder."""
    begun: list[SessionWriter] = []

    def write(frames: list[Frame], options: WriterOptions | None = None, *, close: bool = True) -> Path:
        folder = tmp_path / f"session{len(begun)}"
        begun.append(SessionWriter(folder, session_info(), options))
        write_frames(begun[-1], frames)
        if close:
            begun[-1].close("end")
        return folder

    yield write
    for writer in begun:
        writer.abandon("the test is over")


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory, frames: list[Frame]) -> Iterator[Path]:
    """Twelve frames in two segments. Read only: copy it to change it."""
    folder = tmp_path_factory.mktemp("recorded") / "session"
    clock = Clock()
    writer = SessionWriter(folder, session_info(), WriterOptions(segment_s=60, clock=clock))
    write_frames(writer, frames[:PER_SEGMENT])
    clock.now_ns += 60 * 10**9
    write_frames(writer, frames[PER_SEGMENT:])
    writer.close("end")
    yield folder
