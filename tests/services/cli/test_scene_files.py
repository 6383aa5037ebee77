"""Scenes of other programs (`.ply`, `.splat`, `.spz`) in commands, and malformed ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.errors import BundleError
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import ExportWish, format_named
from gsplat_core.io.model_sources import load_model, load_splat
from gsplat_core.io.ply import load_ply, save_ply
from gsplat_core.scene.gaussians import Gaussians
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK


def cloud(count: int = 200, size: float = 1.0) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator) * size + 100 * size
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(
        means,
        quats,
        torch.full((count, 3), float(np.log(0.2 * size))),
        torch.full((count,), 3.0),
        torch.rand(count, 1, 3, generator=generator),
    )


@pytest.mark.parametrize("size", [0.05, 1.0, 1e4])
def test_default_camera_of_scene_file_sees_scene_of_any_size(tmp_path, size):
    save_ply(cloud(size=size), tmp_path / "scene.ply")
    model = load_model(tmp_path / "scene.ply")
    camera = model.camera.resized(64, 52)
    with torch.inference_mode():
        alpha = model.render(0.0, camera).alpha
    assert 0.05 < float((alpha > 0.5).float().mean()) < 0.9
    seen = model.gaussians.means.double().numpy() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
    assert ((pixels >= 0) & (pixels < [64, 52])).all(1).mean() > 0.85


def test_load_model_refuses_scene_before_near_plane(tmp_path):
    save_ply(cloud(size=1e-3), tmp_path / "scene.ply")
    with pytest.raises(BundleError, match="too small to be shown"):
        load_model(tmp_path / "scene.ply")


def test_splat_file_round_trip(tmp_path):
    save_ply(cloud(), tmp_path / "scene.ply")
    model = load_model(tmp_path / "scene.ply")
    export_model(model, tmp_path / "scene.splat", ExportWish(format_named("splat")))
    read, written = load_splat(tmp_path / "scene.splat"), model.gaussians
    order = np.lexsort(read.means.numpy().T), np.lexsort(written.means.numpy().T)
    for name in ("means", "log_scales", "sh", "logit_opacities"):
        close = np.allclose(
            getattr(read, name).numpy()[order[0]],
            getattr(written, name).numpy()[order[1]],
            atol=0.15 if name == "logit_opacities" else 0.01,
        )
        assert close, name


@pytest.mark.parametrize("name", ["scene.ply", "scene.splat", "scene.compressed.ply", "scene.spz", "SCENE.PLY"])
def test_render_export_and_measure_accept_scene_files(tmp_path, name):
    save_ply(cloud(), tmp_path / "scene.ply")
    if name == "SCENE.PLY":
        (tmp_path / "scene.ply").rename(tmp_path / name)
    elif name != "scene.ply":
        assert run(["export", str(tmp_path / "scene.ply"), str(tmp_path / name)]) == OK
        assert run(["export", str(tmp_path / "scene.ply"), str(tmp_path / name), "--overwrite"]) == OK
    scene, out = str(tmp_path / name), tmp_path / "images"
    assert run(["render", scene, "--out", str(out), "--scale", "0.1", "--fps", "1"]) == OK
    assert len(list(out.glob("*.png"))) > 1
    assert run(["export", scene, str(tmp_path / "x.glb")]) == OK
    assert run(["measure", scene, "--from", "320,256"]) == OK


def _header(**changed: str) -> bytes:
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        *(f"scale_{k}" for k in range(3)),
        *(f"rot_{k}" for k in range(4)),
    ]
    lines = {
        "format": "format binary_little_endian 1.0",
        "element": "element vertex 2",
        "properties": "\n".join(f"property float {n}" for n in names),
    }
    return "\n".join(["ply", *(changed.get(key, line) for key, line in lines.items()), "end_header", ""]).encode()


BODY = np.ones(28, "<f4").tobytes()
HOSTILE = {
    "empty": b"", "no header": b"ply", "junk": bytes(range(256)), "cut short": _header() + BODY[:-1], "ascii": _header(format="format ascii 1.0") + b"1 " * 28,
    "big endian": _header(format="format binary_big_endian 1.0") + BODY, "version 9.9": _header(format="format binary_little_endian 9.9") + BODY,
    "huge count": _header(element="element vertex 99999999999") + BODY, "negative count": _header(element="element vertex -1") + BODY,
    "no count": _header(element="element vertex x") + BODY, "none": _header(element="element vertex 0"),
    "a mesh": _header(properties="property float x\nproperty float y\nproperty float z") + BODY,
    "a list": _header(properties="property list uchar int x") + BODY, "unknown type": _header(properties="property quad x") + BODY,
    "twice": _header(properties="property float x\nproperty float x") + BODY,
    "nan": _header() + np.full(28, np.nan, "<f4").tobytes(), "infinite": _header() + np.full(28, np.inf, "<f4").tobytes(),
    "far away": _header() + np.full(28, 1e30, "<f4").tobytes(), "huge scales": _header() + np.full(28, 80, "<f4").tobytes(),
    "not ascii": _header(element="element vertex ²") + BODY, "endless header": b"ply\n" + b"comment x\n" * 100_000,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.parametrize("command", ["render", "export", "view", "measure"])
def test_commands_print_error_for_malformed_ply(tmp_path, capsys, command, what):
    (tmp_path / "scene.ply").write_bytes(HOSTILE[what])
    more = {
        "render": ["--out", str(tmp_path / "o")],
        "export": [str(tmp_path / "o.glb")],
        "view": [],
        "measure": ["--from", "1,1"],
    }[command]
    assert run([command, str(tmp_path / "scene.ply"), *more]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "scene.ply" in said and "Traceback" not in said


@pytest.mark.parametrize("data", [bytes(31), b"x" * 33, np.full(16, np.nan, "<f4").tobytes(), b""])
def test_load_model_refuses_malformed_splat(tmp_path, data):
    (tmp_path / "scene.splat").write_bytes(data)
    with pytest.raises(BundleError):
        load_model(tmp_path / "scene.splat")


def test_load_model_counts_negative_scales_of_splat(tmp_path):
    (tmp_path / "scene.splat").write_bytes(np.array([1, 2, 3, -1, -2, 5], "<f4").tobytes() + bytes(8))
    with pytest.raises(BundleError, match=r"2 values of scale .* \(first: -1\)"):
        load_model(tmp_path / "scene.splat")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["render", "export", "pack", "measure", "evaluate", "view"])
@pytest.mark.parametrize("name", ["model.pt", "scene.obj", "video.mp4", "nosuffix"])
def test_commands_print_error_for_file_that_is_no_model(tmp_path, capsys, command, name):
    (tmp_path / name).write_bytes(b"x")
    more = {
        "render": ["--out", str(tmp_path / "o")],
        "export": [str(tmp_path / "o.glb")],
        "pack": [str(tmp_path / "o.isplat")],
        "measure": ["--from", "1,1"],
        "evaluate": [str(tmp_path)],
        "view": [],
    }[command]
    assert run([command, str(tmp_path / name), *more]) == BAD_INPUT
    said = capsys.readouterr().err
    assert "folder" in said and "Not a directory" not in said and "Traceback" not in said


def test_load_ply_reads_file_of_other_program(tmp_path):
    (tmp_path / "scene.ply").write_bytes(_header() + BODY)
    assert load_ply(tmp_path / "scene.ply").count == 2


@pytest.mark.parametrize(("name", "least_db"), [("scene.compressed.ply", 38), ("scene.spz", 33)])
def test_compressed_scene_renders_same_image(tmp_path, name, least_db):
    gaussians = cloud(60)
    # A different colour from each side and a shape that a wrong rotation would change.
    turned = torch.randn(60, 4, generator=torch.Generator().manual_seed(2))
    higher = 0.4 * torch.rand(60, 15, 3, generator=torch.Generator().manual_seed(3)) - 0.2
    stretched = gaussians.log_scales + torch.tensor([1.0, 0.0, -1.0])
    gaussians = replace(gaussians, quats=turned, log_scales=stretched, sh=torch.cat([gaussians.sh, higher], 1))
    save_ply(gaussians, tmp_path / "scene.ply")
    assert run(["export", str(tmp_path / "scene.ply"), str(tmp_path / name)]) == OK
    first, second = (load_model(tmp_path / each) for each in ("scene.ply", name))
    camera = first.camera.resized(160, 128)
    difference = (first.render(0.0, camera).image - second.render(0.0, camera).image).square().mean()
    assert -10 * float(difference.log10()) > least_db


@pytest.mark.parametrize("format_name", ["glb", "ply", "compressed-ply", "splat", "spz"])
def test_exported_bytes_do_not_depend_on_file_name(tmp_path, format_name):
    save_ply(cloud(), tmp_path / "scene.ply")
    model = load_model(tmp_path / "scene.ply")
    for name in ("a", "another name"):
        export_model(model, tmp_path / name, ExportWish(format_named(format_name)))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "another name").read_bytes()
