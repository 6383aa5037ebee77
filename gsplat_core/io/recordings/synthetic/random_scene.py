"""Random scenes: every property of tissue, scope, tools, camera and air drawn from a seed.

Each group of properties has its own generator, so a fixed property does not change the others.

A moving scope sways as usual, or follows a drawn path of several kinds.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.synthetic.optics import Exposure, Field, LampPlan, Sensor
from gsplat_core.io.recordings.synthetic.tissue import (
    PULSE_PERIOD_S,
    TISSUE_DISTANCE_MM,
    Breathing,
    Colour,
    TissueAppearance,
    TissueShape,
)
from gsplat_core.io.recordings.synthetic.tool import Kind, ToolAppearance, ToolPlan

PathKind = Literal["hand-held", "translation", "rotation", "insertion"]
PATH_KINDS: tuple[PathKind, ...] = get_args(PathKind)
Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Sway:
    """Trajectory of a moving scope: a sine along each axis and a sinusoidal roll, all 0 at time 0."""

    periods_s: tuple[float, float, float, float] = (4.1, 5.3, 6.7, 4.7)
    """Periods in seconds of the motion along x, y and z, and of the roll."""
    reaches: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factors on the usual amplitudes along x, y and z, and of the roll."""
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
        """Return the scope's centre [3] in mm and roll in radians at a time; `sway_mm`: usual amplitudes along x, y and z."""
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
class ScopePath:
    """Drawn trajectory: slow motion along and around the three axes with a tremor, all 0 at time 0.

    Six values belong to the translation along x, y and z, and to pan, tilt and roll.
    """

    kind: PathKind
    amplitudes: Six
    """Amplitudes of the slow motion, in mm and radians."""
    periods_s: Six
    phases: Six
    followed: float
    """Share of the translation's effect on the view that the scope's orientation compensates."""
    looked_at_mm: float
    """Distance in mm of the point that the scope's orientation keeps in view while it translates."""
    tremor: Six
    """Amplitudes of the tremor, in mm and radians."""
    tremor_hz: Six
    tremor_phases: Six

    @classmethod
    def drawn(cls, rng: np.random.Generator, kind: PathKind, distance_mm: float) -> ScopePath:
        """Draw a path of a kind in front of tissue at a distance in mm."""
        scale = rng.uniform(0.6, 1.4, 6)
        phases, periods = rng.uniform(0, 2 * np.pi, 6), rng.uniform(4, 10, 6)
        followed = float(rng.uniform(0, 1))
        shares = np.array([0.10, 0.08, 0.08, 0.05, 0.05, 0.08])
        if kind == "translation":
            along = rng.uniform(0, 2 * np.pi)
            shares = np.array([0.28 * np.cos(along), 0.28 * np.sin(along), 0.02, 0.01, 0.01, 0.02])
            periods[:2] = rng.uniform(9, 18)
            phases[:2] = rng.uniform(-0.5, 0.5)
            scale[:2] = scale[0]
            followed *= 0.5
        elif kind == "rotation":
            shares, periods = np.array([0.04, 0.04, 0.03, 0.14, 0.12, 0.40]), rng.uniform(6, 14, 6)
        elif kind == "insertion":
            shares = np.array([0.04, 0.04, 0.20, 0.03, 0.03, 0.06])
            periods[2], phases[2] = rng.uniform(8, 16), -np.pi / 2
        amplitudes = shares * scale * np.array([distance_mm] * 3 + [1.0] * 3)
        tremor = rng.uniform(0, 1) ** 2 * rng.uniform(0.3, 1, 6) * np.array([0.15] * 3 + [0.002] * 3)
        return cls(
            kind, _six(amplitudes), _six(periods), _six(phases), followed, distance_mm,
            _six(tremor), _six(rng.uniform(3, 9, 6)), _six(rng.uniform(0, 2 * np.pi, 6)),
        )  # fmt: skip

    def pose(self, time_s: float) -> NDArray[np.float64]:
        """Return the world-to-camera transform [4, 4] at a time; identity at time 0."""
        slow = np.array(self.amplitudes) * _wave(time_s / np.array(self.periods_s), np.array(self.phases))
        fast = np.array(self.tremor) * _wave(time_s * np.array(self.tremor_hz), np.array(self.tremor_phases))
        at = slow + fast
        centre, (pan, tilt, roll) = at[:3], at[3:]
        towards = np.array([0, 0, self.looked_at_mm]) - self.followed * np.array([centre[0], centre[1], 0])
        sin, cos = np.sin, np.cos
        turned = np.array([[cos(pan), 0, -sin(pan)], [0, 1, 0], [sin(pan), 0, cos(pan)]])
        tilted = np.array([[1, 0, 0], [0, cos(tilt), -sin(tilt)], [0, sin(tilt), cos(tilt)]])
        return rigid(tilted @ turned @ looking(towards, float(roll)), centre)


