"""Synthetic scene as a function of time: tissue, tool, air, cameras, and optional content such as disturbances.

Each frame can be rendered independently.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.synthetic.optics import USUAL_LAMP, Air, Lamp, Particles, RadialLens
from gsplat_core.io.recordings.synthetic.random_scene import USUAL_SWAY, RandomScene, Sway, looking, rigid
from gsplat_core.io.recordings.synthetic.renderer import Eye, render_eye
from gsplat_core.io.recordings.synthetic.tissue import NO_TUG, TISSUE_DISTANCE_MM, Colon, Tissue, Tug
from gsplat_core.io.recordings.synthetic.tool import CYCLE_S, USUAL_PLAN, Part, ToolAppearance, ToolMotion
from gsplat_core.scene.cameras import Camera

MOST_SMOKE = 5.0
MOST_NOISE_MM = 20.0
MOST_RATIO = 5.0
MOST_WANDER = 0.5


@dataclass(frozen=True)
class Extras:
    """Optional scene, ground truth and disturbances of a synthetic recording.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    scene: str = "open"
    """`open`: a sheet of tissue with a tool; `colon`: a tube along its axis."""
    third: bool = False
    """Write a third camera's pictures and depth to `views/third/`, for evaluation only."""
    flow: bool = False
    """Write optical flow and scene flow from each frame to the next."""
    tracks: bool = False
    """Write the visibility of each point of `tracks.npy` in each frame."""
    behind: bool = False
    """Write pictures and depth with transparent tools to `behind/`, for evaluation only."""
    smoke: float = 0.0
    """Strength of the smoke; 1 is dense."""
    depth_noise_mm: float = 0.0
    """Standard deviation in mm of the depth noise at a distance of 74 mm.

    It grows with the squared distance. The noise-free depth is written as well.
    """
    exposure_changes: bool = False
    """Let the camera's exposure oscillate over time."""

    breathing_ratio: float = 1.0
    """Duration of expiration divided by that of inspiration."""
    rate_wander: float = 0.0
    """Largest relative deviation of the breathing rate from its mean."""
    scope_path: str = "usual"
    """Path of a moving scope: `usual` is identical for all seeds, `seeded` depends on the seed."""

    def __post_init__(self) -> None:
        if self.scene not in ("open", "colon"):
            raise InvalidSetting(f"scene must be 'open' or 'colon', got {self.scene!r}")
        for name, most in (("smoke", MOST_SMOKE), ("depth_noise_mm", MOST_NOISE_MM)):
            if not 0 <= getattr(self, name) <= most:
                raise InvalidSetting(f"{name} must be from 0 to {most:g}, got {getattr(self, name)}")
        if not 1 / MOST_RATIO <= self.breathing_ratio <= MOST_RATIO:
            raise InvalidSetting(
                f"breathing_ratio must be from {1 / MOST_RATIO:g} to {MOST_RATIO:g}, got {self.breathing_ratio}"
            )
        if not 0 <= self.rate_wander <= MOST_WANDER:
            raise InvalidSetting(f"rate_wander must be from 0 to {MOST_WANDER:g}, got {self.rate_wander}")
        if self.scope_path not in ("usual", "seeded"):
            raise InvalidSetting(f"scope_path must be 'usual' or 'seeded', got {self.scope_path!r}")

    def described(self) -> dict[str, object]:
        """Return the fields for `recording.json`.

        Fields of later versions are omitted at their defaults, so recordings keep their bytes.
        """
        added = ("breathing_ratio", "rate_wander", "scope_path")
        return {
            name: value for name, value in asdict(self).items() if name not in added or value != getattr(CLEAR, name)
        }

    @property
    def changes_pictures(self) -> bool:
        """True if smoke or exposure changes alter the pictures."""
        return self.smoke > 0 or self.exposure_changes


CLEAR = Extras()
"""Extras of a recording without any optional content."""


BASELINE_MM = 4.4
THIRD_MM = (-7.0, -5.0, 3.0)
"""Position of the third camera in the left camera's coordinates, in mm."""
View = Literal["left", "right", "third"]
VIEWS: tuple[View, ...] = get_args(View)
Array = NDArray[np.floating]
SCENES: dict[str, type[Tissue]] = {"open": Tissue, "colon": Colon}


