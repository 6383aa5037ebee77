"""Rendered recordings that are kept on disk."""

from __future__ import annotations

import os

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.synthetic import rendered as module
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, kept_recording, render_recording

SMALL = RenderSettings(frames=2, width_px=40, height_px=32, camera="moving", stereo=True)
ONE = 2 * (40 * 32 * (3 + 3 + 4 + 1) + 128)
"""Bytes of its planes."""


@pytest.fixture
def rendered(monkeypatch):
    """Record which recordings were rendered instead of read from a file."""
    asked = []

    def render(what, progress=None):
        asked.append(what)
        return render_recording(what, progress)

    monkeypatch.setattr(module, "render_recording", render)
    return asked


def same(one, other) -> None:
    for a, b in zip(one, other, strict=True):
        assert (a.seq, a.pts_ns) == (b.seq, b.pts_ns)
        for name in module.PLANES:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


def test_kept_recording_is_read_from_cache_on_second_call(tmp_path, rendered):
    first, second = (kept_recording(SMALL, tmp_path / "kept") for _ in range(2))
    assert rendered == [SMALL]
    same(first, second)
    assert first.digest == second.digest and first.fields == second.fields
    for index in range(2):
        np.testing.assert_array_equal(first.camera_at(index).world_to_camera, second.camera_at(index).world_to_camera)
    assert (tmp_path / "kept").stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", [{"seed": 1}, {"frames": 3}, {"stereo": False}, {"camera": "fixed"}, {"fps": 25.0}, {"width_px": 48}]
)
def test_kept_recording_cache_key_includes_every_argument(tmp_path, rendered, other):
    wanted = RenderSettings(**{**SMALL.__dict__, **other})
    kept_recording(SMALL, tmp_path / "kept")
    assert kept_recording(wanted, tmp_path / "kept").frame_count == wanted.frames
    assert rendered == [SMALL, wanted]


def test_kept_recording_cache_key_includes_renderer(tmp_path, rendered, monkeypatch):
    kept_recording(SMALL, tmp_path / "kept")
    monkeypatch.setattr(module, "_renderer", lambda: "changed")
    kept_recording(SMALL, tmp_path / "kept")
    assert len(rendered) == 2


@pytest.mark.parametrize("damage", [b"", b"no safetensors", None])
def test_kept_recording_renders_again_if_cache_file_is_damaged(tmp_path, rendered, damage):
    first = kept_recording(SMALL, tmp_path / "kept")
    (file,) = (tmp_path / "kept").iterdir()
    file.write_bytes(file.read_bytes()[:-100] if damage is None else damage)
    same(first, kept_recording(SMALL, tmp_path / "kept"))
    same(first, kept_recording(SMALL, tmp_path / "kept"))
    assert len(rendered) == 2


@pytest.mark.slow
def test_kept_recording_cache_removes_least_recently_used(tmp_path, rendered):
    folder = tmp_path / "kept"
    others = [RenderSettings(**{**SMALL.__dict__, "seed": seed}) for seed in range(1, 4)]
    for age, asked in enumerate([SMALL, *others]):
        kept_recording(asked, folder, most_bytes=3 * ONE + ONE // 2)
        for file in folder.iterdir():
            found = file.stat()
            os.utime(file, ns=(found.st_mtime_ns - 10**9, found.st_mtime_ns - 10**9))
        if age:
            kept_recording(SMALL, folder)  # used again and again
    rendered.clear()
    for asked in [others[2], SMALL]:
        kept_recording(asked, folder)
    assert rendered == []
    kept_recording(others[0], folder)
    assert rendered == [others[0]]


def test_kept_recording_larger_than_cache_is_not_stored(tmp_path, rendered):
    kept_recording(SMALL, tmp_path / "kept", most_bytes=ONE - 1)
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_kept_recording_ignores_world_writable_cache_folder(tmp_path, rendered):
    folder = tmp_path / "kept"
    kept_recording(SMALL, folder)
    folder.chmod(0o777)
    kept_recording(SMALL, folder)
    assert len(rendered) == 2


def test_kept_recording_without_cache_folder_still_renders(tmp_path, rendered):
    (tmp_path / "file").write_text("")
    same(kept_recording(SMALL, tmp_path / "file" / "kept"), render_recording(SMALL))


def test_kept_recording_refuses_invalid_arguments(tmp_path):
    with pytest.raises(InvalidSetting, match="frames must be"):
        kept_recording(RenderSettings(frames=0), tmp_path / "kept")
