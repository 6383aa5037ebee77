"""Lens models with distortion: projection of camera-space points to pixels, and rays of pixels, batched and differentiable.

The pinhole and fisheye models are those of OpenCV; the f-theta model is that of gsplat 1.5.3. A distortion polynomial is
meaningful up to the radius at which the distorted radius stops growing. Beyond it, the image folds over, and two points
have the same pixel. Points and pixels there are marked invalid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput

LENS_MODELS = ("pinhole", "ortho", "fisheye", "ftheta")
WIDEST_PINHOLE_RAD = math.radians(89)
"""Largest angle to the optical axis, in radians, of points that a pinhole lens projects to pixels."""
_FOLD_SAMPLES, _FOLD_LEVELS = 512, 3
_BISECTIONS = 14
_NEWTON_STEPS = 6
FTHETA_PIXEL_CENTRE = 0.5
"""Offset added to the principal points of f-theta cameras, which are relative to the centre of the first pixel, not its corner."""


class FThetaPolynomialType(Enum):
    """Polynomial (pixel distance to angle, or angle to pixel distance) that defines an f-theta camera exactly. The other one is an
    approximate inverse.
    """

    PIXELDIST_TO_ANGLE = 0
    ANGLE_TO_PIXELDIST = 1


@dataclass
class FThetaCameraDistortionParameters:
    """Parameters of an f-theta camera, common to all cameras of a call; names and order as in gsplat 1.5.3."""

    reference_poly: FThetaPolynomialType
    pixeldist_to_angle_poly: tuple[float, ...]
    """Six coefficients of the angle in radians by the distance to the principal point in pixels, constant first."""
    angle_to_pixeldist_poly: tuple[float, ...]
    """Six coefficients of the distance in pixels by the angle in radians, constant first."""
    max_angle: float
    """Largest angle to the optical axis, in radians, that the lens maps to a pixel."""
    linear_cde: tuple[float, ...]
    """(c, d, e) of the matrix [[c, d], [e, 1]], which maps radial offsets to pixels."""

    def __post_init__(self) -> None:
        for name, length in (("pixeldist_to_angle_poly", 6), ("angle_to_pixeldist_poly", 6), ("linear_cde", 3)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != length or not all(math.isfinite(value) for value in values):
                raise InvalidInput(f"ftheta: {name} must have {length} finite values, got {list(values)}")
            setattr(self, name, values)
        if not 0 < self.max_angle <= math.pi:
            raise InvalidInput(f"ftheta: max_angle must be above 0 and at most pi, got {self.max_angle}")


class Pixels(NamedTuple):
    """Pixel positions of projected points, and their validity."""

    points: Tensor
    """Pixel positions [..., C, M, 2]; the first pixel's centre is at (0.5, 0.5)."""
    valid: Tensor
    """Mask [..., C, M] of points in front of the camera and inside the part of the lens that does not fold over."""


