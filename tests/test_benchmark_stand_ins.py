"""Replacements for packages of gsplat's example trainer behave as the packages."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from benchmarks.gsplat import stand_ins
from benchmarks.gsplat.colmap_scene import cameras, write_sparse


@dataclass
class Strategy:
    cap_max: int = 10
    verbose: bool = True


@dataclass
class Config:
    data_dir: str = "data"
    steps_scaler: float = 1.0
    save_steps: list[int] = field(default_factory=lambda: [7])
    disable_viewer: bool = False
    ckpt: str | None = None
    strategy: Strategy = field(default_factory=Strategy)


def configured(monkeypatch, *words):
    monkeypatch.setattr("sys.argv", ["simple_trainer.py", "mcmc", *words])
    return stand_ins.config_of_command_line({"mcmc": ("", Config())})


def test_arguments_get_the_types_of_the_fields(monkeypatch):
    found = configured(
        monkeypatch, "--disable_viewer", "--data-dir", "scene", "--steps_scaler", "0.2", "--save_steps", "1", "2",
        "--strategy.cap-max", "30", "--strategy.no-verbose", "--ckpt", "c.pt",
    )  # fmt: skip
    assert found == Config("scene", 0.2, [1, 2], True, "c.pt", Strategy(30, False))


def test_an_unknown_argument_is_refused(monkeypatch):
    with pytest.raises(AttributeError, match="gone"):
        configured(monkeypatch, "--gone", "1")


def test_a_reconstruction_has_the_written_cameras_and_points(tmp_path):
    posed = [(f"{number}.png", camera) for number, camera in enumerate(cameras(3, 16, 12))]
    positions = np.random.default_rng(0).normal(0, 0.3, (5, 3))
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    write_sparse(tmp_path / "sparse/0", posed, positions, colors)
    found = stand_ins.Reconstruction(f"{tmp_path}/sparse/0/")
    assert [image.name for image in found.images.values()] == [name for name, _ in posed]
    for image, (_, camera) in zip(found.images.values(), posed, strict=True):
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera.world_to_camera[:3], atol=1e-6)
    assert list(found.cameras) == [1]
    np.testing.assert_allclose(found.cameras[1].calibration_matrix(), posed[0][1].K)
    np.testing.assert_allclose([point.xyz for point in found.points3D.values()], positions)
    np.testing.assert_array_equal([point.color for point in found.points3D.values()], colors)


def test_neighbours_are_nearest_first():
    points = np.float32([[0, 0, 0], [3, 0, 0], [1, 0, 0]])
    distances, indices = stand_ins.Neighbours(n_neighbors=2).fit(points).kneighbors(points)
    np.testing.assert_allclose(distances, [[0, 1], [0, 2], [0, 1]])
    np.testing.assert_array_equal(indices, [[0, 2], [1, 2], [2, 0]])
