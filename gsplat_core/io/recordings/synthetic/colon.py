"""Colon-like scene: a folded tube viewed along its axis, bright nearby, dark at the closed end.

At rest the wall is an ellipsoid of revolution around the origin with rings of folds; z is its long axis. The material
point (u, v) is on the ray (u, v, TEXTURE_MM) from the origin, so the wall has no seam and no pole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.tissue import SurfacePoints, Tissue

Array = NDArray[np.floating]

RADIUS_MM = 23.0
LENGTH_MM = 150.0
"""Distance in mm from the origin to the closed end of the tube."""
TEXTURE_MM = 72.0
"""Distance in mm at which the texture has its true size; nearer walls stretch it."""
FOLD_SHARE = 0.045
"""Height of the folds as a share of the tube's radius."""
FOLDS = 13.0
"""Angular frequency of the folds, in radians per unit of the logarithm of the distance."""
FOLD_TILT = (1.1, -0.7)
"""Tilt of the folds, which are not perfect rings."""


class Colon(Tissue):
    """Tube of tissue without a tool, with the motion of the open sheet."""

    focal_factor = 0.62
    exposed_mm = 42.0
    looked_at_mm = 100.0
    sway_mm = (4.0, 3.0, 8.0)
    tools = False

    def first_guess(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Intersect the rays with the ellipsoid without folds; see `Tissue.first_guess`."""
        shape = np.array([1 / RADIUS_MM, 1 / RADIUS_MM, 1 / LENGTH_MM], np.float32)
        start, along = origin * shape, directions * shape
        a = np.einsum("hwi,hwi->hw", along, along)
        b = along @ start
        s = (-b + np.sqrt(np.maximum(b * b - a * (start @ start - 1), 0))) / a
        at = origin + s[..., None] * directions
        scale = np.float32(TEXTURE_MM) / np.maximum(at[..., 2], np.float32(1))
        return at[..., 0] * scale, at[..., 1] * scale

    def _at_rest(self, u: Array, v: Array) -> SurfacePoints:
        a, b = u / np.float32(TEXTURE_MM), v / np.float32(TEXTURE_MM)
        narrow = np.float32(1 / RADIUS_MM**2)
        smooth = 1 / np.sqrt((a * a + b * b) * narrow + np.float32(1 / LENGTH_MM**2))
        smooth_a, smooth_b = -(smooth**3) * narrow * a, -(smooth**3) * narrow * b
        folds, share = np.float32(FOLDS), np.float32(FOLD_SHARE)
        tilt_a, tilt_b = (np.float32(tilt) for tilt in FOLD_TILT)
        phase = folds * np.log(smooth) + tilt_a * a + tilt_b * b
        factor, change = 1 + share * np.sin(phase), share * np.cos(phase)
        z = smooth * factor
        z_a = smooth_a * factor + smooth * change * (folds * smooth_a / smooth + tilt_a)
        z_b = smooth_b * factor + smooth * change * (folds * smooth_b / smooth + tilt_b)
        each = np.float32(1 / TEXTURE_MM)
        return SurfacePoints(
            (a * z, b * z, z),
            ((z + a * z_a) * each, b * z_a * each, z_a * each),
            (a * z_b * each, (z + b * z_b) * each, z_b * each),
        )
