"""Each example runs as its docstring says, on a machine without the recordings."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.system.servers import serving

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))

SLOW = (
    "02_fit_an_image.py",
    "03_online_reconstruction.py",
    "04_operator_graph.py",
    "05_bundle_and_ply.py",
    "06_service_life_cycle.py",
)
RUNS = {
    "01_render.py": (["--out", "sphere.png"], r"600 Gaussians, 600 in view", ["sphere.png"]),
    "02_fit_an_image.py": (["--steps", "40"], r"(\d+\.\d) dB before, (\d+\.\d) dB after", []),
    "03_online_reconstruction.py": (["--frames", "3"], r"frame 2: \d+ steps, model 3, training error \d+", []),
    "04_operator_graph.py": ([], r"finished; tool share(?: 0\.\d\d){6}\nfault: operator 'failing' .* frame 2", []),
    "05_bundle_and_ply.py": (
        ["--out", "bundle"],
        r"format 1, ",
        ["bundle/model.safetensors", "bundle/manifest.json", "bundle/last_frame.ply"],
    ),
    "06_service_life_cycle.py": (
        ["--url", "URL", "--key-file", "KEY_FILE"],
        r"(?s)red is life-cycle/1: ready.*a picture of version 1.*refused \(409\).*a picture of version 2.*rolled back to 1.*"
        r"a picture of version 1.*red.glb: \d+ bytes.*live.ply: \d+ bytes.*life-cycle is ready.*"
        r"replay: (?:queued|running), .*replay: done, 6 of 6 frames\nreport.json: 6 frames displayed, the newest at \d+\.\d dB\n.*the old key: 401.*audit \d+: key.revoke .* done\n.*intrasplat_upload_bytes_total [1-9]",
        [],
    ),
}
"""Options, what the output must say, and the files that must be there."""


def test_examples_are_numbered_from_one_and_all_run_here():
    assert [path.name for path in EXAMPLES] == sorted(RUNS)
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_docstring_opens_with_a_sentence_and_gives_the_usage(path):
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert docstring is not None
    assert docstring.splitlines()[0].endswith(".")
    assert re.search(rf"^Usage: python examples/{re.escape(path.name)}", docstring, re.MULTILINE)


@pytest.fixture
def server():
    """Starts a service, for an example that asks one: what stands for its address and for the file with its key."""
    with ExitStack() as running:

        def start() -> dict[str, str]:
            folder = Path(running.enter_context(TemporaryDirectory(prefix="ise-")))  # sockets need a short path
            url, _ = running.enter_context(serving(folder))
            return {"URL": url, "KEY_FILE": str(folder / "data" / "admin.key")}

        yield start


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=pytest.mark.slow if path.name in SLOW else ()) for path in EXAMPLES],
    ids=lambda path: path.name,
)  # fmt: skip
def test_runs(path, tmp_path, server):
    options, expected, files = RUNS[path.name]
    if "URL" in options:
        places = server()
        options = [places.get(option, option) for option in options]
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-W", "error", str(path), *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": search, "OMP_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    said = re.search(expected, done.stdout)
    assert said, done.stdout
    for name in files:
        assert (tmp_path / name).stat().st_size > 0
    if path.name == "02_fit_an_image.py":
        before_db, after_db = map(float, said.groups())
        assert after_db > before_db + 5
