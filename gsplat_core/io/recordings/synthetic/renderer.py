"""Ray caster for tissue and tool lit from the scope's tip: image, depth and tool mask.

Each ray is intersected with the deformed tissue by Newton's method on the material coordinates (u, v), so depth is
exact and not that of a mesh. A pixel (column i, row j) has its centre at (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.optics import Air, Lamp, RadialLens, develop
from gsplat_core.io.recordings.synthetic.tissue import SurfacePoints, Tissue, Tug
from gsplat_core.io.recordings.synthetic.tool import RING, SHAFT, USUAL_PLAN, Part, ToolAppearance, distance, trace
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]


def shade_tissue(
    tissue: Tissue,
    u: Array,
    v: Array,
    points: SurfacePoints,
    local: Array,
    rays: Array,
    parts: list[Part],
    camera: Camera,
    lamp: Lamp,
) -> Array:
    """Return the linear radiance [H, W, 3] of the tissue.

    Combines scattering that bleeds red with a wet film over a fine relief.
    """
    appearance = tissue.appearance
    reflectance, slope = tissue.texture.sample(u, v)
    turn = camera.world_to_camera[:3, :3].T.astype(np.float32)
    along_u = np.stack(points.along_u, axis=-1) @ turn
    along_v = np.stack(points.along_v, axis=-1) @ turn
    # The sheet spans the view, u to the right and v down, so u x v points away from the scope.
    smooth = _unit(np.cross(along_v, along_u))
    bumpy = _unit(np.cross(along_v - slope[..., 1:] * -smooth, along_u - slope[..., :1] * -smooth).astype(np.float32))
    light_diffuse = np.zeros(u.shape, np.float32)
    light_wet = np.zeros(u.shape, np.float32)
    for to_light, power in lamp.rays_to(local):
        facing = np.einsum("hwi,hwi->hw", bumpy, to_light)
        half = _unit(to_light - rays)
        shine = np.clip(np.einsum("hwi,hwi->hw", bumpy, half), 0, 1)
        light_diffuse += power * np.clip((facing + np.float32(0.12)) / np.float32(1.12), 0, 1)
        light_wet += power * (
            np.float32(appearance.glint) * shine ** np.float32(appearance.glint_power)
            + np.float32(appearance.sheen) * shine ** np.float32(appearance.sheen_power)
        )
    shade = _tool_shade(parts, camera, local, lamp)
    diffuse = (light_diffuse * shade)[..., None]
    # Light scattered inside tissue emerges red. Add red where little direct light arrives.
    bleed = np.array(appearance.bleed, np.float32) * np.sqrt(np.maximum(diffuse, 0))
    wet = (light_wet * shade * reflectance[..., 3])[..., None] * np.array([1.0, 0.97, 0.93], np.float32)
    return np.asarray(reflectance[..., :3] * diffuse + bleed + wet, np.float32)


def _tool_shade(parts: list[Part], camera: Camera, local: Array, lamp: Lamp) -> Array:
    """Return the share of light [H, W] that passes the tool on its way to the tissue.

    The distance to the tool is sampled along the shadow rays on a coarse pixel grid.
    """
    step = 3
    rotation = camera.world_to_camera[:3, :3].astype(np.float32)
    coarse = local[::step, ::step].reshape(-1, 3)
    to_light = lamp.shadow_from - coarse
    shade = np.ones(len(coarse), np.float32)
    for reach in (0.015, 0.05, 0.10, 0.17, 0.26, 0.37) if parts else ():
        at = (coarse + np.float32(reach) * to_light) @ rotation + camera.position.astype(np.float32)
        gap, _ = distance(parts, at)
        blur = np.float32(1.0 + 22 * reach)
        shade = np.minimum(shade, np.clip(0.5 + gap / blur, 0, 1))
    rows, columns = local[::step, ::step].shape[:2]
    return _upsample(0.30 + 0.70 * shade.reshape(rows, columns), local.shape[0], local.shape[1], step)


def _upsample(coarse: Array, rows: int, columns: int, step: int) -> Array:
    row, column = np.arange(rows) / step, np.arange(columns) / step
    known_rows, known_columns = np.arange(coarse.shape[0]), np.arange(coarse.shape[1])
    wide = np.stack([np.interp(column, known_columns, line) for line in coarse])
    low = np.minimum(row.astype(int), len(known_rows) - 1)
    high = np.minimum(low + 1, len(known_rows) - 1)
    weight = (row - low)[:, None]
    return np.asarray((1 - weight) * wide[low] + weight * wide[high], np.float32)


def shade_tool(
    at: Array,
    normal: Array,
    rays: Array,
    material: NDArray[np.int8],
    lamp: Lamp,
    appearance: ToolAppearance = USUAL_PLAN.appearance,
) -> Array:
    """Return the linear radiance [N, 3] of the tool.

    The shaft is usually polymer, the jaws are brushed steel reflecting pink surroundings.
    """
    metal = ((material != SHAFT) | appearance.metal_shaft)[:, None]
    base = np.where(
        (material != SHAFT)[:, None], np.array(appearance.steel, np.float32), np.array(appearance.shaft, np.float32)
    )
    base = np.where((material == RING)[:, None], np.array(appearance.ring, np.float32), base)
    gloss = np.where(metal[:, 0], np.float32(appearance.gloss), np.float32(14))
    glint = np.where(metal[:, 0], np.float32(appearance.glint), np.float32(0.16))
    total = np.zeros((len(at), 3), np.float32)
    for to_light, power in lamp.rays_to(at, nearest_mm2=400):
        facing = np.clip(np.einsum("ni,ni->n", normal, to_light), 0, 1)
        shine = np.clip(np.einsum("ni,ni->n", normal, _unit(to_light - rays)), 0, 1)
        total += (power * facing)[:, None] * base + (power * glint * shine**gloss)[:, None]
    mirrored = rays - 2 * np.einsum("ni,ni->n", rays, normal)[:, None] * normal
    tissue_seen = (np.clip(0.45 + 0.65 * mirrored[:, 2], 0, 1) ** 2)[:, None]
    fresnel = (1 - np.clip(-np.einsum("ni,ni->n", rays, normal), 0, 1))[:, None] ** 3
    reflected = np.where(metal, 0.60 + 0.40 * fresnel, 0.05 + 0.45 * fresnel)
    surroundings = np.array([0.250, 0.130, 0.110], np.float32)
    return np.asarray(total + reflected * tissue_seen * surroundings, np.float32)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.sqrt(np.einsum("...i,...i->...", vector, vector))[..., None], np.float32)


NEWTON_STEPS = 6


@dataclass(frozen=True)
class Eye:
    """Picture, depth and material coordinates of the pixels of one camera."""

    image: NDArray[np.uint8]
    """Rendered picture, sRGB uint8 [H, W, 3]."""
    depth: Array
    """Depth z in mm [H, W] of the first surface, tool or tissue, on the ray of each pixel centre."""
    tool: NDArray[np.bool_]
    """Mask bool [H, W] of pixels at least partly covered by the tool."""
    tissue_depth: Array
    """Depth z in mm [H, W] of the tissue, also behind the tool."""
    u: Array
    v: Array


def render_eye(
    tissue: Tissue,
    tug: Tug,
    tools: Sequence[tuple[list[Part], ToolAppearance]],
    camera: Camera,
    time_s: float,
    lamp: Lamp,
    air: Air | None = None,
    *,
    transparent: bool = False,
    lens: RadialLens | None = None,
    after: Callable[[Array, Array], NDArray[np.uint8]] | None = None,
) -> Eye:
    """Render one camera's view of the scene at a time.

    Args:
        tissue: deforming tissue.
        tug: pull of the tool on the tissue.
        tools: capsules and appearance of each tool.
        camera: camera with its pose.
        time_s: time in seconds.
        lamp: light source in the camera's coordinates; the same light serves all cameras.
        air: smoke and exposure; None for clear air and constant exposure.
        transparent: omit the tools from the picture but keep their shadow on the tissue.
        lens: distortion of the lens; None for a pinhole.
        after: function that turns radiance [H, W, 3] and depth [H, W] into a picture; None for `develop`.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    ray_x, ray_y = pixel_rays(camera) if lens is None else lens.rays(camera)
    u, v, points = cast_tissue(tissue, tug, camera, ray_x, ray_y, time_s)
    position = np.stack(points.position, axis=-1)
    local = position @ rotation.T.astype(np.float32) + translation.astype(np.float32)
    tissue_depth = np.ascontiguousarray(local[..., 2])

    length = np.sqrt(ray_x * ray_x + ray_y * ray_y + 1)
    rays = np.stack([ray_x / length, ray_y / length, 1 / length], axis=-1)
    world_rays = (rays @ rotation.astype(np.float32)).reshape(-1, 3)
    shape = tissue_depth.shape
    every_part = [part for parts, _ in tools for part in parts]
    radiance = shade_tissue(tissue, u, v, points, local, rays, every_part, camera, lamp)
    depth, tool = tissue_depth, np.zeros(shape, np.bool_)
    for parts, appearance in [] if transparent else tools:
        hits = trace(parts, camera.position, world_rays, (depth * length).ravel(), 1 / float(camera.K[0, 0]))
        tool_depth = hits.distance_mm.reshape(shape) / length
        cover = hits.cover.reshape(shape)
        touched = cover > 0
        if touched.any():
            normal = hits.normal.reshape(*shape, 3)[touched] @ rotation.T.astype(np.float32)
            reach = np.where(np.isfinite(tool_depth), tool_depth, depth * np.float32(0.9))[touched]
            at = rays[touched] * (reach * length[touched])[:, None]
            steel = shade_tool(at, normal, rays[touched], hits.material.reshape(shape)[touched], lamp, appearance)
            share = cover[touched][:, None]
            radiance[touched] = (1 - share) * radiance[touched] + share * steel
        depth, tool = np.minimum(depth, tool_depth).astype(np.float32), tool | touched
    depth = depth.astype(np.float32)
    if air is not None:
        radiance = air.through(radiance, camera, ray_x, ray_y, depth, lamp, time_s)
    image = develop(radiance) if after is None else after(radiance, depth)
    return Eye(image=image, depth=depth, tool=tool, tissue_depth=tissue_depth, u=u, v=v)


def pixel_rays(camera: Camera) -> tuple[Array, Array]:
    """Return x/z and y/z of the rays through the pixel centres, [H, W] each."""
    column = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    row = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    ray_x, ray_y = np.meshgrid(column.astype(np.float32), row.astype(np.float32))
    return ray_x, ray_y


def cast_tissue(
    tissue: Tissue, tug: Tug, camera: Camera, ray_x: Array, ray_y: Array, time_s: float
) -> tuple[Array, Array, SurfacePoints]:
    """Intersect rays with the tissue. Return the material points (u, v), and their positions and tangents.

    Newton's method solves X - ray_x Z = 0 and Y - ray_y Z = 0.
    """
    r = camera.world_to_camera[:3, :3].astype(np.float32)
    t = camera.world_to_camera[:3, 3].astype(np.float32)
    directions = np.stack([ray_x, ray_y, np.ones_like(ray_x)], axis=-1) @ r
    u, v = tissue.first_guess(camera.position.astype(np.float32), directions)
    for _ in range(NEWTON_STEPS):
        points = tissue.points(u, v, time_s, tug)
        # Jacobian of the two residuals by a displacement of the surface point: rows of the camera's rotation minus the ray.
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
