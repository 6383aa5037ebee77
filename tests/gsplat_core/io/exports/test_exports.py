"""Exports, read back by readers of other programs' conventions."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.errors import ExportError, InvalidSetting
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import FORMATS, ExportWish, format_named, format_of
from gsplat_core.io.ply import load_ply
from gsplat_core.models import Model
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthSource
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from tests.gsplat_core.io.exports.glb_reader import NAME, read_glb, read_mesh_glb
from tests.recipes.test_deformation_field import DriftField

WINDOW_S = (1.0, 3.0)


def random_model(count: int = 50, degree: int = 2, field: bool = False, seed: int = 3) -> Model:
    random = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=random)
    gaussians = Gaussians(
        10 * normal(count, 3), 3 * normal(count, 4), normal(count, 3) - 1, 2 * normal(count),
        0.3 * normal(count, (degree + 1) ** 2, 3),
    )  # fmt: skip
    drift = DriftField(WINDOW_S)
    drift.velocity.data += 1.5
    drift.requires_grad_(False)
    return Model(4, gaussians, drift if field else None, Camera.from_focal(20.0, 32, 24), WINDOW_S)


def exported(tmp_path, model, name, **wish) -> bytes:
    path = tmp_path / f"out{FORMATS[name].suffix}"
    size = export_model(model, path, ExportWish(FORMATS[name], **wish), overwrite=True)
    data = path.read_bytes()
    assert size == len(data)
    return data


def unit(quats: torch.Tensor) -> np.ndarray:
    return (quats / quats.norm(dim=1, keepdim=True)).numpy()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_ply_export_has_unit_rotations_and_equal_other_parameters(tmp_path, degree):
    model = random_model(degree=degree)
    exported(tmp_path, model, "ply")
    back, was = load_ply(tmp_path / "out.ply"), model.gaussians
    np.testing.assert_allclose(back.quats, unit(was.quats), atol=1e-6)
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(getattr(back, name), getattr(was, name)), name
    assert back.sh_degree == degree


def test_splat_export_has_32_bytes_per_gaussian_by_importance(tmp_path):
    model = random_model()
    data = exported(tmp_path, model, "splat")
    assert len(data) == 32 * 50
    floats = np.frombuffer(data, "<f4").reshape(-1, 8)
    whole = np.frombuffer(data, "u1").reshape(-1, 32)
    g = model.gaussians
    importance = (g.log_scales.sum(1).exp() * g.logit_opacities.sigmoid()).numpy()
    order = np.argsort(-importance, kind="stable")
    np.testing.assert_array_equal(floats[:, :3], g.means.numpy()[order])
    np.testing.assert_allclose(floats[:, 3:6], g.log_scales.exp().numpy()[order], rtol=1e-6)
    colours = np.clip((0.5 + SH_C0 * g.sh[:, 0]).numpy()[order] * 255, 0, 255)
    assert np.abs(whole[:, 24:27] - colours).max() <= 0.5 + 1e-3
    assert np.abs(whole[:, 27] - 255 * g.logit_opacities.sigmoid().numpy()[order]).max() <= 0.5 + 1e-3
    rotations = (whole[:, 28:].astype(float) - 128) / 128
    assert np.abs(rotations - unit(g.quats)[order]).max() <= 1 / 128 + 1e-6


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_glb_export_matches_gaussian_splatting_extension(tmp_path, degree):
    model = random_model(degree=degree)
    document, values = read_glb(exported(tmp_path, model, "glb"))
    g = model.gaussians
    np.testing.assert_array_equal(values["POSITION"], g.means)
    np.testing.assert_allclose(values[f"{NAME}:ROTATION"][:, [3, 0, 1, 2]], unit(g.quats), atol=1e-6)
    np.testing.assert_allclose(values[f"{NAME}:SCALE"], g.log_scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(values[f"{NAME}:OPACITY"], g.logit_opacities.sigmoid(), atol=1e-6)
    assert f"{NAME}:SH_DEGREE_{degree + 1}_COEF_0" not in values
    for level in range(degree + 1):
        for n in range(2 * level + 1):
            np.testing.assert_array_equal(values[f"{NAME}:SH_DEGREE_{level}_COEF_{n}"], g.sh[:, level * level + n])
    srgb = np.clip((0.5 + SH_C0 * g.sh[:, 0]).numpy(), 0, 1)
    shown = values["COLOR_0"][:, :3]
    again = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert np.abs(again - srgb).max() < 2e-3
    assert document["accessors"][0]["count"] == 50


def test_glb_node_converts_axes_and_millimetres_to_gltf(tmp_path):
    """x right, y down, z forward becomes x right, y up, z backward, right-handed both; millimetres become metres."""
    document, _ = read_glb(exported(tmp_path, random_model(), "glb"))
    (node,) = document["nodes"]
    x, y, z, w = node["rotation"]
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(turn @ [1.0, 2.0, 3.0], [1, -2, -3], atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert node["scale"] == [0.001] * 3


def test_spherical_harmonics_equal_gltf_extension_definition():
    """The degree 1 functions of the extension's text: -y, z, -x with the constant 0.4886."""
    direction = torch.tensor([[0.36, -0.48, 0.8]])
    for n, factor in enumerate((-direction[0, 1], direction[0, 2], -direction[0, 0])):
        sh = torch.zeros(1, 4, 3)
        sh[0, 1 + n] = 1.0
        seen = spherical_harmonics(1, direction, sh)
        assert seen[0, 0].item() == pytest.approx(0.4886025119029199 * factor.item(), abs=1e-6)


