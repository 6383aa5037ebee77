"""Coloured triangle meshes of a model's surface at one time, made from a depth map and cut at occlusion edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import ExportError, InvalidInput
from gsplat_core.models import Model
from gsplat_core.rendering.surface import COVERED
from gsplat_core.scene.cameras import Camera
from gsplat_core.transfers import HostCopy

Array = NDArray[np.floating]

TORN_DEGREES = 80.0
"""Tilt against the image plane in degrees from which a depth step between neighbouring pixels counts as an occlusion
edge.
"""
MOST_ANGLE_RAD = 1.5
"""Largest angle of a fisheye ray to the axis in radians; at 90 degrees a ray has no point at z = 1."""


def rays_of(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Return the rays of pixel coordinates [..., 2].

    Returns:
        Points at z = 0 and steps to z = 1, both [..., 3] in camera coordinates.
    """
    plane = (np.asarray(pixels, np.float64) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    zero, one = np.zeros_like(plane[..., :1]), np.ones_like(plane[..., :1])
    if camera.model == "ortho":
        return np.concatenate([plane, zero], -1), np.concatenate([zero, zero, one], -1)
    if camera.model == "fisheye":
        angle = np.linalg.norm(plane, axis=-1, keepdims=True)
        plane = plane * np.tan(np.minimum(angle, MOST_ANGLE_RAD)) / np.maximum(angle, 1e-9)
    return np.zeros((*plane.shape[:-1], 3)), np.concatenate([plane, one], -1)


def points_of(depth: Array, camera: Camera) -> NDArray[np.float64]:
    """Return points [H, W, 3] in camera coordinates at the pixel centres of a depth map z [H, W];
    meaningless where the depth is unknown (0).
    """
    if depth.shape != (camera.height_px, camera.width_px):
        raise InvalidInput(
            f"the depth is {list(depth.shape)}; the camera's picture is [{camera.height_px}, {camera.width_px}]"
        )
    column, row = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    start, step = rays_of(camera, np.stack([column, row], -1))
    return np.asarray(start + step * np.nan_to_num(depth, posinf=0, neginf=0)[..., None], np.float64)


def in_world(points: Array, camera: Camera) -> NDArray[np.float64]:
    """Transform points [..., 3] from camera to world coordinates."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return np.asarray((points - translation) @ rotation, np.float64)


def known(depth: Array) -> NDArray[np.bool_]:
    """Return a bool mask [H, W], True where a depth map is finite and positive."""
    return np.asarray(np.isfinite(depth) & (depth > 0))


def joined(depth: Array, camera: Camera, axis: int) -> NDArray[np.bool_]:
    """Return a mask of the pairs of neighbouring pixels that the surface connects.

    Two pixels are connected if both depths are known and the surface between them is tilted by less than `TORN_DEGREES`
    against the image plane.

    Args:
        depth: [H, W], z in camera coordinates, 0 = unknown.
        camera: camera of the depth map.
        axis: 0 for vertical, 1 for horizontal neighbours.

    Returns:
        bool, one element shorter than [H, W] along `axis`.
    """
    points = points_of(depth, camera)
    there = known(depth)
    before, after = _pair(points, axis)
    both = np.logical_and(*_pair(there, axis))
    z = 0.5 * (before[..., 2] + after[..., 2])
    pixel = 1 / camera.K[1 - axis, 1 - axis] * (1 if camera.model == "ortho" else z)
    return np.asarray(both & (np.abs(after[..., 2] - before[..., 2]) < np.tan(np.radians(TORN_DEGREES)) * pixel))


def normals_of(depth: Array, camera: Camera) -> NDArray[np.float32]:
    """Return unit normals [H, W, 3] in camera coordinates, facing the camera, from differences of
    connected neighbours. Pixels without a connected neighbour in both directions get 0.
    """
    points = points_of(depth, camera)
    (across, has_across), (down, has_down) = (_tangent(points, joined(depth, camera, axis), axis) for axis in (1, 0))
    normals = np.cross(down, across)  # down x across: with x right and y down, the normal points towards the camera
    length = np.linalg.norm(normals, axis=-1)
    good = has_across & has_down & (length > 0)
    normals = np.where(good[..., None], normals / np.where(length > 0, length, 1)[..., None], 0)
    towards = normals[..., 2] if camera.model == "ortho" else np.einsum("...i,...i->...", normals, points)
    return np.where((towards > 0)[..., None], -normals, normals).astype(np.float32)


def _pair(values: NDArray, axis: int) -> tuple[NDArray, NDArray]:
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def _tangent(points: Array, joins: NDArray[np.bool_], axis: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return the surface tangent along `axis` [H, W, 3], from one or both connected neighbours, and a bool mask [H, W], True where it
    exists.
    """
    before, after = _pair(points, axis)
    step = np.where(joins[..., None], after - before, 0)
    padding = [(0, 0), (0, 0), (0, 0)]
    padding[axis] = (1, 0)
    backward, has_backward = np.pad(step, padding), np.pad(joins, padding[:2])
    padding[axis] = (0, 1)
    forward, has_forward = np.pad(step, padding), np.pad(joins, padding[:2])
    return backward + forward, has_backward | has_forward


LEAST_OPACITY = 0.5
"""Least rendered opacity of a pixel that becomes part of the mesh."""
assert LEAST_OPACITY >= COVERED


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh with V vertices and T triangles."""

    vertices: NDArray[np.float32]
    """Vertex positions [V, 3]."""
    normals: NDArray[np.float32]
    """Unit vertex normals [V, 3] on the visible side."""
    colours: NDArray[np.uint8]
    """Displayed RGB colours [V, 3]."""
    triangles: NDArray[np.int32]
    """Vertex indices [T, 3], counter-clockwise seen from the visible side; empty for a point cloud."""


def mesh_of(model: Model, time_s: float) -> Mesh:
    """Mesh the surface that the model's camera sees at a time, with one vertex per pixel that shows tissue.

    Args:
        model: model to export.
        time_s: time in seconds.

    Returns:
        The mesh in world coordinates.

    Raises:
        ExportError: if no surface is visible.
    """
    camera = model.camera
    with torch.inference_mode():
        surface = model.surface(time_s, camera)
        image = model.render(time_s, camera, depth=False).image
        displayed = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    alpha = HostCopy(surface.alpha).numpy()
    depth = np.where(alpha >= LEAST_OPACITY, HostCopy(surface.ray_depth).numpy(), 0).astype(np.float32)
    return mesh_of_depth(depth, HostCopy(displayed).numpy(), camera)


def mesh_of_depth(depth: NDArray[np.float32], image: NDArray[np.uint8], camera: Camera) -> Mesh:
    """Mesh a depth map.

    Args:
        depth: float32 [H, W], z in camera coordinates, 0 = unknown.
        image: uint8 [H, W, 3], colours.
        camera: camera of both planes.

    Returns:
        The mesh in world coordinates.

    Raises:
        ExportError: if no three neighbouring pixels are on one surface.
    """
    across, down = joined(depth, camera, 1), joined(depth, camera, 0)
    triangles = _triangles(across, down)
    if not len(triangles):
        raise ExportError("the model shows no surface from this camera at this time; there is nothing to export")
    used, flat = np.unique(triangles, return_inverse=True)
    vertices = in_world(points_of(depth, camera), camera).reshape(-1, 3)[used]
    numbered = flat.reshape(-1, 3).astype(np.int32)
    return Mesh(
        vertices=vertices.astype(np.float32),
        normals=vertex_normals(vertices, numbered).astype(np.float32),
        colours=np.ascontiguousarray(image.reshape(-1, 3)[used]),
        triangles=numbered,
    )


def vertex_normals(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return unit vertex normals [V, 3], the area-weighted mean of the adjacent triangles' normals;
    0 for a vertex without triangles.
    """
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    faces = np.cross(b - a, c - a)
    corners, weights = triangles.T.ravel(), np.tile(faces, (3, 1))
    sums = np.stack([np.bincount(corners, weights[:, axis], len(vertices)) for axis in range(3)], 1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray(sums / np.where(length > 0, length, 1), np.float64)


def _triangles(across: NDArray[np.bool_], down: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return pixel indices [T, 3]: two triangles for each square of pixels with four connected sides, one triangle if a
    corner is disconnected.
    """
    height, width = across.shape[0], down.shape[1]
    pixel = np.arange(height * width).reshape(height, width)
    upper_left, upper_right = pixel[:-1, :-1], pixel[:-1, 1:]
    lower_left, lower_right = pixel[1:, :-1], pixel[1:, 1:]
    top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
    whole = top & bottom & left & right
    # Pixel rows increase downwards, so this corner order is counter-clockwise for a viewer along +z.
    corners = (
        (whole | (top & left), upper_left, lower_left, upper_right),
        (whole | (bottom & right), lower_right, upper_right, lower_left),
        (~whole & top & right & ~(bottom & right) & ~(top & left), upper_right, upper_left, lower_right),
        (~whole & bottom & left & ~(bottom & right) & ~(top & left), lower_left, lower_right, upper_left),
    )
    return np.concatenate([np.stack([a[there], b[there], c[there]], 1) for there, a, b, c in corners])
