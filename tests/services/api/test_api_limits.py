"""Limits of request values and status codes of responses. Clients rely on both."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

NUMBERS = 2**31 - 1
LIMITS: dict[str, set[tuple[float | None, float | None]]] = {
    "azimuth_deg": {(-75, 75)}, "elevation_deg": {(-75, 75)}, "zoom": {(0.25, 4)},
    "before": {(0, NUMBERS), (0, 2**63 - 1)}, "count": {(1, 500)}, "number": {(1, NUMBERS)},
    "version": {(1, NUMBERS)}, "expected_current": {(1, NUMBERS)}, "seed": {(0, NUMBERS)},
    "time_s": {(-1e9, 1e9)}, "times": {(1, 1000)}, "quality": {(10, 95)},
    "scale": {(0, 4)}, "engine_scale": {(0, 1)}, "fps": {(0, 120), (0, 1000)}, "budget_ms": {(0, 10_000)},
    "max_frames": {(1, 10_000_000)}, "steps_per_frame": {(1, 10_000)}, "samples": {(1, 1024)}, "supersampling": {(1, 4)},
    "idempotency-key": {(1, 200)}, "content-digest": {(None, 1000)}, "source": {(None, 1000)}, "verbose": {(None, 8)},
    "renderer": {(None, 4096)}, "field": {(None, 4096)}, "depth": {(None, 4096)}, "tool_mask": {(None, 4096)},
    "recordings": {(None, 2000)}, "streams": {(1, 100)}, "options": {(None, 50)},
}  # fmt: skip
"""Smallest and largest value or length by the name of the parameter or property, None without a limit. The smallest values
of scales, rates and times are excluded."""
KINDS = "exclusiveMinimum", "minimum", "minLength", "minItems"
MOST = "maximum", "maxLength", "maxItems", "maxProperties"


def limits_in(node: Any, name: str = "") -> Iterator[tuple[str, tuple[float | None, float | None]]]:
    """Yield the names of parameters and properties with their limits."""
    if isinstance(node, list):
        for each in node:
            yield from limits_in(each, each.get("name", name) if isinstance(each, dict) else name)
        return
    if not isinstance(node, dict):
        return
    least, most = (next((node[kind] for kind in kinds if isinstance(node.get(kind), int | float)), None) for kinds in (KINDS, MOST))  # fmt: skip
    if least is not None or most is not None:
        yield name, (least, most)
    for key, value in node.items():
        if key == "properties" and isinstance(value, dict):
            for each, schema in value.items():
                yield from limits_in(schema, each)
        else:
            yield from limits_in(value, name)


def test_openapi_states_limits_of_all_values(plane):
    found: dict[str, set[tuple[float | None, float | None]]] = {}
    for name, limits in limits_in(plane.client.get("/openapi.json").json()):
        found.setdefault(name, set()).add(limits)
    assert found == LIMITS


STATUSES = {
    "get /metrics": "200",
    "get /v1/version": "200",
    "get /v1/config": "200",
    "get /v1/config/schema": "200",
    "get /v1/streams": "200",
    "post /v1/streams": "201 408 409 415",
    "get /v1/streams/{name}": "200 404",
    "delete /v1/streams/{name}": "204 404 409",
    "post /v1/streams/{name}/start": "200 404 409",
    "post /v1/streams/{name}/stop": "200 404 409",
    "patch /v1/streams/{name}/options": "200 404 408 409 415",
    "put /v1/streams/{name}/camera": "200 404 408 409 415 507",
    "get /v1/streams/{name}/mjpeg": "200 404 409",
    "get /v1/models": "200",
    "get /v1/models/{name}/versions": "200 404",
    "put /v1/models/{name}/versions": "201 404 408 409 415 507",
    "get /v1/models/{name}/versions/{number}": "200 404",
    "delete /v1/models/{name}/versions/{number}": "204 404 409",
    "post /v1/models/{name}/activate": "200 404 408 409 415",
    "post /v1/models/{name}/rollback": "200 404 409",
    "post /v1/streams/{name}/snapshots": "201 404 408 409 415",
    "get /v1/streams/{name}/snapshots": "200 404",
    "get /v1/streams/{name}/snapshots/{number}": "200 404",
    "delete /v1/streams/{name}/snapshots/{number}": "204 404 409",
    "get /v1/models/{name}/versions/{number}/exports/{format}": "200 404 409",
    "post /v1/models/{name}/versions/{number}/render": "200 404 408 409 415",
    "get /v1/streams/{name}/snapshots/{number}/exports/{format}": "200 404",
    "post /v1/replays": "202 404 408 409 415",
    "get /v1/replays": "200",
    "get /v1/replays/{job_id}": "200 404",
    "delete /v1/replays/{job_id}": "204 404 409",
    "get /v1/batches/{batch}": "200 404",
    "post /v1/replays/{job_id}/cancel": "200 404 409",
    "get /v1/replays/{job_id}/results/{file}": "200 206 404 416",
    "post /v1/replays/{job_id}/keep": "201 404 408 409 415",
    "get /v1/recordings": "200",
    "get /v1/recordings/{name}": "200 404",
    "put /v1/recordings/{name}": "200 201 404 408 409 415 507",
    "delete /v1/recordings/{name}": "204 404 409",
    "get /v1/me": "200",
    "get /v1/keys": "200",
    "post /v1/keys": "201 408 409 415",
    "delete /v1/keys/{key_id}": "204 404 409",
    "post /v1/tickets": "201 408 409 415",
    "get /v1/audit": "200",
    "get /v1/audit/export": "200",
}
"""Statuses by operation that answers a caller with a key, in addition to those that each of them may answer with."""
ALWAYS = {"400", "401", "403", "413", "421", "422", "429", "431", "500", "503"}


def test_openapi_states_statuses_of_all_operations(plane):
    paths = plane.client.get("/openapi.json").json()["paths"]
    found = {
        f"{method} {path}": set(each["responses"]) for path, item in paths.items() for method, each in item.items()
    }
    guarded = {name: statuses for name, statuses in found.items() if "401" in statuses}
    assert set(found) - set(guarded) == {"get /livez", "get /readyz"}
    assert guarded == {name: {*ALWAYS, *statuses.split()} for name, statuses in STATUSES.items()}
