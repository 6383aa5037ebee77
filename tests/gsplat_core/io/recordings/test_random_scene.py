"""Recordings of random scenes: determinism, fixed properties, truth of distorted and partly dark pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize, validate_recording
from gsplat_core.io.recordings.synthetic.optics import Field, RadialLens
from gsplat_core.io.recordings.synthetic.random_scene import draw_scene
from gsplat_core.io.recordings.synthetic.scene import Extras, SyntheticScene
from gsplat_core.io.recordings.synthetic.synthesize import projected

SMALL = {"frames": 2, "width_px": 48, "height_px": 40, "fps": 2}


def test_draw_scene_fixed_property_keeps_other_draws() -> None:
    free = draw_scene(3)
    fixed = draw_scene(3, moving=not free.moving, smoke=0.7, breathing_ratio=2.5)
    assert (fixed.moving, fixed.smoke, fixed.breathing.ratio) == (not free.moving, 0.7, 2.5)
    assert (fixed.appearance, fixed.shape, fixed.tools, fixed.lamp) == (
        free.appearance,
        free.shape,
        free.tools,
        free.lamp,
    )
    assert draw_scene(3) == free


def test_draw_scene_covers_value_ranges() -> None:
    scenes = [draw_scene(seed) for seed in range(200)]
    focal = [scene.focal for scene in scenes]
    assert min(focal) < 0.55 and max(focal) > 1.15 and all(0.5 <= each <= 1.2 for each in focal)
    assert len({scene.organ for scene in scenes}) == 8
    assert {scene.path.kind for scene in scenes if scene.path} == {
        "hand-held",
        "translation",
        "rotation",
        "insertion",
    }
    assert not any(scene.stereo and any(scene.lens) for scene in scenes)


@pytest.mark.slow
def test_random_scene_of_same_seed_gives_same_bytes(tmp_path: Path) -> None:
    folders = [synthesize(tmp_path / name, drawn=draw_scene(seed), **SMALL) for name, seed in (("a", 1), ("b", 1))]
    first, second = (
        {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in folders
    )
    assert first == second
    assert json.loads(first["recording.json"])["random"]["organ"] == draw_scene(1).organ


def test_random_scene_lens_distortion_is_removed_when_read(tmp_path: Path) -> None:
    drawn = replace(draw_scene(4, moving=True, stereo=False, distorted=True), lens=(-0.12, 0.01))
    drawn = replace(drawn, sensor=replace(drawn.sensor, field=Field()))
    recording = open_recording(synthesize(tmp_path / "x", drawn=drawn, **SMALL))
    assert validate_recording(tmp_path / "x").ok
    frame = next(iter(recording))
    scene = SyntheticScene.from_seed(4, 48, 40, 1.0, True, drawn=drawn)
    assert scene.lens is not None and recording.camera.K[0, 0] != scene.camera.K[0, 0]
    # The ideal camera of the reader sees the same tissue as a pinhole that is rendered with it.
    pinhole = replace(scene, camera=recording.camera, lens=None)
    expected = pinhole.render(0.0).tissue_depth
    assert frame.depth is not None and frame.mask is not None
    seen = (frame.mask > 0) & (frame.depth > 0)
    assert np.median(np.abs(frame.depth - expected)[seen] / expected[seen]) < 0.005


def test_radial_lens_equals_opencv() -> None:
    camera = SyntheticScene.from_seed(0, 48, 40, 1.0, False, drawn=draw_scene(0)).camera
    lens = RadialLens.from_corner(camera, -0.1, 0.02)
    x, y = lens.rays(camera)
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float64)
    pixels, _ = projected(camera, points, lens)
    K = camera.K.copy()
    peer = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens.coefficients))[0].reshape(-1, 2)
    np.testing.assert_allclose(pixels, peer, atol=1e-6)
    rows, columns = np.mgrid[:40, :48] + 0.5
    np.testing.assert_allclose(pixels, np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-3)


def test_random_scene_has_no_depth_or_tissue_outside_field_of_view(tmp_path: Path) -> None:
    drawn = draw_scene(5, stereo=False, distorted=False)
    drawn = replace(drawn, sensor=replace(drawn.sensor, field=Field("circle", 0.4)))
    frame = next(iter(open_recording(synthesize(tmp_path / "x", drawn=drawn, **SMALL))))
    inside = drawn.sensor.field.mask(48, 40)
    assert frame.depth is not None and frame.mask is not None
    assert 0.4 < inside.mean() < 0.75
    assert (frame.depth[~inside] == 0).all() and (frame.depth[inside] > 0).all()
    assert not frame.mask[~inside].any()


def test_synthesize_refuses_flow_of_distorted_lens(tmp_path: Path) -> None:
    drawn = draw_scene(2, stereo=False, distorted=True)
    with pytest.raises(InvalidSetting, match="distorted lens"):
        synthesize(tmp_path / "x", drawn=drawn, extras=Extras(flow=True), **SMALL)
    with pytest.raises(InvalidSetting, match="scope_path must be"):
        draw_scene(0, scope_path="spiral")
