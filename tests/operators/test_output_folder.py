"""Foreign files are never overwritten, and outputs of different runs are never mixed."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys

import pytest

from operators import output_folder
from operators.errors import OutputError, OutputFolderInUse
from operators.output_folder import LOCK, MARKER, OutputFolder, check_output_folder


def deliver(folder, made_by="replay", **files):
    """A run that writes these files; a name's underscore stands for its dot."""
    with OutputFolder(folder, made_by) as output:
        for name, text in files.items():
            (output.path / name.replace("_", ".")).write_text(text)
        output.publish()


def holds(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != MARKER}


def test_a_new_and_an_empty_folder_become_ours(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "a" / "b", tmp_path / "empty"):
        deliver(folder, report_json="1")
        assert check_output_folder(folder) and holds(folder) == {"report.json": "1"}


@pytest.mark.parametrize("existed", [False, True])
def test_a_run_that_delivers_nothing_leaves_nothing(tmp_path, existed):
    folder = tmp_path / "a" / "b"
    if existed:
        folder.mkdir(parents=True)
    with pytest.raises(RuntimeError), OutputFolder(folder, "replay") as output:
        (output.path / "report.json").touch()
        raise RuntimeError
    assert folder.exists() == existed and (not existed or list(folder.iterdir()) == [])
    assert (tmp_path / "a").exists() == existed


def test_checking_changes_nothing(tmp_path):
    assert check_output_folder(tmp_path / "new") is False
    assert not (tmp_path / "new").exists()


def test_a_run_replaces_all_of_the_earlier_one_and_nothing_of_the_users(tmp_path):
    deliver(tmp_path / "out", report_json="1", **{"000000_png": "1", "000001_png": "1"})
    (tmp_path / "out" / "notes.txt").write_text("mine")
    deliver(tmp_path / "out", **{"000000_png": "2"})
    assert holds(tmp_path / "out") == {"000000.png": "2", "notes.txt": "mine"}


def test_the_earlier_results_stay_until_the_new_ones_are_complete(tmp_path):
    deliver(tmp_path / "out", report_json="1")
    with OutputFolder(tmp_path / "out", "replay") as output:
        assert output.earlier
        (output.path / "report.json").write_text("2")
        assert (tmp_path / "out" / "report.json").read_text() == "1"
        output.publish()
    assert holds(tmp_path / "out") == {"report.json": "2"}


class Killed(BaseException):
    """The process was killed here."""


def kill_at(monkeypatch, step):
    """Stop at the `step`-th rename or change of the marker; False once there is none any more."""
    seen = 0

    def counted(original):
        def call(*arguments, **options):
            nonlocal seen
            seen += 1
            if seen == step:
                raise Killed
            return original(*arguments, **options)

        return call

    monkeypatch.setattr(output_folder.os, "replace", counted(os.replace))
    monkeypatch.setattr(output_folder, "_write_marker", counted(output_folder._write_marker))


@pytest.mark.parametrize("step", range(1, 16))
def test_a_run_killed_while_it_delivers_leaves_one_run_and_the_next_one_finishes_it(tmp_path, monkeypatch, step):
    deliver(tmp_path / "out", report_json="1", report_html="1", model="1")
    with monkeypatch.context() as patch:
        output = OutputFolder(tmp_path / "out", "replay")
        output.__enter__()
        for name in ("report.json", "report.html", "extra"):
            (output.path / name).write_text("2")
        kill_at(patch, step)
        try:
            output.publish()
            killed = False
        except Killed:
            killed = True
    seen = {text for name, text in holds_files(tmp_path / "out").items()}
    assert len(seen) <= 1, f"a mixture of two runs: {holds_files(tmp_path / 'out')}"
    # The process is gone, and with it its lock; nothing else was cleaned up.
    output._stack.pop_all()
    (tmp_path / "out" / LOCK).unlink()
    with OutputFolder(tmp_path / "out", "replay"):
        pass
    old, new = (
        dict.fromkeys(("report.json", "report.html", "model"), "1"),
        dict.fromkeys(("report.json", "report.html", "extra"), "2"),
    )
    assert holds(tmp_path / "out") == (old if step <= 2 and killed else new)


def holds_files(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file() and path.name[0] != "."}


