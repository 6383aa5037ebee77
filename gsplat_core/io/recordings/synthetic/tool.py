"""Tool that enters through a port, grasps the tissue, tugs and releases it.

Its shape is a signed distance function of tapered capsules, intersected by sphere tracing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.tissue import TUG_RADIUS_MM, Colour, Tissue, Tug

Array = NDArray[np.floating]

PORT_MM = (58.0, 44.0, 8.0)
"""Point in mm where the shaft enters the cavity, to the lower right of the scope."""
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
    """Part of a tool's shape: a capsule from a to b (in mm) with a linearly varying radius."""

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
    """Share of the pixel that the tool covers, 0..1, estimated from the ray's distance to the tool."""
    normal: Array
    """Surface normal [..., 3] at hits."""
    material: NDArray[np.int8]


SHAFT, STEEL, RING = 0, 1, 2


@dataclass(frozen=True)
class ToolAppearance:
    """Colours and gloss of a tool. Colours are linear RGB reflectances."""

    shaft: Colour = (0.085, 0.093, 0.108)
    ring: Colour = (0.10, 0.105, 0.12)
    steel: Colour = (0.26, 0.265, 0.28)
    gloss: float = 64.0
    """Exponent of the highlight lobe of steel."""
    glint: float = 2.6
    """Strength of the highlight lobe of steel."""
    metal_shaft: bool = False
    """True if the shaft is polished like the jaws."""


Kind = Literal["grasper", "scissors", "hook", "suction"]


@dataclass(frozen=True)
class ToolPlan:
    """Kind, size, entry point and habits of a tool."""

    kind: Kind = "grasper"
    scale: float = 1.0
    """Factor on the usual thickness of the shaft and size of the jaws."""
    port_mm: tuple[float, float, float] = PORT_MM
    cycle_s: float = CYCLE_S
    """Duration of one approach to the tissue, tug and retreat, in seconds."""
    hover_mm: float = HOVER_MM
    """Distance of the tool's tip from the tissue between two tugs, in mm."""
    reach_mm: float = 15.0
    """Largest distance in mm of the grasp points from their centre, `centre_mm`."""
    centre_mm: tuple[float, float] = (-4.0, -3.0)
    pull: float = 1.0
    """Factor on the displacement of the grasped tissue; 0 if the tool does not touch it."""
    tug_radius_mm: float = TUG_RADIUS_MM
    appearance: ToolAppearance = ToolAppearance()


USUAL_PLAN = ToolPlan()


