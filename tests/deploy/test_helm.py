"""The chart renders, matches the schemas of Kubernetes, and refuses invalid values."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from services.settings import ServerSettings

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "deploy" / "helm"
OF_AN_OPERATOR = {"ServiceMonitor", "PrometheusRule"}
FULL = [
    "tls.secretName=room-1-tls", "adminKey.secretName=room-1-key", "serviceMonitor.enabled=true",
    "serviceMonitor.keySecretName=room-1-metrics", "serviceMonitor.caSecretName=ca", "prometheusRule.enabled=true",
    "dashboard.enabled=true", "gpu.runtimeClassName=nvidia", "image.pullSecrets[0].name=registry",
    "nodeSelector.room=one", "podAnnotations.note=one", "persistence.storageClass=fast", "extraEnv[0].name=TZ",
    "extraEnv[0].value=UTC", "networkPolicy.egress[0].to[0].ipBlock.cidr=10.20.0.0/16",
]  # fmt: skip
WITHOUT_A_GPU = ["plaintext=true", "gpu.count=0", "image.tag=cpu", "persistence.existingClaim=mine"]


@pytest.fixture
def render(tool):
    """Return a function that renders the chart with values and returns its documents by kind and name."""

    def rendered(values: list[str], release: str = "room-1") -> dict[str, dict]:
        given = [argument for value in values for argument in ("--set", value)]
        done = tool("helm", "template", release, CHART, "--namespace", "theatres", *given)
        assert done.returncode == 0, done.stderr
        documents = [document for document in yaml.safe_load_all(done.stdout) if document]
        return {f"{document['kind']} {document['metadata']['name']}": document for document in documents}

    return rendered


def container(resources: dict[str, dict]) -> dict:
    (deployment,) = [each for each in resources.values() if each["kind"] == "Deployment"]
    (only,) = deployment["spec"]["template"]["spec"]["containers"]
    return only


@pytest.mark.slow
@pytest.mark.parametrize("values", [FULL, WITHOUT_A_GPU], ids=["full", "without a GPU"])
def test_rendered_chart_matches_kubernetes_schemas(render, kubernetes_takes, values):
    for resource in render(values).values():
        if resource["kind"] not in OF_AN_OPERATOR:
            kubernetes_takes(resource)


def test_chart_pods_are_restricted(render):
    resources = render(FULL)
    pod = resources["Deployment room-1-intrasplat"]["spec"]["template"]["spec"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod["automountServiceAccountToken"] is False
    assert container(resources)["securityContext"] == {
        "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
    }  # fmt: skip
    assert not any("hostPath" in volume for volume in pod["volumes"])


def test_chart_deploys_single_pod_with_gpu_limit(render):
    resources = render(FULL)
    deployment = resources["Deployment room-1-intrasplat"]["spec"]
    assert (deployment["replicas"], deployment["strategy"]) == (1, {"type": "Recreate"})
    assert container(resources)["resources"]["limits"]["nvidia.com/gpu"] == 1
    assert "nvidia.com/gpu" not in container(render(WITHOUT_A_GPU))["resources"]["limits"]


def test_chart_probes_use_probe_port(render):
    for values in (FULL, WITHOUT_A_GPU):
        probed = container(render(values))
        asked = {name: probed[f"{name}Probe"]["httpGet"] for name in ("startup", "liveness", "readiness")}
        assert {(each["scheme"], each["port"]) for each in asked.values()} == {("HTTP", "probe")}
        assert asked["readiness"]["path"] == "/readyz" and asked["liveness"]["path"] == "/livez"
        ports = {port["name"]: port["containerPort"] for port in probed["ports"]}
        variables = {each["name"]: each.get("value") for each in probed["env"]}
        assert variables["INTRASPLAT_SERVER__PROBE_PORT"] == str(ports["probe"]) != variables["INTRASPLAT_SERVER__PORT"]


def test_releases_share_no_resources(render):
    one, two = render(FULL, "room-1"), render(FULL, "room-2")
    assert not set(one) & set(two)
    selectors = [
        rooms[f"Service {name}-intrasplat"]["spec"]["selector"]["app.kubernetes.io/instance"]
        for rooms, name in ((one, "room-1"), (two, "room-2"))
    ]
    assert selectors == ["room-1", "room-2"]


def test_chart_rules_and_dashboard_match_deploy_files(render):
    resources = render(FULL)
    rules = yaml.safe_load((ROOT / "deploy" / "prometheus" / "rules.yaml").read_text())
    assert resources["PrometheusRule room-1-intrasplat"]["spec"] == rules
    shown = json.loads(resources["ConfigMap room-1-intrasplat-dashboard"]["data"]["intrasplat.json"])
    assert shown == json.loads((ROOT / "deploy" / "grafana" / "dashboards" / "intrasplat.json").read_text())


def test_chart_service_monitor_uses_metrics_key(render):
    resources = render(FULL)
    (endpoint,) = resources["ServiceMonitor room-1-intrasplat"]["spec"]["endpoints"]
    assert endpoint["authorization"]["credentials"] == {"name": "room-1-metrics", "key": "metrics.key"}
    assert {"targetLabel": "job", "replacement": "intrasplat"} in endpoint["relabelings"]
    (ingress,) = resources["NetworkPolicy room-1-intrasplat"]["spec"]["ingress"]
    assert len(ingress["from"]) == 2


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([], "tls.secretName"),
        (["plaintext=true", "gpu.cout=2"], "cout"),
        (["plaintext=true", "gpu.count=-1"], "minimum"),
        (["plaintext=true", "settings.server.port=9"], "settings"),
        (["plaintext=true", "serviceMonitor.enabled=true"], "keySecretName"),
        (["plaintext=true", "image.digest=latest"], "digest"),
        (["plaintext=true", "terminationGracePeriodSeconds=5"], "minimum"),
    ],
)
def test_chart_refuses_invalid_values(tool, values, why):
    given = [argument for value in values for argument in ("--set", value)]
    done = tool("helm", "template", "room-1", CHART, *given)
    assert done.returncode != 0
    assert why in done.stderr


def test_helm_lint_passes(tool):
    done = tool("helm", "lint", "--strict", CHART, "--set", "plaintext=true")
    assert done.returncode == 0, done.stdout


def test_chart_values_and_schema_have_same_keys():
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    schema = json.loads((CHART / "values.schema.json").read_text())
    assert set(schema["properties"]) - {"global"} == set(values)
    for name, each in schema["properties"].items():
        if "properties" in each:
            assert set(each["properties"]) == set(values[name]), name


def test_chart_allowed_hosts_include_service_names(render):
    def hosts(*values: str) -> list[str]:
        given = {each["name"]: each["value"] for each in container(render(list(values)))["env"]}
        return json.loads(given.get("INTRASPLAT_SERVER__ALLOWED_HOSTS", "null"))

    assert hosts("tls.secretName=x") is None, "those of the certificate"
    inside = ["room-1-intrasplat", "room-1-intrasplat.theatres", "room-1-intrasplat.theatres.svc"]
    assert hosts("plaintext=true") == [*inside, f"{inside[-1]}.cluster.local"]
    assert hosts("tls.secretName=x", "allowedHosts[0]=room-1.example")[:2] == ["room-1.example", inside[0]]
    ServerSettings(allowed_hosts=hosts("plaintext=true"))
