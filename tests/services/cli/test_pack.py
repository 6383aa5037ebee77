"""`intrasplat pack`: a single uploadable file with reproducible bytes."""

from __future__ import annotations

import json

import pytest

from gsplat_core.io.bundle import load_bundle
from services.cli.app import run
from services.cli.terminal import BAD_INPUT
from services.registry.models import ModelRegistry
from tests.services.registry.made import save_model, sha256


@pytest.mark.slow
def test_packed_model_is_accepted_by_registry(tmp_path, capsys):
    model, file = save_model(tmp_path / "model"), tmp_path / "liver.isplat"
    assert run(["pack", str(model), str(file), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"path": str(file), "bytes": file.stat().st_size, "sha256": sha256(file)}
    with ModelRegistry(tmp_path / "registry") as registry:
        assert registry.upload("liver", file, said["sha256"], "surgeon").digest == said["sha256"]


def test_pack_overwrites_only_its_own_files_on_request(tmp_path, capsys):
    model, file = save_model(tmp_path / "model"), tmp_path / "liver.isplat"
    file.write_bytes(b"mine")
    assert run(["pack", str(model), str(file)]) == BAD_INPUT
    assert "already exists" in capsys.readouterr().err and file.read_bytes() == b"mine"
    assert run(["pack", str(model), str(file), "--overwrite"]) == BAD_INPUT
    assert "was not written by intrasplat" in capsys.readouterr().err and file.read_bytes() == b"mine"
    file.unlink()
    assert run(["pack", str(model), str(file)]) == 0
    capsys.readouterr()
    assert run(["pack", str(model), str(file), "--overwrite"]) == 0
    assert capsys.readouterr().out == f"{file}\n" and file.stat().st_size > 1000


@pytest.mark.parametrize(
    ("model", "file", "said"),
    [
        ("model", "liver.zip", "does not end in .isplat"),
        ("model", "nowhere/liver.isplat", "there is no folder"),
        ("missing", "liver.isplat", "is missing"),
        ("broken", "liver.isplat", "has SHA-256"),
    ],
)
def test_pack_prints_one_error_line_for_invalid_input(tmp_path, capsys, model, file, said):
    save_model(tmp_path / "model")
    broken = save_model(tmp_path / "broken") / "model.safetensors"
    broken.write_bytes(broken.read_bytes()[:-1] + b"x")
    assert run(["pack", str(tmp_path / model), str(tmp_path / file)]) == BAD_INPUT
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / file).exists()


@pytest.mark.parametrize("first", [True, False])
def test_pack_refuses_incompletely_saved_model(tmp_path, capsys, first):
    """Both bundles load: their tensors match the manifest that was not renamed yet."""
    model = save_model(tmp_path / "model")
    save_model(tmp_path / "other", seed=1)
    (model / "manifest.json").rename(model / ("manifest.next.json" if first else "manifest.json"))
    if not first:
        (model / "manifest.next.json").write_bytes((tmp_path / "other" / "manifest.json").read_bytes())
        (model / "model.safetensors").write_bytes((tmp_path / "other" / "model.safetensors").read_bytes())
    load_bundle(model)
    assert run(["pack", str(model), str(tmp_path / "liver.isplat")]) == BAD_INPUT
    assert "was not saved to its end" in capsys.readouterr().err
