"""Optional parts of synthetic recordings: another scene, a third camera, exact motion, noise, smoke, exposure."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize, validate_recording
from gsplat_core.io.recordings.synthetic.optics import EXPOSURE_STOPS, Lamp
from gsplat_core.io.recordings.synthetic.renderer import cast_tissue, pixel_rays
from gsplat_core.io.recordings.synthetic.scene import Extras, SyntheticScene, View
from gsplat_core.io.recordings.synthetic.synthesize import motion_to, projected, seen_points
from gsplat_core.io.recordings.synthetic.tissue import COLON_LENGTH_MM, COLON_RADIUS_MM, NO_TUG, Colon
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.scene.cameras import Camera

SIZE = {"width_px": 128, "height_px": 96}
COLON = Extras(scene="colon")


@pytest.fixture(scope="module", params=["open", "colon"])
def scene(request) -> SyntheticScene:
    return SyntheticScene.from_seed(3, 128, 96, 2.4, True, Extras(scene=request.param))


def _lookup(plane: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    at = (pixels - 0.5).astype(np.float32)
    return cv2.remap(plane.astype(np.float32), at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0]


def _world(camera: Camera, depth: np.ndarray) -> np.ndarray:
    ray_x, ray_y = pixel_rays(camera)
    local = np.stack([ray_x * depth, ray_y * depth, depth], axis=-1).reshape(-1, 3).astype(np.float64)
    return (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]


def _within(pixels: np.ndarray) -> np.ndarray:
    return (pixels > 1).all(axis=1) & (pixels[:, 0] < 127) & (pixels[:, 1] < 95)


@pytest.mark.parametrize("time_s", [0.0, 1.2])
def test_third_view_depth_agrees_with_first_view(scene: SyntheticScene, time_s: float) -> None:
    first, third = scene.render(time_s), scene.render(time_s, "third")
    cameras = scene.camera_at(time_s), scene.camera_at(time_s, "third")
    assert np.linalg.norm(cameras[1].position - cameras[0].position) > 5
    pixels, z = projected(cameras[1], _world(cameras[0], first.tissue_depth))
    # Linear interpolation is off where depth curves between two pixels: most of all at the tube's end.
    apart = np.abs(_lookup(third.tissue_depth, pixels) - z) / z
    inside = _within(pixels)
    assert inside.mean() > 0.6
    assert np.median(apart[inside]) < 3e-4 and np.quantile(apart[inside], 0.99) < 0.01
    # The same material points are there, too.
    assert np.median(np.abs(_lookup(third.u, pixels) - first.u.ravel())[inside]) < 0.05


@pytest.mark.parametrize("view", ["left", "third"])
def test_ray_into_colon_meets_surface_once(view: View) -> None:
    tube = SyntheticScene.from_seed(3, 128, 96, 4.0, True, COLON)
    for time_s in (0.0, 1.1, 2.6):
        camera = tube.camera_at(time_s, view)
        u, v, points = cast_tissue(tube.tissue, NO_TUG, camera, *pixel_rays(camera), time_s)
        pixels, z = projected(camera, np.stack(points.position, axis=-1).reshape(-1, 3))
        column, row = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
        assert np.abs(pixels - np.stack([column, row], axis=-1).reshape(-1, 2)).max() < 2e-3
        area = np.gradient(u, axis=1) * np.gradient(v, axis=0) - np.gradient(u, axis=0) * np.gradient(v, axis=1)
        assert area.min() > 0.02 * np.median(area)
        assert z.min() < 1.5 * COLON_RADIUS_MM and z.max() > 0.8 * COLON_LENGTH_MM


def test_colon_surface_derivatives_equal_finite_differences() -> None:
    tissue = Colon(np.random.default_rng(1), 1.0)
    u, v = np.meshgrid(np.linspace(-38, 38, 11), np.linspace(-31, 31, 9))
    step = 1e-3
    points = tissue.points(u, v, 0.7, NO_TUG)
    for axis in range(3):
        for along, (du, dv) in ((points.along_u, (step, 0)), (points.along_v, (0, step))):
            ahead, behind = (tissue.points(u + s * du, v + s * dv, 0.7, NO_TUG) for s in (1, -1))
            assert along[axis] == pytest.approx((ahead.position[axis] - behind.position[axis]) / (2 * step), abs=2e-3)


def test_colon_brightness_falls_with_distance() -> None:
    """Brightness falls with the square of the distance and with the cosine: the end of the tube is dark."""
    tube = SyntheticScene.from_seed(0, 128, 96, 2.4, False, COLON)
    eye = tube.render(0.0)
    near, far = eye.tissue_depth < 1.5 * COLON_RADIUS_MM, eye.tissue_depth > 0.7 * COLON_LENGTH_MM
    assert eye.image[near].mean() > 1.8 * eye.image[far].mean()
    assert not eye.tool.any()


def test_lamp_light_falls_with_square_of_distance() -> None:
    lamp = Lamp.of_eye(0.0)
    ahead = np.array([[0, 0, 50.0], [0, 0, 100.0]], np.float32)
    arriving = sum(power for _, power in lamp.rays_to(ahead))
    to_fibre = np.linalg.norm(ahead[:, None] - lamp.fibres[None], axis=-1)
    expected = (0.5 * 66.0**2 / to_fibre**2 * (ahead[:, None, 2] / to_fibre) ** 2).sum(axis=1)
    assert arriving == pytest.approx(expected, rel=1e-5)
    assert arriving[0] / arriving[1] == pytest.approx(4, rel=0.03)
    turned = lamp.seen_from(SyntheticScene.from_seed(0, 48, 40, 1.0, False).left_to("third"))
    assert np.linalg.norm(turned.axis) == pytest.approx(1) and not np.allclose(turned.axis, lamp.axis)


def test_true_flow_maps_material_points_to_next_frame(scene: SyntheticScene) -> None:
    now_s, next_s = 0.9, 0.9 + 1 / 12
    now, then = scene.render(now_s), scene.render(next_s)
    motion = motion_to(scene, now, now_s, next_s)
    assert np.isnan(motion.flow[now.tool]).all() and np.isfinite(motion.flow[~now.tool]).all()
    column, row = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
    tissue = ~now.tool.ravel()
    target = (np.stack([column, row], axis=-1) + motion.flow).reshape(-1, 2)
    inside = tissue & _within(np.nan_to_num(target, nan=-1))
    assert inside.mean() > 0.5 and np.linalg.norm(motion.flow[~now.tool], axis=-1).max() > 0.5
    # The next frame shows the same material point there.
    for plane, own in ((then.u, now.u), (then.v, now.v)):
        assert np.quantile(np.abs(_lookup(plane, target[inside]) - own.ravel()[inside]), 0.99) < 0.1
    # And the scene flow leads to the point that is there.
    moved = _world(scene.camera_at(now_s), now.tissue_depth) + motion.scene_flow.reshape(-1, 3)
    pixels, z = projected(scene.camera_at(next_s), moved[inside])
    assert np.abs(pixels - target[inside]).max() < 0.01
    assert np.quantile(np.abs(_lookup(then.tissue_depth, pixels) - z) / z, 0.99) < 0.01


def test_seen_points_excludes_points_behind_tool() -> None:
    scene = SyntheticScene.from_seed(3, 128, 96, 2.4, False)
    hidden = 0
    for time_s in (0.0, 1.2):
        eye = scene.render(time_s)
        seen = seen_points(scene, eye, time_s)
        pixels, _ = projected(scene.camera_at(time_s), scene.track(time_s))
        column, row = np.floor(pixels.T).astype(int)
        assert not eye.tool[row[seen], column[seen]].any()
        inside = (pixels > 0).all(axis=1) & (pixels < [128, 96]).all(axis=1)
        hidden += int((inside & ~seen).sum())
        assert (inside & ~seen == inside & eye.tool[row.clip(0, 95), column.clip(0, 127)]).all()
    assert hidden > 2


@pytest.fixture(scope="module")
def everything(tmp_path_factory) -> Path:
    extras = Extras(
        third=True, flow=True, tracks=True, smoke=0.5, depth_noise_mm=0.8, exposure_changes=True, scene="colon"
    )
    return synthesize(tmp_path_factory.mktemp("extras") / "all", frames=3, fps=3, seed=5, extras=extras, **SIZE)


@pytest.mark.slow
def test_synthetic_extras_read_back(everything: Path) -> None:
    recording = open_recording(everything)
    assert recording.notes == () and validate_recording(everything).ok
    truth = open_truth(everything, recording.frame_count)
    scene = SyntheticScene.from_seed(5, 128, 96, 1.0, False, Extras(scene="colon", smoke=0.5, exposure_changes=True))
    assert truth.tracks is not None and truth.tracks.points.shape == (3, 63, 3) and truth.tracks.seen.any()
    (view,) = truth.views
    assert view.name == "third" and np.array_equal(view.camera.world_to_camera, scene.left_to("third"))
    for frame in recording:
        third, left = scene.render(frame.seq / 3, "third"), scene.render(frame.seq / 3)
        read = view.read(frame.seq)
        assert np.array_equal(read.image, third.image) and np.array_equal(frame.image, left.image)
        assert read.depth is not None and np.abs(read.depth - third.depth).max() < 0.0051
        true = truth.depth_of(frame)
        assert true is not None and frame.depth is not None and np.abs(true - left.depth).max() < 0.0051
        noise = (frame.depth - true) / (true / 74.0) ** 2
        assert abs(noise.mean()) < 0.05 and noise.std() == pytest.approx(0.8, rel=0.05)
        flow = np.load(everything / "flow" / f"{frame.seq:06d}.npy")
        moved = np.load(everything / "scene_flow" / f"{frame.seq:06d}.npy")
        assert flow.shape == (96, 128, 2) and moved.shape == (96, 128, 3) and flow.dtype == np.float32
    half = open_truth(everything, 3, 0.5).views[0]
    assert half.read(0).image.shape == (48, 64, 3) and half.camera.width_px == 64


def test_evaluation_files_do_not_change_training_data(everything: Path, tmp_path: Path) -> None:
    extras = Extras(smoke=0.5, depth_noise_mm=0.8, exposure_changes=True, scene="colon")
    plain = synthesize(tmp_path / "plain", frames=3, fps=3, seed=5, extras=extras, **SIZE)
    for name in ("images", "images_right", "masks", "depth"):
        for path in (plain / name).iterdir():
            assert path.read_bytes() == (everything / name / path.name).read_bytes()
    assert open_recording(plain).fields == open_recording(everything).fields
    files = {path.name for path in open_recording(everything)._contents.files()}
    assert not files & {"views.json", "tracks.npy", "tracks_seen.npy"}
    assert open_truth(plain, 3).views == () and open_truth(plain, 3).tracks is None


@pytest.mark.slow
def test_smoke_and_exposure_change_only_pictures() -> None:
    clear = SyntheticScene.from_seed(3, 64, 48, 2.0, False)
    smoky = SyntheticScene.from_seed(3, 64, 48, 2.0, False, Extras(smoke=1.0))
    bright = SyntheticScene.from_seed(3, 64, 48, 2.0, False, Extras(exposure_changes=True))
    for other in (smoky, bright):
        assert np.array_equal(other.render(0.0).image, clear.render(0.0).image)  # it comes up later
        assert np.array_equal(other.render(1.2).depth, clear.render(1.2).depth)
        assert np.abs(other.render(1.2).image.astype(int) - clear.render(1.2).image).mean() > 5
    assert smoky.render(1.2).image.std() < 0.7 * clear.render(1.2).image.std()
    assert bright.air is not None
    gains = [bright.air.exposure_at(time_s) for time_s in np.linspace(0, 10, 200)]
    assert 1.3 < max(gains) <= 2 ** sum(EXPOSURE_STOPS) and min(gains) < 0.75


@pytest.mark.slow
def test_synthesize_with_extras_gives_same_bytes(everything: Path, tmp_path: Path) -> None:
    again = synthesize(
        tmp_path / "again",
        frames=3,
        fps=3,
        seed=5,
        extras=Extras(**json.loads((everything / "recording.json").read_text())["made_with"]),
        **SIZE,
    )
    files = [path for path in everything.rglob("*") if path.is_file()]
    assert len(files) == 3 * 10 + 5
    for path in files:
        assert path.read_bytes() == (again / path.relative_to(everything)).read_bytes(), path
    assert synthesize(again, frames=1, fps=3, **SIZE).exists()  # its own work is replaced, with all its folders
    (again / "images" / "thesis").mkdir()
    with pytest.raises(InvalidSetting, match="images/thesis"):
        synthesize(again, frames=1, fps=3, **SIZE)


@pytest.mark.parametrize("wrong", [{"scene": "bladder"}, {"smoke": -1.0}, {"depth_noise_mm": float("nan")}])
def test_extras_refuse_values_out_of_range(wrong: dict) -> None:
    with pytest.raises(InvalidSetting, match=str(next(iter(wrong.values())))):
        Extras(**wrong)