def test_export_evaluates_model_at_given_time(tmp_path):
    model = random_model(field=True)
    for time_s in (None, 1.0, 1.75):
        exported(tmp_path, model, "ply", time_s=time_s)
        at = model.at(3.0 if time_s is None else time_s).means
        assert torch.equal(load_ply(tmp_path / "out.ply").means, at)
    assert not torch.equal(model.at(1.0).means, model.at(3.0).means)


def test_ply_sequence_export_has_one_file_per_time(tmp_path):
    model = random_model(field=True)
    exported(tmp_path, model, "ply-sequence", times=5)
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        assert archive.testzip() is None
        said = json.loads(archive.read("times.json"))
        assert said["time_window_s"] == [1.0, 3.0]
        assert list(said["files"].values()) == [1.0, 1.5, 2.0, 2.5, 3.0]
        assert archive.namelist() == ["times.json", *said["files"]]
        for name, time_s in said["files"].items():
            archive.extract(name, tmp_path)
            assert torch.equal(load_ply(tmp_path / name).means, model.at(time_s).means)


@pytest.mark.parametrize("name", list(FORMATS))
def test_export_of_same_model_gives_same_bytes(tmp_path, name):
    assert exported(tmp_path, random_model(field=True), name) == exported(tmp_path, random_model(field=True), name)


@pytest.mark.parametrize("name", list(FORMATS))
def test_export_refuses_invalid_model_and_leaves_no_file(tmp_path, name):
    model = random_model()
    broken = model.gaussians.clone()
    broken.means[7, 1] = math.nan
    huge = model.gaussians.clone()
    huge.log_scales[0, 0] = 200.0
    for gaussians in (broken, huge, model.gaussians.select(slice(0, 0))):
        with pytest.raises(ExportError):
            exported(tmp_path, Model(1, gaussians, None, model.camera, WINDOW_S), name)
    assert list(tmp_path.iterdir()) == []


def test_export_writes_zero_quaternion_as_identity(tmp_path):
    gaussians = random_model().gaussians.clone()
    gaussians.quats[0] = 0
    gaussians.quats[1] = 1e-30
    model = Model(1, gaussians, None, Camera.from_focal(20.0, 32, 24), WINDOW_S)
    exported(tmp_path, model, "ply")
    quats = load_ply(tmp_path / "out.ply").quats
    assert quats[0].tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(quats[1], [0.5] * 4)


def test_export_of_one_gaussian(tmp_path):
    for name in (name for name, each in FORMATS.items() if not each.is_surface):
        assert exported(tmp_path, random_model(count=1), name)