class ToolMotion:
    """Tool motion in cycles of approach, tug and retreat, each with a new grasp point."""

    def __init__(self, rng: np.random.Generator, cycles: int, plan: ToolPlan = USUAL_PLAN) -> None:
        self.plan = plan
        angle = rng.uniform(0, 2 * np.pi, cycles + 1)
        radius = plan.reach_mm * np.sqrt(rng.uniform(0.05, 1, cycles + 1))
        self._grasps = np.stack([radius * np.cos(angle), 0.75 * radius * np.sin(angle)], axis=1) + plan.centre_mm
        side = rng.uniform(-0.6, 0.6, cycles + 1)
        # Pull towards the port and away from the surface.
        if plan.port_mm == PORT_MM:
            across = np.stack([2.8 + side, 1.8 - side], axis=1)
        else:
            to_port = np.array(plan.port_mm[:2]) / np.linalg.norm(plan.port_mm[:2])
            across = 3.3 * to_port + side[:, None] * np.array([-to_port[1], to_port[0]])
        self._pulls = plan.pull * np.concatenate([across, np.full((cycles + 1, 1), -6.0)], axis=1)

    def tug(self, time_s: float) -> Tug:
        """Return the tool's displacement of the tissue at a time; 0 outside the middle half of a cycle."""
        cycle, phase = self._phase(time_s)
        strength = np.sin(np.pi * np.clip((phase - 0.25) / 0.5, 0, 1)) ** 2
        pull = self._pulls[cycle] * strength
        return Tug(self._grasp(cycle), (float(pull[0]), float(pull[1]), float(pull[2])), self.plan.tug_radius_mm)

    def parts(self, tissue: Tissue, time_s: float, tug: Tug | None = None) -> list[Part]:
        """Return the tool's capsules in world mm. During a tug the tip holds the grasped material point.

        Args:
            tissue: deforming tissue.
            time_s: time in seconds.
            tug: pull on the tissue by another tool; None if this tool pulls.
        """
        cycle, phase = self._phase(time_s)
        plan, scale, port = self.plan, self.plan.scale, np.array(self.plan.port_mm)
        tug = self.tug(time_s) if tug is None else tug
        held = tissue.position(self._grasp(cycle), time_s, tug)
        away = _smooth(1 - phase / 0.25) if phase < 0.25 else _smooth((phase - 0.75) / 0.25)
        if phase > 0.75:  # on the way to the next grasp
            after = tissue.position(self._grasp(cycle + 1), time_s, tug)
            held = held + _smooth((phase - 0.75) / 0.25) * (after - held)
        back = port - held
        back /= np.linalg.norm(back)
        tip = held + back * plan.hover_mm * away + np.array([0, 0, -0.4])
        axis = port - tip
        axis /= np.linalg.norm(axis)
        sideways = np.cross(axis, [0.25, 0.1, 1.0])
        sideways /= np.linalg.norm(sideways)
        opening = scale * (0.9 + 3.4 * away)
        hinge, wrist, collar = tip + 11 * scale * axis, tip + 16.5 * scale * axis, tip + 22 * scale * axis
        return [
            *(
                Part(part.a, part.b, scale * part.radius_a_mm, scale * part.radius_b_mm, part.material)
                for part in (
                    *_end(plan.kind, tip, hinge, axis, sideways, opening, scale),
                    Part(hinge - 0.5 * scale * axis, wrist, 2.6, 3.1, STEEL),
                    Part(wrist, collar, 3.3, 3.8, RING),
                    Part(collar, port + 20 * axis, 4.0, 4.0, SHAFT),
                )
            )
        ]

    def _grasp(self, cycle: int) -> tuple[float, float]:
        return float(self._grasps[cycle, 0]), float(self._grasps[cycle, 1])

    def _phase(self, time_s: float) -> tuple[int, float]:
        cycle = int(time_s // self.plan.cycle_s)
        return cycle, time_s / self.plan.cycle_s - cycle


def _end(
    kind: Kind,
    tip: NDArray[np.float64],
    hinge: NDArray[np.float64],
    axis: NDArray[np.float64],
    sideways: NDArray[np.float64],
    opening: float,
    scale: float,
) -> list[Part]:
    """Return the capsules of a tool's working end, between hinge and tip. Their radii are those of a tool of scale 1."""
    if kind == "suction":
        return [Part(hinge, tip, 2.6, 2.4, SHAFT)]
    if kind == "hook":
        bend = tip + 1.5 * scale * axis + 3.0 * scale * sideways
        return [Part(hinge, bend, 1.1, 0.8, STEEL), Part(bend, tip, 0.8, 0.6, STEEL)]
    knee_at, thick = (5.5, 1.45) if kind == "grasper" else (3.0, 1.0)
    return [
        part
        for side in (-1, 1)
        for knee in [tip + knee_at * scale * axis + side * (0.75 * opening + 0.5 * scale) * sideways]
        for part in (
            Part(hinge, knee, 1.9, thick, STEEL),
            Part(knee, tip + side * 0.5 * opening * sideways, thick, 0.75 if kind == "grasper" else 0.35, STEEL),
        )
    ]


def _smooth(x: float) -> float:
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)


def distance(parts: list[Part], points: Array) -> tuple[Array, NDArray[np.int8]]:
    """Return the distance of points [N, 3] to a tool of at least one part, and the index of the nearest part.

    The distance is slightly underestimated where a part tapers.
    """
    gaps = _gaps(parts, points)
    return gaps.min(axis=0), gaps.argmin(axis=0).astype(np.int8)


def _gaps(parts: list[Part], points: Array) -> Array:
    """Return the distance of points [N, 3] to each part, [parts, N]."""
    x, y, z = np.ascontiguousarray(points.T)
    a_x, a_y, a_z = np.array([part.a for part in parts], np.float32).T[..., None]
    b_x, b_y, b_z = np.array([part.b - part.a for part in parts], np.float32).T[..., None]
    radius = np.array([[part.radius_a_mm] for part in parts], np.float32)
    taper = np.array([[part.radius_b_mm - part.radius_a_mm] for part in parts], np.float32)
    length2 = b_x * b_x + b_y * b_y + b_z * b_z
    p_x, p_y, p_z = x - a_x, y - a_y, z - a_z
    dot = p_x * b_x + p_y * b_y + p_z * b_z
    h = np.clip(dot / length2, 0, 1)
    squared = p_x * p_x + p_y * p_y + p_z * p_z - h * (2 * dot - h * length2)
    return np.asarray(np.sqrt(np.maximum(squared, 0)) - radius - taper * h, np.float32)


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
    along = rays[active]
    s = np.full(len(active), NEAREST_MM, np.float32)
    for _ in range(TRACE_STEPS):
        gap = _gaps(parts, start + along * s[:, None]).min(axis=0)
        passing = gap / (s * np.float32(pixel_rad))
        closer = passing < closest[active]
        closest[active[closer]], reach[active[closer]] = passing[closer], s[closer]
        touched = gap < HIT_MM
        travelled[active[touched]] = s[touched]
        s = s + np.float32(0.97) * gap
        alive = ~touched & (s < limit_mm[active])
        active, along, s = active[alive], along[alive], s[alive]
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
            axis = (part.b - part.a).astype(np.float32)
            h = np.clip(offset @ axis / np.float32(axis @ axis), 0, 1)
            away = offset - h[:, None] * axis
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