class Rays(NamedTuple):
    """Rays of pixels in camera axes."""

    origins: Tensor
    """Start of each ray [..., C, M, 3]; zero for all models but "ortho"."""
    directions: Tensor
    """Unit directions [..., C, M, 3]; arbitrary where not `valid`."""
    valid: Tensor
    """Mask [..., C, M] of pixels that the lens sees."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens model and distortion coefficients of C cameras; leading dimensions as those of the cameras.

    Coefficients of OpenCV that are None count as 0.

    Raises:
        InvalidInput: for an unknown model, or coefficients that the model does not have.
    """

    model: str = "pinhole"
    radial: Tensor | None = None
    """OpenCV's k1 to k6 [..., C, 6] of a pinhole lens, k1 to k4 [..., C, 4] of a fisheye lens."""
    tangential: Tensor | None = None
    """OpenCV's p1, p2 [..., C, 2]; pinhole only."""
    thin_prism: Tensor | None = None
    """OpenCV's s1 to s4 [..., C, 4]; pinhole only."""
    ftheta: FThetaCameraDistortionParameters | None = None

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise InvalidInput(f"unknown camera_model {self.model!r}; the models are {', '.join(LENS_MODELS)}")
        radial = {"pinhole": 6, "fisheye": 4}.get(self.model)
        prism = self.model == "pinhole"
        for name, value, length in (
            ("radial_coeffs", self.radial, radial),
            ("tangential_coeffs", self.tangential, 2 if prism else None),
            ("thin_prism_coeffs", self.thin_prism, 4 if prism else None),
        ):
            if value is None:
                continue
            if length is None:
                raise InvalidInput(f"{name} do not belong to camera_model={self.model!r}; leave them out")
            if value.dim() < 2 or value.shape[-1] != length:
                raise InvalidInput(
                    f"{name} of camera_model={self.model!r} must be [..., C, {length}], got {list(value.shape)}"
                )
        if (self.ftheta is None) == (self.model == "ftheta"):
            raise InvalidInput(
                "camera_model='ftheta' needs ftheta_coeffs"
                if self.ftheta is None
                else f"ftheta_coeffs do not belong to camera_model={self.model!r}; use camera_model='ftheta'"
            )

    @classmethod
    def from_opencv(cls, coefficients: Sequence[float], model: str = "pinhole", **like: Any) -> Lens:
        """Return the lens of one camera with OpenCV's distortion coefficients.

        Args:
            coefficients: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]] of a pinhole lens, or k1, k2, k3, k4 of
                a fisheye lens.
            model: "pinhole" or "fisheye".
            **like: dtype and device of the tensors.

        Raises:
            InvalidInput: for another number of coefficients.
        """
        values = [float(value) for value in coefficients]
        lengths = (4,) if model == "fisheye" else (0, 4, 5, 8, 12)
        if len(values) not in lengths or not all(math.isfinite(value) for value in values):
            raise InvalidInput(
                f"a {model} lens has {' or '.join(str(length) for length in lengths)} finite distortion coefficients,"
                f" got {values}"
            )
        row = lambda *numbers: torch.tensor([numbers], **like)
        if model == "fisheye":
            return cls(model, row(*values))
        values += [0.0] * (12 - len(values))
        k1, k2, p1, p2, k3, k4, k5, k6, *prism = values
        return cls(model, row(k1, k2, k3, k4, k5, k6), row(p1, p2), row(*prism))

    @property
    def distorted(self) -> bool:
        """True if the model has coefficients, so that straight lines may be bent."""
        return self.model == "ftheta" or any(
            each is not None for each in (self.radial, self.tangential, self.thin_prism)
        )

    @torch.no_grad()
    def fold_limit(self, Ks: Tensor) -> Tensor:
        """Return the largest radius or angle [..., C, 1] of points for which the lens model is one-to-one.

        It is the radius at z = 1 of a pinhole lens, and the angle to the axis in radians of a fisheye lens.
        """
        if self.model == "pinhole":
            widest = math.tan(WIDEST_PINHOLE_RAD)
            return _pinhole_limit(self.radial, Ks).clamp(max=widest).expand(*Ks.shape[:-2], 1)
        if self.model == "fisheye":
            return _fisheye_limit(self.radial, Ks).expand(*Ks.shape[:-2], 1)
        return Ks.new_full((*Ks.shape[:-2], 1), math.inf)

    def project(self, points: Tensor, Ks: Tensor) -> Pixels:
        """Project camera-space points; values and gradients of invalid points are finite and meaningless.

        Args:
            points: [..., C, M, 3] in camera axes.
            Ks: intrinsic matrices [..., C, 3, 3] in pixels.
        """
        with torch.no_grad():
            front = points[..., 2] > 0
        if self.model == "ortho":
            return Pixels(_to_pixels(points[..., :2], Ks), points.isfinite().all(-1))
        # Replace depths behind the camera before the division: masking the result would leave NaN in the gradient.
        depth = torch.where(front, points[..., 2], torch.ones_like(points[..., 2]))
        points = torch.cat(
            [torch.where(front[..., None], points[..., :2], torch.zeros_like(points[..., :2])), depth[..., None]], -1
        )
        if self.model == "pinhole":
            flat = points[..., :2] / points[..., 2:]
            inside = (flat * flat).sum(-1) < math.tan(WIDEST_PINHOLE_RAD) ** 2
            if self.distorted:
                with torch.no_grad():
                    limit = _pinhole_limit(self.radial, flat)
                    inside = inside & ((flat * flat).sum(-1) < limit**2)
                flat = torch.where(inside[..., None], flat, torch.zeros_like(flat))
                with torch.no_grad():
                    xx, xy, yx, yy = self._slopes(flat)
                    inside = inside & (xx * yy - xy * yx > 0)
                flat = self._distort(flat)
            return Pixels(_to_pixels(flat, Ks), front & inside)
        radius, outward = _polar(points)
        angle = torch.atan2(radius, points[..., 2])
        if self.model == "fisheye":
            with torch.no_grad():
                inside = angle < _fisheye_limit(self.radial, angle)
            bent = _fisheye_radius(self.radial, torch.where(inside, angle, torch.zeros_like(angle)))
            return Pixels(_to_pixels(outward * bent[..., None], Ks), front & inside)
        assert self.ftheta is not None
        inside = angle.detach() <= self.ftheta.max_angle
        distance, found = _ftheta_distance(self.ftheta, torch.where(inside, angle, torch.zeros_like(angle)))
        return Pixels(_ftheta_pixels(self.ftheta, outward * distance[..., None], Ks), front & inside & found)

    def rays(self, pixels: Tensor, Ks: Tensor) -> Rays:
        """Return the rays of pixels [..., C, M, 2]; the inverse of `project`.

        Distortion is inverted by bisection and Newton's method without gradient. One further Newton step has the exact
        gradient with respect to pixels, intrinsics and coefficients (implicit function theorem).
        """
        if self.model == "ftheta":
            return self._ftheta_rays(pixels, Ks)
        flat = (pixels - Ks[..., None, :2, 2]) / _focal(Ks)
        valid = flat.detach().isfinite().all(-1)
        flat = torch.where(valid[..., None], flat, torch.zeros_like(flat))
        nothing, one = torch.zeros_like(flat[..., :1]), torch.ones_like(flat[..., :1])
        if self.model == "ortho":
            return Rays(torch.cat([flat, nothing], -1), torch.cat([nothing, nothing, one], -1), valid)
        if self.model == "fisheye":
            bent, outward = _polar(flat)
            with torch.no_grad():
                angle, found = _inverse(
                    lambda angle: _fisheye_radius(self.radial, angle), bent, _fisheye_limit(self.radial, bent)
                )
                for _ in range(_NEWTON_STEPS):
                    step = (_fisheye_radius(self.radial, angle) - bent) / _fisheye_slope(self.radial, angle)
                    angle = torch.where(step.isfinite(), angle - step, angle)
                slope = _fisheye_slope(self.radial, angle)
                found &= (slope > 0) & ((_fisheye_radius(self.radial, angle) - bent).abs() < _tolerance(bent))
                slope = torch.where(found, slope, torch.ones_like(slope))
            angle = angle - (_fisheye_radius(self.radial, angle) - bent) / slope
            angle = torch.where(found, angle, torch.zeros_like(angle))
            directions = torch.cat([outward * angle.sin()[..., None], angle.cos()[..., None]], -1)
            return Rays(torch.zeros_like(directions), directions, valid & found)
        if self.distorted:
            flat, found = self._undistort(flat)
            valid = valid & found
        directions = torch.nn.functional.normalize(torch.cat([flat, one], -1), dim=-1)
        return Rays(torch.zeros_like(directions), directions, valid)

    def undistort(self, pixels: Tensor, Ks: Tensor) -> Pixels:
        """Return the pixels of the same rays in a pinhole camera with the intrinsics `Ks`, without distortion."""
        directions, valid = self.rays(pixels, Ks)[1:]
        valid = valid & (directions[..., 2] > math.cos(WIDEST_PINHOLE_RAD))
        z = torch.where(valid, directions[..., 2], torch.ones_like(directions[..., 2]))
        return Pixels(_to_pixels(directions[..., :2] / z[..., None], Ks), valid)

    def _distort(self, flat: Tensor) -> Tensor:
        """Bend pinhole coordinates [..., C, M, 2] at z = 1 (OpenCV's model)."""
        x, y = flat.unbind(-1)
        r2 = x * x + y * y
        scale = 1.0 if self.radial is None else _ratio(self.radial, r2)[0]
        across, down = x * scale, y * scale
        if self.tangential is not None:
            p1, p2 = (self.tangential[..., None, i] for i in range(2))
            across = across + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            down = down + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        if self.thin_prism is not None:
            s1, s2, s3, s4 = (self.thin_prism[..., None, i] for i in range(4))
            across = across + r2 * (s1 + s2 * r2)
            down = down + r2 * (s3 + s4 * r2)
        return torch.stack([across, down], -1)

    def _slopes(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the derivatives (dx'/dx, dx'/dy, dy'/dx, dy'/dy) of distorted by undistorted coordinates, each [..., C, M]."""
        x, y = flat.unbind(-1)
        r2 = x * x + y * y
        scale, slope = (torch.ones_like(x), torch.zeros_like(x)) if self.radial is None else _ratio(self.radial, r2)
        xx, yy = scale + 2 * x * x * slope, scale + 2 * y * y * slope
        xy = yx = 2 * x * y * slope
        if self.tangential is not None:
            p1, p2 = (self.tangential[..., None, i] for i in range(2))
            both = 2 * (p1 * x + p2 * y)
            xx, yy = xx + 2 * p1 * y + 6 * p2 * x, yy + 6 * p1 * y + 2 * p2 * x
            xy, yx = xy + both, yx + both
        if self.thin_prism is not None:
            s1, s2, s3, s4 = (self.thin_prism[..., None, i] for i in range(4))
            right, below = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
            xx, xy = xx + x * right, xy + y * right
            yx, yy = yx + x * below, yy + y * below
        return xx, xy, yx, yy

    def _undistort(self, bent: Tensor) -> tuple[Tensor, Tensor]:
        """Invert `_distort`: return pinhole coordinates at z = 1 [..., C, M, 2], and a mask that is True where a solution exists."""
        with torch.no_grad():
            target = bent.detach()
            radius, outward = _polar(target)
            limit = _pinhole_limit(self.radial, target)
            start = radius
            if self.radial is not None:
                radial = self.radial
                start, _ = _inverse(lambda r: r * _ratio(radial, r * r)[0], radius, limit)
            flat = outward * torch.minimum(start, limit)[..., None]
            for _ in range(_NEWTON_STEPS):
                step = _solve(self._slopes(flat), self._distort(flat) - target)
                flat = torch.where(step.isfinite().all(-1, keepdim=True), flat - step, flat)
            rest = (self._distort(flat) - target).abs().amax(-1)
            slopes = self._slopes(flat)
            found = (rest < _tolerance(radius)) & ((flat * flat).sum(-1) < limit**2)
            found &= slopes[0] * slopes[3] - slopes[1] * slopes[2] > 0
            flat = torch.where(found[..., None], flat, torch.zeros_like(flat))
            slopes = self._slopes(flat)
        last = flat - _solve(slopes, self._distort(flat) - bent)
        return torch.where(found[..., None], last, torch.zeros_like(last)), found

    def _ftheta_rays(self, pixels: Tensor, Ks: Tensor) -> Rays:
        assert self.ftheta is not None
        c, d, e = self.ftheta.linear_cde
        x, y = (pixels - Ks[..., None, :2, 2] - FTHETA_PIXEL_CENTRE).unbind(-1)
        offsets = torch.stack([x - d * y, c * y - e * x], -1) / (c - d * e)
        valid = offsets.detach().isfinite().all(-1)
        distance, outward = _polar(torch.where(valid[..., None], offsets, torch.zeros_like(offsets)))
        backward, forward = self.ftheta.pixeldist_to_angle_poly, self.ftheta.angle_to_pixeldist_poly
        found = torch.ones_like(valid)
        if self.ftheta.reference_poly is FThetaPolynomialType.PIXELDIST_TO_ANGLE:
            angle = _horner(backward, distance)
        else:
            angle, found = _newton_inverse(forward, backward, distance)
        valid = valid & found & (angle >= 0) & (angle <= self.ftheta.max_angle)
        angle = torch.where(valid, angle, torch.zeros_like(angle))
        directions = torch.cat([outward * angle.sin()[..., None], angle.cos()[..., None]], -1)
        return Rays(torch.zeros_like(directions), directions, valid)


def _to_pixels(flat: Tensor, Ks: Tensor) -> Tensor:
    return flat * _focal(Ks) + Ks[..., None, :2, 2]


def _focal(Ks: Tensor) -> Tensor:
    # Take the diagonal, because indexing with lists would synchronise on CUDA.
    return Ks.diagonal(dim1=-2, dim2=-1)[..., None, :2]


def _polar(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance of points to the optical axis, and the unit vector (x, y) from the axis to them; (0, 0) on the axis."""
    across = points[..., :2]
    squared = (across * across).sum(-1)
    on_axis = squared == 0
    radius = torch.where(on_axis, torch.ones_like(squared), squared).sqrt()
    outward = across / radius[..., None]
    return torch.where(on_axis, torch.zeros_like(radius), radius), outward


def _ratio(radial: Tensor, r2: Tensor) -> tuple[Tensor, Tensor]:
    """Return OpenCV's radial scale (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³), s = r², and its derivative by s."""
    k1, k2, k3, k4, k5, k6 = (radial[..., None, i] for i in range(6))
    over, under = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    d_over, d_under = k1 + r2 * (2 * k2 + 3 * k3 * r2), k4 + r2 * (2 * k5 + 3 * k6 * r2)
    scale = over / under
    return scale, (d_over - scale * d_under) / under


def _fisheye_radius(radial: Tensor | None, angle: Tensor) -> Tensor:
    if radial is None:
        return angle
    k1, k2, k3, k4 = (radial[..., None, i] for i in range(4))
    squared = angle * angle
    return angle * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))


