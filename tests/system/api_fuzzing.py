"""Calls the API of a real server in ways that its OpenAPI document allows and forbids, by schemathesis: no 5xx, no undocumented answer.

Usage: python -m tests.system.api_fuzzing [--examples N] [--seed N]
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsplat_core.io.bundle import save_bundle
from services.client import Client
from services.registry.bundle_file import pack
from tests.services.supervisor.test_model_show import uniform

ROOT = Path(__file__).resolve().parents[2]
NAME = "theatre-1"
"""The document's example of a name."""
SETTINGS = """
server: {{port: 0}}
paths: {{data: {folder}/data, runtime: {folder}/r}}
log: {{format: text}}
limits: {{requests_per_s: 100000, address_requests_per_s: 100000}}
streams: {{theatre-1: {{source: "synthetic:?width=64&height=48&frames=4&fps=2", device: cpu, start: false}}}}
"""
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_headers_conformance",
    "response_schema_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method", "ignored_auth",
)  # fmt: skip
"""All but those that take it for an error when a request that fits its schema is refused for what it says."""
ENDLESS = "/v1/streams/{name}/mjpeg"
ABSENT = {"jobs": "/v1/replays", "recordings": "/v1/recordings"}
"""Resources that this server may have been built without: then they answer 503, and only that."""
ANSWER_S = 30


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, str]]:
    """A server of its own: its address and its administrator's key."""
    settings = folder / "settings.yaml"
    settings.write_text(SETTINGS.format(folder=folder))
    log = folder / "log"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "services.cli", "serve", "--config", settings],
            cwd=ROOT,
            stdout=output,
            stderr=output,
        )
    try:
        end_s = time.monotonic() + 60
        while not (found := re.search(r"IntraSplat is on (http://[^/\s]+)", log.read_text())):
            assert time.monotonic() < end_s and process.poll() is None, log.read_text()
            time.sleep(0.05)
        yield found[1], (folder / "data" / "admin.key").read_text().strip()
        process.terminate()
        assert process.wait(60) == 0, log.read_text()[-4000:]
        assert "Traceback" not in log.read_text(), log.read_text()
    finally:
        process.kill()
        process.wait()


def with_models(client: Client, folder: Path) -> None:
    """A model with two versions, the second one active, so that calls of its routes reach it."""
    save_bundle(uniform((0.9, 0.1, 0.1)), folder / "model")
    pack(folder / "model", folder / "model.isplat")
    for number in (1, 2):
        client.upload(NAME, folder / "model.isplat")
        assert client.checked(NAME, number).state == "ready"
        client.activate(NAME, number, expected_current=number - 1 or None)


def fuzz(url: str, key: str, folder: Path, examples: int, *options: str) -> subprocess.CompletedProcess[str]:
    """Run schemathesis; its exit code is 0 where it has found nothing."""
    with Client(url, key) as client:
        parts = set(client.about()["parts"])
        with_models(client, folder)
    left_out = [ENDLESS, *(path for part, path in ABSENT.items() if part not in parts)]
    arguments = [argument for path in left_out for argument in ("--exclude-path", path)]
    return subprocess.run(
        [
            str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json", "--header", f"Authorization: Bearer {key}",
            "--checks", ",".join(CHECKS), "--max-examples", str(examples), "--request-timeout", str(ANSWER_S), "--no-color",
            "--suppress-health-check", "all", *arguments, *options,
        ],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--examples", type=int, default=200)
    parser.add_argument("--seed", type=int)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="isf-") as folder, serving(Path(folder)) as (url, key):
        done = fuzz(
            url, key, Path(folder), asked.examples, *([] if asked.seed is None else ["--seed", str(asked.seed)])
        )
    sys.stdout.write(done.stdout + done.stderr)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
