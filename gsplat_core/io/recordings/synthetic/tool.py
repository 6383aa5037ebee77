"""Grasper that enters through a port, grasps the tissue, tugs and releases it.

Its shape is a signed distance function of tapered capsules, intersected by sphere tracing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug

Array = NDArray[np.floating]

PORT_MM = np.array([58.0, 44.0, 8.0])
"""Entry point of the shaft in mm: to the lower right of the scope."""
CYCLE_S = 2.4
HOVER_MM = 13.0
TRACE_STEPS = 56
HIT_MM = 2e-3
NEAREST_MM = 4.0
HULL_RADIUS_MM = 7.0
"""Radius in mm of the bounding hull around the shaft's axis.

Includes the open jaws and a margin for rays that graze the tool within a pixel.
"""


@dataclass(frozen=True)
class Part:
    """Capsule from a to b with a linearly varying radius."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    radius_a_mm: float
    radius_b_mm: float
    material: int


@dataclass(frozen=True)
class ToolHits:
    """Intersections of rays with the tool."""

    distance_mm: Array
    """Distance in mm along the ray; infinity if the ray hits nothing before its limit."""
    cover: Array
    """Coverage of the pixel, 0..1, by the ray's distance from the tool."""
    normal: Array
    """Surface normal [..., 3] at hits."""
    material: NDArray[np.int8]


SHAFT, STEEL, RING = 0, 1, 2


class ToolMotion:
    """Tool motion in cycles of approach, tug and retreat, each with a new grasp point."""

    def __init__(self, rng: np.random.Generator, cycles: int) -> None:
        angle = rng.uniform(0, 2 * np.pi, cycles + 1)
        radius = 15 * np.sqrt(rng.uniform(0.05, 1, cycles + 1))
        self._grasps = np.stack([radius * np.cos(angle) - 4, 0.75 * radius * np.sin(angle) - 3], axis=1)
        side = rng.uniform(-0.6, 0.6, cycles + 1)
        # Pull towards the port and away from the surface.
        self._pulls = np.stack([2.8 + side, 1.8 - side, np.full(cycles + 1, -6.0)], axis=1)

    def tug(self, time_s: float) -> Tug:
        """Return the pull on the tissue; 0 outside the middle half of a cycle."""
        cycle, phase = self._phase(time_s)
        strength = np.sin(np.pi * np.clip((phase - 0.25) / 0.5, 0, 1)) ** 2
        pull = self._pulls[cycle] * strength
        return Tug(self._grasp(cycle), (float(pull[0]), float(pull[1]), float(pull[2])))

    def parts(self, tissue: Tissue, time_s: float) -> list[Part]:
        """Return the tool's capsules in world mm. During a tug the tip holds the grasped material point."""
        cycle, phase = self._phase(time_s)
        tug = self.tug(time_s)
        held = tissue.position(tug.grasp, time_s, tug)
        away = _smooth(1 - phase / 0.25) if phase < 0.25 else _smooth((phase - 0.75) / 0.25)
        if phase > 0.75:  # on the way to the next grasp
            after = tissue.position(self._grasp(cycle + 1), time_s, tug)
            held = held + _smooth((phase - 0.75) / 0.25) * (after - held)
        back = PORT_MM - held
        back /= np.linalg.norm(back)
        tip = held + back * HOVER_MM * away + np.array([0, 0, -0.4])
        axis = PORT_MM - tip
        axis /= np.linalg.norm(axis)
        sideways = np.cross(axis, [0.25, 0.1, 1.0])
        sideways /= np.linalg.norm(sideways)
        opening = 0.9 + 3.4 * away
        hinge, wrist, collar = tip + 11 * axis, tip + 16.5 * axis, tip + 22 * axis
        jaws = [
            part
            for side in (-1, 1)
            for knee in [tip + 5.5 * axis + side * (0.75 * opening + 0.5) * sideways]
            for part in (
                Part(hinge, knee, 1.9, 1.45, STEEL),
                Part(knee, tip + side * 0.5 * opening * sideways, 1.45, 0.75, STEEL),
            )
        ]
        return [
            *jaws,
            Part(hinge - 0.5 * axis, wrist, 2.6, 3.1, STEEL),
            Part(wrist, collar, 3.3, 3.8, RING),
            Part(collar, PORT_MM + 20 * axis, 4.0, 4.0, SHAFT),
        ]

    def _grasp(self, cycle: int) -> tuple[float, float]:
        return float(self._grasps[cycle, 0]), float(self._grasps[cycle, 1])

    def _phase(self, time_s: float) -> tuple[int, float]:
        cycle = int(time_s // CYCLE_S)
        return cycle, time_s / CYCLE_S - cycle


def _smooth(x: float) -> float:
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)