@dataclass(frozen=True)
class SyntheticScene:
    """Tissue, tool and cameras as functions of time."""

    tissue: Tissue
    motion: ToolMotion
    camera: Camera
    moving: bool
    air: Air | None = None
    sway: Sway = USUAL_SWAY
    """Amplitudes and periods of a moving scope's sway."""
    drawn: RandomScene | None = None
    """Random properties; None for the usual scene."""
    others: tuple[ToolMotion, ...] = ()
    """Motions of further tools, which do not pull the tissue."""
    lens: RadialLens | None = None
    particles: Particles | None = None

    @classmethod
    def from_seed(
        cls,
        seed: int,
        width_px: int,
        height_px: int,
        duration_s: float,
        moving: bool,
        extras: Extras = CLEAR,
        drawn: RandomScene | None = None,
    ) -> SyntheticScene:
        """Create the scene of a seed; the picture size does not change the scene.

        `drawn` replaces the usual properties by random ones, including the motion of the scope and the smoke.
        """
        if drawn is not None:
            return cls._random(width_px, height_px, duration_s, extras, drawn)
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

    @classmethod
    def _random(
        cls, width_px: int, height_px: int, duration_s: float, extras: Extras, drawn: RandomScene
    ) -> SyntheticScene:
        side = max(width_px, height_px)
        camera = Camera.from_focal(drawn.focal * side, width_px, height_px)
        seeds = np.random.SeedSequence((drawn.seed, 27)).spawn(6)
        rngs = [np.random.default_rng(child) for child in seeds]
        texel_mm = min(0.6 * TISSUE_DISTANCE_MM / (SCENES[drawn.scene].focal_factor * side), 0.3)
        tissue = SCENES[drawn.scene](rngs[0], texel_mm, drawn.appearance, drawn.shape)
        tissue.breathing, tissue.exposed_mm, tissue.tools = drawn.breathing, drawn.exposed_mm, bool(drawn.tools)
        if drawn.scene == "open":
            tissue.looked_at_mm = drawn.shape.distance_mm
        cycles = lambda plan: int(duration_s // plan.cycle_s) + 1
        tools = [ToolMotion(rngs[1], cycles(plan), plan) for plan in drawn.tools or (USUAL_PLAN,)]
        particles = None
        if drawn.particles:
            particles = Particles.drawn(rngs[2], drawn.particles, drawn.particle_mm, drawn.shape.distance_mm)
        return cls(
            tissue,
            tools[0],
            camera,
            drawn.moving,
            Air.from_seed(seeds[3], drawn.smoke, False) if drawn.smoke else None,
            Sway.seeded(rngs[4]) if extras.scope_path == "seeded" else USUAL_SWAY,
            drawn,
            tuple(tools[1:]),
            RadialLens.from_corner(camera, *drawn.lens) if any(drawn.lens) else None,
            particles,
        )

    @property
    def baseline_mm(self) -> float:
        """Distance between the eyes in mm."""
        return BASELINE_MM if self.drawn is None else self.drawn.baseline_mm

    def camera_at(self, time_s: float, view: View = "left") -> Camera:
        """Return a camera at a time; the left camera at time 0 is at the world's origin."""
        left = self._left_at(time_s)
        return left if view == "left" else left.with_pose(self.left_to(view) @ left.world_to_camera)

    def _left_at(self, time_s: float) -> Camera:
        """Return the left camera: at rest, on the path drawn for the scene, or swaying around a fixed point on the
        tissue.
        """
        if not self.moving:
            return self.camera
        if self.drawn is not None and self.drawn.path is not None:
            return self.camera.with_pose(self.drawn.path.pose(time_s))
        centre, roll = self.sway.at(time_s, self.tissue.sway_mm)
        rotation = looking(np.array([0, 0, self.tissue.looked_at_mm]) - centre, roll)
        return self.camera.with_pose(rigid(rotation, centre))

    def left_to(self, view: View) -> NDArray[np.float64]:
        """Return the rigid transform [4, 4] from the left camera to another camera of the same scope."""
        if view == "left":
            return np.eye(4)
        if view == "right":
            return self.camera.right_eye(self.baseline_mm).world_to_camera
        centre = np.array(THIRD_MM)
        return rigid(looking(np.array([0, 0, self.tissue.looked_at_mm]) - centre, 0.0), centre)

    def render(self, time_s: float, view: View = "left", transparent: bool = False) -> Eye:
        """Render one camera's view at a time.

        Args:
            time_s: time in seconds.
            view: camera to render.
            transparent: omit the tools but keep their shadow on the tissue.
        """
        reference_mm, half_mm = self.tissue.exposed_mm, self.baseline_mm / 2
        plan = USUAL_LAMP if self.drawn is None else self.drawn.lamp
        if view == "third":
            lamp = Lamp.of_eye(half_mm, reference_mm, plan).seen_from(self.left_to(view))
        else:
            lamp = Lamp.of_eye(half_mm if view == "left" else -half_mm, reference_mm, plan)
        camera = self.camera_at(time_s, view)
        draw = lambda lens, after: render_eye(
            self.tissue, self.tug(time_s), self.tools(time_s), camera, time_s, lamp, self.air,
            transparent=transparent, lens=lens, after=after,
        )  # fmt: skip
        if self.drawn is None:
            return draw(None, None)

        def picture(radiance: Array, depth: Array) -> NDArray[np.uint8]:
            assert self.drawn is not None
            if self.particles is not None:
                radiance = self.particles.over(radiance, depth, camera, lamp, time_s)
            noise = np.random.default_rng((self.drawn.seed, round(time_s * 1e6), VIEWS.index(view), 28))
            return self.drawn.sensor.picture(np.float32(self.exposure_at(time_s)) * radiance, noise)

        eye = draw(None if view == "third" else self.lens, picture)
        inside = self.inside
        return eye if inside is None else replace(eye, depth=np.where(inside, eye.depth, 0), tool=eye.tool & inside)

    @cached_property
    def inside(self) -> NDArray[np.bool_] | None:
        """Pixels inside of the field of view, bool [H, W]; None if all are."""
        if self.drawn is None or self.drawn.sensor.field.kind == "full":
            return None
        inside = self.drawn.sensor.field.mask(self.camera.width_px, self.camera.height_px)
        return None if inside.all() else inside

    def exposure_at(self, time_s: float) -> float:
        """Return the exposure factor at a time."""
        if self.drawn is None:
            return 1.0 if self.air is None else self.air.exposure_at(time_s)
        exposure = self.drawn.sensor.exposure
        if exposure.kind == "drift":
            waves = zip(exposure.stops, exposure.periods_s, strict=True)
            return float(2 ** sum(stops * np.sin(2 * np.pi * time_s / period) for stops, period in waves))
        if exposure.kind == "automatic":
            before_s = max(0.0, time_s - exposure.delay_s)
            return float((self._distance(before_s) / self._distance(0.0)) ** (2 * exposure.gain))
        return 1.0

    def _distance(self, time_s: float) -> float:
        """Return the distance in mm between the scope and the tissue that it looked at in the beginning."""
        if self.drawn is not None and self.drawn.scene != "open":
            return self.tissue.looked_at_mm - float(self.camera_at(time_s).position[2])
        at = self.tissue.position((0.0, 0.0), time_s, NO_TUG)
        return float(np.linalg.norm(at - self.camera_at(time_s).position))

    def tug(self, time_s: float) -> Tug:
        """Return the tool's pull on the tissue at a time; `NO_TUG` without tools."""
        return self.motion.tug(time_s) if self.tissue.tools else NO_TUG

    def tools(self, time_s: float) -> list[tuple[list[Part], ToolAppearance]]:
        """Return the capsules and the appearance of each tool at a time; empty in scenes without a tool."""
        if not self.tissue.tools:
            return []
        tug = self.tug(time_s)
        return [
            (motion.parts(self.tissue, time_s, tug), motion.plan.appearance) for motion in (self.motion, *self.others)
        ]

    def track(self, time_s: float) -> NDArray[np.float32]:
        """Return the positions in the world, [63, 3] in mm, of a grid of tissue points at a time."""
        u, v = np.meshgrid(np.linspace(-32, 32, 9, dtype=np.float32), np.linspace(-24, 24, 7, dtype=np.float32))
        if (
            self.drawn is not None and self.drawn.scene == "open"
        ):  # scaled so that the grid covers the same part of the picture for every focal length
            share = self.tissue.focal_factor / self.drawn.focal * self.drawn.shape.distance_mm / TISSUE_DISTANCE_MM
            u, v = np.float32(share) * u, np.float32(share) * v
        points = self.tissue.points(u.ravel(), v.ravel(), time_s, self.tug(time_s))
        return np.stack(points.position, axis=1)
