"""`intrasplat bench`: rendering along a path, measurements, video output, invalid options."""

from __future__ import annotations

import json
from typing import ClassVar

import av
import numpy as np
import pytest
import torch

from gsplat_core import Camera
from gsplat_core.choices import RENDERERS
from gsplat_core.io.ply import save_ply
from gsplat_core.rendering.renderer import Capabilities, FinishedFrame
from gsplat_core.scene.gaussians import Gaussians
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK


class Recorder:
    """Renderer of black pictures that keeps its arguments."""

    capabilities = Capabilities(
        outputs=("image", "alpha", "depth"),
        precisions={"cpu": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "supersampling", "order"),
    )
    made: ClassVar[list] = []

    def __init__(self, camera, device, *, precision="fp32", background=None, options=None):
        self.camera, self.options, self.frames = camera, options, []
        self.made.append(self)

    def prepare(self, model):
        self.model = model

    def render(self, camera, time_s, outputs=("image",)):
        self.frames.append((camera, time_s))
        size = camera.height_px, camera.width_px
        return FinishedFrame({"image": torch.full((*size, 3), 0.5), "alpha": torch.ones(size)})


@pytest.fixture
def recorder(monkeypatch):
    monkeypatch.setattr(Recorder, "made", [])
    RENDERERS.add("recorder", Recorder)
    yield Recorder
    RENDERERS.remove("recorder")


@pytest.fixture
def scene(tmp_path):
    generator = torch.Generator().manual_seed(0)
    count = 50
    save_ply(
        Gaussians(
            torch.randn(count, 3, generator=generator),
            torch.randn(count, 4, generator=generator),
            torch.full((count, 3), -2.0),
            torch.full((count,), 2.0),
            torch.rand(count, 1, 3, generator=generator),
        ),
        tmp_path / "scene.ply",
    )
    return tmp_path / "scene.ply"


def path_of(tmp_path, count=5):
    """Write a path of cameras moving along x, 10 s apart, which exceeds the time window of a scene file."""
    cameras = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, 3] = k, 0, -4
        cameras.append({"time_s": 10.0 * k, "camera_to_world": pose.tolist()})
    (tmp_path / "path.json").write_text(json.dumps({"cameras": cameras}))
    return tmp_path / "path.json"


def test_bench_renders_and_measures_every_camera_of_path(scene, tmp_path, recorder, capsys):
    words = [
        "bench",
        str(scene),
        "--renderer",
        "recorder",
        "--samples",
        "3",
        "--supersampling",
        "2",
        "--order",
        "pixel",
    ]
    words += ["--path", str(path_of(tmp_path)), "--frames", "5", "--width", "64", "--height", "32", "--json"]
    assert run([*words, "--out", str(tmp_path / "v.mp4")]) == OK
    said = json.loads(capsys.readouterr().out)
    (made,) = recorder.made
    assert (made.options.samples, made.options.supersampling, made.options.order) == (3, 2, "pixel")
    measured = made.frames[-5:]
    assert [round(float(camera.position[0]), 6) for camera, _ in measured] == [0, 1, 2, 3, 4]
    assert {(camera.width_px, camera.height_px) for camera, _ in made.frames} == {(64, 32)}
    assert said["frames"] == 5 and said["gaussians"] == 50 and said["renderer"] == "recorder"
    assert said["fps_p50"] == pytest.approx(1e3 / said["frame_ms_p50"]) and said["frame_ms_p50"] <= said["frame_ms_p99"]
    assert said["parameter_bytes"] == 50 * 14 * 4 and said["host_peak_bytes"] > said["parameter_bytes"]
    with av.open(str(tmp_path / "v.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 5


def test_render_uses_path_and_renderer_options(scene, tmp_path, recorder, capsys):
    words = ["render", str(scene), "--renderer", "recorder", "--samples", "3", "--fps", "0.1"]
    words += ["--path", str(path_of(tmp_path)), "--scale", "0.1", "--out", str(tmp_path / "out")]
    assert run([*words, "--view", "orbit"]) == BAD_INPUT
    assert "give one of them" in capsys.readouterr().err
    assert run(words) == OK
    assert recorder.made[-1].options.samples == 3
    assert [round(float(camera.position[0]), 6) for camera, _ in recorder.made[-1].frames] == [0, 1, 2, 3, 4]


def test_bench_without_path_succeeds(scene, capsys):
    assert run(["bench", str(scene), "--frames", "2", "--width", "40", "--height", "32"]) == OK
    assert "frames/s" in capsys.readouterr().out


def test_camera_fitted_keeps_vertical_field_of_view():
    camera = Camera(np.array([[100.0, 0, 30], [0, 120, 25], [0, 0, 1]]), 64, 48)
    wide = camera.fitted(192, 96)
    assert wide.K.tolist() == [[200, 0, 92], [0, 240, 50], [0, 0, 1]] and (wide.width_px, wide.height_px) == (192, 96)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--width", "64"], "only one of width and height"),
        (["--frames", "0"], "frames is 0"),
        (["--width", "0", "--height", "0"], "width is 0"),
        (["--width", "90000", "--height", "2"], "on a side"),
        (["--renderer", "none"], "renderer is 'none'; choose alpha"),
        (["--samples", "0"], "samples is 0; it must be from 1"),
        (["--samples", "4"], "'alpha' has no option samples"),
        (["--order", "none"], "order is 'none'; choose splat or pixel"),
        (["--path", "nothing.json"], "nothing.json"),
        (["--path", "nothing.txt"], "nothing.txt"),
        (["--out", "video.avi"], "does not end in .mp4"),
    ],
)
def test_bench_prints_one_error_line_for_invalid_option(scene, capsys, words, reason):
    assert run(["bench", str(scene), *words]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and reason in said and said.count("\n") == 1


def test_bench_does_not_overwrite_foreign_video(scene, tmp_path, capsys):
    (tmp_path / "v.mp4").write_bytes(b"mine")
    assert run(["bench", str(scene), "--out", str(tmp_path / "v.mp4"), "--overwrite"]) != OK
    assert (tmp_path / "v.mp4").read_bytes() == b"mine"
