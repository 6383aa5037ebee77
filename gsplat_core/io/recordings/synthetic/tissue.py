"""Deforming tissue: a smooth sheet of material points (u, v) with motion, breathing and colour, and a tube of it.

The texture has multi-octave noise, islands of fat, branching vessels, fine relief and wetness. It is sampled at (u, v),
the point's position on the undeformed sheet in millimetres. It therefore moves with the tissue, and finer texels show
equal tissue in more detail. Times are in seconds. World axes are those of the camera at rest (x right, y down, z away).

`Colon` is a folded tube viewed along its axis, bright nearby, dark at the closed end. At rest its wall is an ellipsoid of
revolution around the origin with rings of folds; z is its long axis. The material point (u, v) is on the ray
(u, v, COLON_TEXTURE_MM) from the origin, so the wall has no seam and no pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.calibration import DEFAULT_FOCAL_FACTOR
from gsplat_core.io.recordings.synthetic.optics import REFERENCE_MM

PERIOD_S = 3.4
"""Mean period of a breath, in seconds."""
WANDER_PERIODS_S = (6.1, 9.7)
"""Periods in seconds of the two waves that modulate the breathing rate: about two and three breaths."""


@dataclass(frozen=True)
class Breathing:
    """Phase of breathing over time. Its sine has the minimum at -pi/2 and the maximum at pi/2."""

    start: float
    """Phase of breathing at time 0 in radians, before the asymmetry is applied."""
    ratio: float = 1.0
    """Duration of expiration (falling sine) divided by that of inspiration (rising sine)."""
    wander: float = 0.0
    """Largest relative deviation of the breathing rate from its mean."""
    wander_phases: tuple[float, float] = (0.0, 0.0)
    period_s: float = PERIOD_S
    """Mean period of a breath, in seconds."""
    pause: float = 0.0
    """Share of each breath without motion, after expiration."""

    def phase(self, time_s: float) -> float:
        """Return the phase at `time_s` in radians; continuous and increasing."""
        uniform = 2 * np.pi * time_s / self.period_s + self.start
        if self.wander:
            uniform += 2 * np.pi / self.period_s * self.wander * self._ahead_s(time_s)
        if self.pause:
            uniform = paused(float(uniform), self.pause)
        return float(uniform) if self.ratio == 1 else unequal(float(uniform), self.ratio)

    def _ahead_s(self, time_s: float) -> float:
        """Return the lead of breathing in seconds over one of constant rate, per unit of `wander`: the integral over time of a rate
        deviation between -1 and 1."""
        waves = (
            period / (2 * np.pi) * (np.sin(2 * np.pi * time_s / period + phase) - np.sin(phase))
            for period, phase in zip(WANDER_PERIODS_S, self.wander_phases, strict=True)
        )
        return float(sum(waves)) / len(WANDER_PERIODS_S)


def paused(phase: float, share: float) -> float:
    """Map a uniform phase to one that rests at the minimum of the sine for a share of each turn.

    Motion starts and ends smoothly if the rest is at least `SMOOTH_PAUSE` of the turn.
    """
    turns, at = divmod((phase + np.pi / 2) / (2 * np.pi), 1.0)
    at = min(at / (1 - share), 1.0)
    at -= min(share / SMOOTH_PAUSE, 1.0) * np.sin(2 * np.pi * at) / (2 * np.pi)
    return float(2 * np.pi * (turns + at) - np.pi / 2)


SMOOTH_PAUSE = 0.15


def unequal(phase: float, ratio: float) -> float:
    """Map a uniform phase to one whose sine falls `ratio` times as long as it rises.

    The map is smooth and preserves multiples of pi: tan(after / 2) = k tan(before / 2). The rising
    half takes 4 atan(1 / k) of a turn of 2 pi.
    """
    k = 1 / np.tan(np.pi / 2 / (1 + ratio))
    turns = round(phase / (2 * np.pi))
    half = phase / 2 - np.pi * turns
    return float(2 * np.pi * turns + 2 * np.arctan2(k * np.sin(half), np.cos(half)))


Array = NDArray[np.floating]

HALF_EXTENT_MM = 84.0
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class TissueAppearance:
    """Colours, texture and gloss of a tissue. Colours are linear RGB reflectances."""

    base: Colour = (0.62, 0.175, 0.115)
    pale: Colour = (0.76, 0.315, 0.215)
    deep: Colour = (0.40, 0.072, 0.055)
    fat: Colour = (0.86, 0.420, 0.150)
    vein: Colour = (0.130, 0.022, 0.040)
    artery: Colour = (0.300, 0.014, 0.012)
    mottling: float = 1.0
    """Factor on the amplitude of the large light and dark areas."""
    fat_from: float = 0.75
    """Level of normally distributed noise above which the tissue is fat; larger values give less fat."""
    veins: int = 7
    arteries: int = 16
    vessel_strength: float = 1.0
    grain: float = 0.10
    """Standard deviation of the fine texture, relative to the colour."""
    creases: float = 0.20
    """Share by which the colour is darkened at the bottom of the tissue's creases."""
    roughness: float = 1.0
    """Factor on the slopes of the tissue's fine relief."""
    wetness: float = 0.12
    """Wetness of the driest tissue, 0 to 1; wet tissue has highlights."""
    glint: float = 9.0
    """Strength of the narrow highlight lobe."""
    glint_power: float = 900.0
    """Exponent of the narrow highlight lobe."""
    sheen: float = 0.20
    """Strength of the broad highlight lobe."""
    sheen_power: float = 40.0
    """Exponent of the broad highlight lobe."""
    bleed: Colour = (0.060, 0.014, 0.010)
    """Colour of the light that scatters inside the tissue."""
    zoom: float = 1.0
    """Size of the tissue's texture relative to its usual size."""