def _fisheye_slope(radial: Tensor | None, angle: Tensor) -> Tensor:
    if radial is None:
        return torch.ones_like(angle)
    k1, k2, k3, k4 = (radial[..., None, i] for i in range(4))
    squared = angle * angle
    return 1 + squared * (3 * k1 + squared * (5 * k2 + squared * (7 * k3 + squared * 9 * k4)))


def _pinhole_limit(radial: Tensor | None, like: Tensor) -> Tensor:
    """Return the undistorted radius [..., C, 1] at z = 1 up to which the distorted radius grows with it."""
    if radial is None:
        return like.new_full((1,), math.tan(WIDEST_PINHOLE_RAD))

    def grows(angle: Tensor) -> Tensor:
        r2 = angle.tan() ** 2
        scale, slope = _ratio(radial, r2)
        k4, k5, k6 = (radial[..., None, i] for i in range(3, 6))
        return (scale + 2 * r2 * slope > 0) & (1 + r2 * (k4 + r2 * (k5 + r2 * k6)) > 0)

    return _first_failure(grows, radial, WIDEST_PINHOLE_RAD).tan()


def _fisheye_limit(radial: Tensor | None, like: Tensor) -> Tensor:
    """Return the angle [..., C, 1] of rays to the axis in radians up to which the distorted radius grows with it."""
    if radial is None:
        return like.new_full((1,), math.pi)
    return _first_failure(lambda angle: _fisheye_slope(radial, angle) > 0, radial, math.pi)


