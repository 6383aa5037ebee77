"""The whole application: imports, routes without parts, OpenAPI document."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from control_fakes import fake_parts
from fastapi.routing import iter_route_contexts

from services.api.guard import rule_of
from services.api.pages import SWAGGER_FILES, SWAGGER_UI
from services.api.problems import PROBLEM_JSON, Problem
from services.api.state import Parts
from services.auth.keys import Role
from services.schemas import CheckResult

ROOT = Path(__file__).resolve().parents[3]
PUBLIC = {"/livez", "/readyz", "/openapi.json", "/docs", "/docs/{file}"}


@pytest.mark.slow
def test_new_app_does_not_import_torch_or_opencv(tmp_path):
    code = (
        "import sys, services.api, services.settings, services.audit, services.cli.serve\n"
        "from services.settings import ServiceSettings\n"
        f"services.api.new_app(ServiceSettings(paths={{'data': {str(tmp_path)!r}}}))\n"
        "print(sorted({'torch', 'cv2', 'av', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "[]\n"


def routes(app):
    return [each for each in iter_route_contexts(app.routes) if getattr(each, "endpoint", None) is not None]


def test_every_route_returns_401_without_key_and_403_for_lower_roles(plane):
    found = routes(plane.app)
    assert len(found) > 25
    assert {each.path for each in found if rule_of(each.endpoint).role is Role.PUBLIC} == PUBLIC
    for each in found:
        rule = rule_of(each.endpoint)
        path = each.path.replace("{number}", "1").replace("{file}", "start.js")
        path = re.sub(r"\{\w+\}", "x", path)
        if rule.role is Role.PUBLIC:
            assert plane.client.get(path).status_code == 200
            continue
        for method in getattr(each, "methods", None) or ():
            answer = plane.client.request(method, path)
            assert (answer.status_code, answer.headers["content-type"]) == (401, PROBLEM_JSON), (method, path)
            assert answer.headers["www-authenticate"].startswith("Bearer")
            lower = {"viewer": (), "operator": ("viewer",), "admin": ("viewer", "operator")}[rule.role]
            for role in lower:
                assert plane.ask(method, path, role).status_code == 403, (method, path, role)


def test_router_raises_for_endpoint_without_role():
    from services.api.guard import new_router

    async def open_to_all() -> None: ...

    with pytest.raises(TypeError, match="open_to_all declares no role"):
        new_router("x").get("/open")(open_to_all)


def test_wrong_method_returns_405_with_allow_header(plane):
    for path, methods in (("/v1/streams", "GET, POST"), ("/v1/models/a/versions", "GET, PUT"), ("/livez", "GET, HEAD")):
        answer = plane.ask("TRACE", path)
        assert (answer.status_code, answer.headers["allow"], answer.json()["status"]) == (405, methods, 405)


def test_livez_and_readyz_answer_head_requests(plane):
    for path in ("/livez", "/readyz", "/readyz?verbose=1"):
        seen, asked = (plane.client.request(method, path) for method in ("HEAD", "GET"))
        assert (seen.status_code, seen.content) == (200, b"") and asked.status_code == 200


def test_routes_of_absent_parts_return_503(new_plane):
    plane = new_plane(Parts())
    for path in ("/v1/streams", "/v1/models", "/v1/replays", "/v1/recordings"):
        answer = plane.ask("GET", path)
        assert (answer.status_code, answer.json()["title"]) == (503, "Not built into this server")
        assert answer.headers["content-type"] == PROBLEM_JSON


def test_openapi_describes_every_operation_with_role_and_responses(plane):
    document = plane.client.get("/openapi.json").json()
    operations = [(path, operation) for path, item in document["paths"].items() for operation in item.values()]
    assert {"/v1/streams", "/v1/models/{name}/versions", "/livez", "/metrics"} <= set(document["paths"])
    names = [operation["operationId"] for _, operation in operations]
    assert len(names) == len(set(names))
    for path, operation in operations:
        assert operation["description"] and operation["x-role"], path
        assert {"400", "421", "429", "500"} <= set(operation["responses"])
        assert operation["responses"]["429"]["content"] == {
            PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}
        }
        assert ("401" in operation["responses"]) == (operation["x-role"] != "public")
        assert bool(operation["security"]) == (operation["x-role"] != "public")
    upload = document["paths"]["/v1/models/{name}/versions"]["put"]
    assert list(upload["requestBody"]["content"]) == ["application/octet-stream"]
    assert [each["name"] for each in upload["parameters"]] == ["name", "format", "Content-Digest"]
    assert document["components"]["schemas"]["Activation"]["properties"]["version"]["examples"] == [3]


def test_openapi_operations_list_their_problem_statuses(plane):
    paths = plane.client.get("/openapi.json").json()["paths"]
    for method, path, more in (
        ("get", "/livez", set()),
        ("get", "/v1/streams", {401, 403}),
        ("get", "/v1/streams/{name}", {401, 403, 404}),
        ("post", "/v1/streams", {401, 403, 408, 409, 415}),
        ("delete", "/v1/streams/{name}", {401, 403, 404, 409}),
        ("put", "/v1/models/{name}/versions", {401, 403, 404, 408, 409, 415, 507}),
    ):
        responses = paths[path][method]["responses"]
        problems = {int(status) for status in responses if int(status) >= 400} - {422}
        assert problems == {400, 413, 421, 429, 431, 500, 503} | more, (method, path)
        assert ("422" in responses) == (more != set()), (method, path)


def test_docs_page_loads_only_local_files(plane):
    page = plane.client.get("/docs")
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert len(loaded) == 5
    for address in loaded:
        assert address.startswith("/docs/"), address
        assert plane.client.get(address).status_code == 200
    assert "<script>" not in page.text and "style=" not in page.text and "onload" not in page.text
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "http" not in page.headers["content-security-policy"]
    assert re.findall(r"https?://", (SWAGGER_UI / "start.js").read_text() + (SWAGGER_UI / "page.css").read_text()) == []
    # In the style sheet addresses are names of namespaces within data: pictures, and nothing that is loaded.
    assert re.findall(r"url\((?!['\"]?data:)", (SWAGGER_UI / "swagger-ui.css").read_text()) == []


def test_swagger_ui_files_match_version_in_notice():
    digests = {name: hashlib.sha256((SWAGGER_UI / name).read_bytes()).hexdigest() for name in SWAGGER_FILES}
    assert "5.33.1" in (SWAGGER_UI / "NOTICE").read_text()
    assert digests["swagger-ui-bundle.js"] == "050bc415ee7048dcd881682678f720264e7da5e373f7461d7c58c755305255f7"
    assert digests["swagger-ui.css"] == "1ac324f7dcd27e4b9386b4bd6421271ec147e922a22c05ba24b11515e9aa6321"


@pytest.mark.parametrize("name", ["../app.py", "%2e%2e/app.py", "nope.js", "start.js%00"])
def test_docs_route_returns_404_for_other_files(plane, name):
    assert plane.client.get(f"/docs/{name}").status_code == 404


def test_problem_classes_have_error_status_and_title():
    for kind in Problem.__subclasses__():
        assert 400 <= kind.status < 600 and kind.title


def test_readyz_reports_state_of_each_check(new_plane):
    async def well():
        return CheckResult(True, "one model is active")

    async def camera():
        return CheckResult(False, "source lost", needed=False)

    async def broken():
        return CheckResult(False, "no database")

    plane = new_plane(fake_parts(checks={"registry": well, "camera": camera}))
    assert plane.client.get("/readyz").json() == {"status": "degraded"}
    verbose = plane.client.get("/readyz?verbose").json()
    assert verbose["checks"]["camera"] == {"ok": False, "detail": "source lost", "needed": False}
    assert plane.client.get("/livez").json() == {"status": "alive"}

    plane = new_plane(fake_parts(checks={"registry": broken}))
    answer = plane.client.get("/readyz?verbose")
    assert (answer.status_code, answer.json()["status"]) == (503, "not ready")

    plane = new_plane()
    assert plane.client.get("/readyz").json() == {"status": "ready"}
    plane.control.draining.set()
    assert plane.client.get("/readyz").status_code == 503


def test_background_parts_are_exited_in_reverse_order(tmp_path):
    from contextlib import asynccontextmanager

    from starlette.testclient import TestClient

    from services.api import new_app
    from services.settings import ServiceSettings

    said = []

    def part(name):
        @asynccontextmanager
        async def running():
            said.append(f"{name} on")
            yield
            said.append(f"{name} off")

        return running

    parts = Parts(background=[part("registry"), part("streams")])
    with TestClient(new_app(ServiceSettings(paths={"data": tmp_path}), parts), "http://localhost") as client:
        assert client.get("/livez").status_code == 200
        assert said == ["registry on", "streams on"]
    assert said[2:] == ["streams off", "registry off"]
