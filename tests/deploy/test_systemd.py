"""The systemd units are valid and hardened."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from services.settings import ENVIRONMENT_PREFIX, load_settings

ROOT = Path(__file__).resolve().parents[2]
UNITS = sorted((ROOT / "deploy" / "systemd").iterdir())


@pytest.fixture
def units(tmp_path) -> list[Path]:
    """The units with existing programs, which systemd-analyze requires."""
    for unit in UNITS:
        (tmp_path / unit.name).write_text(re.sub(r"/opt/intrasplat/bin/\w+", "/bin/true", unit.read_text()))
    return sorted(tmp_path.iterdir())


def test_systemd_analyze_accepts_units(tool, units):
    checked = tool("systemd-analyze", "verify", "--man=no", *units)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_systemd_analyze_reports_misspelt_option(tool, tmp_path):
    wrong = tmp_path / "wrong.service"
    wrong.write_text("[Service]\nType=exec\nExecStart=/bin/true\nProtectSistem=strict\n")
    assert "ProtectSistem" in tool("systemd-analyze", "verify", "--man=no", wrong).stderr


def test_systemd_unit_security_exposure_is_low(tool, units):
    (service,) = [unit for unit in units if unit.name == "intrasplat.service"]
    done = tool("systemd-analyze", "security", "--offline=true", "--threshold=25", service)
    assert done.returncode == 0, done.stdout[-200:]


def test_systemd_unit_uses_notify_and_watchdog():
    """Counterpart of `sd_notify` in services/api/server.py."""
    text = (ROOT / "deploy" / "systemd" / "intrasplat.service").read_text()
    assert "\nType=notify\n" in text and "\nNotifyAccess=main\n" in text
    assert re.search(r"^WatchdogSec=\d+s$", text, re.MULTILINE)


def test_commands_with_service_settings_use_folders_that_systemd_unit_creates(monkeypatch):
    """`keys`, `backup` and `igtl` know the folders of the service from the settings file alone."""
    for name in [name for name in os.environ if name.startswith(ENVIRONMENT_PREFIX)]:
        monkeypatch.delenv(name)
    unit = (ROOT / "deploy" / "systemd" / "intrasplat.service").read_text()
    (config,) = re.findall(r"^ExecStart=.* --config (\S+)$", unit, re.MULTILINE)
    assert f"deploy/settings.yaml {config}\n" in (ROOT / "docs" / "operations.md").read_text()
    settings = load_settings(ROOT / "deploy" / "settings.yaml")
    assert f"\nStateDirectory={settings.data_dir.relative_to('/var/lib')}\n" in unit
    assert f"\nRuntimeDirectory={settings.runtime_dir.relative_to('/run')}\n" in unit
    assert f"{ENVIRONMENT_PREFIX}PATHS__" not in unit