def _six(values: NDArray[np.float64]) -> Six:
    x, y, z, pan, tilt, roll = (float(each) for each in values)
    return x, y, z, pan, tilt, roll


def _wave(turns: NDArray[np.float64], phases: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sin(2 * np.pi * turns + phases) - np.sin(phases))


def looking(towards: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """Return the rotation of a camera looking in a direction; its rows are the camera's axes."""
    forward = towards / np.linalg.norm(towards)
    right = np.cross([-np.sin(roll), np.cos(roll), 0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def rigid(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the world-to-camera transform [4, 4] of a camera with a rotation and a centre."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose


Random = np.random.Generator

ORGANS: dict[str, tuple[Colour, Colour, Colour, Colour, float, float]] = {
    "uterus": ((0.62, 0.175, 0.115), (0.76, 0.315, 0.215), (0.40, 0.072, 0.055), (0.86, 0.42, 0.15), 0.9, 1.0),
    "liver": ((0.30, 0.070, 0.045), (0.40, 0.115, 0.070), (0.17, 0.032, 0.026), (0.70, 0.36, 0.14), 1.6, 0.5),
    "bowel": ((0.66, 0.300, 0.220), (0.78, 0.440, 0.330), (0.48, 0.150, 0.110), (0.84, 0.50, 0.20), 0.8, 1.2),
    "gallbladder": ((0.46, 0.330, 0.170), (0.60, 0.480, 0.260), (0.30, 0.200, 0.090), (0.82, 0.55, 0.20), 0.6, 0.8),
    "stomach": ((0.70, 0.290, 0.200), (0.80, 0.420, 0.310), (0.52, 0.160, 0.110), (0.85, 0.46, 0.17), 1.3, 0.7),
    "pale": ((0.78, 0.660, 0.500), (0.86, 0.760, 0.610), (0.66, 0.480, 0.330), (0.86, 0.72, 0.45), 1.2, 1.0),
    "yellow": ((0.78, 0.500, 0.150), (0.85, 0.600, 0.230), (0.64, 0.360, 0.100), (0.90, 0.62, 0.16), 0.2, 0.8),
    "dark": ((0.115, 0.034, 0.030), (0.180, 0.060, 0.045), (0.062, 0.016, 0.016), (0.45, 0.22, 0.09), 1.4, 0.5),
}
"""Linear RGB of base, pale, deep and fat areas, level from which there is fat, and strength of vessels."""
FOCAL_RANGE = (0.5, 1.2)
"""Range of the focal length divided by the longer side of the picture."""
STEEPEST = 0.75
"""Largest product of the tissue's slope and the tangent of the corner's viewing angle, so that nothing hides behind a hill."""
USUAL_SLOPE = 0.33
"""Twice the root-mean-square slope (height per length, along one direction) of the hills of tissue of relief 1."""


@dataclass(frozen=True)
class RandomScene:
    """Properties of a scene that are drawn from a seed."""

    seed: int
    scene: str
    moving: bool
    stereo: bool
    organ: str
    focal: float
    """Focal length divided by the longer side of the picture."""
    lens: tuple[float, float]
    """Displacements of the picture's corners by the distortion terms k1 and k2, as shares of their distance from the centre."""
    baseline_mm: float
    shape: TissueShape
    appearance: TissueAppearance
    breathing: Breathing
    path: ScopePath | None
    """Path of a moving scope; None for the paths of `Extras.scope_path`."""
    tools: tuple[ToolPlan, ...]
    lamp: LampPlan
    exposed_mm: float
    """Distance from the lamp in mm at which a white surface facing the scope has radiance 1; sets the exposure."""
    sensor: Sensor
    smoke: float
    particles: int
    particle_mm: float
    """Median radius of the particles in mm."""

    def described(self) -> dict[str, Any]:
        """Return all properties for `recording.json`."""
        return asdict(self)


def draw_scene(
    seed: int,
    *,
    scene: str = "open",
    moving: bool | None = None,
    stereo: bool | None = None,
    distorted: bool | None = None,
    smoke: float | None = None,
    exposure: bool | None = None,
    breathing_ratio: float | None = None,
    rate_wander: float | None = None,
    scope_path: str | None = None,
) -> RandomScene:
    """Draw the properties of a scene; arguments other than None fix a property.

    Args:
        seed: seed of all properties.
        scene: `open` or `colon`.
        moving: motion of the scope.
        stereo: second eye. A stereo scope has no distortion, because its pictures are rectified.
        distorted: lens distortion of a scope with one eye.
        smoke: strength of the smoke.
        exposure: changes of the exposure.
        breathing_ratio: expiration to inspiration ratio.
        rate_wander: largest relative deviation of the breathing rate.
        scope_path: kind of path, or `usual` or `seeded` as in `Extras.scope_path`.

    Raises:
        InvalidSetting: for an unknown kind of path.
    """
    if scope_path not in (None, "usual", "seeded", *PATH_KINDS):
        raise InvalidSetting(f"scope_path must be usual, seeded or one of {', '.join(PATH_KINDS)}, got {scope_path!r}")
    rngs = [np.random.default_rng(child) for child in np.random.SeedSequence((seed, 26)).spawn(10)]
    camera, form, colours, breath, way, tool, light, chip, air, general = rngs
    moves, two, bent = bool(general.random() < 0.6), bool(general.random() < 0.5), bool(general.random() < 0.6)
    moves, two = moves if moving is None else moving, two if stereo is None else stereo
    bent = (bent if distorted is None else distorted) and not two
    focal = float(camera.uniform(*FOCAL_RANGE))
    lens = float(camera.uniform(-0.14, 0.05)), float(camera.uniform(-0.02, 0.02))
    baseline_mm = float(camera.uniform(3.8, 5.6))
    distance_mm = float(np.exp(form.uniform(np.log(32), np.log(110)))) if scene == "open" else TISSUE_DISTANCE_MM
    organ = str(colours.choice(list(ORGANS)))
    appearance = _appearance(colours, organ, distance_mm)
    path = None
    kinds = PATH_KINDS if scene == "open" else tuple(kind for kind in PATH_KINDS if kind != "translation")
    kind = kinds[int(way.integers(len(kinds)))] if scope_path in (None, "usual", "seeded") else scope_path
    if moves and scope_path not in ("usual", "seeded"):
        path = ScopePath.drawn(way, kind, distance_mm if scene == "open" else 40.0)  # type: ignore[arg-type]
    sensor, bright = _sensor(chip, moves, exposure)
    grey = float(np.mean(np.array(appearance.base) * [0.35, 0.5, 0.15]) * 3)
    exposed_mm = (1.0 if scene == "open" else 42.0 / TISSUE_DISTANCE_MM) * distance_mm * float(
        np.sqrt(bright * (0.30 / grey) ** 0.75)
    ) * 0.9  # fmt: skip
    offset = light.uniform(2.2, 4.5)
    turn = light.uniform(0, np.pi)
    x, y, lift = offset * np.cos(turn), offset * np.sin(turn), light.uniform(-2.5, 0.0)
    lamp = LampPlan(((-x, lift - y, 0.0), (x, lift + y, 0.0)), float(light.uniform(0.8, 4.0)))
    strength = float(air.uniform(0.1, 0.8)) if air.random() < 0.3 else 0.0
    count = int(air.integers(8, 60)) if air.random() < 0.35 else 0
    return RandomScene(
        seed=seed,
        scene=scene,
        moving=moves,
        stereo=two,
        organ=organ,
        focal=focal,
        lens=lens if bent else (0.0, 0.0),
        baseline_mm=baseline_mm,
        shape=_shape(form, distance_mm, focal),
        appearance=appearance,
        breathing=_breathing(breath, breathing_ratio, rate_wander),
        path=path,
        tools=_tools(tool, distance_mm) if scene == "open" else (),
        lamp=lamp,
        exposed_mm=exposed_mm,
        sensor=sensor,
        smoke=strength if smoke is None else smoke,
        particles=count,
        particle_mm=float(air.uniform(0.05, 0.2)) * distance_mm / TISSUE_DISTANCE_MM,
    )


def _colour(values: NDArray[np.float64]) -> Colour:
    red, green, blue = (float(each) for each in values)
    return red, green, blue


def _appearance(rng: Random, organ: str, distance_mm: float) -> TissueAppearance:
    """Draw colours near those of an organ, texture, roughness and highlight lobes."""
    tint = np.exp(rng.normal(0, 0.10, 3) + rng.normal(0, 0.12))
    coloured = lambda colour: _colour(np.clip(np.array(colour) * tint, 0.008, 0.93))
    base, pale, deep, fat, fat_from, vessels = ORGANS[organ]
    gloss = float(np.sqrt(np.mean(base) / 0.30))  # pictures of dark tissue are exposed longer
    return TissueAppearance(
        base=coloured(base),
        pale=coloured(pale),
        deep=coloured(deep),
        fat=coloured(fat),
        mottling=float(rng.uniform(0.4, 1.3)),
        fat_from=fat_from + float(rng.uniform(-0.3, 0.6)),
        veins=int(rng.integers(2, 10)),
        arteries=int(rng.integers(3, 20)),
        vessel_strength=vessels * float(rng.uniform(0.3, 1.0)) / 1.2,
        grain=float(rng.uniform(0.03, 0.14)),
        creases=float(rng.uniform(0.05, 0.35)),
        roughness=float(rng.uniform(0.4, 1.4)),
        wetness=float(rng.uniform(0.0, 0.4)),
        glint=gloss * float(rng.uniform(1.0, 10.0)),
        glint_power=float(np.exp(rng.uniform(np.log(120), np.log(1500)))),
        sheen=gloss * float(rng.uniform(0.02, 0.30)),
        sheen_power=float(rng.uniform(12, 60)),
        bleed=_colour(rng.uniform(0.2, 1.2) * np.array([0.060, 0.014, 0.010]) * tint),
        zoom=distance_mm / TISSUE_DISTANCE_MM * float(rng.uniform(0.55, 1.2)),
    )  # fmt: skip


def _shape(rng: Random, distance_mm: float, focal: float) -> TissueShape:
    """Draw the shape and the motion of the tissue. A wide view gets flatter hills."""
    corner = float(np.hypot(0.5, 0.4)) / focal
    relief = float(rng.uniform(0.3, 1.3))
    size = distance_mm / TISSUE_DISTANCE_MM
    return TissueShape(
        distance_mm=distance_mm,
        relief=min(relief, STEEPEST / corner / USUAL_SLOPE),
        width=size * float(rng.uniform(0.8, 1.5)),
        bowl=float(rng.uniform(0.0, 1.3)) / size,
        tilt=float(rng.uniform(0.05, 0.25)),
        breath=float(rng.uniform(0.1, 1.3)) * min(1.0, size),
        pulse=float(rng.uniform(0.0, 1.6)) * min(1.0, size),
        pulse_period_s=PULSE_PERIOD_S * float(rng.uniform(0.7, 1.3)),
    )


def _breathing(rng: Random, ratio: float | None, wander: float | None) -> Breathing:
    start, first, second = (float(each) for each in rng.uniform(0, 2 * np.pi, 3))
    drawn_ratio, drawn_wander = float(rng.uniform(1, 3)), float(rng.uniform(0, 0.2))
    pause = float(rng.uniform(0.05, 0.3)) if rng.random() < 0.5 else 0.0
    return Breathing(
        start=start,
        ratio=drawn_ratio if ratio is None else ratio,
        wander=drawn_wander if wander is None else wander,
        wander_phases=(first, second),
        period_s=float(rng.uniform(2.6, 5.5)),
        pause=pause,
    )


SHAFTS: tuple[tuple[Colour, bool], ...] = (
    ((0.085, 0.093, 0.108), False),
    ((0.020, 0.021, 0.023), False),
    ((0.30, 0.31, 0.33), True),
    ((0.70, 0.70, 0.67), False),
    ((0.35, 0.36, 0.37), False),
    ((0.04, 0.10, 0.30), False),
)
"""Linear RGB of shafts (black, grey, steel, white, blue), and True for polished ones."""


def _tools(rng: Random, distance_mm: float) -> tuple[ToolPlan, ...]:
    """Draw up to three tools; only the first one may pull the tissue."""
    count = int(rng.choice([0, 1, 2, 3], p=[0.15, 0.45, 0.3, 0.1]))
    size = distance_mm / TISSUE_DISTANCE_MM
    first = rng.uniform(0, 2 * np.pi)
    plans = []
    for number in range(count):
        angle = first + number * 2 * np.pi / max(count, 2) + rng.uniform(-0.5, 0.5)
        reach, depth_mm = rng.uniform(55, 85) * size, rng.uniform(-5, 25) * size
        kind: Kind = ("grasper", "scissors", "hook", "suction")[int(rng.choice(4, p=[0.5, 0.2, 0.15, 0.15]))]
        shaft, metal = SHAFTS[int(rng.integers(len(SHAFTS)))]
        grey = float(rng.uniform(0.14, 0.38))
        appearance = ToolAppearance(
            shaft=shaft,
            ring=_colour(0.3 * np.array(shaft) + 0.06),
            steel=(grey, 1.01 * grey, 1.06 * grey),
            gloss=float(rng.uniform(20, 110)),
            glint=float(rng.uniform(0.8, 4.0)),
            metal_shaft=metal,
        )
        touches = number == 0 and rng.random() < 0.7
        radius_mm = float(rng.uniform(7, 13)) * min(1.0, size)
        plans.append(
            ToolPlan(
                kind=kind,
                scale=float(rng.uniform(0.55, 1.15)) * float(np.sqrt(min(1.0, size))),
                port_mm=(float(reach * np.cos(angle)), float(reach * np.sin(angle)), float(depth_mm)),
                cycle_s=float(rng.uniform(1.6, 5.0)),
                hover_mm=float(rng.uniform(6, 18)) * size,
                reach_mm=float(rng.uniform(6, 16)) * size,
                centre_mm=(float(9 * size * np.cos(angle)), float(9 * size * np.sin(angle))),
                pull=float(rng.uniform(0.3, 1.0)) * radius_mm / 12.0 if touches else 0.0,
                tug_radius_mm=radius_mm,
                appearance=appearance,
            )
        )
    return tuple(plans)


def _sensor(rng: Random, moving: bool, exposure: bool | None) -> tuple[Sensor, float]:
    """Draw the camera, and the brightness of its pictures relative to the usual one."""
    shape: Literal["full", "circle", "octagon"] = ("full", "circle", "octagon")[int(rng.choice(3, p=[0.6, 0.25, 0.15]))]
    field = Field(
        shape,
        float(rng.uniform(0.40, 0.54)),
        (float(rng.uniform(0.47, 0.53)), float(rng.uniform(0.47, 0.53))),
    )
    kind = int(rng.choice(3, p=[0.3, 0.35, 0.35])) if exposure is None else (int(rng.choice([1, 2])) if exposure else 0)
    changes = Exposure(
        kind=("constant", "drift", "automatic")[kind],
        stops=(float(rng.uniform(0.05, 0.35)), float(rng.uniform(0.0, 0.15))),
        periods_s=(float(rng.uniform(2, 8)), float(rng.uniform(1, 3))),
        gain=float(rng.uniform(0.4, 1.0)) if moving else float(rng.uniform(0.2, 0.8)),
        delay_s=float(rng.uniform(0.1, 0.8)),
    )
    noise = float(rng.uniform(0, 1)) ** 1.5
    sensor = Sensor(
        field=field,
        exposure=changes,
        white=(float(rng.uniform(0.88, 1.12)), 1.0, float(rng.uniform(0.8, 1.25))),
        contrast=float(rng.uniform(1.1, 1.9)),
        blur_px=float(rng.uniform(0.3, 0.9)),
        shot_noise=0.03 * noise,
        read_noise=0.004 * noise,
        sharpening=float(rng.uniform(0.2, 0.8)) if rng.random() < 0.5 else 0.0,
        quality=int(rng.integers(55, 97)) if rng.random() < 0.75 else None,
    )
    return sensor, float(2 ** rng.uniform(-0.5, 0.5))