@pytest.mark.parametrize("marker", [None, "not json", "[]", '{"format": "something else"}', "[" * 100_000])
def test_a_folder_of_somebody_else_is_refused_and_untouched(tmp_path, marker):
    (tmp_path / "thesis.tex").write_text("years of work")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OutputFolderInUse, match=r"not made by intrasplat .*thesis\.tex.*choose another --out"):
        deliver(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("name", ["report.html", "model", "000007.png"])
def test_a_file_that_no_run_wrote_is_not_replaced(tmp_path, name):
    deliver(tmp_path / "out", report_json="1")
    (tmp_path / "out" / name).write_text("mine")
    with pytest.raises(OutputFolderInUse, match=f"holds {name}, which no run of intrasplat wrote"):
        deliver(tmp_path / "out", report_json="2")
    assert holds(tmp_path / "out") == {"report.json": "1", name: "mine"}


@pytest.mark.parametrize("files", [["../diary"], ["/etc/passwd"], [".ssh"], ["", 7, None], "report.json", [".."]])
def test_a_marker_that_was_tampered_with_reaches_nothing_outside(tmp_path, files):
    deliver(tmp_path / "out")
    (tmp_path / "diary").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".ssh").write_text("mine")
    (tmp_path / "out" / MARKER).write_text(json.dumps({"format": "intrasplat-output", "files": files}))
    deliver(tmp_path / "out", report_json="2")
    assert (tmp_path / "diary").read_text() == "mine" and (tmp_path / "out" / ".ssh").read_text() == "mine"


def test_a_file_and_a_link_to_nowhere_are_not_folders(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputFolderInUse, match="is a file"):
        deliver(tmp_path / "file")
    with pytest.raises(OutputFolderInUse, match="is a link that leads nowhere"):
        deliver(tmp_path / "link")
    assert not (tmp_path / "nowhere").exists()


def test_planted_links_and_pipes_are_not_followed(tmp_path):
    (tmp_path / "diary").write_text("mine")
    deliver(tmp_path / "out", report_json="1")
    (tmp_path / "out" / LOCK).symlink_to(tmp_path / "diary")
    with pytest.raises(OutputError, match="cannot write to"):
        deliver(tmp_path / "out", report_json="2")
    (tmp_path / "out" / LOCK).unlink()
    (tmp_path / "out" / "report.json").unlink()
    (tmp_path / "out" / "report.json").symlink_to(tmp_path / "diary")
    (tmp_path / "out" / ".run-0123abcd").symlink_to(tmp_path)
    with pytest.raises(OutputFolderInUse, match=r"report\.json, which no run"):
        deliver(tmp_path / "out", report_json="2")
    (tmp_path / "out" / "report.json").unlink()
    deliver(tmp_path / "out", report_json="2")
    assert (tmp_path / "diary").read_text() == "mine"
    assert (tmp_path / "out" / "report.json").read_text() == "2" and not (tmp_path / "out" / "report.json").is_symlink()
    os.unlink(tmp_path / "out" / MARKER)
    os.mkfifo(tmp_path / "out" / MARKER)
    with pytest.raises(OutputFolderInUse, match="not made by intrasplat"):
        deliver(tmp_path / "out", report_json="3")


def test_two_runs_do_not_share_a_folder(tmp_path):
    with OutputFolder(tmp_path / "out", "replay") as output:
        (output.path / "report.json").write_text("first")
        with pytest.raises(OutputFolderInUse, match=rf"another run writes into .*process {os.getpid()}"):
            deliver(tmp_path / "out", report_json="second")
        output.publish()
    assert holds(tmp_path / "out") == {"report.json": "first"}


@pytest.mark.slow
def test_a_lock_ends_with_its_process_however_that_ends(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from operators.output_folder import OutputFolder\n"
        "output = OutputFolder(Path(sys.argv[1]), 'replay').__enter__()\n"
        "(output.path / 'report.json').write_text('half'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], check=False)
    assert (tmp_path / "out" / LOCK).exists()
    deliver(tmp_path / "out", report_json="2")
    assert holds(tmp_path / "out") == {"report.json": "2"}


def test_a_folder_that_is_deleted_meanwhile_is_said_in_a_sentence(tmp_path):
    with pytest.raises(OutputError, match="out is not there"), OutputFolder(tmp_path / "out", "replay") as output:
        shutil.rmtree(tmp_path / "out")
        output.publish()


def test_a_file_system_without_locks_is_refused(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OutputError, match="cannot lock files"):
        deliver(tmp_path / "out")
    assert not (tmp_path / "out").exists()
