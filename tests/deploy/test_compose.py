"""The compose files are accepted by Docker Compose, and their services are hardened."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
from pathlib import Path

import pytest
import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PROFILES = ("cpu", "gpu", "observability")


@pytest.fixture(scope="module")
def services() -> dict:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]


@pytest.fixture
def composed(tool, tmp_path):
    """Return a function that gives the configuration computed by Docker Compose, with generated secrets."""
    folder = shutil.copytree(DEPLOY, tmp_path / "deploy")
    subprocess.run([folder / "new_secrets.sh"], check=True)

    def configuration(*files: str) -> dict:
        arguments = [argument for name in files for argument in ("-f", folder / name)]
        arguments += [argument for name in PROFILES for argument in ("--profile", name)]
        done = tool("docker-compose", *arguments, "config", "--format", "json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return configuration


def test_every_compose_profile_has_services(services):
    assert {profile for each in services.values() for profile in each["profiles"]} == set(PROFILES)


@pytest.mark.parametrize("name", ["cpu", "gpu", "prometheus", "grafana"])
def test_compose_services_are_hardened(services, name):
    service = services[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert "privileged" not in service


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_compose_runtime_folder_is_private_tmpfs(services, name):
    (runtime,) = [entry for entry in services[name]["tmpfs"] if entry.startswith("/run/intrasplat:")]
    assert {"mode=0700", "uid=10001", "gid=10001"} <= set(runtime.split(":")[1].split(","))
    assert services[name]["shm_size"] == "1gb"


def test_compose_reserves_gpu_in_gpu_profile_only(services):
    (device,) = services["gpu"]["deploy"]["resources"]["reservations"]["devices"]
    assert (device["driver"], device["capabilities"]) == ("nvidia", ["gpu"])
    assert "deploy" not in services["cpu"]


def test_files_mounted_by_compose_exist():
    document = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    mounted = [config["file"] for config in document["configs"].values()]
    mounted += [
        volume.split(":")[0]
        for service in document["services"].values()
        for volume in service.get("volumes", [])
        if volume.startswith("./")
    ]
    assert len(mounted) == 5
    assert [name for name in mounted if not (DEPLOY / name).exists()] == []


def test_docker_compose_accepts_compose_file(composed):
    services = composed("compose.yaml")["services"]
    assert set(services) == {"cpu", "gpu", "prometheus", "grafana"}
    assert services["cpu"]["ports"][0]["host_ip"] == "127.0.0.1"
    assert services["gpu"]["build"]["target"] == "cuda"


def test_compose_tls_file_replaces_port_and_disables_plaintext(composed, tool, tmp_path):
    document = composed("compose.yaml", "compose.tls.yaml")
    for name in ("cpu", "gpu"):
        service = document["services"][name]
        assert [(port["host_ip"], port["published"]) for port in service["ports"]] == [("0.0.0.0", "8443")]
        assert service["environment"]["INTRASPLAT_SERVER__PLAINTEXT"] == "false"
        assert {secret["source"] for secret in service["secrets"]} == {
            "admin_key", "server_certificate", "server_key"
        }  # fmt: skip
        assert "HEALTHCHECK_URL" not in service["environment"]  # the image's: the probe listener, which speaks no TLS
    scraped = yaml.safe_load(document["configs"]["prometheus_tls"]["content"])
    assert scraped["scrape_configs"][0]["tls_config"]["server_name"] == "intrasplat"
    (tmp_path / "prometheus.yaml").write_text(document["configs"]["prometheus_tls"]["content"])
    checked = tool("promtool", "check", "config", "--syntax-only", tmp_path / "prometheus.yaml")
    assert checked.returncode == 0, checked.stderr


def test_new_secrets_are_created_once_and_key_is_accepted(tmp_path):
    from services.auth.keys import KeyStore, Role, first_admin_key

    script = shutil.copy(DEPLOY / "new_secrets.sh", tmp_path)
    subprocess.run([script], check=True)
    secrets = tmp_path / "secrets"
    assert stat.S_IMODE(secrets.stat().st_mode) == 0o700
    first = (secrets / "admin.key").read_text()
    subprocess.run([script], check=True)
    assert (secrets / "admin.key").read_text() == first
    store = KeyStore(tmp_path / "keys.json")
    assert first_admin_key(store, secrets / "admin.key") is False
    found = store.find(first.strip())
    assert found is not None and found.role == Role.ADMIN
