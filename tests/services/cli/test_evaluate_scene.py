"""`intrasplat evaluate FILE --scene`: held-out images of a scene in COLMAP's format."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from gsplat_core import Camera
from gsplat_core.io.ply import load_ply, save_ply
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.gaussians import Gaussians
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from tests.colmap_writer import write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Ten images around a cloud, the even ones (0, 8) exactly as rendered and all others black."""
    folder = tmp_path_factory.mktemp("scene")
    generator = torch.Generator().manual_seed(0)
    count = 300
    save_ply(
        Gaussians(
            torch.randn(count, 3, generator=generator),
            torch.randn(count, 4, generator=generator),
            torch.randn(count, 3, generator=generator) * 0.3 - 2,
            torch.randn(count, generator=generator),
            torch.randn(count, 4, 3, generator=generator) * 0.4,
        ),
        folder / "scene.ply",
    )
    gaussians = load_ply(folder / "scene.ply")
    (folder / "images").mkdir()
    images = []
    for k in range(10):
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(np.array([0.1 * k, 0.3 * k - 1, 0.2]))
        pose[:3, 3] = 0.1, -0.2, 6
        camera = Camera(np.array([[90.0, 0, 33], [0, 80, 22], [0, 0, 1]]), 64, 48, pose)
        with torch.inference_mode():
            image = (render(gaussians, camera).image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        cv2.imwrite(str(folder / "images" / f"{k:02d}.png"), image[..., ::-1] if k in (0, 8) else 0 * image)
        images.append((f"{k:02d}.png", camera))
    write_scene(folder / "sparse/0", images, text=False)
    return folder


def test_evaluate_scene_compares_every_eighth_image(scene, tmp_path, capsys):
    words = ["evaluate", str(scene / "scene.ply"), "--scene", str(scene), "--out", str(tmp_path / "out"), "--json"]
    assert run(words) == OK
    said = json.loads(capsys.readouterr().out)
    assert [each["name"] for each in said["images"]] == ["00.png", "08.png"]
    assert said["psnr_db"] > 57 and said["ssim"] > 0.999  # rounding to 8 bits alone: 58.9 dB
    assert json.loads((tmp_path / "out/evaluation.json").read_text())["psnr_db"] == said["psnr_db"]
    shown, true = (cv2.imread(str(path)) for path in (tmp_path / "out/0001.png", scene / "images/08.png"))
    assert np.abs(shown.astype(int) - true).max() <= 1
    # The same call again replaces its own results.
    assert run(words) == OK


def test_evaluate_scene_every_option_changes_heldout_images(scene, capsys):
    assert run(["evaluate", str(scene / "scene.ply"), "--scene", str(scene), "--every", "4", "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert [each["name"] for each in said["images"]] == ["00.png", "04.png", "08.png"]
    assert said["worst"] == "04.png" and said["worst_db"] < 25


def test_evaluate_scene_with_scale_succeeds(scene, capsys):
    assert run(["evaluate", str(scene / "scene.ply"), "--scene", str(scene), "--scale", "0.5"]) == OK
    assert "2 held-out images: PSNR " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "nothing to evaluate on"),
        (["--scene", "nowhere"], "no scene of COLMAP"),
        (["{scene}", "--scene", "{scene}"], "--scene is for scenes"),
        (["{scene}"], "comes from no recording"),
        (["--scene", "{scene}", "--protocol", "live"], "--protocol is for recordings"),
        (["--scene", "{scene}", "--images", "../x"], "inside the scene"),
        (["--scene", "{scene}", "--images", "images_8"], "images_8"),
        (["--scene", "{scene}", "--every", "0"], "every is 0"),
        (["--scene", "{scene}", "--samples", "2"], "no option samples"),
        (["--scene", "{scene}", "--renderer", "none"], "renderer is 'none'; choose alpha"),
    ],
)
def test_evaluate_scene_prints_error_for_invalid_option(scene, capsys, words, reason):
    words = [word.format(scene=scene) for word in words]
    assert run(["evaluate", str(scene / "scene.ply"), *words]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and reason in said and "Traceback" not in said


def test_evaluate_scene_refuses_image_with_other_aspect_ratio(scene, tmp_path, capsys):
    (scene / "others").mkdir()
    cv2.imwrite(str(scene / "others/00.png"), np.zeros((48, 48, 3), np.uint8))
    assert run(["evaluate", str(scene / "scene.ply"), "--scene", str(scene), "--images", "others"]) == BAD_INPUT
    assert "another shape" in capsys.readouterr().err
