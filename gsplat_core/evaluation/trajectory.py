"""Absolute trajectory error (ATE) of an estimated scope trajectory.

The error of a static scope serves as baseline. ATE: Sturm et al., "A Benchmark for the Evaluation
of RGB-D SLAM Systems" (2012). Alignment: Umeyama, "Least-squares estimation of transformation
parameters between two point patterns" (1991).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput

LEAST_PATH_SHARE = 1e-6
"""Relative path length below which the scope counts as static.

The length is compared with this share of the distance from the origin, and with this value.
"""

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class TrajectoryErrors:
    """RMS position error divided by the length of the true path."""

    rigid_share: float
    """Error after alignment by rotation and translation, for estimates with metric scale."""
    similarity_share: float
    """Error after alignment by a similarity transform, for the shape of the path alone."""
    still_share: float
    """Baseline: error of a static scope at the mean of the true positions."""
    rigid_rmse: float
    """`rigid_share` in the unit of the true path."""
    rotation_deg: float
    """Mean angle in degrees between true and estimated orientations, after the rotation of the alignment."""
    scale: float
    """Scale factor of the similarity alignment."""
    path: float
    """Length of the true path, in its unit."""
    frames: int


def evaluate_trajectory(estimated: Poses, true: Poses) -> TrajectoryErrors | None:
    """Compare world-to-camera poses [N, 4, 4] of the same frames; None for a static true scope.

    Raises:
        InvalidInput: for fewer than three poses or different numbers of poses.
    """
    if estimated.shape != true.shape or len(true) < 3:
        raise InvalidInput(
            f"there are {list(estimated.shape)} estimated and {list(true.shape)} true poses; give three or more of both"
        )
    found, right = _centres(estimated), _centres(true)
    path = float(np.linalg.norm(np.diff(right, axis=0), axis=1).sum())
    if path <= LEAST_PATH_SHARE * max(1.0, float(np.abs(right).max())):
        return None
    rotation, scale = _alignment(found, right)
    rmse = lambda factor: _rmse(factor * (found - found.mean(axis=0)) @ rotation.T, right - right.mean(axis=0))
    turned = estimated[:, :3, :3] @ rotation.T
    cosine = (np.einsum("nij,nij->n", turned, true[:, :3, :3]) - 1) / 2
    return TrajectoryErrors(
        rigid_share=rmse(1.0) / path,
        similarity_share=rmse(scale) / path,
        still_share=rmse(0.0) / path,
        rigid_rmse=rmse(1.0),
        rotation_deg=float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()),
        scale=scale,
        path=path,
        frames=len(true),
    )


def _centres(poses: Poses) -> Poses:
    """Return the camera centres [N, 3] of world-to-camera poses [N, 4, 4]."""
    return np.asarray(-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]))


def _alignment(found: Poses, right: Poses) -> tuple[Poses, float]:
    """Return the rotation [3, 3] and scale that align `found` with `right` about their means.

    The scale of coincident positions is 0.
    """
    a, b = found - found.mean(axis=0), right - right.mean(axis=0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    spread = float(np.square(a).sum())
    return (u * signs) @ vt, float((singular * signs).sum() / spread) if spread > 0 else 0.0


def _rmse(a: Poses, b: Poses) -> float:
    return float(np.sqrt(np.square(a - b).sum(axis=1).mean()))
