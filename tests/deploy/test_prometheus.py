"""Prometheus accepts its configuration, and alerts fire as expected."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

HERE = Path(__file__).parent
PROMETHEUS = HERE.parents[1] / "deploy" / "prometheus"


def test_promtool_accepts_config_and_rules(tool):
    checked = tool("promtool", "check", "config", "--syntax-only", PROMETHEUS / "prometheus.yaml")
    assert checked.returncode == 0, checked.stderr
    checked = tool("promtool", "check", "rules", "--lint-fatal", PROMETHEUS / "rules.yaml")
    assert checked.returncode == 0, checked.stderr + checked.stdout


@pytest.mark.slow
def test_alerts_fire_as_in_rules_test(tool, tmp_path):
    for file in (PROMETHEUS / "rules.yaml", HERE / "rules_test.yaml"):
        shutil.copy(file, tmp_path)
    tested = tool("promtool", "test", "rules", "rules_test.yaml", cwd=tmp_path)
    assert tested.returncode == 0, tested.stdout + tested.stderr


def test_every_alert_fires_in_rules_test():
    examples = yaml.safe_load((HERE / "rules_test.yaml").read_text())["tests"]
    raised = {each["alertname"] for test in examples for each in test["alert_rule_test"] if each["exp_alerts"]}
    groups = yaml.safe_load((PROMETHEUS / "rules.yaml").read_text())["groups"]
    assert raised == {rule["alert"] for group in groups for rule in group["rules"]}
