"""Viewer by pictures: page, rendered pictures, accumulation of samples, refused requests."""

from __future__ import annotations

import contextlib
import http.client
from dataclasses import replace
from urllib.parse import urlencode

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from gsplat_core.models import TrainedBy
from gsplat_core.rendering.renderer import PROGRESSIVE_SAMPLES, Capabilities, FinishedFrame, RendererOptions
from services.cli.app import run
from services.cli.terminal import BAD_INPUT
from services.model_view import Pictures, PictureView, Viewpoint
from tests.services.supervisor.test_model_show import uniform

STILL = {"azimuth": 0, "elevation": 0, "distance": 1, "right": 0, "down": 0, "time": 1, "width": 64, "height": 48}


class Counter:
    """Renderer of grey pictures with samples, for counting accumulated samples."""

    capabilities = Capabilities(
        outputs=("image", "alpha", "depth"),
        precisions={"cpu": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "progressive"),
    )

    def __init__(self, camera, device, *, precision="fp32", background=None, options=None):
        assert options.progressive
        self.camera = camera

    def prepare(self, model):
        self.model = model

    def render(self, camera, time_s, outputs=("image",)):
        return FinishedFrame({"image": torch.full((camera.height_px, camera.width_px, 3), 0.5)})


@pytest.fixture
def counter():
    RENDERERS.add("counter", Counter)
    yield
    RENDERERS.remove("counter")


def served(renderer="alpha", **options):
    model = uniform((0.9, 0.1, 0.1))
    return PictureView(
        Pictures(model, renderer, RendererOptions(**options), "cpu"), model.time_window_s, "127.0.0.1", 0
    )


def get(view, path, host=None):
    with contextlib.closing(http.client.HTTPConnection(*view.address, timeout=300)) as connection:
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def picture(view, **changed):
    status, headers, data = get(view, f"/picture?{urlencode({**STILL, **changed})}")
    assert status == 200 and headers["Content-Type"] == "image/jpeg"
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], headers


def test_picture_view_serves_page_and_pictures_of_requested_size():
    with served() as view:
        status, headers, page = get(view, "/")
        assert status == 200 and b"not a medical device" in page and "text/html" in headers["Content-Type"]
        image, headers = picture(view)
        assert image.shape == (48, 64, 3) and headers["X-Complete"] == "1" and headers["X-Samples"] == "0"
        # The scene is red in the middle. From far away it is small.
        assert image[24, 32, 0] > 150 and image[24, 32, 1] < 80
        far, _ = picture(view, distance=50)
        assert (far[..., 0] > 100).mean() < (image[..., 0] > 100).mean()
        assert picture(view, width=100, height=30)[0].shape == (30, 100, 3)


def test_samples_accumulate_while_camera_is_still(counter):
    with served("counter", samples=3) as view:
        drawn = [picture(view, **changed)[1]["X-Samples"] for changed in ({}, {}, {"azimuth": 5}, {"azimuth": 5}, {})]
        assert drawn == ["3", "6", "3", "6", "3"]
    with served("counter", samples=PROGRESSIVE_SAMPLES) as view:
        assert picture(view)[1]["X-Complete"] == "1"


def test_viewpoint_camera_orbits_around_pivot():
    model = uniform((0.5, 0.5, 0.5))
    start = model.camera
    still = Viewpoint(0, 0, 1, 0, 0, 0, start.width_px, start.height_px)
    assert np.allclose(still.camera(start, 40.0).world_to_camera, start.world_to_camera)
    turned = Viewpoint(90, 0, 2, 0, 0, 0, 64, 48).camera(start, 40.0)
    # After a quarter turn at twice the distance, the pivot is 80 ahead.
    pivot = np.linalg.inv(start.world_to_camera) @ [0, 0, 40, 1]
    assert np.allclose(turned.world_to_camera @ pivot, [0, 0, 80, 1])
    assert np.allclose(abs(turned.world_to_camera[2, :3] @ start.world_to_camera[2, :3]), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/nothing", 404),
        ("/picture", 400),
        (f"/picture?{urlencode({**STILL, 'width': 1e9})}", 400),
        (f"/picture?{urlencode({**STILL, 'distance': 0})}", 400),
        (f"/picture?{urlencode({**STILL, 'azimuth': 'nan'})}", 400),
        (f"/picture?{urlencode({**STILL, 'depth': 1})}", 400),
        (f"/picture?{urlencode({**STILL, 'azimuth': 'x'})}", 400),
    ],
)
def test_picture_view_refuses_malformed_requests(path, status):
    with served() as view:
        assert get(view, path)[0] == status


def test_picture_view_refuses_unknown_host_header():
    with served() as view:
        assert get(view, "/", host="attacker.example:80")[0] == 403
        assert get(view, "/", host="localhost:1")[0] == 200


def test_pictures_raise_for_renderer_incompatible_with_model():
    model = replace(uniform((0.5, 0.5, 0.5)), trained_by=TrainedBy("weighted_sum"))
    with pytest.raises(InvalidSetting, match="choose renderer 'weighted_sum'"):
        Pictures(model, "alpha", RendererOptions(), "cpu")


def test_picture_view_raises_for_taken_port():
    with served() as view, pytest.raises(InvalidSetting, match="choose another --port"):
        model = uniform((0.5, 0.5, 0.5))
        PictureView(Pictures(model, "alpha", RendererOptions(), "cpu"), model.time_window_s, *view.address)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--samples", "4"], "give --renderer with its options"),
        (["--renderer", "none"], "renderer is 'none'; choose alpha"),
        (["--renderer", "alpha", "--samples", "4"], "no option samples"),
    ],
)
def test_view_prints_error_for_invalid_renderer_options(tmp_path, capsys, words, reason):
    assert run(["view", str(tmp_path / "scene.ply"), *words]) == BAD_INPUT
    assert reason in capsys.readouterr().err
