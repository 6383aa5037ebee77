"""Other users cannot read the service's files, independent of the user's umask."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import stat
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

import services
from services.jobs import runners
from services.jobs.results import Task
from services.private_files import KEPT, FolderNotPrivate, make_state_private

SERVICES = Path(services.__file__).parent
OF_THE_USER = {"services/cli/doctor.py"}
"""Programs of the command line, whose files are the user's own."""


def programs() -> list[Path]:
    """Return the modules of the service that run as separate processes."""
    found = [path for path in SERVICES.rglob("*.py") if 'if __name__ == "__main__":' in path.read_text()]
    return [path for path in found if str(path.relative_to(SERVICES.parent)) not in OF_THE_USER]


@pytest.fixture
def open_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


def open_to_others(folder: Path) -> set[str]:
    """Return the folder's files and folders, including itself, that other users may access."""
    return {str(path) for path in [folder, *folder.rglob("*")] if path.lstat().st_mode & 0o077}


ENTRIES = [
    *((".".join(path.relative_to(SERVICES.parent).with_suffix("").parts), "main") for path in programs()),
    ("services.cli.serve", "serve_command"),
    ("services.cli.serve", "backup_command"),
    ("services.cli.serve", "restore_command"),
]


@pytest.mark.parametrize(("module", "function"), ENTRIES)
def test_service_programs_set_private_umask_first(monkeypatch, module, function):
    """The umask is set before any argument is read."""

    class Begun(BaseException):
        pass

    def begin():
        raise Begun

    program = importlib.import_module(module)
    monkeypatch.setattr(program, "keep_files_private", begin)
    entry = getattr(program, function)
    needed = [each for each in inspect.signature(entry).parameters.values() if each.default is each.empty]
    with pytest.raises(Begun):
        entry(*(None for each in needed if each.kind is not each.KEYWORD_ONLY), **{
            each.name: None for each in needed if each.kind is each.KEYWORD_ONLY
        })  # fmt: skip


def test_ray_attempt_sets_private_umask(monkeypatch, tmp_path, open_umask):
    masks = []
    monkeypatch.setattr(runners, "work", lambda task: masks.append(os.umask(0o022)))
    runners._attempt(asdict(Task("job", "recording", str(tmp_path))))
    assert masks == [0o077]


def test_programs_lists_service_programs():
    assert {"launcher", "capture", "engine", "pool", "check", "files"} <= {path.stem for path in programs()}


def test_process_and_its_children_create_private_files(tmp_path, open_umask):
    program = (
        "import subprocess, sys, os\n"
        "from services.private_files import keep_files_private\n"
        "keep_files_private()\n"
        "os.mkdir('folder'); open('folder/file', 'w').close()\n"
        "subprocess.run([sys.executable, '-c', \"open('folder/of a child', 'w').close()\"], check=True)\n"
        "if os.fork() == 0:\n    os.mkdir('folder/of a fork'); os._exit(0)\n"
        "os.wait()\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    assert len(list((tmp_path / "folder").iterdir())) == 3
    assert open_to_others(tmp_path / "folder") == set()


def test_make_state_private_closes_existing_service_files(tmp_path, open_umask):
    data, elsewhere = tmp_path / "data", tmp_path / "elsewhere"
    for folder in (data, elsewhere):
        (folder / "replays" / "a" / "model").mkdir(parents=True)
        (folder / "replays" / "a" / "report.json").write_text("{}")
    for name in ("audit.jsonl", "audit.000000000000.jsonl", "keys.json", "keys.lock", "mine.txt"):
        (data / name).write_text("x")
    (data / "registry").mkdir()
    (data / "registry" / "registry.sqlite").write_text("x")
    (data / "registry" / "link").symlink_to(data / "mine.txt")
    assert make_state_private(data, elsewhere, None) == 16
    assert open_to_others(data) == {str(data / "mine.txt"), str(data / "registry" / "link")}
    assert open_to_others(elsewhere) == set()
    assert make_state_private(data, elsewhere, None) == 0
    assert os.access(data / "registry" / "registry.sqlite", os.W_OK)


def test_make_state_private_creates_private_folders(tmp_path, open_umask):
    assert make_state_private(tmp_path / "a" / "data", tmp_path / "b") == 0
    for folder in (tmp_path / "a" / "data", tmp_path / "b"):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_make_state_private_refuses_open_folder_with_foreign_files(tmp_path, open_umask):
    home = tmp_path / "home"
    home.mkdir()
    (home / "letter").write_text("x")
    with pytest.raises(FolderNotPrivate, match="chmod 700"):
        make_state_private(home)
    assert stat.S_IMODE(home.stat().st_mode) == 0o755
    home.chmod(0o700)
    make_state_private(home)
    assert stat.S_IMODE((home / "letter").stat().st_mode) == 0o644


def test_make_state_private_refuses_folder_of_other_user(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 4711)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(FolderNotPrivate, match="belongs to user"):
        make_state_private(tmp_path)


@pytest.mark.parametrize("kind", ["a file", "in a file"])
def test_make_state_private_refuses_path_that_is_no_folder(tmp_path, kind):
    (tmp_path / "file").write_text("x")
    with pytest.raises(FolderNotPrivate, match="folder that its user owns"):
        make_state_private(tmp_path / "file" if kind == "a file" else tmp_path / "file" / "data")


@pytest.mark.slow
def test_kept_lists_all_entries_of_data_folder():
    """Entries of the data folder that `KEPT` does not list would keep their permissions."""
    named = set()
    for path in SERVICES.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div) and isinstance(node.right, ast.Constant):
                left = ast.unparse(node.left)
                if left in ("data", "settings.data_dir", "self.data_dir") and isinstance(node.right.value, str):
                    named.add(node.right.value)
    assert {"registry", "recordings", "replays", "snapshots", "uploads", "exports", "admin.key"} <= named
    assert named - KEPT == set()
