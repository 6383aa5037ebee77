"""Coloured triangle meshes of a model's surface at one time, made from a depth map and cut at occlusion edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import ExportError
from gsplat_core.geometry.surface import in_world, joined, points_of
from gsplat_core.models.model import Model
from gsplat_core.rendering.surface import COVERED
from gsplat_core.scene.cameras import Camera
from gsplat_core.transfers import HostCopy

LEAST_OPACITY = 0.5
"""Least opacity of a pixel that becomes part of the mesh, stricter than `COVERED`."""
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


def mesh_of(model: Model, time_s: float, camera: Camera | None = None) -> Mesh:
    """Mesh the surface that a camera sees at a time, with one vertex per pixel that shows tissue.

    Args:
        model: model to export.
        time_s: time in seconds.
        camera: viewpoint; None for the model's own camera.

    Returns:
        The mesh in world coordinates.

    Raises:
        ExportError: if no surface is visible.
    """
    camera = camera or model.camera
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
