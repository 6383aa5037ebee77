"""`intrasplat compare` with a mesh of the model's own surface in every format, and refused inputs."""

from __future__ import annotations

import json
import math
import struct
from functools import cache

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, Model, save_bundle
from gsplat_core.geometry.mesh import Mesh, mesh_of
from gsplat_core.io.exports.files import mesh_ply_pieces
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthSource
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK

METRIC = DepthSource(DEPTH_ORIGINS["measured"], metric=True)


@cache
def bumpy(source: DepthSource | None = METRIC) -> Model:
    x, y = torch.meshgrid(torch.arange(-30.0, 31), torch.arange(-25.0, 26), indexing="xy")
    x, y = x.ravel(), y.ravel()
    z = 45 + 4 * torch.sin(x / 6) * torch.cos(y / 7) + 0.1 * x
    count = len(x)
    gaussians = Gaussians(
        torch.stack([x, y, z], 1), torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), -0.7), torch.full((count,), 6.0), torch.zeros(count, 1, 3),
    )  # fmt: skip
    return Model(1, gaussians, None, Camera.from_focal(50.0, 48, 40), (0.0, 1.0), depth_source=source)


@cache
def surface() -> Mesh:
    return mesh_of(bumpy(), 0.0)


def write(mesh: Mesh, path) -> None:
    """Write a mesh as other programs do."""
    if path.suffix == ".ply":
        path.write_bytes(b"".join(mesh_ply_pieces(mesh, "millimetre", with_triangles=True)))
    elif path.suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices.tolist()]
        path.write_text(
            "\n".join([*lines, *(f"f {a + 1}//1 {b + 1}//1 {c + 1}//1" for a, b, c in mesh.triangles.tolist())])
        )
    else:
        rows = [struct.pack("<12fH", 0, 0, 0, *mesh.vertices[t].ravel().tolist(), 0) for t in mesh.triangles]
        path.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows))


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_compare_registers_moved_mesh_of_same_model(suffix, tmp_path, capsys):
    model = bumpy()
    save_bundle(model, tmp_path / "model")
    mesh = surface()
    angle = math.radians(3)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    moved = Mesh(
        (mesh.vertices @ turn.T + [0.5, -0.4, 0.8]).astype(np.float32), mesh.normals, mesh.colours, mesh.triangles
    )
    write(moved, tmp_path / f"ct{suffix}")
    assert run(["compare", str(tmp_path / "model"), str(tmp_path / f"ct{suffix}"), "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert said["signed_distances"]["rmse"] < 0.01 and said["signed_distances"]["inlier_share"] == 1
    assert np.allclose(np.array(said["registration"]["transform"])[:3, :3], turn, atol=2e-3)


def test_compare_takes_scale_of_unitless_model_from_pairs(tmp_path, capsys):
    model = bumpy(None)
    save_bundle(model, tmp_path / "model")
    mesh = surface()
    write(Mesh(2 * mesh.vertices, mesh.normals, mesh.colours, mesh.triangles), tmp_path / "ct.stl")
    arguments = ["compare", str(tmp_path / "model"), str(tmp_path / "ct.stl")]
    assert run(arguments) == BAD_INPUT
    assert "give three or more --pairs" in capsys.readouterr().err
    chosen = mesh.vertices[[5, 40, 900, 1500]].tolist()
    pairs = ";".join(f"{x},{y},{z}={2 * x},{2 * y},{2 * z}" for x, y, z in chosen)
    assert run([*arguments, "--pairs", pairs, "--json"]) == OK
    assert json.loads(capsys.readouterr().out)["registration"]["scale"] == pytest.approx(2, rel=1e-3)
    assert run([*arguments, "--pairs", pairs]) == OK
    assert "RMSE 0.0" in capsys.readouterr().out


LISTS = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int v\nend_header\n"
)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("ct.vtk", b"", "ends in none of"),
        (
            "ct.ply",
            b"ply\nformat ascii 1.0\nelement vertex 2000000\nproperty float x\nend_header\n",
            "more than the file",
        ),
        ("ct.ply", b"hello", "it has no header"),
        ("ct.stl", b"solid x", "no triangles"),
        ("ct.obj", b"v 0 0 0\nf 1 2 3\n", "a vertex that is not there"),
        ("ct.obj", b"v 0 0 nan\n", "not finite"),
        ("ct.obj", b"v 0 0\n", "the vertex 'v 0 0' has fewer than three coordinates"),
        ("ct.obj", b"v 0 0 0\nf 1 2 " + b"9" * 30, "a number that is too large"),
        ("ct.stl", bytes(80) + b"\xff\0\0\0" + bytes(50), "it has 134 bytes, and 12834 by its header"),
        ("ct.ply", LISTS + b"\x03" + bytes(11), "cut short"),
        ("ct.ply", LISTS.replace(b"uchar", b"int") + b"\x03\0", "cut short"),
        ("ct.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles with an area"),
    ],
)
def test_compare_refuses_invalid_mesh_files(name, content, said, tmp_path, capsys):
    save_bundle(bumpy(), tmp_path / "model")
    (tmp_path / name).write_bytes(content)
    assert run(["compare", str(tmp_path / "model"), str(tmp_path / name)]) == BAD_INPUT
    assert said in capsys.readouterr().err


