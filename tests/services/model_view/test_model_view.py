"""The model viewer with a stand-in for viser's server: time slider, playback, axes and camera."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gsplat_core.models import Model
from services import model_view
from services.model_view import DISTANCE, ModelView, rotation_matrices, scene_to_view
from tests.gsplat_core.io.exports.test_exports import random_model


class Control(SimpleNamespace):
    """Slider or checkbox with its options."""


class Server:
    """Records the controls and splats of the viewer."""

    def __init__(self, **options: Any) -> None:
        self.options, self.stopped, self.shown, self.texts = options, False, [], []
        self.theme: dict[str, Any] = {}
        self.gui = SimpleNamespace(
            configure_theme=self.theme.update,
            add_markdown=self.texts.append,
            add_slider=lambda label, **given: Control(value=given["initial_value"], **given),
            add_checkbox=lambda label, **given: Control(value=given["initial_value"], **given),
        )
        self.scene = SimpleNamespace(
            set_up_direction=lambda up: setattr(self, "up", up),
            add_gaussian_splats=lambda name, **splats: self.shown.append((name, splats)),
        )

    def get_port(self) -> int:
        return 18081

    def on_client_connect(self, call: Any) -> None:
        self.on_connect = call

    def atomic(self) -> Any:
        return nullcontext()

    def stop(self) -> None:
        self.stopped = True


@pytest.fixture(autouse=True)
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_view, "viser", lambda: SimpleNamespace(ViserServer=Server))


def model_of(field: bool, window_s: tuple[float, float] = (1.0, 3.0)) -> Model:
    return replace(random_model(field=field), time_window_s=window_s)


def test_rotation_matrices_match_rodrigues(rng: np.random.Generator) -> None:
    axes, angles = rng.normal(size=(20, 3)), rng.uniform(-3, 3, 20)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    quats = np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axes], 1)
    expected = [cv2.Rodrigues(angle * axis)[0] for angle, axis in zip(angles, axes, strict=True)]
    np.testing.assert_allclose(rotation_matrices(quats.astype(np.float32)), expected, atol=1e-5)


def test_scene_to_view_scales_median_depth_to_distance() -> None:
    model = model_of(field=False)
    pose = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 60], [0, 0, 0, 1]])
    rotation, offset, scale = scene_to_view(replace(model, camera=model.camera.with_pose(pose)))
    depths = model.gaussians.means.double().numpy()[:, 2] + 60
    assert scale * np.median(depths[depths > 0]) == pytest.approx(DISTANCE)
    np.testing.assert_array_equal(rotation, pose[:3, :3])
    np.testing.assert_array_equal(offset, pose[:3, 3])
    pose[2, 3] = -1e6  # everything is behind the camera
    assert scene_to_view(replace(model, camera=model.camera.with_pose(pose)))[2] == 1


@pytest.mark.parametrize(("field", "window_s", "moves"), [(True, (1.0, 3.0), True), (True, (2.0, 2.0), False), (False, (1.0, 3.0), False)])  # fmt: skip
def test_time_slider_is_enabled_only_for_moving_model(field: bool, window_s: tuple[float, float], moves: bool) -> None:
    with ModelView(model_of(field, window_s), "127.0.0.1", 5) as view:
        server, slider = view._server, view._time
        assert view.address == ("127.0.0.1", 18081) and server.options["port"] == 5
        assert slider.disabled == view._play.disabled == (not moves)
        assert slider.min == window_s[0] and slider.step > 0 and slider.min < slider.max
        if moves:
            assert (slider.max, slider.value) == (3.0, 3.0) and slider.step == pytest.approx(0.01)
        assert len(server.shown) == 1 and server.shown[0][0] == "/model"
        assert any("not a medical device" in text for text in server.texts)
        assert server.theme["show_share_button"] is False and server.up == "-y" and not server.stopped
    assert server.stopped


def test_browser_starts_at_endoscope_camera() -> None:
    view = ModelView(model_of(field=False), "127.0.0.1", 0)
    client = SimpleNamespace(camera=SimpleNamespace())
    view._server.on_connect(client)
    camera = view._model.camera
    assert client.camera.position == (0, 0, 0) and client.camera.look_at[2] > 0 > client.camera.up_direction[1]
    assert np.tan(client.camera.fov / 2) * camera.K[1, 1] == pytest.approx(camera.height_px / 2)


def test_splats_are_transformed_to_view_axes_and_scale() -> None:
    model = model_of(field=True)
    view = ModelView(model, "127.0.0.1", 0)
    now, (rotation, offset, scale) = model.at(1.5), view._place
    splats = view._splats(1.5)
    np.testing.assert_allclose(
        splats["centers"], scale * (now.means.numpy() @ rotation.T + offset), rtol=1e-4, atol=1e-3
    )
    sizes = np.linalg.eigvalsh(splats["covariances"].astype(np.float64))
    np.testing.assert_allclose(
        sizes, np.sort((scale * now.log_scales.exp().numpy()) ** 2, 1), rtol=1e-2, atol=1e-4 * sizes.max()
    )
    np.testing.assert_allclose(splats["opacities"][:, 0], now.opacities.numpy(), rtol=1e-5)
    assert splats["rgbs"].min() >= 0 and splats["rgbs"].max() <= 1


def test_run_plays_time_window_in_loop_and_draws_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    view = ModelView(model_of(field=True), "127.0.0.1", 0)
    clock, drawn, rounds = iter([10.0, 10.0, 10.5, 11.25, 12.0, 12.0, 20.0]), [], []
    monkeypatch.setattr(model_view.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(model_view.threading, "Event", lambda: SimpleNamespace(wait=lambda seconds: None))
    monkeypatch.setattr(view, "_show", lambda time_s, splats: (drawn.append(time_s), setattr(view, "_drawn_s", time_s)))

    def stop_requested() -> bool:
        rounds.append(None)
        view._play.value = len(rounds) in (2, 3, 4)
        if len(rounds) == 5:
            view._time.value = 2.0  # moved by hand
        return len(rounds) > 6

    view.run(stop_requested)
    # 3.0 is the end of the window from 1 s to 3 s, so that playback continues at its start.
    assert drawn == pytest.approx([1.5, 2.25, 1.0, 2.0])
