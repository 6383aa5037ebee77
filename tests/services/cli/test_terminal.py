"""Tables and messages on the terminal, and runs that do not end after the second signal."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from services.cli import terminal
from services.cli.terminal import MOST_WORD, WIDEST, sentence, size, table


def test_table_omits_empty_columns_except_first():
    columns = {"id": "ID", "empty": "EMPTY", "name": "NAME"}
    assert table(columns, [{"name": "a"}, {"empty": None, "name": "bc"}]) == ["ID  NAME", "    a", "    bc"]
    assert table(columns, [{"id": "x", "empty": ""}]) == ["ID", "x"]
    assert table(columns, [{"id": "x", "empty": "y"}]) == ["ID  EMPTY", "x   y"]


@pytest.mark.parametrize(("length", "shown"), [(WIDEST, WIDEST * "a"), (WIDEST + 1, (WIDEST - 1) * "a" + "…")])
def test_table_truncates_long_cells_except_in_last_column(length, shown):
    assert table({"a": "A", "b": "B"}, [{"a": length * "a", "b": 200 * "b"}])[1] == f"{shown}  {200 * 'b'}"


def test_table_formats_cells_by_field_and_type(monkeypatch):
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    cells = {
        "at": ("2026-01-02T03:04:05+00:00", "2026-01-02 03:04:05 +0000"),
        "created_at": ("2026-01-02T03:04:05.678+01:00", "2026-01-02 02:04:05 +0000"),
        "changed_at": ("yesterday\n", "yesterday\\n"),
        "used_bytes": (1536, "1.5 KiB"),
        "free_bytes": ("unknown", "unknown"),
        "is_live": (True, "yes"),
        "is_late": (False, "no"),
        "psnr_db": (31.26, "31.3"),
        "error": (float("nan"), ""),
        "options": ({"a": 1, "b": "x"}, "a 1, b x"),
        "names": (["a", "b"], "a, b"),
        "last_used_at": (None, "never"),
        "streams": (None, "all"),
        "reason": ("no\x1b[2J frame", "no\\x1b[2J frame"),
    }
    for field, (value, text) in cells.items():
        # The row with a text keeps the column where the tested cell is empty.
        assert table({"x": "X", field: "H"}, [{field: value}, {field: "text"}])[1].strip() == text, field
    monkeypatch.undo()
    time.tzset()


def test_table_cell_is_empty_if_nested_field_is_missing():
    assert table({"a": "A", "b.c.d": "D"}, [{"a": 1, "b": {"c": {"d": 2}}}, {"a": 1, "b": {"c": 3}}]) == [
        "A  D", "1  2", "1",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"), (1023, "1023 B"), (1024, "1.0 KiB"), (2**20 - 2**10, "1023.0 KiB"), (2**20, "1.0 MiB"),
        (1.5 * 2**30, "1.5 GiB"), (2**41, "2048.0 GiB"),
    ],
)  # fmt: skip
def test_size_uses_binary_units(count, text):
    assert size(count) == text


def test_sentence_shortens_long_words_in_middle():
    longest = MOST_WORD * "a"
    assert sentence(f"cannot read {longest} ; free space") == f"cannot read {longest} ; free space"
    assert sentence(f"cannot read /{longest}/end; free space") == (
        f"cannot read /{159 * 'a'}...{55 * 'a'}/end; free space"
    )


@pytest.mark.parametrize("imported", ["absent", "half imported"])
def test_end_on_interrupt_during_import_exits_130_without_traceback(imported):
    program = (
        "import os, signal, sys, types\n"
        "from services.cli import terminal\n"
        "terminal.end_on_interrupt()\n"
        "name = 'gsplat_core.io.files'\n"
        "sys.modules.pop(name, None)\n"
        "if sys.argv[1] == 'half imported': sys.modules[name] = types.ModuleType(name)\n"
        "os.kill(os.getpid(), signal.SIGINT)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, imported], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


PROGRAM = """
import os, signal, sys, threading, time
from services.cli import terminal

class Files:
    @staticmethod
    def remove_unfinished():
        os.write(1, b"removed\\n")

sys.modules["gsplat_core.io.files"] = Files
terminal.GRACE_S = float(sys.argv[1])
signal.signal(signal.SIGUSR1, lambda number, frame: None)
threads = []

def joined(name):
    for thread in [*threads, *threading.enumerate()]:
        if thread.name == name:
            thread.join(250)
            if thread.is_alive():
                os.write(1, f"{name} goes on\\n".encode())

code = 0
try:
    with terminal.InterruptRequest():
        threads = threading.enumerate()
        try:
            for number in sys.argv[2:]:
                os.kill(os.getpid(), getattr(signal, number))
        except KeyboardInterrupt:
            if terminal.GRACE_S == 0:
                time.sleep(250)
            raise
except KeyboardInterrupt:
    code = 5
joined("signals")
joined("end")
sys.exit(code)
"""


def interrupted(grace_s: float, *signals: str) -> tuple[int, str, str]:
    """Return exit code, output and errors of a program that sends itself signals."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(grace_s), *signals],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def test_second_signal_lets_run_end_within_grace_time():
    code, out, err = interrupted(30, "SIGINT", "SIGINT")
    assert (code, out) == (5, "")
    assert err.startswith("interrupted: finishing the frame") and "Traceback" not in err


def test_repeated_sighup_is_one_request_and_sigusr1_none():
    code, out, err = interrupted(30, "SIGUSR1", "SIGHUP", "SIGUSR1", "SIGHUP", "SIGHUP")
    assert (code, out) == (0, "") and err.count("interrupted") == 1
    assert interrupted(30, "SIGUSR1") == (0, "", "")


def test_second_signal_ends_hanging_run_and_removes_unfinished_files():
    code, out, err = interrupted(0, "SIGTERM", "SIGINT")
    assert (code, out) == (130, "removed\n")
    assert err.count("interrupted") == 2 and "interrupted again: ending at once" in err


@pytest.mark.parametrize(("byte", "written"), [(0x80, b"\x80"), (0xFF, b"\xff"), (0xE4, b"\xe4")])
def test_output_keeps_bytes_of_file_names_and_escapes_other_characters(byte, written):
    name = os.fsdecode(b"a" + bytes([byte]) + b"b")
    error = UnicodeEncodeError("ascii", name, 1, 2, "")
    assert terminal._as_the_system_spells_it(error) == (written, 2)
    missing = UnicodeEncodeError("ascii", "x\u20ac", 1, 2, "")
    assert terminal._as_the_system_spells_it(missing) == (b"\\u20ac", 2)
    lone = UnicodeEncodeError("utf-8", "\udc7f\udd00", 0, 1, "")
    assert terminal._as_the_system_spells_it(lone) == (b"\\udc7f", 1)