USUAL_APPEARANCE = TissueAppearance()


class TissueTexture:
    """Texture maps of reflectance, wetness and the slopes of the fine relief over the undeformed sheet."""

    def __init__(
        self, rng: np.random.Generator, texel_mm: float, appearance: TissueAppearance = USUAL_APPEARANCE
    ) -> None:
        base, pale, deep, fat_colour, vein, artery = (
            np.array(colour, np.float32)
            for colour in (
                appearance.base,
                appearance.pale,
                appearance.deep,
                appearance.fat,
                appearance.vein,
                appearance.artery,
            )
        )
        self._per_mm = np.float32(1 / appearance.zoom)
        self.size = 2 * int(np.ceil(HALF_EXTENT_MM / texel_mm))
        self.texel_mm = 2 * HALF_EXTENT_MM / self.size
        cloud = self._noise(rng, (46.0, 21.0, 9.0, 4.2, 2.0, 0.9), 0.62)
        grain = self._noise(rng, (3.4, 1.7, 0.85, 0.45), 0.75)
        fat_cloud = self._noise(rng, (38.0, 17.0, 7.0, 3.0), 0.5)
        folds = 1 - np.abs(self._noise(rng, (23.0, 11.0), 0.45))  # ridged: long soft creases
        lobules = np.abs(self._noise(rng, (4.6, 2.3), 0.5))

        mottled = np.float32(appearance.mottling) * cloud
        colour = _mix(base, pale, _smoothstep(0.1, 1.3, mottled))
        colour = _mix(colour, deep, _smoothstep(0.0, 1.5, -mottled))
        fat = _smoothstep(appearance.fat_from, appearance.fat_from + 0.5, fat_cloud)
        colour = _mix(colour, fat_colour * (0.86 + 0.14 * _smoothstep(0.0, 0.5, lobules))[..., None], 0.85 * fat)
        crease = _smoothstep(0.72, 1.0, folds) * (1 - fat)
        colour *= (1 - appearance.creases * crease)[..., None]
        veins, vein_relief = self._vessels(rng, count=appearance.veins, width_mm=2.1, blur_mm=0.42)
        arteries, artery_relief = self._vessels(rng, count=appearance.arteries, width_mm=0.85, blur_mm=0.12)
        colour = _mix(colour, vein, appearance.vessel_strength * 0.66 * veins * (1 - 0.5 * fat))
        colour = _mix(colour, artery, appearance.vessel_strength * 0.80 * arteries)
        colour *= (1 + appearance.grain * grain)[..., None]

        relief_mm = 0.040 * grain + 0.22 * cloud - 0.20 * crease + 0.34 * fat * lobules + 0.25 * fat
        relief_mm += 0.30 * vein_relief + 0.14 * artery_relief
        relief_mm = cv2.GaussianBlur(relief_mm.astype(np.float32), (0, 0), 0.22 / self.texel_mm)
        wetness = appearance.wetness + (1 - appearance.wetness) * _smoothstep(
            -0.3, 1.2, self._noise(rng, (16.0, 6.0, 2.5), 0.6)
        )
        self.reflectance = np.ascontiguousarray(np.clip(np.dstack([colour, wetness]), 0.004, 0.95), np.float32)
        """Linear RGB reflectance and wetness of each texel, [S, S, 4]."""
        relief_mm *= np.float32(appearance.roughness)
        slope_v, slope_u = np.gradient(relief_mm, np.float32(self.texel_mm))
        self.slope = np.ascontiguousarray(np.dstack([slope_u, slope_v]), np.float32)
        """Derivatives of the fine relief by u and v at each texel, [S, S, 2]."""

    def sample(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return reflectance and wetness [H, W, 4] and relief slopes [H, W, 2] of material points [H, W]."""
        column = (u * self._per_mm + np.float32(HALF_EXTENT_MM)) / np.float32(self.texel_mm) - np.float32(0.5)
        row = (v * self._per_mm + np.float32(HALF_EXTENT_MM)) / np.float32(self.texel_mm) - np.float32(0.5)
        reflectance = cv2.remap(self.reflectance, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        slope = cv2.remap(self.slope, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(reflectance, np.float32), np.asarray(slope, np.float32)

    def _noise(self, rng: np.random.Generator, cells_mm: tuple[float, ...], gain: float) -> Array:
        """Sum value noises of the cell sizes, each weaker by `gain`; mean 0, standard deviation about 1."""
        total = np.zeros((self.size, self.size), np.float32)
        power, weight = 0.0, 1.0
        for cell_mm in cells_mm:
            count = int(np.ceil(2 * HALF_EXTENT_MM / cell_mm)) + 3
            grid = rng.standard_normal((count, count), dtype=np.float32)
            # The grid's node (1, 1) coincides with the sheet's corner for every texel size.
            scale, shift = self.texel_mm / cell_mm, 1 + 0.5 * self.texel_mm / cell_mm
            affine = np.array([[scale, 0, shift], [0, scale, shift]])
            total += np.float32(weight) * cv2.warpAffine(
                grid, affine, (self.size, self.size), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            )
            power += 0.5 * weight**2  # interpolation halves the variance, roughly
            weight *= gain
        return total / np.float32(np.sqrt(power))

    def _vessels(self, rng: np.random.Generator, count: int, width_mm: float, blur_mm: float) -> tuple[Array, Array]:
        """Draw branching vessel trees; return their cover 0..1 and a raised relief."""
        canvas = np.zeros((self.size, self.size), np.uint8)
        stack = []
        for _ in range(count):
            x, y = (float(at) for at in rng.uniform(-HALF_EXTENT_MM, HALF_EXTENT_MM, 2))
            stack.append((x, y, rng.uniform(0, 2 * np.pi), width_mm * rng.uniform(0.6, 1.0), 0))
        pixel = lambda at_mm: round((at_mm + HALF_EXTENT_MM) / self.texel_mm * 16)  # sixteenths, for `cv2.line`
        while stack:
            x, y, heading, width, depth = stack.pop()
            bend = rng.normal(0, 0.02)
            for _ in range(int(rng.uniform(16, 40))):
                bend = 0.9 * bend + rng.normal(0, 0.045)
                heading += bend
                start = pixel(x), pixel(y)
                x, y = x + 1.3 * float(np.cos(heading)), y + 1.3 * float(np.sin(heading))
                thickness = max(1, round(width / self.texel_mm))
                cv2.line(canvas, start, (pixel(x), pixel(y)), 255, thickness, cv2.LINE_AA, shift=4)
                width *= 0.988
            if depth < 4 and width > 0.2:
                for side in (-1, 1):
                    if rng.random() < 0.88:
                        stack.append(
                            (x, y, heading + side * rng.uniform(0.25, 0.8), width * rng.uniform(0.55, 0.85), depth + 1)
                        )
        cover = canvas.astype(np.float32) / 255
        soft = cv2.GaussianBlur(cover, (0, 0), blur_mm / self.texel_mm)
        raised = cv2.GaussianBlur(cover, (0, 0), (blur_mm + 0.3) / self.texel_mm)
        return np.asarray(soft, np.float32), np.asarray(raised, np.float32)


def _smoothstep(low: float, high: float, value: Array) -> Array:
    x = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(x * x * (3 - 2 * x), np.float32)


def _mix(a: Array, b: Array, weight: Array) -> Array:
    weight = weight[..., None]
    return np.asarray(a * (1 - weight) + b * weight, np.float32)


TISSUE_DISTANCE_MM = 74.0
PULSE_PERIOD_S = 0.9
TUG_RADIUS_MM = 12.0


@dataclass(frozen=True)
class TissueShape:
    """Shape of a sheet of tissue at rest, and amplitudes of its motion."""

    distance_mm: float = TISSUE_DISTANCE_MM
    """Mean distance from a scope at rest, in mm."""
    relief: float = 1.0
    """Factor on the slopes of the hills."""
    width: float = 1.0
    """Factor on the wavelengths of the hills."""
    bowl: float = 1.0
    """Factor on the curvature of the sheet towards the scope."""
    tilt: float = 0.10
    """Largest slope (height per length) of the whole sheet along u and v, without hills and bowl. Each slope is drawn at random
    from -tilt to tilt.
    """
    breath: float = 1.0
    """Factor on the amplitude of breathing."""
    pulse: float = 1.0
    """Factor on the amplitude of the pulse."""
    pulse_period_s: float = PULSE_PERIOD_S


USUAL_SHAPE = TissueShape()


@dataclass(frozen=True)
class Tug:
    """Local displacement by a tool: `pull` at the material point `grasp` with a Gaussian falloff."""

    grasp: tuple[float, float]
    pull: tuple[float, float, float]
    radius_mm: float = TUG_RADIUS_MM


NO_TUG = Tug((0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class SurfacePoints:
    """Positions and tangents of material points: each a tuple of x, y and z arrays."""

    position: tuple[Array, Array, Array]
    along_u: tuple[Array, Array, Array]
    along_v: tuple[Array, Array, Array]


class Tissue:
    """One patient's sheet of tissue at the bottom of an open cavity: shape, breathing, pulse, colour.

    Deterministic for a given random generator. Subclasses override the shape at rest.
    """

    focal_factor = DEFAULT_FOCAL_FACTOR
    """Focal length of the scene's camera over the longer side of its pictures."""
    exposed_mm = REFERENCE_MM
    """Distance from the lamp in mm at which a white surface facing the scope has radiance 1; sets the exposure."""
    looked_at_mm = TISSUE_DISTANCE_MM
    """Distance in mm of the point that a moving scope keeps at the centre of its view."""
    sway_mm = (7.0, 4.5, 6.0)
    """Amplitudes in mm of a moving scope's sway along x, y and z."""
    tools = True
    """True if the scene contains a tool."""

    def __init__(
        self,
        rng: np.random.Generator,
        texel_mm: float,
        appearance: TissueAppearance = USUAL_APPEARANCE,
        shape: TissueShape = USUAL_SHAPE,
    ) -> None:
        self.appearance, self.shape = appearance, shape
        wavelengths = shape.width * np.array([74.0, 58.0, 43.0, 33.0, 26.0, 21.0])
        slopes = shape.relief * np.array([0.16, 0.17, 0.15, 0.14, 0.10, 0.07])
        angles = rng.uniform(0, 2 * np.pi) + np.arange(6) * 2.4 + rng.uniform(-0.4, 0.4, 6)
        wave_numbers = 2 * np.pi / wavelengths
        self._relief = [
            (float(k * np.cos(angle)), float(k * np.sin(angle)), float(phase), float(slope / k))
            for k, angle, phase, slope in zip(wave_numbers, angles, rng.uniform(0, 2 * np.pi, 6), slopes, strict=True)
        ]
        self._tilt = rng.uniform(-shape.tilt, shape.tilt, 2)
        self.breathing = Breathing(float(rng.uniform(0, 2 * np.pi)))
        """Phase of breathing over time, regular by default; replaced if a recording requests other breathing."""
        self._breath_angle = float(rng.uniform(0, 2 * np.pi))
        self.texture = TissueTexture(rng, texel_mm, appearance)

    def first_guess(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Return u and v [H, W] in mm at which Newton's method for the ray intersections starts.

        They are x and y of the points where the rays from `origin` [3] along `directions` [H, W, 3] meet the plane at the
        mean distance.
        """
        s = (np.float32(self.shape.distance_mm) - origin[2]) / directions[..., 2]
        return origin[0] + s * directions[..., 0], origin[1] + s * directions[..., 1]

    def _at_rest(self, u: Array, v: Array) -> SurfacePoints:
        """Return undeformed positions of the material points (u, v) and their derivatives by u and v."""
        one, zero = np.ones_like(u), np.zeros_like(u)
        bowl = np.float32(-0.0022 * self.shape.bowl)
        tilt_u, tilt_v = (np.float32(tilt) for tilt in self._tilt)
        z = np.float32(self.shape.distance_mm) + tilt_u * u + tilt_v * v + bowl * (u * u + v * v)
        z_u, z_v = tilt_u + 2 * bowl * u, tilt_v + 2 * bowl * v
        for k_u, k_v, phase, amplitude in self._relief:
            angle = np.float32(k_u) * u + np.float32(k_v) * v + np.float32(phase)
            z = z + np.float32(amplitude) * np.sin(angle)
            slope = np.float32(amplitude) * np.cos(angle)
            z_u, z_v = z_u + np.float32(k_u) * slope, z_v + np.float32(k_v) * slope
        return SurfacePoints((u, v, z), (one, zero, z_u), (zero, one, z_v))

    def points(self, u: Array, v: Array, time_s: float, tug: Tug) -> SurfacePoints:
        """Return positions of the material points (u, v) at a time and their derivatives by u and v."""
        rest = self._at_rest(u, v)
        (x, y, z), (x_u, y_u, z_u), (x_v, y_v, z_v) = rest.position, rest.along_u, rest.along_v

        # Breathing is a long wave that lifts and shears the sheet. The pulse is a short wave that runs across it.
        breath = self.breathing.phase(time_s)
        pulse = 2 * np.pi * time_s / self.shape.pulse_period_s
        direction = (np.cos(self._breath_angle), np.sin(self._breath_angle))
        waves = ((130.0, breath, 2.4, 1.6, self.shape.breath), (55.0, -pulse, 0.35, 0.25, self.shape.pulse))
        for wavelength_mm, phase, lift_mm, shear_mm, factor in waves:
            wave_u, wave_v = (np.float32(2 * np.pi / wavelength_mm * component) for component in direction)
            angle = wave_u * u + wave_v * v + np.float32(phase)
            sine, cosine = np.sin(angle), np.cos(angle)
            lift, shear = np.float32(factor * lift_mm), np.float32(factor * shear_mm)
            z, z_u, z_v = z + lift * sine, z_u + lift * wave_u * cosine, z_v + lift * wave_v * cosine
            for axis, component in enumerate(direction):
                part = shear * np.float32(component)
                if axis == 0:
                    x, x_u, x_v = x + part * cosine, x_u - part * wave_u * sine, x_v - part * wave_v * sine
                else:
                    y, y_u, y_v = y + part * cosine, y_u - part * wave_u * sine, y_v - part * wave_v * sine

        # Add the tool's pull with its Gaussian falloff around the grasp point.
        inverse = np.float32(1 / tug.radius_mm**2)
        d_u, d_v = u - np.float32(tug.grasp[0]), v - np.float32(tug.grasp[1])
        weight = np.exp(np.float32(-0.5) * inverse * (d_u * d_u + d_v * d_v))
        w_u, w_v = -inverse * d_u * weight, -inverse * d_v * weight
        p_x, p_y, p_z = (np.float32(component) for component in tug.pull)
        return SurfacePoints(
            (x + p_x * weight, y + p_y * weight, z + p_z * weight),
            (x_u + p_x * w_u, y_u + p_y * w_u, z_u + p_z * w_u),
            (x_v + p_x * w_v, y_v + p_y * w_v, z_v + p_z * w_v),
        )

    def position(self, point: tuple[float, float], time_s: float, tug: Tug) -> NDArray[np.float64]:
        """Return the position [3] in mm of one material point (u, v) at a time."""
        u, v = point
        points = self.points(np.array([u], np.float32), np.array([v], np.float32), time_s, tug)
        return np.array([float(component[0]) for component in points.position])


COLON_RADIUS_MM = 23.0
COLON_LENGTH_MM = 150.0
"""Distance in mm from the origin to the closed end of the tube."""
COLON_TEXTURE_MM = 72.0
"""Distance in mm at which the texture has its true size; nearer walls stretch it."""
FOLD_SHARE = 0.045
"""Height of the folds as a share of the tube's radius."""
FOLDS = 13.0
"""Angular frequency of the folds, in radians per unit of the logarithm of the distance."""
FOLD_TILT = (1.1, -0.7)
"""Tilt of the folds, which are not perfect rings."""


class Colon(Tissue):
    """Tube of tissue seen along its axis, without a tool, with the breathing and pulse of the open sheet."""

    focal_factor = 0.62
    exposed_mm = 42.0
    looked_at_mm = 100.0
    sway_mm = (4.0, 3.0, 8.0)
    tools = False

    def first_guess(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Return x and y [H, W] in mm of the rays' intersections with the ellipsoid without folds, to start Newton's method."""
        shape = np.array([1 / COLON_RADIUS_MM, 1 / COLON_RADIUS_MM, 1 / COLON_LENGTH_MM], np.float32)
        start, along = origin * shape, directions * shape
        a = np.einsum("hwi,hwi->hw", along, along)
        b = along @ start
        s = (-b + np.sqrt(np.maximum(b * b - a * (start @ start - 1), 0))) / a
        at = origin + s[..., None] * directions
        scale = np.float32(COLON_TEXTURE_MM) / np.maximum(at[..., 2], np.float32(1))
        return at[..., 0] * scale, at[..., 1] * scale

    def _at_rest(self, u: Array, v: Array) -> SurfacePoints:
        a, b = u / np.float32(COLON_TEXTURE_MM), v / np.float32(COLON_TEXTURE_MM)
        narrow = np.float32(1 / COLON_RADIUS_MM**2)
        smooth = 1 / np.sqrt((a * a + b * b) * narrow + np.float32(1 / COLON_LENGTH_MM**2))
        smooth_a, smooth_b = -(smooth**3) * narrow * a, -(smooth**3) * narrow * b
        folds, share = np.float32(FOLDS), np.float32(FOLD_SHARE)
        tilt_a, tilt_b = (np.float32(tilt) for tilt in FOLD_TILT)
        phase = folds * np.log(smooth) + tilt_a * a + tilt_b * b
        factor, change = 1 + share * np.sin(phase), share * np.cos(phase)
        z = smooth * factor
        z_a = smooth_a * factor + smooth * change * (folds * smooth_a / smooth + tilt_a)
        z_b = smooth_b * factor + smooth * change * (folds * smooth_b / smooth + tilt_b)
        each = np.float32(1 / COLON_TEXTURE_MM)
        return SurfacePoints(
            (a * z, b * z, z),
            ((z + a * z_a) * each, b * z_a * each, z_a * each),
            (a * z_b * each, (z + b * z_b) * each, z_b * each),
        )
