"""The arrows between the packages point one way, and importing them does nothing but import."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from benchmarks.structure import circles, imports, parsed

ROOT = Path(__file__).resolve().parent.parent
MAY_IMPORT = {
    "gsplat_core": {"gsplat_core"},
    "operators": {"gsplat_core", "operators"},
    "services": {"gsplat_core", "operators", "services"},
}


@pytest.mark.slow
@pytest.mark.parametrize("package", ["operators", "services"])
def test_no_modules_import_each_other_not_even_in_functions_or_for_type_checkers(package):
    assert circles(imports(parsed(ROOT, [package]), everything=True)) == []


REFERENCE = "gsplat_core.reference"


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """Every node of a file's syntax tree."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imported_modules(path: Path) -> frozenset[str]:
    """Every module that a file may import, also inside of functions: `from a import b` counts as a and as a.b."""
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def imported_packages(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imported_modules(path)}


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_arrows_point_one_way(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    forbidden = (set(MAY_IMPORT) | {"tests", "benchmarks"}) - MAY_IMPORT[package]
    named = re.compile(rf"^\s*(?:import|from)\s.*\b(?:{'|'.join(forbidden)})\b", re.MULTILINE)
    for path in files:
        if named.search(path.read_text(encoding="utf-8")):  # few files are parsed, because that takes seconds for all
            wrong = imported_packages(path) & forbidden
            assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def imports_reference(path: Path) -> bool:
    return any(name == REFERENCE or name.startswith(f"{REFERENCE}.") for name in imported_modules(path))


@pytest.mark.slow
@pytest.mark.parametrize("package", MAY_IMPORT)
def test_the_reference_is_imported_by_tests_only(package):
    reference = ROOT / REFERENCE.replace(".", "/")
    files = [path for path in (ROOT / package).rglob("*.py") if reference not in path.parents]
    assert [str(path.relative_to(ROOT)) for path in files if imports_reference(path)] == []


@pytest.mark.parametrize(
    "line",
    [
        "import gsplat_core.reference",
        "from gsplat_core import reference",
        "from gsplat_core.reference.rendering import x",
        "def f():\n    from gsplat_core.reference import deformation",
    ],
)
def test_every_way_to_import_the_reference_is_seen(tmp_path, line):
    (tmp_path / "module.py").write_text(line)
    assert imports_reference(tmp_path / "module.py")


@pytest.mark.slow
def test_experimental_methods_are_named_by_registries_only():
    """An import path in a registry is a string. An import statement would make an experimental method part of another module."""
    folder = ROOT / "gsplat_core/experimental"
    others = [path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py") if folder not in path.parents]
    wrong = [
        str(path.relative_to(ROOT))
        for path in others
        if any(name.startswith("gsplat_core.experimental") for name in imported_modules(path))
    ]
    assert list(folder.glob("*.py")) and wrong == []


FIELD_MODULES = (
    "gsplat_core/choices.py", "gsplat_core/deformation/", "gsplat_core/ops/", "gsplat_core/reference/",
    "gsplat_core/contrib.py", "gsplat_core/as_gsplat/",
)  # fmt: skip
"""Registry entries of the deformation fields, their modules and their kernels, and gsplat's class of the same name."""
FIELD_NAMES, FIELD_CLASSES = {"basis", "hexplane"}, {"BasisField", "HexPlaneField"}


def named_fields(path: Path) -> set[str]:
    """Return the names of fields in the strings of a file, and their classes in its code."""
    text = path.read_text(encoding="utf-8")
    if not any(name in text for name in FIELD_NAMES | FIELD_CLASSES):
        return set()
    nodes = nodes_of(path)
    strings = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    identifiers = {getattr(node, kind, None) for node in nodes for kind in ("id", "attr", "name")}
    return strings & FIELD_NAMES | {each for each in identifiers if isinstance(each, str)} & FIELD_CLASSES


def test_no_other_module_names_a_deformation_field():
    assert named_fields(ROOT / "gsplat_core/choices.py") >= {"basis", "hexplane"}
    assert named_fields(ROOT / "gsplat_core/deformation/__init__.py") >= {"BasisField", "HexPlaneField"}
    for package in MAY_IMPORT:
        for path in (ROOT / package).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            assert name.startswith(FIELD_MODULES) or not named_fields(path), name


def test_scene_data_imports_nothing_above_it():
    files = sorted((ROOT / "gsplat_core/scene").rglob("*.py"))
    allowed = {"scene", "errors", "registry", "value_ranges", "transfers"}
    imported = {
        name.split(".")[1] for path in files for name in imported_modules(path) if name.startswith("gsplat_core.")
    }
    assert files and imported <= allowed


def test_geometry_knows_nothing_of_training():
    files = sorted((ROOT / "gsplat_core/geometry").rglob("*.py"))
    assert files
    wrong = [
        path.name for path in files if any(each.startswith("gsplat_core.training") for each in imported_modules(path))
    ]
    assert not wrong


PROGRAM = """
import socket, subprocess, sys
import torch  # runs ldconfig on its own account

def forbidden(*arguments, **options):
    raise AssertionError(f"import did something: {arguments}")

socket.socket.connect = socket.socket.bind = forbidden
subprocess.Popen.__init__ = forbidden
import importlib
for name in sys.argv[1:]:
    importlib.import_module(name)
    assert not torch.cuda.is_initialized(), name
    assert "torch.utils.cpp_extension" not in sys.modules, name
"""


@pytest.mark.slow
def test_import_opens_no_socket_starts_no_process_and_compiles_nothing():
    packages = (*MAY_IMPORT, "gsplat_core.rendering.rasterization", "gsplat_core.reference")
    done = subprocess.run([sys.executable, "-c", PROGRAM, *packages], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


WITHOUT_TORCH = [
    "services.bus.messages",
    "services.bus.runtime",
    "services.supervisor.launcher",
    "services.supervisor.process",
    "services.supervisor.worker",
    "services.supervisor.stream",
    "services.display",
    "services.registry.models",
    "services.recordings.store",
    "services.jobs.pool",
    "services.jobs.store",
    "services.api.pages",
    "services.exports.snapshots",
    "services.exports.files",
    "services.client",
    "services.audit",
    "services.api",
    "services.api.server",
    "services.settings",
]
"""Modules that the control plane's process loads."""


CLIENT_WITHOUT_FASTAPI = (
    "services.client",
    "services.schemas",
)


def test_the_client_and_the_schemas_load_no_server_framework():
    program = "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)\nassert not {'fastapi', 'starlette', 'uvicorn', 'sqlalchemy', 'torch', 'cv2'} & set(sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program, *CLIENT_WITHOUT_FASTAPI], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_control_plane_loads_neither_torch_nor_opencv():
    """Import all modules in one process and check for torch and OpenCV after each."""
    program = "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)\n    assert not {'torch', 'cv2'} & set(sys.modules), name"
    done = subprocess.run([sys.executable, "-c", program, *WITHOUT_TORCH], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
