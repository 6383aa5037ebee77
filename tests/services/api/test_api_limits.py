"""Limits of the values that clients send. Narrower ones would refuse requests that are valid today."""

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


def test_the_api_document_states_the_limits_of_all_values(plane):
    found: dict[str, set[tuple[float | None, float | None]]] = {}
    for name, limits in limits_in(plane.client.get("/openapi.json").json()):
        found.setdefault(name, set()).add(limits)
    assert found == LIMITS