@pytest.fixture
def metric_model(tmp_path):
    model = bumpy()
    save_bundle(model, tmp_path / "model")
    return tmp_path / "model", surface()


@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1e-7, 1e-3, 0.0254, 39.37, 1e3, 1e7, 1e30])
@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_compare_refuses_mesh_in_other_unit(metric_model, tmp_path, capsys, suffix, factor):
    model, mesh = metric_model
    with np.errstate(over="ignore", under="ignore"):
        vertices = (mesh.vertices.astype(np.float64) * factor).astype(np.float32)
    write(Mesh(vertices, mesh.normals, mesh.colours, mesh.triangles), tmp_path / f"ct{suffix}")
    assert run(["compare", str(model), str(tmp_path / f"ct{suffix}")]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and len(said.strip().splitlines()) == 1


@pytest.mark.parametrize("factor", [0.001, 0.1, 2.0, 1000.0])
def test_compare_refuses_pairs_in_other_unit(metric_model, tmp_path, capsys, factor):
    model, mesh = metric_model
    write(
        Mesh((mesh.vertices * factor).astype(np.float32), mesh.normals, mesh.colours, mesh.triangles),
        tmp_path / "ct.stl",
    )
    chosen = mesh.vertices[[5, 40, 900, 1500]].astype(float).tolist()
    pairs = ";".join(f"{x},{y},{z}={factor * x},{factor * y},{factor * z}" for x, y, z in chosen)
    assert run(["compare", str(model), str(tmp_path / "ct.stl"), "--pairs", pairs]) == BAD_INPUT
    assert "as far from each other" in capsys.readouterr().err


def test_compare_fails_if_surfaces_do_not_match(metric_model, tmp_path, capsys):
    model, mesh = metric_model
    write(Mesh((mesh.vertices * 3).astype(np.float32), mesh.normals, mesh.colours, mesh.triangles), tmp_path / "ct.stl")
    code = run(["compare", str(model), str(tmp_path / "ct.stl"), "--inlier", "0.01", "--json"])
    said = capsys.readouterr()
    assert code == BAD_INPUT and "do not lie on each other" in said.err
    assert json.loads(said.out)["surfaces_match"] is False


PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\nproperty list {} int v\nend_header\n"


@pytest.mark.parametrize(
    "content",
    [
        b"", b"ply\n", b"ply\nend_header\n", PLY.format("ascii 9.9", 0, 0, "uchar").encode(), PLY.format("binary_little_endian 9.9", 0, 0, "uchar").encode(),
        PLY.format("binary_big_endian 1.0", 0, 0, "uchar").encode(), PLY.format("ascii", 0, 0, "uchar").encode(), PLY.format("ascii 1.0", 10**12, 0, "uchar").encode(),
        PLY.format("ascii 1.0", -1, 0, "uchar").encode(), PLY.format("binary_little_endian 1.0", 1, 1, "char").encode() + bytes(12) + b"\xff" + bytes(40),
        PLY.format("binary_little_endian 1.0", 1, 1, "float").encode() + bytes(12) + b"\x00\x00\xc0\x7f" + bytes(40),
        PLY.format("ascii 1.0", 1, 1, "uchar").encode() + b"0 0 0 -3 0 0 0", PLY.format("ascii 1.0", 1, 1, "uchar").encode() + b"nan inf 0 3 0 0 0",
        PLY.format("ascii 1.0", 3, 1, "uchar").encode() + b"0 0 0 1 0 0 0 1e30 0 3 0 1 2", PLY.format("ascii 1.0", 3, 1, "uchar").encode() + b"0 0 0 1 0 0 0 1 0 3 0 1 9" + b"9" * 5000,
    ],
    ids=range(15),
)  # fmt: skip
def test_compare_prints_error_for_damaged_ply_mesh(metric_model, tmp_path, capsys, content):
    (tmp_path / "ct.ply").write_bytes(content)
    assert run(["compare", str(metric_model[0]), str(tmp_path / "ct.ply")]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "Traceback" not in said
