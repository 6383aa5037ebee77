"""Validators of deployment files, and parsed files shared by tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

ROOT = Path(__file__).resolve().parents[2]
WHERE = {
    "promtool": "Debian's package prometheus",
    "systemd-analyze": "Debian's package systemd",
    "docker-compose": "the extra dev",
    "hadolint": "the extra dev",
    "cyclonedx-py": "the extra dev",
    "helm": "tests/deploy/get_helm.sh",
}
Run = Callable[..., subprocess.CompletedProcess[str]]


def missing(message: str) -> NoReturn:
    """Skip a test whose tools are missing, or fail if they are required."""
    if os.environ.get("INTRASPLAT_REQUIRE_DEPLOY_TOOLS") == "1":
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture
def kubernetes_takes() -> Callable[[dict], None]:
    """Validate a resource with Kubernetes' schemas."""
    try:
        import kubernetes_validate
    except ImportError as error:
        missing(f"kubernetes-validate is not installed ({error}); it is in the extra dev")
    return lambda resource: kubernetes_validate.validate(resource, "1.31", strict=True)


@pytest.fixture
def tool() -> Run:
    """Run a program. If it is not installed, skip the test; fail if INTRASPLAT_REQUIRE_DEPLOY_TOOLS is set."""

    def run(name: str, *arguments: str | Path, **options: object) -> subprocess.CompletedProcess[str]:
        places = f"{Path(sys.executable).parent}:{ROOT / 'build' / 'tools'}:{os.environ['PATH']}"
        program = shutil.which(name, path=places)
        if program is None:
            missing(f"{name} is not installed; it is in {WHERE[name]}")
        return subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, timeout=300, **options)  # type: ignore[call-overload]

    return run


@pytest.fixture(autouse=True)
def no_settings_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove service settings from the environment."""
    for name in [name for name in os.environ if name.startswith("INTRASPLAT_") and "__" in name]:
        monkeypatch.delenv(name)
