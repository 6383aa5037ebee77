"""A grasper that comes in through a port, takes hold of the tissue, tugs and lets go.

Its shape is a signed distance function (tapered capsules), found by sphere tracing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug

Array = NDArray[np.float32]

PORT_MM = np.array([58.0, 44.0, 8.0])
"""Where the shaft enters: to the lower right, beside the scope."""
CYCLE_S = 2.4
HOVER_MM = 13.0
TRACE_STEPS = 56
HIT_MM = 2e-3


@dataclass(frozen=True)
class Part:
    """A capsule from a to b whose radius changes linearly."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    radius_a_mm: float
    radius_b_mm: float
    material: int


@dataclass(frozen=True)
class ToolHits:
    """What the rays meet."""

    distance_mm: Array
    """Along the ray; infinity where it meets nothing before the limit."""
    cover: Array
    """0..1: share of the pixel, by how close its ray passes."""
    normal: Array
    """[..., 3] where hit."""
    material: NDArray[np.int8]


SHAFT, STEEL, RING = 0, 1, 2


class ToolMotion:
    """Where the tool is at a time, and how it pulls: cycles of approach, tug and retreat with a new grasp each."""

    def __init__(self, rng: np.random.Generator, cycles: int) -> None:
        angle = rng.uniform(0, 2 * np.pi, cycles + 1)
        radius = 15 * np.sqrt(rng.uniform(0.05, 1, cycles + 1))
        self._grasps = np.stack([radius * np.cos(angle) - 4, 0.75 * radius * np.sin(angle) - 3], axis=1)
        side = rng.uniform(-0.6, 0.6, cycles + 1)
        # Towards the port and off the surface.
        self._pulls = np.stack([2.8 + side, 1.8 - side, np.full(cycles + 1, -6.0)], axis=1)

    def tug(self, time_s: float) -> Tug:
        """The pull on the tissue, 0 outside the middle half of a cycle."""
        cycle, phase = self._phase(time_s)
        strength = np.sin(np.pi * np.clip((phase - 0.25) / 0.5, 0, 1)) ** 2
        pull = self._pulls[cycle] * strength
        grasp = self._grasps[cycle]
        return Tug((float(grasp[0]), float(grasp[1])), (float(pull[0]), float(pull[1]), float(pull[2])))

    def parts(self, tissue: Tissue, time_s: float) -> list[Part]:
        """The tool's parts in world millimetres. While it tugs, its tip holds the grasped material point."""
        cycle, phase = self._phase(time_s)
        tug = self.tug(time_s)
        held = tissue.position(*tug.grasp, time_s, tug)
        away = _smooth(1 - phase / 0.25) if phase < 0.25 else _smooth((phase - 0.75) / 0.25)
        if phase > 0.75:  # on the way to the next grasp
            after = self._grasps[cycle + 1]
            held = held + _smooth((phase - 0.75) / 0.25) * (tissue.position(*after, time_s, tug) - held)
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

    def _phase(self, time_s: float) -> tuple[int, float]:
        cycle = int(time_s // CYCLE_S)
        return cycle, time_s / CYCLE_S - cycle


def _smooth(x: float) -> float:
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)


def distance(parts: list[Part], points: Array) -> tuple[Array, NDArray[np.int8]]:
    """Distance of points [N, 3] to the tool (never more than the true one), and the nearest part."""
    nearest = np.full(len(points), np.inf, np.float32)
    which = np.zeros(len(points), np.int8)
    for index, part in enumerate(parts):
        along = (part.b - part.a).astype(np.float32)
        offset = points - part.a.astype(np.float32)
        length2 = float(along @ along)
        h = np.clip(offset @ (along / np.float32(length2)), 0, 1)
        taper = part.radius_b_mm - part.radius_a_mm
        squared = np.einsum("ni,ni->n", offset, offset) - 2 * h * (offset @ along) + h * h * np.float32(length2)
        gap = np.sqrt(np.maximum(squared, 0)) - np.float32(part.radius_a_mm) - np.float32(taper) * h
        closer = gap < nearest
        nearest[closer] = gap[closer]
        which[closer] = index
    return nearest, which


def trace(parts: list[Part], origin: NDArray[np.float64], rays: Array, limit_mm: Array, pixel_rad: float) -> ToolHits:
    """Sphere tracing of unit rays [N, 3] from one origin up to a limit for each.

    J. C. Hart, "Sphere tracing", The Visual Computer 12 (1996). `pixel_rad` is a pixel's angle, for the cover.
    """
    count = len(rays)
    start = origin.astype(np.float32)
    travelled = np.full(count, np.inf, np.float32)
    closest = np.full(count, np.inf, np.float32)
    hit = np.zeros(count, bool)
    material = np.zeros(count, np.int8)
    active = np.arange(count)
    s = np.full(count, 4.0, np.float32)
    for _ in range(TRACE_STEPS):
        gap, _ = distance(parts, start + rays[active] * s[:, None])
        closest[active] = np.minimum(closest[active], gap / (s * np.float32(pixel_rad)))
        touched = gap < HIT_MM
        hit[active[touched]] = True
        travelled[active[touched]] = s[touched]
        s = s + np.float32(0.97) * gap
        alive = ~touched & (s < limit_mm[active])
        active, s = active[alive], s[alive]
        if not active.size:
            break
    cover = np.where(hit, np.float32(1), np.clip(np.float32(0.75) - closest, 0, 1)).astype(np.float32)
    touching = np.flatnonzero(cover > 0)
    normal = np.zeros((count, 3), np.float32)
    if touching.size:
        # A ray that only grazes is shaded where it comes closest, near enough to the silhouette of a hit beside it.
        reach = np.where(hit[touching], travelled[touching], _closest_approach(parts, start, rays[touching]))
        at = start + rays[touching] * reach[:, None]
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


def _closest_approach(parts: list[Part], start: Array, rays: Array) -> Array:
    """Distance along each ray at which it comes closest to the axis of the part that it passes nearest."""
    best = np.full(len(rays), np.inf, np.float32)
    reach = np.full(len(rays), 10.0, np.float32)
    for part in parts:
        for weight in np.linspace(0, 1, 24):
            radius = part.radius_a_mm + weight * (part.radius_b_mm - part.radius_a_mm)
            point = (part.a + weight * (part.b - part.a)).astype(np.float32) - start
            s = np.maximum(rays @ point, np.float32(4.0))
            gap = np.linalg.norm(point - rays * s[:, None], axis=1) - np.float32(radius)
            closer = gap < best
            best[closer], reach[closer] = gap[closer], s[closer]
    return reach
