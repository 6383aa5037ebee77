"""Symbols that the compiled libraries import from the C++ runtime, and refusal of arguments for every kind of linking."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from gsplat_core.ops.native import CUDA_LIBRARY_PATH, CUDA_MISSING, LIBRARY_PATH

ROOT = Path(__file__).resolve().parents[2]
IOSTREAMS = re.compile(r"std::(ios_base|locale|basic_\w*(stream|streambuf)\b|\w*stream\b|__cxx11::basic_\w*stream)")
REFUSED = """
import sys, torch
torch.ops.load_library(sys.argv[1])
splat = torch.ones(1, 2), torch.ones(1, 2, dtype=torch.int32), torch.ones(1), None, None
try:
    torch.ops.gsplat_core.bin_splats_within(*splat, None, 1, 16, 1, 1, -7)
except RuntimeError as error:
    print(error)
"""


@pytest.fixture(params=[LIBRARY_PATH, CUDA_LIBRARY_PATH], ids=["cpu", "cuda"])
def library(request: pytest.FixtureRequest) -> Path:
    if request.param == CUDA_LIBRARY_PATH and not CUDA_LIBRARY_PATH.exists():
        pytest.skip(f"the CUDA kernels are {CUDA_MISSING}")
    return request.param


def symbols(library: Path, *options: str) -> list[str]:
    text = subprocess.run(["nm", "-C", *options, str(library)], check=True, capture_output=True, text=True).stdout
    return [line[17:].strip() for line in text.splitlines()]


def test_libraries_do_not_import_iostreams(library):
    """In a library with a static libstdc++, iostreams are a second copy that is never initialised."""
    names = symbols(library)
    if any(name.endswith("std::ios_base_library_init()") and not name.startswith("U ") for name in names):
        pytest.skip("this toolchain links libstdc++ statically, and torch's library, which needs iostreams, adds them")
    found = sorted({name for name in names if IOSTREAMS.search(name)})
    assert not found, (
        f"{library.name} needs iostreams: {found}; native/torch_abi.h says how torch's headers bring them in"
    )


def test_iostreams_pattern_matches_known_symbols():
    for name in (
        "U std::ios_base::Init::Init()@GLIBCXX_3.4",
        "U std::__cxx11::basic_ostringstream<char, std::char_traits<char>, std::allocator<char> >::basic_ostringstream()",
        "U std::ostream& std::ostream::_M_insert<long>(long)",
        "U std::locale::~locale()",
    ):
        assert IOSTREAMS.search(name)


def test_libraries_export_own_names_only(library):
    exported = {name.split(maxsplit=1)[1] for name in symbols(library, "-D", "--defined-only")}
    assert {name for name in exported if not name.startswith("gsplat_core_")} == set()


def test_native_sources_use_own_check_macros():
    """torch's macros use iostreams and let exceptions escape; torch_abi.h defines replacements."""
    sources = [path for ending in ("cpp", "h", "cu", "cuh") for path in (ROOT / "gsplat_core").rglob(f"*.{ending}")]
    assert len(sources) > 50
    for theirs in ("STD_TORCH_CHECK(", "TORCH_BOX(", "#include <torch/"):
        assert [p.name for p in sources if p.name != "torch_abi.h" and theirs in p.read_text()] == []


@pytest.mark.slow
def test_invalid_argument_rejected_with_static_runtime():
    """Link the CPU library's objects with this toolchain's static libstdc++ and libgcc, in a separate process."""
    build = ROOT / "build" / "editable"
    if not (build / "CMakeCache.txt").exists():
        pytest.skip("the library was not built in this folder: there are no objects to link anew")
    cmake = Path(sys.executable).parent / "cmake"
    subprocess.run(
        [cmake, "--build", build, "--target", "gsplat_core_cpu_static_runtime"], check=True, capture_output=True
    )
    (linked,) = build.rglob("gsplat_core_cpu_static_runtime.so")
    needed = subprocess.run(["readelf", "-d", linked], check=True, capture_output=True, text=True).stdout
    assert "libstdc++" not in needed and "libgcc_s" not in needed
    result = subprocess.run([sys.executable, "-c", REFUSED, linked], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert "capacity must be 0 to 2^31 - 1, got -7" in result.stdout
