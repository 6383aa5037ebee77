"""`make sbom` lists every package of the images, and the images contain the tested versions."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


def pinned(lock: str) -> dict[str, str]:
    text = (ROOT / lock).read_text()
    return dict(re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", text, re.MULTILINE))


def test_sbom_lists_locked_packages_with_hashes(tool, tmp_path):
    recipe = (ROOT / "Makefile").read_text().partition("\nsbom:")[2].partition("\n\n")[0]
    command = re.search(r"\$\(BIN\)/cyclonedx-py (.*) -o out/sbom.json", recipe)
    assert command is not None
    done = tool("cyclonedx-py", *command[1].split(), "-o", tmp_path / "sbom.json", cwd=ROOT)
    assert done.returncode == 0, done.stderr
    bom = json.loads((tmp_path / "sbom.json").read_text())
    assert (bom["bomFormat"], bom["metadata"]["component"]["name"]) == ("CycloneDX", "intrasplat")
    listed = {each["name"]: each for each in bom["components"]}
    wanted = pinned("requirements-service.lock")
    assert len(wanted) > 90 and {name: each["version"] for name, each in listed.items()} == wanted
    for name, each in listed.items():
        assert each["purl"] == f"pkg:pypi/{name}@{wanted[name]}"
        assert any(reference.get("hashes") for reference in each["externalReferences"]), name


def test_service_lock_has_versions_of_default_lock_and_extras():
    service, default = pinned("requirements-service.lock"), pinned("requirements.lock")
    assert {name: service[name] for name in default} == default
    assert {"psycopg", "s3fs", "pyjwt", "cryptography"} <= set(service) - set(default)
