"""Viewpoints for showing a model (orbit, stereo, path), and marking of tissue that was never seen."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, Model
from gsplat_core.deformation import new_field
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.bundle import save_bundle
from operators.applications.render import ROUND_S, ViewWish, render_model, typical_depth, view_of
from operators.layer_pictures import UNOBSERVED, UNOBSERVED_LINE

CAMERA = Camera.from_focal(60.0, 48, 40)
WINDOW_S = (1.0, 2.0)


def wall(distance: float = 50.0) -> Model:
    """Opaque and grey, most of the picture."""
    x, y = torch.meshgrid(torch.arange(-18.0, 19), torch.arange(-15.0, 16), indexing="xy")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), distance)], 1)
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    scales = torch.zeros(count, 3)
    gaussians = Gaussians(means, quats, scales, torch.full((count,), 6.0), torch.zeros(count, 1, 3))
    return Model(1, gaussians, None, CAMERA, WINDOW_S)


def test_orbit_view_starts_at_recorded_pose_and_keeps_distance():
    model = wall()
    view = view_of(model, CAMERA, ViewWish("orbit"))
    assert typical_depth(model, CAMERA) == pytest.approx(50, abs=0.1)
    places = [view.cameras(1.0 + t)[0] for t in np.linspace(0, ROUND_S, 9)]
    assert np.allclose(places[0].world_to_camera, CAMERA.world_to_camera, atol=1e-9)
    assert np.allclose(places[-1].world_to_camera, CAMERA.world_to_camera, atol=1e-9)
    centre = np.array([0, 0, 50.0])
    for camera in places:
        assert np.linalg.norm(camera.position - centre) == pytest.approx(50, abs=0.1)
        local = camera.world_to_camera[:3, :3] @ centre + camera.world_to_camera[:3, 3]
        assert np.allclose(local[:2], 0, atol=0.1)
    assert max(np.linalg.norm(camera.position) for camera in places) > 15


def moving_wall():
    model = wall()
    return replace(model, field=new_field("basis", model.gaussians, WINDOW_S).detached_copy())


@pytest.mark.parametrize(("baseline", "apart"), [(None, 3.0), (4.4, 4.4)])
def test_stereo_view_baseline_is_along_rotated_camera_x_axis(baseline, apart):
    pose = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    model = wall()
    left, right = view_of(model, CAMERA.with_pose(pose), ViewWish("stereo", baseline)).cameras(1.0)
    moved = right.position - left.position
    assert np.linalg.norm(moved) == pytest.approx(apart, rel=2e-3)
    assert np.allclose(moved / np.linalg.norm(moved), pose[0, :3]), "to the picture's right"


def test_path_view_interpolates_poses_at_picture_size(tmp_path):
    moved = np.eye(4)
    moved[0, 3] = 2.0
    cameras = [
        {"time_s": 1.0, "camera_to_world": np.eye(4).tolist()},
        {"time_s": 1.5, "camera_to_world": moved.tolist()},
    ]
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": cameras}))
    view = view_of(wall(), CAMERA.scaled(0.5), ViewWish(str(file)))
    assert view.window_s == (1.0, 1.5) and view.is_virtual
    (camera,) = view.cameras(1.25)
    assert (camera.width_px, camera.height_px) == (24, 20) and np.allclose(camera.position, [1, 0, 0])
    cameras[1]["time_s"] = 2.5
    file.write_text(json.dumps({"cameras": cameras}))
    with pytest.raises(InvalidSetting, match="the model has seen 1 to 2 s"):
        view_of(moving_wall(), CAMERA, ViewWish(str(file)))
    assert view_of(wall(), CAMERA, ViewWish(str(file))).window_s == (1.0, 2.5), "a static model looks alike at any time"


@pytest.mark.parametrize(
    ("name", "baseline", "said"),
    [
        ("sideways", None, "choose recorded, orbit, stereo, or a camera path"),
        ("orbit", 4.0, "goes with --view stereo"),
        ("stereo", 0.0, "a positive one"),
        ("stereo", float("inf"), "a positive one"),
    ],
)
def test_view_of_refuses_unknown_view_and_invalid_baseline(name, baseline, said):
    with pytest.raises(InvalidSetting, match=said):
        view_of(wall(), CAMERA, ViewWish(name, baseline))


def test_orbit_view_of_empty_model_is_refused():
    model = wall()
    away = Model(1, model.gaussians.select(slice(0, 0)), None, CAMERA, WINDOW_S)
    with pytest.raises(InvalidSetting, match="shows nothing"):
        view_of(away, CAMERA, ViewWish("orbit"))


def test_render_of_orbit_view_hatches_unobserved_pixels(tmp_path):
    save_bundle(wall(), tmp_path / "model")
    assert render_model(tmp_path / "model", tmp_path / "orbit", fps=2, view=ViewWish("orbit")) == 3
    aside = cv2.imread(str(tmp_path / "orbit" / "000001.png"))[..., ::-1]
    marked = np.isin(aside.reshape(-1, 3).tolist(), [UNOBSERVED, UNOBSERVED_LINE]).all(1).reshape(aside.shape[:2])
    assert 0.02 < marked.mean() < 0.6
    assert np.abs(aside[18:22, 22:26].astype(int) - 128).max() <= 2
    assert render_model(tmp_path / "model", tmp_path / "pair.mp4", fps=2, view=ViewWish("stereo", 5.0)) == 3
    video = cv2.VideoCapture(str(tmp_path / "pair.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (96, 40)


def test_typical_depth_ignores_pixels_below_half_alpha():
    from types import SimpleNamespace

    output = SimpleNamespace(
        depth=torch.tensor([[10.0, 20.0, 30.0, -5.0, 900.0]]), alpha=torch.tensor([[0.5, 1.0, 0.8, 1.0, 0.49]])
    )
    model = SimpleNamespace(field=object(), time_window_s=WINDOW_S, render=lambda time_s, camera: output)
    assert typical_depth(model, CAMERA) == 20.0


def test_path_view_must_lie_within_model_time_window(tmp_path):
    def path(first_s, last_s):
        file = tmp_path / "path.json"
        cameras = [{"time_s": time_s, "camera_to_world": np.eye(4).tolist()} for time_s in (first_s, last_s)]
        file.write_text(json.dumps({"cameras": cameras}))
        return ViewWish(str(file))

    view = view_of(moving_wall(), CAMERA, path(*WINDOW_S))
    assert view.window_s == WINDOW_S and view.cameras(1.0)[0].width_px == CAMERA.width_px
    for first_s, last_s in ((0.99, 2.0), (1.0, 2.01)):
        with pytest.raises(InvalidSetting, match="the model has seen 1 to 2 s"):
            view_of(moving_wall(), CAMERA, path(first_s, last_s))


def test_view_wish_inputs_lists_path_file():
    assert ViewWish().inputs == ViewWish("stereo").inputs == () and [p.name for p in ViewWish("a.json").inputs] == [
        "a.json"
    ]
