"""Metrics and labels named in dashboard panels and alert rules exist in the service."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml

from services.api.observability import STATES, Measures, StreamMeasures
from services.api.server import ServerCertificate
from services.api.state import Storage
from services.audit import AuditLog
from services.audit.log import SystemEvents
from services.backup import StoredFiles, StoredFilesWatch
from services.registry.database import Database

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
OF_PROMETHEUS = {"up": {"job", "instance"}}
OF_THE_TARGET = {"job", "instance"}
SUFFIXES = {
    "counter": {"_total": set(), "_created": set()},
    "gauge": {"": set()},
    "histogram": {"_bucket": {"le"}, "_sum": set(), "_count": set(), "_created": set()},
}
INFO_LABELS = {"intrasplat_build_info": {"version"}}
NAME = re.compile(r"\b(?:intrasplat|process|python)_[a-z_]+\b|\bup\b")
MATCHER = re.compile(r'([a-z_]+)\s*(?:=~|!~|!=|=)\s*"([^"]*)"')
GROUPING = re.compile(r"\b(?:by|without)\s*\(([^)]*)\)")


@cache
def served() -> dict[str, set[str]]:
    """Return the labels of each sample of the service, by name of the sample."""
    with tempfile.TemporaryDirectory() as folder:
        audit = AuditLog(Path(folder) / "audit.jsonl")
        audit.close()
        files = StoredFilesWatch(Database("sqlite://"), StoredFiles(Path(folder), Path(folder), None), SystemEvents())
    measures = Measures([StreamMeasures(), Storage({}, audit), files])
    certificate = object.__new__(ServerCertificate)  # of no files: only the names of its metrics are asked for
    certificate._expires_s, certificate._failure = 0.0, None
    measures.registry.register(certificate)
    found = dict(OF_PROMETHEUS)
    labels = {
        name: set(getattr(collector, "_labelnames", ()))
        for collector, names in measures.registry._collector_to_names.items()
        for name in names
    }
    for family in measures.registry.collect():
        own = set(getattr(family, "_labelnames", ())) | labels.get(family.name, set())
        if family.type == "info":
            found[f"{family.name}_info"] = INFO_LABELS[f"{family.name}_info"]
        for suffix, more in SUFFIXES.get(family.type, {}).items():
            found[f"{family.name}{suffix}"] = own | more | OF_THE_TARGET
    return found


def rules() -> Iterator[tuple[str, str]]:
    for group in yaml.safe_load((DEPLOY / "prometheus" / "rules.yaml").read_text())["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]


def panels() -> Iterator[tuple[str, str]]:
    dashboard = json.loads((DEPLOY / "grafana" / "dashboards" / "intrasplat.json").read_text())
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            yield f"{panel['title']} {target['refId']}", target["expr"]
    for variable in dashboard["templating"]["list"]:
        query = re.fullmatch(r"label_values\((\w+), (\w+)\)", variable["query"])
        assert query, variable["query"]
        yield f"variable {variable['name']}", f"max by ({query[2]}) ({query[1]})"


ASKED = [*rules(), *panels()]


def labels_of(expression: str) -> set[str]:
    named = {label for label, _ in MATCHER.findall(expression)}
    for grouping in GROUPING.findall(expression):
        named |= {label.strip() for label in grouping.split(",")}
    return named


@pytest.mark.parametrize(("where", "expression"), ASKED, ids=[where for where, _ in ASKED])
def test_metrics_of_rules_and_panels_exist_with_labels(where, expression):
    known = served()
    names = {name for name in NAME.findall(re.sub(r'"[^"]*"', '""', expression)) if name != "instance"}
    assert names, f"{where} names no metric: {expression}"
    assert names <= set(known), f"{where}: the service has no {sorted(names - set(known))}"
    labels = set().union(*(known[name] for name in names))
    assert labels_of(expression) <= labels, f"{where}: {sorted(labels_of(expression) - labels)} is no label of {names}"


def test_stream_states_in_rules_and_panels_exist():
    for where, expression in ASKED:
        for label, value in MATCHER.findall(expression):
            if label == "state":
                assert set(value.split("|")) <= set(STATES), f"{where}: {value}"


def test_refusal_reasons_in_rules_and_panels_exist():
    sources = "".join(path.read_text() for path in (DEPLOY.parent / "services" / "api").rglob("*.py"))
    for where, expression in ASKED:
        for label, value in MATCHER.findall(expression):
            if label == "reason":
                assert f'"{value}"' in sources, f"{where}: {value}"


@pytest.mark.parametrize("name", ["intrasplat_stream_states", "intrasplat_viewers_total"])
def test_unknown_metric_names_are_detected(name):
    assert name in NAME.findall(f"rate({name}[1m])") and name not in served()


def test_every_service_metric_is_in_dashboard_panel():
    shown = {name for _, expression in panels() for name in NAME.findall(expression)}
    families = {re.sub(r"_(total|created|bucket|sum|count)$", "", name) for name in served() if "intrasplat" in name}
    assert {name for name in families if not any(each.startswith(name) for each in shown)} == set()


def test_operations_docs_cover_every_alert():
    text = (DEPLOY.parent / "docs" / "operations.md").read_text()
    assert [name for name, _ in rules() if f"`{name}`" not in text] == []


def test_service_docs_name_existing_metrics():
    text = (DEPLOY.parent / "docs" / "service.md").read_text()
    named = set(re.findall(r"`(intrasplat_[a-z_]+)[`{]", text))
    code = "".join(path.read_text() for path in (DEPLOY.parent / "services").rglob("*.py"))
    made = set(re.findall(r'"(intrasplat_[a-z_]+)"', code))
    assert len(named) > 20
    assert [name for name in named if name not in served() and re.sub(r"_(total|info)$", "", name) not in made] == []
