"""The compiled core holds code for several instruction sets, and the wider ones must stay where they are chosen at run time."""

from __future__ import annotations

import platform
import re
import subprocess

import pytest

from gsplat_core.ops.native import LIBRARY_PATH

# The registers of a set -> the namespaces (as they are in mangled names) that may use them.
WIDE_REGISTERS = {"%zmm": ("6avx512",), "%ymm": ("6avx512", "4avx2")}


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the wider sets are those of x86-64")
def test_wide_registers_used_only_inside_own_namespaces() -> None:
    """An inline function that an AVX-512 file shares with others would be linked once, and crash older processors."""
    code = subprocess.run(["objdump", "-d", str(LIBRARY_PATH)], check=True, capture_output=True, text=True).stdout
    users: dict[str, set[str]] = {register: set() for register in WIDE_REGISTERS}
    function = ""
    for line in code.splitlines():
        if start := re.match(r"[0-9a-f]+ <(.+)>:$", line):
            function = start[1]
        for register, names in users.items():
            if register in line:
                names.add(function)
    assert users["%zmm"], "no AVX-512 kernel was found; the library or this test is broken"
    for register, names in users.items():
        strangers = sorted(n for n in names if not any(space in n for space in WIDE_REGISTERS[register]))
        assert not strangers, f"{register} is used outside of its namespace by {strangers}"