@torch.no_grad()
def _first_failure(holds: Callable[[Tensor], Tensor], radial: Tensor, most: float) -> Tensor:
    """Return the smallest angle [..., C, 1] in 0 to `most` at which the condition `holds` is false; `most` if it is always true."""
    shares = torch.linspace(0, 1, _FOLD_SAMPLES, dtype=radial.dtype, device=radial.device)
    low, high = radial.new_zeros(*radial.shape[:-1], 1), radial.new_full((*radial.shape[:-1], 1), most)
    for _ in range(_FOLD_LEVELS):
        samples = low + (high - low) * shares
        count = holds(samples).cumprod(-1, dtype=torch.int64).sum(-1, keepdim=True).clamp(min=1)
        low, high = samples.gather(-1, count - 1), samples.gather(-1, count.clamp(max=_FOLD_SAMPLES - 1))
    return low


@torch.no_grad()
def _inverse(rises: Callable[[Tensor], Tensor], target: Tensor, most: Tensor) -> tuple[Tensor, Tensor]:
    """Solve rises(x) = target for an increasing function approximately, by bisection of 0 to `most`.

    Returns:
        x, and a mask that is True where the target is at most rises(`most`).
    """
    low, high = torch.zeros_like(target), most.expand_as(target).clone()
    found = target <= rises(high)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        below = rises(middle) < target
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return 0.5 * (low + high), found


