"""`intrasplat measure`: output, units and refused points."""

from __future__ import annotations

import json

import pytest
import torch

from gsplat_core import Camera, Gaussians, Model, save_bundle
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthSource
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK


@pytest.fixture
def wall(tmp_path):
    x, y = torch.meshgrid(torch.arange(-20.0, 25), torch.arange(-25.0, 26), indexing="xy")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), 40.0)], 1)
    count = len(means)
    scales = torch.tensor([1.0, 1.0, 0.05]).log().repeat(count, 1)
    quats, opacities = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count,), 6.0)
    gaussians = Gaussians(means, quats, scales, opacities, torch.zeros(count, 1, 3))

    def save(source: DepthSource | None) -> str:
        model = Model(1, gaussians, None, Camera.from_focal(50.0, 64, 48), (0.0, 2.0), depth_source=source)
        save_bundle(model, tmp_path / "model")
        return str(tmp_path / "model")

    return save


def test_measure_prints_distance_in_millimetres(wall, capsys):
    bundle = wall(DepthSource(DEPTH_ORIGINS["measured"], metric=True))
    assert run(["measure", bundle, "--time", "0.5", "--from", "22,24", "--to", "47,24", "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert (said["unit"], said["depth_origin"], said["time_s"]) == ("mm", "measured", 0.5)
    assert said["distance"]["value"] == pytest.approx(25 / 50 * 40, abs=0.05)
    assert said["along_surface"]["value"] == pytest.approx(20, abs=0.2)
    assert 0.05 < said["distance"]["error"] < 1
    assert said["points"][0]["position"][2] == pytest.approx(40, abs=0.05)
    assert run(["measure", bundle, "--from", "22,24", "--to", "47,24"]) == OK
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and lines[2].startswith("straight: 20.0") and lines[2].endswith(" mm")


def test_measure_states_relative_unit_of_unitless_model(wall, capsys):
    assert run(["measure", wall(None), "--from", "22,24"]) == OK
    assert "relative: the model's lengths have no known unit" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--from", "1,24"], "nothing was observed at"),
        (["--from", "80,24"], "outside of the picture"),
        (["--from", "middle"], "is no pixel"),
        (["--from", "30,24", "--to", "-3,4"], "is no pixel"),
        (["--from", "30,24", "--time", "7"], "its window is"),
    ],
)
def test_measure_prints_error_for_unmeasurable_points(wall, capsys, options, said):
    assert run(["measure", wall(None), *options]) == BAD_INPUT
    assert said in capsys.readouterr().err
