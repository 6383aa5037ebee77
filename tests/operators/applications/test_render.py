"""Rendering a finished model: how many frames, where, and what is refused."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidSetting, RecordingError
from gsplat_core.io.bundle import save_bundle
from gsplat_core.rendering.renderer import RendererOptions
from operators.applications import render
from operators.applications.render import render_model, render_picture, write_video
from operators.errors import DeviceMissing, OutputError, OutputFolderInUse


@pytest.fixture
def bundle(model, tmp_path):
    save_bundle(model(), tmp_path / "model")
    return tmp_path / "model"


def test_render_model_covers_whole_time_window(bundle, tmp_path):
    events = []
    assert render_model(bundle, tmp_path / "images", fps=4, progress=events.append) == 5, "0, 0.25, 0.5, 0.75 and 1 s"
    assert len(list((tmp_path / "images").glob("*.png"))) == 5
    assert [event.done for event in events] == [1, 2, 3, 4, 5]


def test_render_model_keeps_complete_frames_on_stop_request(bundle, tmp_path):
    shown = []
    written = render_model(
        bundle, tmp_path / "v.mp4", fps=10, progress=shown.append, stop_requested=lambda: len(shown) == 3
    )
    assert written == 3 and (tmp_path / "v.mp4").stat().st_size > 0


def test_render_model_places_outputs_side_by_side(bundle, model, tmp_path):
    camera = model().camera
    render_model(bundle, tmp_path / "images", fps=1, outputs=("image", "normals", "ray_depth"))
    shown = cv2.imread(str(tmp_path / "images" / "000000.png"))
    assert shown.shape == (camera.height_px, 3 * camera.width_px, 3)
    render_model(bundle, tmp_path / "plain", fps=1)
    assert (shown[:, : camera.width_px] == cv2.imread(str(tmp_path / "plain" / "000000.png"))).all()


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"outputs": ()}, "outputs is none"),
        ({"outputs": ("depth", "depth")}, "each once"),
        ({"outputs": ("normals",), "renderer": "points"}, "choose renderer alpha"),
        ({"outputs": ("semantics",)}, "train with --losses semantics"),
    ],
)
def test_render_model_refuses_unavailable_outputs(bundle, tmp_path, wanted, message):
    with pytest.raises(InvalidSetting, match=message):
        render_model(bundle, tmp_path / "images", **wanted)
    assert not (tmp_path / "images").exists()


@pytest.mark.cuda
def test_render_model_on_cuda_matches_cpu(gpu, bundle, tmp_path):
    for device in ("cpu", "cuda"):
        assert render_model(bundle, tmp_path / device, fps=4, device=device) == 5
    for name in (path.name for path in (tmp_path / "cpu").glob("*.png")):
        expected, seen = (cv2.imread(str(tmp_path / device / name)).astype(int) for device in ("cpu", "cuda"))
        assert np.abs(seen - expected).max() <= 1


def test_render_model_refuses_missing_device_before_output(bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceMissing, match="finds no GPU"):
        render_model(bundle, tmp_path / "images", device="cuda")
    assert not (tmp_path / "images").exists()


@pytest.mark.parametrize("fps", [0, -1, math.nan, math.inf, 1e6])
def test_render_model_refuses_invalid_fps(bundle, tmp_path, fps):
    with pytest.raises(InvalidSetting, match="fps is"):
        render_model(bundle, tmp_path / "v.mp4", fps=fps)


def test_render_model_refuses_invalid_output_paths(bundle, tmp_path):
    with pytest.raises(OutputError, match="there is no folder"):
        render_model(bundle, tmp_path / "missing" / "v.mp4")
    with pytest.raises(OutputError, match="lies inside --out"):
        render_model(bundle, bundle)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").touch()
    with pytest.raises(OutputFolderInUse, match="not made by intrasplat"):
        render_model(bundle, tmp_path / "thesis")
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        render_model(bundle, tmp_path / "folder.mp4")
    with pytest.raises(OutputError, match=r"give a video that ends in \.mp4"):
        render_model(bundle, tmp_path / "v.AVI")
    assert not (tmp_path / "v.AVI").exists()


def test_render_refuses_unknown_renderer_before_reading_model(tmp_path):
    with pytest.raises(InvalidSetting, match="sculptor"):
        render_model(tmp_path / "missing", tmp_path / "images", renderer="sculptor")
    assert not (tmp_path / "images").exists()
    with pytest.raises(InvalidSetting, match="sculptor"):
        render_picture(tmp_path / "missing", renderer="sculptor")


def test_render_refuses_unsupported_renderer_option_before_reading_model(tmp_path):
    with pytest.raises(InvalidSetting, match="'alpha' has no option samples; choose stochastic or points"):
        render_model(tmp_path / "none", tmp_path / "out", options=RendererOptions(samples=4))
    assert not (tmp_path / "out").exists()


def pictures_until_an_error(count):
    for number in range(count):
        yield np.full((48, 64, 3), 40 * number, np.uint8)
    raise OutputError("no space is left")


def frames_of(path):
    video = cv2.VideoCapture(str(path))
    frames = 0
    while video.read()[0]:
        frames += 1
    return frames


def test_write_video_keeps_partial_video_after_error(tmp_path):
    out = tmp_path / "view.mp4"
    with pytest.raises(OutputError, match="no space is left"):
        write_video(pictures_until_an_error(3), out, (64, 48), 30.0, overwrite=False)
    assert frames_of(out) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["view.mp4"]


def test_write_video_keeps_earlier_video_after_error(tmp_path):
    out = tmp_path / "view.mp4"
    out.write_bytes(b"earlier")
    with pytest.raises(OutputError, match="no space is left"):
        write_video(pictures_until_an_error(3), out, (64, 48), 30.0, overwrite=True)
    assert out.read_bytes() == b"earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["view.mp4"]


def test_write_video_removes_video_that_cannot_be_finished(tmp_path):
    """The encoder holds back the frames until the end, which exceeds the largest size of a file."""
    script = (
        "import resource, sys, pathlib, numpy as np\n"
        "from operators.applications.render import write_video\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))\n"
        "write_video(iter([np.zeros((48, 64, 3), np.uint8)] * 3), pathlib.Path(sys.argv[1]), (64, 48), 30.0, False)\n"
    )
    ran = subprocess.run([sys.executable, "-c", script, str(tmp_path / "view.mp4")], capture_output=True, text=True)
    assert "ulimit -f" in ran.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("was_there", [False, True])
def test_write_video_error_before_first_picture_creates_no_video(tmp_path, was_there):
    out = tmp_path / "view.mp4"
    if was_there:
        out.write_bytes(b"earlier")
    with pytest.raises(OutputError, match="no space is left"):
        write_video(pictures_until_an_error(0), out, (64, 48), 30.0, overwrite=True)
    assert out.exists() == was_there


def test_typical_depth_of_large_scene_is_median_of_sampled_visible_gaussians(model, monkeypatch):
    """A scene with three times `MOST_PICTURED` Gaussians is measured by every third one."""
    scene = replace(model(), field=None)
    count = scene.gaussians.count
    means = scene.gaussians.means.clone()
    means[:, 2] = torch.arange(count) - count / 2
    scene = replace(scene, gaussians=replace(scene.gaussians, means=means))
    monkeypatch.setattr(render, "MOST_PICTURED", -(-count // 3))
    pose = np.eye(4)
    pose[2, 3] = 7.0
    camera = scene.camera.with_pose(pose)
    depths = means[::3, 2].numpy() + 7
    assert render.typical_depth(scene, camera) == pytest.approx(np.median(depths[depths > 0]))
    pose[2, 3] = -1e6
    with pytest.raises(InvalidSetting, match="sees no part of the scene"):
        render.typical_depth(scene, scene.camera.with_pose(pose))


@pytest.mark.parametrize(
    ("digest", "own", "is_refused"), [("a", "a", True), ("a", "b", False), ("a", None, False), (None, "a", False)]
)
def test_render_refuses_to_overwrite_training_recording(tmp_path, monkeypatch, digest, own, is_refused):
    def opened(path):
        if digest is None:
            raise RecordingError("no recording")
        return SimpleNamespace(digest=digest)

    monkeypatch.setattr(render, "open_recording", opened)
    made_from = SimpleNamespace(training_digest=own)
    render._check_not_trained_on(made_from, tmp_path / "v.mp4")  # there is no such file yet
    (tmp_path / "v.mp4").write_bytes(b"video")
    if is_refused:
        with pytest.raises(OutputError, match="the model was trained on"):
            render._check_not_trained_on(made_from, tmp_path / "v.mp4")
    else:
        render._check_not_trained_on(made_from, tmp_path / "v.mp4")
