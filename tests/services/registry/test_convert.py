"""Splat files of other programs are converted to models of the registry."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import FORMATS, ExportWish
from services.errors import CheckFailed, Rejected
from services.registry import check
from services.registry.bundle_file import unpack
from services.registry.models import ModelRegistry
from services.registry.records import State
from tests.services.supervisor.test_model_show import uniform

FILES = {"ply": "ply", "compressed-ply": "ply", "splat": "splat", "spz": "spz"}


def written(folder: Path, format_name: str) -> Path:
    file = folder / f"scene.{FILES[format_name]}"
    model = uniform((0.2, 0.5, 0.8))
    export_model(model, file, ExportWish(FORMATS[format_name]))
    return file


@pytest.fixture
def converted(monkeypatch, capsys, tmp_path):
    """Return the program's result in this process, without resource limits."""
    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "keep_files_private", lambda: None)

    def result(file: Path) -> dict[str, object]:
        assert check.main([str(file), str(tmp_path / "made.isplat"), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return result


@pytest.mark.parametrize("format_name", FILES)
def test_convert_makes_static_model_from_splat_file(converted, tmp_path, format_name):
    said = converted(written(tmp_path, format_name))
    assert said["stage"] == "ready" and said["gaussians"] == 144
    made = tmp_path / "made.isplat"
    (tmp_path / "model").mkdir()
    with open(made, "rb") as file:
        unpack(file, made.stat().st_size, tmp_path / "model")
    model, wanted = load_bundle(tmp_path / "model"), uniform((0.2, 0.5, 0.8))
    assert model.field is None
    found = torch.cdist(model.gaussians.means, wanted.gaussians.means).min(1).values
    assert float(found.max()) < 0.01
    colours = model.render(model.time_window_s[0], model.camera).image
    assert np.allclose(colours[colours.shape[0] // 2, colours.shape[1] // 2], (0.2, 0.5, 0.8), atol=0.03)
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith("tmp")] == []


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "file.ply|a.ply"),
        ("a.splat", bytes(33), "33 bytes"),
        ("a.splat", b"", "no Gaussians"),
        ("a.spz", b"\x1f\x8b" + bytes(40), "gzip"),
        ("a.spz", b"NGSP" + bytes(40), "version"),
    ],
)
def test_convert_rejects_invalid_splat_file_with_reason(converted, tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    said = converted(tmp_path / name)
    assert said["stage"] == "rejected" and str(tmp_path) not in said["reason"]
    assert any(word in said["reason"] for word in reason.split("|"))
    assert not (tmp_path / "made.isplat").exists()


def test_convert_rejects_splat_file_with_too_many_gaussians(converted, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "MOST_GAUSSIANS", 100)
    assert "144 Gaussians; at most 100" in converted(written(tmp_path, "ply"))["reason"]


@pytest.mark.slow
def test_uploaded_splat_file_is_converted_checked_and_activated(tmp_path):
    with ModelRegistry(tmp_path / "registry") as registry:
        file = written(tmp_path, "spz").rename(tmp_path / "upload-1")
        made = registry.upload_splats("liver", file, "spz", "test")
        assert registry.check("liver", made.version).state is State.READY
        registry.activate("liver", made.version, None, "test")
        assert load_bundle(registry.folder_of("liver", made.version)).gaussians.count == 144
        with pytest.raises(Rejected, match=r"the \.ply file"):
            registry.upload_splats("liver", file, "ply", "test")
        assert os.listdir(tmp_path / "registry" / "incoming") == []


@pytest.mark.parametrize(
    ("program", "error", "message"),
    [
        ('import sys; print(\'{"stage": "rejected", "reason": "file.ply is bad"}\')', Rejected, "the .ply file is bad"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", Rejected, "SIGKILL"),
        ("raise SystemExit('no memory here')", CheckFailed, "no memory here"),
        ("pass", CheckFailed, "without a result"),
    ],
)
def test_upload_splats_raises_rejected_or_check_failed_by_program_end(tmp_path, program, error, message):
    with ModelRegistry(tmp_path / "registry", convert_program=(sys.executable, "-c", program)) as registry:
        (tmp_path / "upload-1").write_bytes(b"ply")
        with pytest.raises(error, match=message):
            registry.upload_splats("liver", tmp_path / "upload-1", "ply", "test")
        assert registry.models() == [] and os.listdir(tmp_path / "registry" / "incoming") == []
