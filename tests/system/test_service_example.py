"""Runs examples/06_service_life_cycle.sh against a new server."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path

import pytest

from gsplat_core.io.bundle import save_bundle
from services.registry.bundle_file import pack
from tests.missing import missing
from tests.services.supervisor.test_model_show import uniform
from tests.system.servers import ROOT, serving

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def programs() -> None:
    """Require the programs that the example calls. If one is missing, skip the test; fail in CI."""
    absent = [name for name in ("bash", "curl", "openssl") if shutil.which(name) is None]
    if absent:
        missing(f"the example needs {', '.join(absent)}; install it")


def test_service_life_cycle_example_succeeds(tiny, tmp_path):
    for name, colour in (("one", (0.9, 0.1, 0.1)), ("two", (0.1, 0.9, 0.1))):
        save_bundle(uniform(colour), tmp_path / name)
        pack(tmp_path / name, tmp_path / f"{name}.isplat")
    with zipfile.ZipFile(tmp_path / "case.zip", "w") as archive:
        for path in sorted(tiny.rglob("*")):
            archive.write(path, f"case/{path.relative_to(tiny)}")
    with tempfile.TemporaryDirectory(prefix="isg-") as folder, serving(Path(folder)) as (url, _):
        environment = {**os.environ, "URL": url, "KEY_FILE": f"{folder}/data/admin.key"}
        example = ROOT / "examples" / "06_service_life_cycle.sh"
        done = subprocess.run([example], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "pictures.mjpeg").read_bytes().count(b"\xff\xd8\xff") >= 1
    events = [entry["event"] for entry in json.loads((tmp_path / "audit.json").read_text())["entries"]]
    assert {"model.rollback", "model.check", "stream.create", "key.revoke", "process.started"} <= set(events)
    assert {"recording.upload", "replay.start", "replay.delete", "recording.delete"} <= set(events)
    assert json.loads((tmp_path / "report.json").read_text())["frames"]["displayed"] == 6
    assert "intrasplat_build_info{" in (tmp_path / "metrics.txt").read_text()
