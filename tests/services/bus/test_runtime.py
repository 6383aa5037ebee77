from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from services.bus.runtime import ProcessIdentity, RuntimeFolder, write_json
from services.errors import AlreadyRunning, RuntimeFolderUnusable


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_runtime_folders_and_files_are_private(runtime):
    path = runtime.path / "inside"
    stream = RuntimeFolder(path).stream("room-1")
    assert (mode(path), mode(stream.path)) == (0o700, 0o700)
    write_json(stream.path / "capture.json", {})
    assert mode(stream.path / "capture.json") == 0o600
    assert RuntimeFolder(path).streams() == ["room-1"]


def test_runtime_folder_open_to_others_is_refused(runtime):
    runtime.path.chmod(0o750)
    with pytest.raises(RuntimeFolderUnusable, match=r"0750.*chmod 700"):
        RuntimeFolder(runtime.path)


def test_runtime_folder_refuses_symbolic_link(runtime):
    (runtime.path / "real").mkdir(mode=0o700)
    (runtime.path / "link").symlink_to(runtime.path / "real")
    with pytest.raises(RuntimeFolderUnusable, match="no folder"):
        RuntimeFolder(runtime.path / "link")


def test_runtime_folder_refuses_file_at_its_path(runtime):
    (runtime.path / "file").touch()
    with pytest.raises(RuntimeFolderUnusable, match="cannot be made"):
        RuntimeFolder(runtime.path / "file")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_runtime_folder_of_other_user_is_refused(runtime):
    other = runtime.path / "other"
    other.mkdir(mode=0o700)
    os.chown(other, 12345, -1)
    with pytest.raises(RuntimeFolderUnusable, match="user 12345"):
        RuntimeFolder(other)


def test_stream_path_too_long_for_socket_is_refused(runtime):
    with pytest.raises(RuntimeFolderUnusable, match="bytes"):
        runtime.stream("x" * 80)


def test_record_of_running_process_is_returned(runtime):
    stream = runtime.stream("a")
    stream.write_record("engine", "abc")
    record = stream.record("engine")
    assert record is not None
    assert (record.identity.pid, record.spec_digest) == (os.getpid(), "abc")


def test_leftovers_of_dead_process_are_removed_despite_reused_pid(runtime):
    stream = runtime.stream("a")
    now = ProcessIdentity.of(os.getpid())
    assert now is not None
    earlier = ProcessIdentity(now.pid, now.started + "0")
    write_json(stream.path / "engine.json", {"pid": earlier.pid, "started": earlier.started, "spec_digest": ""})
    for name in ("shown", "engine.ctl", "engine.status"):
        with socket.socket(socket.AF_UNIX) as left:
            left.bind(str(stream.path / name))
    stream.log("engine").touch()
    assert stream.record("engine") is None
    assert [path.name for path in stream.path.iterdir()] == ["engine.log"]


def test_role_lock_is_held_by_one_process(runtime):
    stream = runtime.stream("a")
    held = stream.lock("capture")
    program = (
        "import sys; from pathlib import Path; from services.bus.runtime import StreamFolder\n"
        "StreamFolder(Path(sys.argv[1])).lock('capture')"
    )
    command = [sys.executable, "-c", program, str(stream.path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert AlreadyRunning.__name__ in done.stderr
    os.close(held)
    assert subprocess.run(command).returncode == 0


def test_remove_deletes_all_files_of_stream(runtime):
    stream = runtime.stream("a")
    os.close(stream.lock("capture"))
    stream.write_record("capture", "")
    for path in (stream.log("engine"), stream.spec("capture")):
        path.touch()
    stream.remove()
    assert runtime.streams() == []


def test_failed_write_leaves_no_part_file(tmp_path):
    target = tmp_path / "engine.json"
    target.mkdir()
    with pytest.raises(OSError):
        write_json(target, {})
    assert [path.name for path in tmp_path.iterdir()] == ["engine.json"]


def test_remove_deletes_parts_of_killed_writers(runtime):
    stream = runtime.stream("room-1")
    (stream.path / "engine.spec.7.part").write_bytes(b"{")
    stream.remove()
    assert not stream.path.exists()
    stream.remove()  # also if it is deleted already
