"""Settings and variables in images, compose files, chart and units are known to the service."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from services.settings import ENVIRONMENT_PREFIX, ServiceSettings, load_settings

ROOT = Path(__file__).resolve().parents[2]
FILES = [
    "docker/Dockerfile", "deploy/compose.yaml", "deploy/compose.tls.yaml", "deploy/helm/templates/deployment.yaml",
    "deploy/systemd/intrasplat.service",
]  # fmt: skip


def test_deploy_settings_file_loads():
    settings = load_settings(ROOT / "deploy" / "settings.yaml")
    assert set(settings.streams) == {"endoscope"}


def test_chart_settings_load(tmp_path):
    values = yaml.safe_load((ROOT / "deploy" / "helm" / "values.yaml").read_text())
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(values["settings"]))
    assert set(load_settings(tmp_path / "settings.yaml").streams) == {"endoscope"}


@pytest.mark.parametrize("file", FILES)
def test_environment_variables_of_deploy_files_are_settings(file):
    named = re.findall(rf"{ENVIRONMENT_PREFIX}([A-Z]+)__([A-Z_]+)", (ROOT / file).read_text())
    assert named
    for section, key in named:
        field = ServiceSettings.model_fields[section.lower()].annotation
        assert key.lower() in field.model_fields, f"{file}: {section}__{key}"


def test_image_environment_and_settings_load(monkeypatch):
    text = (ROOT / "docker" / "Dockerfile").read_text()
    for name, value in re.findall(rf"({ENVIRONMENT_PREFIX}\w+)=(\S+)", text):
        monkeypatch.setenv(name, value)
    settings = load_settings(ROOT / "deploy" / "settings.yaml")
    assert (settings.server.host, settings.server.port) == ("0.0.0.0", 8000)
    assert settings.data_dir == Path("/var/lib/intrasplat")
    longest = settings.runtime_dir / ("x" * 40) / "capture.status"
    assert len(str(longest)) < 100  # of a socket


@pytest.mark.parametrize(
    "file", ["deploy/compose.yaml", "deploy/helm/values.yaml", "deploy/systemd/intrasplat.service"]
)
def test_stop_timeout_exceeds_drain_time(file):
    seconds = re.search(
        r"(?:stop_grace_period: |terminationGracePeriodSeconds: |TimeoutStopSec=)(\d+)", (ROOT / file).read_text()
    )
    assert seconds is not None
    assert float(seconds[1]) > ServiceSettings().server.drain_s + 10
