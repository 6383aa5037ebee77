"""Export program: formats, refusals and resource limits."""

from __future__ import annotations

import json
import resource

import av
import cv2
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.bundle import save_bundle
from services.exports import files
from services.exports.files import ALL
from tests.services.supervisor.test_model_show import uniform


@pytest.fixture
def ran(monkeypatch):
    """Replace the writers by fakes and return a dict of their calls."""
    calls: dict[str, tuple] = {}
    monkeypatch.setattr(files, "keep_files_private", lambda: calls.update(private=()))
    monkeypatch.setattr(files.os, "nice", lambda by: calls.update(nice=(by,)))
    monkeypatch.setattr(files.resource, "setrlimit", lambda *limit: calls.update(limit=limit))
    monkeypatch.setattr(files, "pack", lambda *paths: calls.update(pack=paths))
    monkeypatch.setattr(files, "export", lambda *wanted: calls.update(export=wanted))
    return calls


def test_export_program_packs_isplat_and_exports_other_formats(ran, tmp_path):
    folder, file = tmp_path / "model", tmp_path / "file"
    assert files.main([str(folder), str(file), "--format", "isplat"]) == 0
    assert ran.pop("pack") == (folder, file) and "export" not in ran
    assert files.main([str(folder), str(file), "--format", "ply", "--time", "1.5"]) == 0
    assert "pack" not in ran
    asked_folder, asked_file, wish = ran["export"]
    assert (asked_folder, asked_file) == (folder, file)
    assert (wish.format, wish.time_s, wish.times) == (ALL["ply"], 1.5, None)


def test_export_program_lowers_priority_and_disables_core_files(ran, tmp_path):
    files.main([str(tmp_path), "file", "--format", "isplat"])
    assert "private" in ran and ran["limit"] == (resource.RLIMIT_CORE, (0, 0)) and ran["nice"][0] > 0


def test_export_refusal_omits_server_folder(ran, tmp_path, monkeypatch, capsys):
    def refuse(*wanted):
        raise InvalidSetting(f"{tmp_path}/model.safetensors is damaged")

    monkeypatch.setattr(files, "export", refuse)
    assert files.main([str(tmp_path), "file", "--format", "ply"]) == files.REFUSED
    assert capsys.readouterr().err == "model.safetensors is damaged\n"


def test_export_loads_bundle_and_calls_export_model(monkeypatch, tmp_path):
    from gsplat_core.io import bundle
    from gsplat_core.io.exports import export

    made = []
    monkeypatch.setattr(bundle, "load_bundle", lambda folder: ("model of", folder))
    monkeypatch.setattr(export, "export_model", lambda *wanted: made.append(wanted))
    files.export(tmp_path, tmp_path / "file", "wish")
    assert made == [(("model of", tmp_path), tmp_path / "file", "wish")]


@pytest.mark.parametrize("name", ["png", "mp4"])
def test_export_program_renders_requested_outputs(ran, tmp_path, name):
    save_bundle(uniform((0.2, 0.5, 0.8)), tmp_path / "model")
    file, outputs = tmp_path / f"file.{name}", ["image", "normals"]
    wanted = {"view": "recorded", "time_s": None, "options": {"outputs": outputs, "fps": 1.0}}
    arguments = [str(tmp_path / "model"), str(file), f"--format={name}", f"--render={json.dumps(wanted)}"]
    assert files.main(arguments) == 0
    camera = uniform((0.2, 0.5, 0.8)).camera
    if name == "png":
        shown = cv2.imread(str(file))
        assert shown.shape == (camera.height_px, 2 * camera.width_px, 3)
    else:
        with av.open(str(file)) as video:
            assert video.streams.video[0].width == 2 * camera.width_px
