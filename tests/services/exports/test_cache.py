"""Exports are made once, within limits, in a separate process."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.exports.formats import FORMATS, ExportWish
from operators.settings import RenderOptions
from services.errors import ExportBusy, ExportFailed, ExportRefused
from services.exports.files import PICTURES, ExportCache, ExportPrograms, RenderWish
from tests.services.supervisor.test_model_show import uniform

STUB = (sys.executable, str(Path(__file__).with_name("stub_make.py")))
PLY = ExportWish(FORMATS["ply"], 1.5)


@pytest.fixture
def cache(tmp_path):
    made = ExportCache(tmp_path / "exports", most_bytes=2500, programs=ExportPrograms(STUB))
    yield made
    made.close()


def content(cache, digest: str, name: str = "good", wish: ExportWish = PLY) -> bytes:
    exported = cache.get(digest, lambda: Path("/nowhere") / name, wish)
    with exported.file as file:
        data = file.read()
    assert (exported.size_bytes, exported.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    return data


def test_export_is_made_once_and_cached(cache):
    first = content(cache, "a")
    assert first.startswith(b"good --format=ply --time=1.5 ")
    assert content(cache, "a") == first and cache.made == 1


def test_cache_key_includes_model_time_and_format(cache):
    for digest, wish in (
        ("a", PLY),
        ("b", PLY),
        ("a", ExportWish(FORMATS["ply"], 2.0)),
        ("a", ExportWish(FORMATS["glb"], 1.5)),
    ):
        content(cache, digest, wish=wish)
    assert cache.made == 4


def test_cache_key_includes_render_options(cache):
    for options in ({}, {"outputs": ("normals",)}, {}):
        wish = RenderWish(PICTURES["png"], RenderOptions(**options), "orbit", 0.5)
        said = content(cache, "a", wish=wish)
    assert said.startswith(b"good --format=png --render=")
    wanted = json.loads(said.split(b"--render=")[1].split(b"\0")[0])
    assert wanted == {"view": "orbit", "time_s": 0.5, "options": {}} and cache.made == 2


def test_cache_evicts_oldest_export_and_open_file_stays_readable(cache):
    reading = cache.get("a", lambda: Path("/nowhere/good"), PLY)
    content(cache, "b")
    content(cache, "c")
    assert len(list(cache._folder.glob("*.data"))) == len(list(cache._folder.glob("*.json"))) == 2
    with reading.file as file:
        assert len(file.read()) == reading.size_bytes
    content(cache, "a")
    assert cache.made == 4


def test_cache_keeps_recently_used_export(cache):
    content(cache, "a")
    content(cache, "b")
    for path in cache._folder.glob("*.data"):
        os.utime(path, (1, 1))
    content(cache, "a")
    content(cache, "c")
    content(cache, "a")
    assert cache.made == 3


def test_export_larger_than_cache_raises(tmp_path):
    small = ExportCache(tmp_path / "x", most_bytes=10, programs=ExportPrograms(STUB))
    with pytest.raises(ExportFailed, match="10 bytes"):
        content(small, "a")


@pytest.mark.parametrize(
    ("folder", "error", "said"),
    [("refused", ExportRefused, "^the model has no Gaussians$"), ("fails", ExportFailed, "code 1: it broke")],
)
def test_failed_export_raises_with_reason_and_is_not_cached(cache, folder, error, said):
    with pytest.raises(error, match=said):
        content(cache, "a", folder)
    assert list(cache._folder.iterdir()) == []
    content(cache, "a")


def test_export_over_time_limit_raises(tmp_path):
    slow = ExportCache(tmp_path / "x", programs=ExportPrograms(STUB, most_s=0.5))
    with pytest.raises(ExportFailed, match=r"longer than 0\.5 s"):
        content(slow, "a", "slow")


def test_waiting_exports_are_limited_and_end_on_close(tmp_path):
    cache = ExportCache(tmp_path / "x", most_waiting=1, programs=ExportPrograms(STUB))
    ended: list[Exception] = []

    def wait() -> None:
        try:
            content(cache, "a", "slow")
        except ExportFailed as error:
            ended.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    until_s = time.monotonic() + 300
    while not cache._programs._running:
        assert time.monotonic() < until_s
        time.sleep(0.01)
    with pytest.raises(ExportBusy, match="wait already"):
        content(cache, "b")
    cache.close()
    waiting.join(300)
    assert len(ended) == 1


def test_concurrent_requests_share_one_export(cache):
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(content(cache, "a"))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(300)
    assert len(found) == 4 and cache.made == 1


def test_new_cache_removes_unfinished_exports(tmp_path):
    (tmp_path / "x" / "new-1").mkdir(parents=True)
    ExportCache(tmp_path / "x")
    assert list((tmp_path / "x").iterdir()) == []


@pytest.mark.slow
def test_export_program_writes_ply_or_refuses_time_out_of_window(tmp_path):
    save_bundle(uniform((0.9, 0.1, 0.1)), tmp_path / "model")
    cache = ExportCache(tmp_path / "exports")
    with cache.get("a", lambda: tmp_path / "model", PLY).file as ply:
        assert ply.read(3) == b"ply"
    with pytest.raises(ExportRefused, match="window"):
        cache.get("a", lambda: tmp_path / "model", ExportWish(FORMATS["glb"], 9.0))


@pytest.mark.parametrize("module", ["services.exports.files", "services.exports.snapshots"])
@pytest.mark.slow
def test_export_modules_do_not_import_torch(module):
    program = f"import sys, {module}; assert not {{'torch', 'cv2'}} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
