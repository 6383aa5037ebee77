"""Calls the API of a real server in ways that its OpenAPI document allows and forbids, by schemathesis: no 5xx, no undocumented answer.

Usage: python -m tests.system.api_fuzzing [--examples N] [--seed N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from gsplat_core.io.bundle import save_bundle
from services.client import Client
from services.registry.bundle_file import pack
from tests.services.supervisor.test_model_show import uniform
from tests.system.servers import ROOT, serving

NAME = "theatre-1"
"""The document's example of a name."""
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_headers_conformance",
    "response_schema_conformance", "negative_data_rejection", "missing_required_header", "unsupported_method", "ignored_auth",
)  # fmt: skip
"""All but those that take it for an error when a request that fits its schema is refused for what it says."""
ENDLESS = "/v1/streams/{name}/mjpeg"
ABSENT = {"jobs": "/v1/replays", "recordings": "/v1/recordings"}
"""Resources that this server may have been built without: then they answer 503, and only that."""
ANSWER_S = 30


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
