"""Meshes of depth maps and models: what is joined, which way triangles face, and how far vertices are from a surface that is known."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core import Camera, Model
from gsplat_core.errors import ExportError
from gsplat_core.geometry.mesh import mesh_of, mesh_of_depth, vertex_normals
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.training.initialisation import gaussians_from_frame

CAMERA = Camera.from_focal(50.0, 20, 14)


def picture(camera: Camera = CAMERA) -> np.ndarray:
    return (
        np.arange(camera.height_px * camera.width_px * 3).reshape(camera.height_px, camera.width_px, 3).astype(np.uint8)
    )


def test_mesh_of_depth_has_two_camera_facing_triangles_per_square():
    mesh = mesh_of_depth(np.full((14, 20), 40.0, np.float32), picture(), CAMERA)
    assert len(mesh.vertices) == 280 and len(mesh.triangles) == 2 * 13 * 19
    assert np.allclose(mesh.normals, [0, 0, -1]) and np.allclose(mesh.vertices[:, 2], 40)
    assert np.array_equal(mesh.colours, picture().reshape(-1, 3))
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all(), "counter-clockwise for the camera"
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(13 * 19 * (40 / 50) ** 2, rel=1e-5), "every square once"


def test_mesh_of_depth_cuts_at_depth_steps_and_holes():
    depth = np.full((14, 20), 40.0, np.float32)
    depth[:, 10:] = 30.0
    depth[5, 4] = 0.0
    mesh = mesh_of_depth(depth, picture(), CAMERA)
    z = mesh.vertices[:, 2][mesh.triangles]
    assert (np.ptp(z, axis=1) < 1e-3).all()
    # Around the hole four squares lose the corner that it is: each keeps one triangle.
    assert len(mesh.triangles) == 2 * 13 * 18 - 4 and len(mesh.vertices) == 279


def test_mesh_of_depth_applies_camera_pose():
    pose = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 7], [0, 0, 0, 1]])
    depth = np.linspace(30, 36, 280, dtype=np.float32).reshape(14, 20)
    here, there = (mesh_of_depth(depth, picture(), camera) for camera in (CAMERA, CAMERA.with_pose(pose)))
    assert np.allclose(there.vertices @ pose[:3, :3].T + pose[:3, 3], here.vertices, atol=1e-4)
    assert np.allclose(there.normals @ pose[:3, :3].T, here.normals, atol=1e-5)
    assert np.array_equal(here.triangles, there.triangles)


def test_mesh_of_depth_without_surface_is_refused():
    for depth in (np.zeros((14, 20), np.float32), np.full((14, 20), np.nan, np.float32)):
        with pytest.raises(ExportError, match="no surface"):
            mesh_of_depth(depth, picture(), CAMERA)
    checker = np.where(np.indices((14, 20)).sum(0) % 2, 40, 0).astype(np.float32)
    with pytest.raises(ExportError, match="no surface"):
        mesh_of_depth(checker, picture(), CAMERA)


def test_vertex_normals_are_weighted_by_area():
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1], [9, 9, 9]], float)
    normals = vertex_normals(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    assert np.allclose(normals[0], np.array([3, 0, 9]) / np.hypot(3, 9)) and not normals[4].any()


def test_mesh_of_model_lies_on_tissue():
    recording = render_recording(RenderSettings(frames=1, width_px=96, height_px=80, seed=4))
    frame = next(iter(recording))
    frame = frame.with_fields(mask=np.ones_like(frame.mask))
    gaussians = gaussians_from_frame(frame, recording.camera, 4000, sh_degree=0, default_depth_mm=60.0)
    mesh = mesh_of(Model(1, gaussians, None, recording.camera, (0.0, 1.0)), 0.0)
    local = mesh.vertices
    pixels = local[:, :2] / local[:, 2:] * recording.camera.K[0, 0] + recording.camera.K[:2, 2]
    true = frame.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    assert len(local) > 0.95 * 96 * 80
    assert np.median(np.abs(local[:, 2] - true) / true) < 0.004
