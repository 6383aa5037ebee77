"""Synthetic scene as a function of time: tissue, tool, air and cameras.

Each frame can be rendered independently.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.air import Air
from gsplat_core.io.recordings.synthetic.colon import Colon
from gsplat_core.io.recordings.synthetic.extras import CLEAR, Extras
from gsplat_core.io.recordings.synthetic.lamp import Lamp
from gsplat_core.io.recordings.synthetic.renderer import Eye, render_eye
from gsplat_core.io.recordings.synthetic.tissue import NO_TUG, TISSUE_DISTANCE_MM, Tissue, Tug
from gsplat_core.io.recordings.synthetic.tool import CYCLE_S, Part, ToolMotion
from gsplat_core.scene.cameras import Camera

BASELINE_MM = 4.4
THIRD_MM = (-7.0, -5.0, 3.0)
"""Position of the third camera in the left camera's coordinates, in mm."""
View = Literal["left", "right", "third"]
SCENES: dict[str, type[Tissue]] = {"open": Tissue, "colon": Colon}


@dataclass(frozen=True)
class Sway:
    """Trajectory of a moving scope: a sine along each axis and a sinusoidal roll, all 0 at time 0."""

    periods_s: tuple[float, float, float, float] = (4.1, 5.3, 6.7, 4.7)
    """Periods in seconds of the motion along x, y and z, and of the roll."""
    reaches: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factors on the usual amplitudes."""
    phases: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @classmethod
    def seeded(cls, rng: np.random.Generator) -> Sway:
        """Draw another trajectory: 0.7 to 1.5 times the usual periods, 0.6 to 1.3 times the amplitudes.

        Phases are random.
        """
        periods = np.array(cls.periods_s) * rng.uniform(0.7, 1.5, 4)
        return cls(
            *(tuple(each.tolist()) for each in (periods, rng.uniform(0.6, 1.3, 4), rng.uniform(0, 2 * np.pi, 4)))
        )

    def at(self, time_s: float, sway_mm: tuple[float, float, float]) -> tuple[NDArray[np.float64], float]:
        """Return the centre [3] in mm and the roll in radians, for the usual amplitudes along x, y and z."""
        turn = 2 * np.pi * time_s
        ways = [
            most * reach * (np.sin(turn / period + phase) - np.sin(phase))
            for most, reach, period, phase in zip(
                (*sway_mm, USUAL_ROLL), self.reaches, self.periods_s, self.phases, strict=True
            )
        ]
        return np.array(ways[:3]), float(ways[3])


USUAL_ROLL = 0.05
USUAL_SWAY = Sway()


@dataclass(frozen=True)
class SyntheticScene:
    """Tissue, tool and cameras as functions of time."""

    tissue: Tissue
    motion: ToolMotion
    camera: Camera
    moving: bool
    air: Air | None = None
    sway: Sway = field(default_factory=lambda: USUAL_SWAY)
    """Amplitudes and periods of a moving scope's sway."""

    @classmethod
    def from_seed(
        cls, seed: int, width_px: int, height_px: int, duration_s: float, moving: bool, extras: Extras = CLEAR
    ) -> SyntheticScene:
        """Create the scene of a seed; the picture size does not change the scene."""
        kind = SCENES[extras.scene]
        camera = Camera.from_focal(kind.focal_factor * max(width_px, height_px), width_px, height_px)
        seeds = np.random.SeedSequence(seed).spawn(3)
        shape, tool = (np.random.default_rng(child) for child in seeds[:2])
        tissue = kind(shape, texel_mm=min(0.6 * TISSUE_DISTANCE_MM / float(camera.K[0, 0]), 0.3))
        air = Air.from_seed(seeds[2], extras.smoke, extras.exposure_changes) if extras.changes_pictures else None
        breath, path = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)[3:])
        first, second = breath.uniform(0, 2 * np.pi, 2)
        tissue.breathing = replace(
            tissue.breathing, ratio=extras.breathing_ratio, wander=extras.rate_wander, wander_phases=(first, second)
        )
        sway = Sway.seeded(path) if extras.scope_path == "seeded" else USUAL_SWAY
        return cls(tissue, ToolMotion(tool, cycles=int(duration_s // CYCLE_S) + 1), camera, moving, air, sway)

    def camera_at(self, time_s: float, view: View = "left") -> Camera:
        """Return a camera at a time; the left camera at time 0 is at the world's origin."""
        left = self._left_at(time_s)
        return left if view == "left" else left.with_pose(self.left_to(view) @ left.world_to_camera)

    def _left_at(self, time_s: float) -> Camera:
        """Return the left camera: at rest, or swaying around a fixed point on the tissue."""
        if not self.moving:
            return self.camera
        centre, roll = self.sway.at(time_s, self.tissue.sway_mm)
        rotation = _looking(np.array([0, 0, self.tissue.looked_at_mm]) - centre, roll)
        return self.camera.with_pose(_pose(rotation, centre))

    def left_to(self, view: View) -> NDArray[np.float64]:
        """Return the rigid transform [4, 4] from the left camera to another camera of the same scope."""
        if view == "left":
            return np.eye(4)
        if view == "right":
            return self.camera.right_eye(BASELINE_MM).world_to_camera
        centre = np.array(THIRD_MM)
        return _pose(_looking(np.array([0, 0, self.tissue.looked_at_mm]) - centre, 0.0), centre)

    def render(self, time_s: float, view: View = "left", transparent: bool = False) -> Eye:
        """Render one camera's view at a time.

        Args:
            time_s: time in seconds.
            view: camera to render.
            transparent: omit the tools but keep their shadow on the tissue.
        """
        reference_mm = self.tissue.exposed_mm
        if view == "third":
            lamp = Lamp.of_eye(BASELINE_MM / 2, reference_mm).seen_from(self.left_to(view))
        else:
            lamp = Lamp.of_eye(BASELINE_MM / 2 if view == "left" else -BASELINE_MM / 2, reference_mm)
        camera = self.camera_at(time_s, view)
        tug, parts = self.tug(time_s), self.parts(time_s)
        return render_eye(self.tissue, tug, parts, camera, time_s, lamp, self.air, transparent=transparent)

    def tug(self, time_s: float) -> Tug:
        """Return the tool's pull on the tissue at a time."""
        return self.motion.tug(time_s) if self.tissue.tools else NO_TUG

    def parts(self, time_s: float) -> list[Part]:
        """Return the capsules of the tool at a time; empty in scenes without a tool."""
        return self.motion.parts(self.tissue, time_s) if self.tissue.tools else []

    def track(self, time_s: float) -> NDArray[np.float32]:
        """Return a grid of material points in the world [63, 3] in mm."""
        u, v = np.meshgrid(np.linspace(-32, 32, 9, dtype=np.float32), np.linspace(-24, 24, 7, dtype=np.float32))
        points = self.tissue.points(u.ravel(), v.ravel(), time_s, self.tug(time_s))
        return np.stack(points.position, axis=1)


def _looking(towards: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """Return the rotation of a camera looking in a direction; its rows are the camera's axes."""
    forward = towards / np.linalg.norm(towards)
    right = np.cross([-np.sin(roll), np.cos(roll), 0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _pose(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose
