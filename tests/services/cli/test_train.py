"""`intrasplat train SCENE`: a static scene in COLMAP's format."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, load_bundle, load_ply, render
from operators.applications.static_scene import train_scene
from operators.settings import TrainOptions
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from tests.colmap_writer import write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Nine images of a point cloud, whose centres are the points."""
    folder = tmp_path_factory.mktemp("scene")
    generator = torch.Generator().manual_seed(0)
    n = 80
    cloud = Gaussians(
        torch.randn(n, 3, generator=generator) * 0.5,
        torch.randn(n, 4, generator=generator),
        torch.full((n, 3), -2.0),
        torch.full((n,), 2.0),
        torch.randn(n, 1, 3, generator=generator),
    )
    (folder / "images").mkdir()
    images = []
    for k in range(9):
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(np.array([0.1 * k, 0.3 * k - 1, 0.2]))
        pose[:3, 3] = 0.1, -0.2, 3
        camera = Camera.from_focal(30, 32, 24, pose)
        with torch.inference_mode():
            image = (render(cloud, camera).image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        cv2.imwrite(str(folder / "images" / f"{k}.png"), image[..., ::-1])
        images.append((f"{k}.png", camera))
    colours = ((cloud.sh[:, 0] * 0.28 + 0.5).clamp(0, 1) * 255).int()
    points = [(*map(float, mean), *map(int, colour)) for mean, colour in zip(cloud.means, colours, strict=True)]
    write_scene(folder / "sparse/0", images, text=True, points=points)
    return folder


@pytest.mark.slow
def test_train_saves_and_evaluates_scene(scene, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["train", str(scene), "--out", str(out), "--steps", "40", "--sh-degree", "1", "--strategy", "mcmc"]
    assert run([*words, "--max-gaussians", "90", "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert (said["steps"], said["training_images"], said["initial_gaussians"], said["gaussians"]) == (40, 7, 80, 90)
    assert [each["name"] for each in said["heldout"]["images"]] == ["0.png", "8.png"]
    assert said["peak_memory_bytes"] > 0 and said["training_s"] > 0 and not said["interrupted"]
    assert json.loads((out / "training.json").read_text())["heldout"] == said["heldout"]
    # The model and the file are in the coordinates of the scene.
    for model in (out / "model", out / "scene.ply"):
        assert run(["evaluate", str(model), "--scene", str(scene), "--json"]) == OK
        found = json.loads(capsys.readouterr().out)
        assert found["psnr_db"] == pytest.approx(said["heldout"]["psnr_db"], abs=0.01)


def test_interrupted_train_scene_saves_model_so_far(scene, tmp_path):
    polled = iter([False, False, True])
    options = TrainOptions(steps=40, sh_degree=0)
    result = train_scene(scene, options, tmp_path, stop_requested=lambda: next(polled))
    assert (result.steps, result.interrupted, result.heldout) == (3, True, None)
    assert torch.equal(load_bundle(tmp_path / "model").gaussians.means, load_ply(tmp_path / "scene.ply").means)


def test_train_scene_saves_model_during_training(scene, tmp_path):
    class Killed(Exception):
        pass

    def stop():
        if (tmp_path / "model/manifest.json").exists():
            raise Killed
        return False

    with pytest.raises(Killed):
        options = TrainOptions(steps=40, strategy="none", save_every=2, sh_degree=0)
        train_scene(scene, options, tmp_path, stop_requested=stop)
    assert load_bundle(tmp_path / "model").gaussians.count == 80


@pytest.mark.parametrize(
    ("damage", "words", "reason"),
    [
        (lambda folder: shutil.rmtree(folder / "sparse"), [], "no scene of COLMAP"),
        (lambda folder: (folder / "images/3.png").unlink(), [], "3.png"),
        (
            lambda folder: cv2.imwrite(str(folder / "images/3.png"), np.zeros((32, 32, 3), np.uint8)),
            [],
            "another shape",
        ),
        (lambda folder: (folder / "sparse/0/points3D.txt").unlink(), [], "has no points3D"),
        (lambda folder: (folder / "sparse/0/points3D.txt").write_text("# none\n"), [], "has 0 points"),
        (lambda _: None, ["--every", "1"], "every is 1"),
        (lambda _: None, ["--steps", "0"], "steps is 0"),
        (lambda _: None, ["--strategy", "streaming"], "adc, mcmc or none"),
        (lambda _: None, ["--strategy", "mcmc", "--absgrad"], "belongs to strategy adc"),
        (lambda _: None, ["--sh-degree", "7"], "sh_degree is 7"),
        (lambda _: None, ["--images", "/etc"], "inside the scene"),
        (lambda _: None, ["--scale", "0.01"], "nothing is left"),
    ],
)
def test_train_prints_one_error_line_for_invalid_scene_or_option(scene, tmp_path, capsys, damage, words, reason):
    broken = tmp_path / "scene"
    shutil.copytree(scene, broken)
    damage(broken)
    assert run(["train", str(broken), "--out", str(tmp_path / "out"), "--steps", "2", *words]) == BAD_INPUT
    said = capsys.readouterr().err
    error = said[said.index("error: ") :]
    assert reason in error and error.count("\n") == 1 and not (tmp_path / "out").exists()
