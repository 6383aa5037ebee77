"""Ray caster for tissue and tool lit from the scope's tip: image, depth and tool mask.

Each ray is intersected with the deformed tissue by Newton's method on the material coordinates (u, v), so depth is
exact and not that of a mesh. A pixel (column i, row j) has its centre at (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.air import Air
from gsplat_core.io.recordings.synthetic.lamp import Lamp
from gsplat_core.io.recordings.synthetic.shading import develop, shade_tissue, shade_tool
from gsplat_core.io.recordings.synthetic.tissue import SurfacePoints, Tissue, Tug
from gsplat_core.io.recordings.synthetic.tool import Part, trace
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]

NEWTON_STEPS = 6


@dataclass(frozen=True)
class Eye:
    """Picture, depth and material coordinates of the pixels of one camera."""

    image: NDArray[np.uint8]
    """sRGB [H, W, 3]."""
    depth: Array
    """Depth z in mm [H, W] of the first surface, tool or tissue, on the ray of each pixel centre."""
    tool: NDArray[np.bool_]
    """bool [H, W]; pixels at least partly covered by the tool."""
    tissue_depth: Array
    """Depth z in mm [H, W] of the tissue, also behind the tool."""
    u: Array
    v: Array


def render_eye(
    tissue: Tissue,
    tug: Tug,
    parts: list[Part],
    camera: Camera,
    time_s: float,
    lamp: Lamp,
    air: Air | None = None,
    *,
    transparent: bool = False,
) -> Eye:
    """Render one camera's view of the scene at a time.

    Args:
        tissue: deforming tissue.
        tug: pull of the tool on the tissue.
        parts: capsules that make up the tool.
        camera: camera with its pose.
        time_s: time in seconds.
        lamp: light source in the camera's coordinates; the same light serves all cameras.
        air: smoke and exposure; None for clear air and constant exposure.
        transparent: omit the tools from the picture but keep their shadow on the tissue.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    ray_x, ray_y = pixel_rays(camera)
    u, v, points = cast_tissue(tissue, tug, camera, ray_x, ray_y, time_s)
    position = np.stack(points.position, axis=-1)
    local = position @ rotation.T.astype(np.float32) + translation.astype(np.float32)
    tissue_depth = np.ascontiguousarray(local[..., 2])

    length = np.sqrt(ray_x * ray_x + ray_y * ray_y + 1)
    rays = np.stack([ray_x / length, ray_y / length, 1 / length], axis=-1)
    world_rays = (rays @ rotation.astype(np.float32)).reshape(-1, 3)
    hits = trace(
        [] if transparent else parts,
        camera.position,
        world_rays,
        (tissue_depth * length).ravel(),
        1 / float(camera.K[0, 0]),
    )
    shape = tissue_depth.shape
    tool_depth = hits.distance_mm.reshape(shape) / length
    cover = hits.cover.reshape(shape)

    radiance = shade_tissue(tissue, u, v, points, local, rays, parts, camera, lamp)
    touched = cover > 0
    if touched.any():
        normal = hits.normal.reshape(*shape, 3)[touched] @ rotation.T.astype(np.float32)
        reach = np.where(np.isfinite(tool_depth), tool_depth, tissue_depth * np.float32(0.9))[touched]
        at = rays[touched] * (reach * length[touched])[:, None]
        steel = shade_tool(at, normal, rays[touched], hits.material.reshape(shape)[touched], lamp)
        share = cover[touched][:, None]
        radiance[touched] = (1 - share) * radiance[touched] + share * steel
    depth = np.minimum(tissue_depth, tool_depth).astype(np.float32)
    if air is not None:
        radiance = air.through(radiance, camera, ray_x, ray_y, depth, lamp, time_s)
    return Eye(image=develop(radiance), depth=depth, tool=touched, tissue_depth=tissue_depth, u=u, v=v)


def pixel_rays(camera: Camera) -> tuple[Array, Array]:
    """Return x/z and y/z of the rays through the pixel centres, [H, W] each."""
    column = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    row = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    ray_x, ray_y = np.meshgrid(column.astype(np.float32), row.astype(np.float32))
    return ray_x, ray_y


def cast_tissue(
    tissue: Tissue, tug: Tug, camera: Camera, ray_x: Array, ray_y: Array, time_s: float
) -> tuple[Array, Array, SurfacePoints]:
    """Intersect rays with the tissue and return the material points (u, v).

    Newton's method solves X - ray_x Z = 0 and Y - ray_y Z = 0.
    """
    r = camera.world_to_camera[:3, :3].astype(np.float32)
    t = camera.world_to_camera[:3, 3].astype(np.float32)
    directions = np.stack([ray_x, ray_y, np.ones_like(ray_x)], axis=-1) @ r
    u, v = tissue.first_guess(camera.position.astype(np.float32), directions)
    for _ in range(NEWTON_STEPS):
        points = tissue.points(u, v, time_s, tug)
        # Camera rotation rows minus the ray: Jacobian of the two residuals by displacement.
        residual_x, residual_y, xu, xv, yu, yv = (
            _dot(r[axis], vector) - ray * _dot(r[2], vector)
            for vector_axis in (
                ((points.position, 0, ray_x), (points.position, 1, ray_y)),
                ((points.along_u, 0, ray_x), (points.along_v, 0, ray_x)),
                ((points.along_u, 1, ray_y), (points.along_v, 1, ray_y)),
            )
            for vector, axis, ray in vector_axis
        )
        residual_x = residual_x + t[0] - ray_x * t[2]
        residual_y = residual_y + t[1] - ray_y * t[2]
        determinant = xu * yv - xv * yu
        u = u - (residual_x * yv - residual_y * xv) / determinant
        v = v - (residual_y * xu - residual_x * yu) / determinant
    return u, v, tissue.points(u, v, time_s, tug)


def _dot(row: Array, vector: tuple[Array, Array, Array]) -> Array:
    return np.asarray(row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2])
