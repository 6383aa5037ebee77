"""`intrasplat edit`: selected Gaussians of a model are changed and saved."""

from __future__ import annotations

import json

import pytest
import torch

from gsplat_core import Gaussians, Model, load_bundle, load_ply, save_bundle, save_ply
from gsplat_core.deformation import BasisField
from gsplat_core.scene.cameras import Camera
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK


@pytest.fixture
def gaussians():
    g = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return Gaussians(
        means=normal(40, 3) + torch.tensor([0, 0, 9.0]), quats=normal(40, 4), log_scales=normal(40, 3) - 2,
        logit_opacities=normal(40), sh=normal(40, 4, 3), extra={"semantics": torch.eye(4).repeat(10, 1)},
    )  # fmt: skip


@pytest.fixture
def ply(gaussians, tmp_path):
    save_ply(gaussians, tmp_path / "scene.ply")
    return str(tmp_path / "scene.ply")


@pytest.fixture
def bundle(gaussians, tmp_path):
    field = BasisField(40, (0.0, 1.0), bumps=4)
    torch.nn.init.normal_(field.weights, std=0.1)
    model = Model(1, gaussians, field.detached_copy(), Camera.from_focal(40.0, 40, 30), (0.0, 1.0))
    save_bundle(model, tmp_path / "bundle")
    return str(tmp_path / "bundle")


@pytest.mark.slow
def test_edit_deletes_gaussians_outside_box_of_scene_file(ply, gaussians, tmp_path, capsys):
    out = tmp_path / "cut.ply"
    words = ["edit", ply, "--select", "box:-1,-1,8,1,1,10", "--outside", "--delete", "--out", str(out), "--json"]
    assert run(words) == OK
    inside = ((gaussians.means - torch.tensor([0, 0, 9.0])).abs() <= 1).all(-1)
    said = json.loads(capsys.readouterr().out)
    assert (said["gaussians_before"], said["gaussians"]) == (40, int(inside.sum()))
    torch.testing.assert_close(load_ply(out).means, gaussians.means[inside])


def test_edit_deletes_label_of_deforming_model(bundle, tmp_path):
    assert run(["edit", bundle, "--select", "label:1", "--delete", "--out", str(tmp_path / "out")]) == OK
    before, after = load_bundle(bundle), load_bundle(tmp_path / "out")
    kept = torch.arange(40) % 4 != 1
    for time_s in (0.0, 0.6):
        torch.testing.assert_close(after.at(time_s).means, before.at(time_s).means[kept])


def test_edit_recolours_transforms_and_merges_scenes(ply, gaussians, tmp_path):
    out = tmp_path / "out"
    words = ["--select", "sphere:0,0,9,1", "--recolour", "1,0,0.5", "--rotate", "0,0,2,90", "--translate", "1,0,0"]
    assert run(["edit", ply, *words, "--scale", "2", "--merge", ply, "--out", str(out)]) == OK
    edited = load_bundle(out).gaussians
    chosen = (gaussians.means - torch.tensor([0, 0, 9.0])).norm(dim=-1) <= 1
    x, y, z = gaussians.means[chosen].unbind(-1)
    wanted = torch.stack([-2 * y + 1, 2 * x, 2 * z], -1)
    torch.testing.assert_close(edited.means[:40][chosen], wanted)
    torch.testing.assert_close(edited.means[40:], gaussians.means)
    assert (edited.sh[:40][chosen][:, 1:] == 0).all() and torch.equal(edited.sh[:40][~chosen], gaussians.sh[~chosen])


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "nothing to change"),
        (["--delete"], "--delete needs a selection"),
        (["--delete", "--select", "sphere:0,0,9,100"], "holds all Gaussians"),
        (["--delete", "--select", "cube:1"], "'cube:1' is none of box:"),
        (["--delete", "--select", "box:1,2,3"], "--select box takes X,Y,Z,X,Y,Z"),
        (["--delete", "--select", "label:0"], "have no labels"),
        (["--recolour", "2,0,0"], "from 0 to 1"),
        (["--recolour", "red"], "--recolour takes R,G,B, got 'red'"),
        (["--rotate", "0,0,0,90"], "an axis of a length above 0"),
        (["--scale", "0"], "scale must be from 1e-37"),
        (["--scale", "1e30"], "beyond what can be shown; change --scale or --translate"),
        (["--scale", "1e-30"], "too small to be shown; change --scale or --translate"),
        (["--translate", "1e38,0,0"], "holds a position of 1e+38"),
        (["--translate", "1_0,0,0"], "--translate takes X,Y,Z, got '1_0,0,0'"),
        (["--delete", "--select", "sphere:0,0,9000,1"], "the selection holds none of the 40 Gaussians; they are at ["),
        (["--recolour", "1,0,0", "--outside"], "the outside of the selection holds none"),
    ],
)
def test_edit_prints_one_error_line_for_invalid_edit(ply, tmp_path, capsys, words, reason):
    assert run(["edit", ply, *words, "--out", str(tmp_path / "out.ply")]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and reason in said and said.count("\n") == 1
    assert not (tmp_path / "out.ply").exists()


def test_edit_refuses_to_transform_deforming_model(bundle, tmp_path, capsys):
    assert run(["edit", bundle, "--scale", "2", "--out", str(tmp_path / "out")]) == BAD_INPUT
    assert "export one time" in capsys.readouterr().err
