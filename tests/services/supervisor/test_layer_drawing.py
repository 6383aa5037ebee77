"""Depth, confidence and virtual-view layers of a known scene: a red wall far away, a green post in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.models import Model, SnapshotSlots
from gsplat_core.scene.cameras import Orbit
from operators.display import COVERED
from operators.layer_pictures import UNOBSERVED, UNOBSERVED_LINE, DepthColours
from operators.messages import PictureState
from operators.rasterize import displayed
from services.supervisor.screen import LayerDrawing, LayerScene, label
from tests.services.supervisor.test_model_show import uniform

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)


def wall_and_post(unseen: bool = False) -> Model:
    """Return a model of a wall, whose left half is covered by a post at half the distance."""
    wall, post = uniform(RED), uniform(GREEN).gaussians
    left = post.select(post.means[:, 0] < -0.3)
    near = replace(left, means=left.means * 0.5, log_scales=left.log_scales - 0.7)
    both = wall.gaussians.append(near)
    unseen_s = torch.zeros(both.count, dtype=torch.float64)
    unseen_s[wall.gaussians.count :] = 20.0
    return Model(3, both, None, wall.camera.scaled(5), wall.time_window_s, unseen_s=unseen_s if unseen else None)


def drawn(layer, model, orbit=Orbit(), **options):
    drawing = LayerDrawing("cpu")
    drawing.orbit = orbit
    return drawing.draw(layer, LayerScene(model, model.camera, 1.0, {"state": "live"}, **options))


def test_depth_layer_is_warmer_near_and_legend_has_depth_range():
    image, said = drawn("depth", wall_and_post(), metric=True)
    left, right = image[60, 30].astype(int), image[60, 130].astype(int)
    assert left[0] > left[2] and right[2] > right[0] - 20
    assert said["legend"]["unit"] == "mm"
    assert said["legend"]["low"] == pytest.approx(2, abs=0.4) and said["legend"]["high"] == pytest.approx(4, abs=0.4)


def test_depth_layer_uses_given_planes_without_rendering(monkeypatch):
    monkeypatch.setattr("services.supervisor.screen.render", None)
    model = wall_and_post()
    plane = np.full((120, 160), 7.0, np.float32)
    _, said = drawn("depth", model, planes=(plane, np.ones_like(plane)))
    assert said["legend"]["unit"] == "relative" and said["legend"]["low"] < 1 < said["legend"]["high"]


def test_confidence_layer_darkens_with_time_unseen():
    image, said = drawn("confidence", wall_and_post(unseen=True))
    assert "time" in said["legend"]["counts"]
    certain, _ = drawn("confidence", wall_and_post())
    right, left = (60, 130), (60, 30)
    assert np.abs(image[right].astype(int) - certain[right]).max() < 5
    assert image[left].astype(int).sum() < certain[left].astype(int).sum() - 100


def test_orbit_layer_renders_turned_camera_and_marks_unobserved():
    model = wall_and_post()
    orbit, depths = Orbit(-40, 10, 1.2), DepthColours()
    plain = model.render(1.0)
    depths.adapt_range(plain.depth.numpy(), plain.alpha.numpy())
    expected = model.render(1.0, orbit.camera(model.camera, depths.median))
    image, said = drawn("orbit", model, orbit)
    assert said["virtual"] == {"azimuth_deg": -40, "elevation_deg": 10, "zoom": 1.2}
    shown = expected.alpha.numpy() >= COVERED
    assert said["unobserved_share"] == pytest.approx(1 - shown.mean(), abs=1e-3) and 0 < shown.mean() < 1
    inside = np.s_[4:-20, 4:-4]
    seen = shown[inside]
    np.testing.assert_array_equal(image[inside][seen], displayed(expected.image)[inside][seen])
    assert {tuple(colour) for colour in image[inside][~seen].tolist()} <= {UNOBSERVED, UNOBSERVED_LINE}
    straight, _ = drawn("orbit", model)
    assert np.abs(image.astype(int) - straight).mean() > 10


def test_orbit_layer_desaturates_tissue_out_of_view():
    image, _ = drawn("orbit", wall_and_post(unseen=True))
    left, right = image[60, 30].astype(int), image[60, 130].astype(int)
    assert np.ptp(left) <= 2 and np.ptp(right) > 100


def test_label_of_orbit_layer_is_empty_for_live_state():
    image = np.zeros((200, 300, 3), np.uint8)
    label(image, "orbit", PictureState.LIVE, 10)
    assert not image.any()
    label(image, "orbit", PictureState.STALE, 10)
    assert image.any()
    depth = np.zeros((200, 300, 3), np.uint8)
    label(depth, "depth", PictureState.LIVE, 10)
    assert depth.any()


@pytest.mark.parametrize("layer", ["depth", "confidence", "orbit"])
def test_layers_of_snapshot_match_layers_of_its_model(layer, device):
    model = wall_and_post(unseen=True)
    here = model.to(device)
    snapshot = SnapshotSlots(device).publish(
        here.gaussians, None, version=3, camera=model.camera, time_window_s=model.time_window_s, unseen_s=here.unseen_s
    )
    drawing, scene = LayerDrawing(device.type), LayerScene(snapshot, model.camera, 1.0, {"state": "live"})
    drawing.orbit = Orbit(20, -10)
    image, said = drawing.draw(layer, scene)
    expected, drawn_layer = drawn(layer, model, Orbit(20, -10))
    assert said.keys() == drawn_layer.keys()
    away = np.abs(image.astype(int) - expected)
    palette_step = {"depth": 9}.get(layer, 3)
    """Depth is coloured in 256 steps, up to 8 levels of a channel apart: another device's rounding may fall on either side of one."""
    assert (away > palette_step).mean() < 0.01, "beside the borders of what is marked"