def _tolerance(distance: Tensor) -> Tensor:
    return (1e-8 if distance.dtype == torch.float64 else 1e-4) * (1 + distance)


def _solve(slopes: tuple[Tensor, Tensor, Tensor, Tensor], right: Tensor) -> Tensor:
    """Solve the 2x2 linear systems [[xx, xy], [yx, yy]] step = right; return `step` [..., 2]. `slopes` is (xx, xy, yx, yy)."""
    xx, xy, yx, yy = slopes
    x, y = right.unbind(-1)
    return torch.stack([yy * x - xy * y, xx * y - yx * x], -1) / (xx * yy - xy * yx)[..., None]


def _horner(coefficients: Sequence[float], x: Tensor) -> Tensor:
    value = torch.zeros_like(x)
    for each in reversed(coefficients):
        value = value * x + each
    return value


def _newton_inverse(exact: Sequence[float], approximate: Sequence[float], target: Tensor) -> tuple[Tensor, Tensor]:
    """Solve exact(x) = target by Newton's method from x = approximate(target); both are polynomials by their coefficients.

    Returns:
        x, and a mask that is True where a solution was found.
    """
    slopes = [power * each for power, each in enumerate(exact)][1:]
    with torch.no_grad():
        x = _horner(approximate, target)
        for _ in range(_NEWTON_STEPS):
            step = (_horner(exact, x) - target) / _horner(slopes, x)
            x = torch.where(step.isfinite(), x - step, x)
        slope = _horner(slopes, x)
        found = ((_horner(exact, x) - target).abs() <= 1e-4 * (1 + target.abs())) & (slope > 0)
        slope = torch.where(found, slope, torch.ones_like(slope))
    return x - (_horner(exact, x) - target) / slope, found


def _ftheta_distance(ftheta: FThetaCameraDistortionParameters, angle: Tensor) -> tuple[Tensor, Tensor]:
    backward, forward = ftheta.pixeldist_to_angle_poly, ftheta.angle_to_pixeldist_poly
    if ftheta.reference_poly is FThetaPolynomialType.ANGLE_TO_PIXELDIST:
        return _horner(forward, angle), torch.ones_like(angle, dtype=torch.bool)
    return _newton_inverse(backward, forward, angle)


def _ftheta_pixels(ftheta: FThetaCameraDistortionParameters, offsets: Tensor, Ks: Tensor) -> Tensor:
    c, d, e = ftheta.linear_cde
    x, y = offsets.unbind(-1)
    moved = torch.stack([c * x + d * y, e * x + y], -1)
    return moved + Ks[..., None, :2, 2] + FTHETA_PIXEL_CENTRE