def test_glb_export_refuses_sh_degree_4(tmp_path):
    with pytest.raises(ExportError, match="degree 4"):
        exported(tmp_path, random_model(degree=4), "glb")


@pytest.mark.parametrize("wrong", [{"time_s": 0.5}, {"time_s": 3.1}])
def test_export_refuses_time_outside_model_window(tmp_path, wrong):
    with pytest.raises(InvalidSetting, match="window"):
        exported(tmp_path, random_model(), "ply", **wrong)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("ply", {"times": 3}),
        ("ply-sequence", {"time_s": 1.0}),
        ("ply-sequence", {"times": 0}),
        ("ply-sequence", {"times": 1001}),
        ("glb", {"time_s": math.nan}),
    ],
)
def test_export_wish_refuses_invalid_times(name, wrong):
    with pytest.raises(InvalidSetting):
        ExportWish(FORMATS[name], **wrong)


def test_export_format_by_name_and_file_suffix(tmp_path):
    assert format_named("glb") is format_of(tmp_path / "a.GLB")
    for wrong in (lambda: format_named("obj"), lambda: format_of(tmp_path / "a.obj")):
        with pytest.raises(InvalidSetting, match=r"ply"):
            wrong()


def wall(source: DepthSource | None = None) -> Model:
    x, y = torch.meshgrid(torch.arange(-20.0, 21), torch.arange(-16.0, 17), indexing="xy")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), 20.0)], 1)
    count = len(means)
    quats, opacities = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count,), 6.0)
    sh = torch.tensor([0.5, -0.2, -0.9]).repeat(count, 1)[:, None]
    gaussians = Gaussians(means, quats, torch.tensor([1.0, 1.0, 0.02]).log().repeat(count, 1), opacities, sh)
    return Model(1, gaussians, None, Camera.from_focal(20.0, 32, 24), WINDOW_S, depth_source=source)


def test_mesh_glb_export_is_surface_visible_to_camera(tmp_path):
    data = exported(tmp_path, wall(DepthSource(DEPTH_ORIGINS["measured"], metric=True)), "mesh-glb", time_s=2.0)
    document, values, indices = read_mesh_glb(data)
    assert document["asset"]["extras"] == {"time_s": 2.0, "unit": "millimetre"}
    assert len(values["POSITION"]) == 32 * 24 and len(indices) == 3 * 2 * 31 * 23
    assert np.allclose(values["POSITION"][:, 2], 20, atol=0.02) and np.allclose(values["NORMAL"], [0, 0, -1], atol=1e-2)
    shown = np.clip(0.5 + SH_C0 * np.array([0.5, -0.2, -0.9]), 0, 1)
    assert np.allclose(values["COLOR_0"][:, :3], ((shown + 0.055) / 1.055) ** 2.4, atol=0.01)
    assert (values["COLOR_0"][:, 3] == 1).all()


@pytest.mark.parametrize("name", ["mesh-ply", "points-ply"])
def test_mesh_ply_export_has_vertices_and_triangles(tmp_path, name):
    data = exported(tmp_path, wall(), name)
    head, body = data.split(b"end_header\n", 1)
    assert b"comment unit relative\nelement vertex 768\n" in head
    vertices = np.frombuffer(body, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)], 768)
    assert np.allclose(vertices["xyz"][:, 2], 20, atol=0.02) and np.allclose(
        np.linalg.norm(vertices["normal"], axis=1), 1
    )
    faces = np.frombuffer(body[768 * 27 :], [("n", "u1"), ("v", "<i4", 3)])
    assert len(faces) == (2 * 31 * 23 if name == "mesh-ply" else 0) and (faces["n"] == 3).all()
    assert (b"element face" in head) is (name == "mesh-ply")
    assert not len(faces) or (faces["v"].min(), faces["v"].max()) == (0, 767)


def test_mesh_export_of_invisible_model_is_refused(tmp_path):
    model = wall()
    behind = replace(model, gaussians=replace(model.gaussians, means=-model.gaussians.means))
    with pytest.raises(ExportError, match="no surface"):
        exported(tmp_path, behind, "mesh-glb")
    assert not (tmp_path / "out.glb").exists()
