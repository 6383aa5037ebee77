"""Calls the API of a real server in ways that its OpenAPI document allows and forbids, by schemathesis: no 5xx, no undocumented answer.

Usage: python -m tests.system.api_fuzzing [--examples N] [--seed N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from gsplat_core.io.bundle import save_bundle
from services.client import Client
from services.exports.snapshots import SnapshotStore, described
from services.registry.bundle_file import pack
from tests.services.supervisor.test_model_show import uniform
from tests.system.servers import ROOT, serving

NAME = "theatre-1"
SNAPSHOT = "1f0c9a3b5d7e8f20"
"""The document's examples of a name and of a snapshot's number."""
WINDOW_S = (0.0, 3.0)
"""Has the document's example of a time in it."""
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_headers_conformance",
    "response_schema_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method", "ignored_auth",
)  # fmt: skip
"""All but those that take it for an error when a request that fits its schema is refused for what it says."""
ENDLESS = "/v1/streams/{name}/mjpeg"
"""Endless response while a stream runs, so it is called without one. `tests/services/api/test_display.py` has
the pictures."""
ANSWER_S = 300.0


def with_models(client: Client, folder: Path) -> None:
    """Upload a model with two versions and activate the second, so that its routes can be called."""
    save_bundle(replace(uniform((0.9, 0.1, 0.1)), time_window_s=WINDOW_S), folder / "model")
    pack(folder / "model", folder / "model.isplat")
    for number in (1, 2):
        client.upload(NAME, folder / "model.isplat")
        assert client.checked(NAME, number).state == "ready"
        client.activate(NAME, number, expected_current=number - 1 or None)


def with_snapshot(folder: Path) -> None:
    """Store a snapshot of a stream, so that its routes can be called."""
    store = SnapshotStore(folder / "data" / "snapshots")
    said = {"seq": 1, "model_version": 1, "gaussians": 1, "time_window_s": list(WINDOW_S), "pause_ms": 0.1}
    with store.new() as new:
        save_bundle(replace(uniform((0.1, 0.9, 0.1)), time_window_s=WINDOW_S), new / "model")
        store.keep(new / "model", replace(described(new / "model", NAME, "nobody", said), id=SNAPSHOT))


def fuzz(url: str, key: str, folder: Path, examples: int, *options: str) -> list[subprocess.CompletedProcess[str]]:
    """Run schemathesis on every route of a server with a stopped stream. The exit codes are 0 without findings."""
    with Client(url, key) as client:
        with_models(client, folder)
    with_snapshot(folder)
    return [called(url, key, examples, which, ENDLESS, *options) for which in ("--include-path", "--exclude-path")]


def called(url: str, key: str, examples: int, *options: str) -> subprocess.CompletedProcess[str]:
    """Run schemathesis over the routes that the options choose."""
    return subprocess.run(
        [
            str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json", "--header", f"Authorization: Bearer {key}",
            "--checks", ",".join(CHECKS), "--max-examples", str(examples), "--request-timeout", str(ANSWER_S), "--no-color",
            "--suppress-health-check", "all", *options,
        ],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--examples", type=int, default=200)
    parser.add_argument("--seed", type=int)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="isf-") as folder, serving(Path(folder)) as (url, key):
        runs = fuzz(
            url, key, Path(folder), asked.examples, *([] if asked.seed is None else ["--seed", str(asked.seed)])
        )
    for done in runs:
        sys.stdout.write(done.stdout + done.stderr)
    return max(done.returncode for done in runs)


if __name__ == "__main__":
    sys.exit(main())