def distance(parts: list[Part], points: Array) -> tuple[Array, NDArray[np.int8]]:
    """Return the distance of points [N, 3] to the tool and the index of the nearest part.

    The distance is slightly underestimated where a part tapers.
    """
    x, y, z = np.ascontiguousarray(points.T)
    nearest = np.full(len(points), np.inf, np.float32)
    which = np.zeros(len(points), np.int8)
    for index, part in enumerate(parts):
        a_x, a_y, a_z = part.a.astype(np.float32)
        b_x, b_y, b_z = (part.b - part.a).astype(np.float32)
        length2 = b_x * b_x + b_y * b_y + b_z * b_z
        p_x, p_y, p_z = x - a_x, y - a_y, z - a_z
        dot = p_x * b_x + p_y * b_y + p_z * b_z
        h = np.clip(dot / length2, 0, 1)
        squared = p_x * p_x + p_y * p_y + p_z * p_z - h * (2 * dot - h * length2)
        taper = np.float32(part.radius_b_mm - part.radius_a_mm)
        gap = np.sqrt(np.maximum(squared, 0)) - np.float32(part.radius_a_mm) - taper * h
        which[gap < nearest] = index
        nearest = np.minimum(nearest, gap)
    return nearest, which


def trace(parts: list[Part], origin: NDArray[np.float64], rays: Array, limit_mm: Array, pixel_rad: float) -> ToolHits:
    """Sphere-trace unit rays [N, 3] from one origin up to a limit for each (Hart 1996).

    J. C. Hart, "Sphere tracing", The Visual Computer 12 (1996). `pixel_rad` is the angle of a pixel, used for coverage.
    """
    count = len(rays)
    if not parts:
        nothing, far = np.zeros(count, np.float32), np.full(count, np.inf, np.float32)
        return ToolHits(far, nothing, np.zeros((count, 3), np.float32), np.zeros(count, np.int8))
    start = origin.astype(np.float32)
    travelled = np.full(count, np.inf, np.float32)
    closest = np.full(count, np.inf, np.float32)
    reach = np.zeros(count, np.float32)
    active = may_meet(parts, start, rays)
    s = np.full(len(active), NEAREST_MM, np.float32)
    for _ in range(TRACE_STEPS):
        gap, _ = distance(parts, start + rays[active] * s[:, None])
        passing = gap / (s * np.float32(pixel_rad))
        closer = passing < closest[active]
        closest[active[closer]], reach[active[closer]] = passing[closer], s[closer]
        touched = gap < HIT_MM
        travelled[active[touched]] = s[touched]
        s = s + np.float32(0.97) * gap
        alive = ~touched & (s < limit_mm[active])
        active, s = active[alive], s[alive]
        if not active.size:
            break
    hit = np.isfinite(travelled)
    cover = np.where(hit, np.float32(1), np.clip(np.float32(0.75) - closest, 0, 1)).astype(np.float32)
    touching = np.flatnonzero(cover > 0)
    normal = np.zeros((count, 3), np.float32)
    material = np.zeros(count, np.int8)
    if touching.size:
        # A ray that only grazes the tool is shaded where it comes closest.
        at = start + rays[touching] * reach[touching][:, None]
        which = distance(parts, at)[1]
        material[touching] = np.array([part.material for part in parts], np.int8)[which]
        for index, part in enumerate(parts):
            own = touching[which == index]
            offset = at[which == index] - part.a.astype(np.float32)
            along = (part.b - part.a).astype(np.float32)
            h = np.clip(offset @ along / np.float32(along @ along), 0, 1)
            away = offset - h[:, None] * along
            normal[own] = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    return ToolHits(travelled, cover, normal, material)


def may_meet(parts: list[Part], start: Array, rays: Array) -> NDArray[np.intp]:
    """Select the rays that pass near the tool: those that hit one of a chain of bounding spheres."""
    shaft = parts[-1]
    axis = (shaft.a - shaft.b) / np.linalg.norm(shaft.a - shaft.b)
    tip = max(float((part.b - shaft.a) @ axis) for part in parts)
    count = 32
    spacing = (np.linalg.norm(shaft.a - shaft.b) + tip) / (count - 1)
    centres = shaft.b + np.linspace(0, (count - 1) * spacing, count)[:, None] * axis - start
    radius = float(np.hypot(HULL_RADIUS_MM, spacing / 2))
    away = np.linalg.norm(centres, axis=1)
    cosine = np.where(away > radius, np.sqrt(np.maximum(1 - (radius / away) ** 2, 0)), -1)
    towards = (centres / away[:, None]).astype(np.float32)
    return np.flatnonzero((rays @ towards.T > cosine.astype(np.float32)).any(axis=1))
