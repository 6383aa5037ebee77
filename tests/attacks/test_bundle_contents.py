"""Well-formed uploads of hostile models: the check rejects them with one sentence and executes nothing."""

import contextlib
import io
import json
import pickle
import struct

import pytest
import torch
from safetensors.torch import save

from gsplat_core.io.bundle import load_bundle
from services.errors import Conflict
from services.registry import check, checking
from services.registry.bundle_file import pack
from services.registry.models import ModelRegistry


@pytest.fixture
def registry(tmp_path):
    with ModelRegistry(tmp_path / "registry", most_upload_bytes=4 << 20) as opened:
        yield opened


@pytest.fixture
def check_here(monkeypatch):
    """Run the check program in this process, without resource limits. Starting a separate process takes seconds."""

    def run(command, passed_s, take, **_):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            assert check.main([command[len(checking.PROGRAM)], "--json"]) == 0
        for line in said.getvalue().splitlines():
            take(json.loads(line))
        return ""

    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "keep_files_private", lambda: None)
    monkeypatch.setattr(checking, "run_program", run)


@pytest.fixture
def payload(bundle, tmp_path):
    """Return the bytes of a valid upload."""
    pack(bundle.folder, tmp_path / "good")
    return (tmp_path / "good").read_bytes()


@pytest.fixture
def rejected(registry, bundle, tmp_path):
    """Return a function that packs and uploads the tampered bundle and returns the reason of its rejection."""

    def upload():
        pack(bundle.folder, tmp_path / "upload", overwrite=True)
        version = registry.upload("liver", tmp_path / "upload", None, "stranger").version
        record = registry.check("liver", version)
        assert record.state == "rejected", record
        with pytest.raises(Conflict, match="is rejected"):
            registry.activate("liver", version, None, "stranger")
        assert "\n" not in record.reason and str(tmp_path) not in record.reason
        return record.reason

    return upload


class Attack:
    """Object that creates a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return self.marker.touch, ()


@pytest.mark.slow
def test_valid_upload_is_accepted_and_ready(registry, payload, tmp_path):
    (tmp_path / "upload").write_bytes(payload)
    assert registry.upload("liver", tmp_path / "upload", None, "friend").version == 1
    assert registry.check("liver", 1).state == "ready"


@pytest.mark.slow
def test_check_rejects_pickle_as_tensors_without_executing(rejected, bundle, tmp_path):
    bundle.replace_tensors(pickle.dumps([Attack(tmp_path / "executed"), bytes(1000)]))
    assert rejected()
    assert not (tmp_path / "executed").exists()


def test_check_rejects_non_finite_weights(check_here, rejected, bundle):
    tensors = dict(load_bundle(bundle.folder).tensors())
    tensors["field.weights"] = torch.full_like(tensors["field.weights"], float("nan"))
    bundle.replace_tensors(save(tensors))
    assert "field.weights holds 390 of 390 values that are NaN" in rejected()


def test_check_rejects_overlapping_tensors(check_here, rejected, bundle):
    header = json.loads(bundle.header_and_data()[0])
    header["gaussians.means"]["data_offsets"] = header["gaussians.log_scales"]["data_offsets"]
    bundle.replace_header(json.dumps(header).encode())
    assert "not a safetensors file" in rejected()


def test_check_rejects_giant_tensor_header(check_here, rejected, bundle):
    bundle.replace_tensors(struct.pack("<Q", 2**40) + bundle.tensors.read_bytes()[8:])
    assert "states a header of 1099511627776 bytes" in rejected()


def test_check_rejects_tensors_missing_in_manifest(check_here, rejected, bundle):
    bundle.replace_tensors(save(dict(load_bundle(bundle.folder).tensors()) | {"__reduce__": torch.zeros(0)}))
    assert "unknown __reduce__" in rejected()


def test_check_rejects_deeply_nested_manifest(check_here, rejected, bundle):
    bundle.manifest.write_bytes(b"[" * 100_000 + b"]" * 100_000)
    assert "not valid JSON" in rejected()


def test_check_rejects_camera_over_pixel_limit(check_here, rejected, bundle):
    bundle.edit(lambda manifest: manifest["camera"].update(width_px=16384, height_px=4096))
    assert "16384x4096" in rejected()


def test_check_rejects_gaussian_count_beyond_file_size(check_here, rejected, bundle):
    bundle.edit(lambda manifest: manifest["gaussians"].update(count=1_900_000))
    assert "describes" in rejected()


@pytest.mark.slow
def test_check_rejects_model_with_empty_picture(check_here, rejected, bundle):
    """All values and the rendered picture are finite, but the Gaussians are moved out of view."""
    tensors = dict(load_bundle(bundle.folder).tensors())
    tensors["field.weights"] = torch.full_like(tensors["field.weights"], 3e38)
    bundle.replace_tensors(save(tensors))
    assert "show nothing" in rejected()
