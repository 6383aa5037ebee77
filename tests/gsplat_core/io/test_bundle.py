"""Saving and loading a model: bit for bit, atomically, and never half."""

import errno
import json
import os
from dataclasses import replace

import pytest
import torch

from gsplat_core.deformation import new_field
from gsplat_core.errors import BundleCorrupt, BundleError, InvalidInput
from gsplat_core.io import bundle, files
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthError, DepthSource

CAMERA = Camera([[812.5, 0, 319.25], [0, 811.0, 255.75], [0, 0, 1]], 640, 512)


def make_model(gaussians, kind="basis", version=3):
    field = None
    if kind is not None:
        torch.manual_seed(7)
        field = new_field(kind, gaussians, (0.5, 2.5)).detached_copy()
        for parameter in field.parameters():
            parameter += torch.randn_like(parameter)
    return Model(version, gaussians, field, CAMERA, (0.5, 2.0), "0f" * 32)


@pytest.mark.parametrize("kind", ["basis", "hexplane", None])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_bundle_round_trip_is_bit_exact(kind, count, make_gaussians, tmp_path):
    model = make_model(make_gaussians(count, sh_degree=2), kind)
    save_bundle(model, tmp_path / "deep" / "model")
    loaded = load_bundle(tmp_path / "deep" / "model")
    assert loaded.sha256() == model.sha256()
    assert loaded.tensors().keys() == model.tensors().keys()
    for name, tensor in model.tensors().items():
        assert torch.equal(loaded.tensors()[name].view(torch.int32), tensor.view(torch.int32)), name
    assert loaded.version == 3 and loaded.training_digest == "0f" * 32
    assert loaded.camera == CAMERA and loaded.time_window_s == (0.5, 2.0)
    assert torch.equal(loaded.at(1.0).means, model.at(1.0).means)


def test_bundle_keeps_right_eye_colours_and_digest_includes_them(make_gaussians, tmp_path):
    left = make_gaussians(4, sh_degree=1)
    model = make_model(replace(left, right_sh=torch.randn_like(left.sh)))
    save_bundle(model, tmp_path)
    loaded = load_bundle(tmp_path)
    assert loaded.sha256() == model.sha256() != make_model(left).sha256()
    torch.testing.assert_close(loaded.seen_by_right().at(1.0).sh, model.at(1.0).sh + model.gaussians.right_sh)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    for claim, said in ((1, "right_eye must be true or false"), (False, "parameters")):
        other = {**manifest, "gaussians": {**manifest["gaussians"], "right_eye": claim}}
        (tmp_path / "manifest.json").write_text(json.dumps(other))
        with pytest.raises(BundleCorrupt, match=said):
            load_bundle(tmp_path)


def test_bundle_keeps_extra_tensors_and_digest_includes_them(make_gaussians, tmp_path):
    plain = make_gaussians(4)
    model = make_model(replace(plain, extra={"semantics": torch.randn(4, 3), "weight": torch.randn(4)}))
    save_bundle(model, tmp_path)
    loaded = load_bundle(tmp_path)
    assert loaded.sha256() == model.sha256() != make_model(plain).sha256()
    assert torch.equal(loaded.at(1.0).extra["semantics"], model.gaussians.extra["semantics"])
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["gaussians"]["extra"] == {"semantics": [3], "weight": []}
    for claim, message in (
        (3, "extra must be a JSON object"),
        ({"A/b": [3]}, "'A/b' is no name of a tensor"),
        ({"semantics": 3}, "semantics must be a list of at most 3 integers, got 3"),
        ({"semantics": [3, 1, 1, 1]}, "at most 3 integers"),
        ({"semantics": [0]}, "an integer from 1 to 1024, got 0"),
        ({f"t{index}": [] for index in range(17)}, "17 extra tensors; at most 16"),
        ({"semantics": [1024] * 3}, "describes|describe"),
    ):
        (tmp_path / "manifest.json").write_text(
            json.dumps({**manifest, "gaussians": {**manifest["gaussians"], "extra": claim}})
        )
        with pytest.raises(BundleCorrupt, match=message):
            load_bundle(tmp_path)


@pytest.mark.parametrize(
    "source",
    [
        None,
        *(DepthSource(DEPTH_ORIGINS[name], metric=False) for name in DEPTH_ORIGINS),
        DepthSource(DEPTH_ORIGINS["stereo"], False, (DepthError(0.25, 0.01), DepthError(0.5, 0.02))),
    ],
)
def test_bundle_keeps_depth_source_and_digest_includes_it(source, make_gaussians, tmp_path):
    model = replace(make_model(make_gaussians(4)), depth_source=source)
    save_bundle(model, tmp_path)
    loaded = load_bundle(tmp_path)
    assert loaded.depth_source == source and loaded.sha256() == model.sha256() and not loaded.metric
    assert ("depth" in json.loads((tmp_path / "manifest.json").read_text())) is (source is not None)
    assert (model.sha256() == make_model(make_gaussians(4)).sha256()) is (source is None)


@pytest.mark.parametrize(
    ("depth", "said"),
    [
        ({"origin": "guess", "metric": False}, "origin must be one of measured, stereo, parallax, light, learned"),
        ({"origin": "measured", "metric": 1}, "metric must be true or false"),
        ({"origin": "light", "metric": True}, "depth of origin 'light' has no unit"),
        ({"origin": "parallax", "metric": True}, "depth of origin 'parallax' has no unit"),
        ({"origin": "learned", "metric": True}, "depth of origin 'learned' has no unit"),
        ([], "must be a JSON object"),
        ({"origin": "stereo", "metric": True, "errors": []}, "errors must be a list of 1 to 1024 pairs"),
        ({"origin": "stereo", "metric": True, "errors": [[0, 0.1], 3]}, "errors must be pairs of time and relative"),
        ({"origin": "stereo", "metric": True, "errors": [[1, 0.1], [0, 0.1]]}, "in temporal order"),
        ({"origin": "stereo", "metric": True, "errors": [[0, 2]]}, "relative"),
        ({"origin": "stereo", "metric": True, "errors": [[0, "0.1"]]}, "relative"),
    ],
)
def test_bundle_with_invalid_depth_source_is_refused(depth, said, make_gaussians, tmp_path):
    save_bundle(make_model(make_gaussians(4)), tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "depth": depth}))
    with pytest.raises(BundleCorrupt, match=said):
        load_bundle(tmp_path)


def test_bundle_keeps_extended_and_trimmed_field(make_gaussians, tmp_path):
    gaussians = make_gaussians(5)
    field = new_field("basis", gaussians, (0.0, 1.0), spacing_s=0.1)
    field.extend((7.3, 9.1))
    with torch.no_grad():
        field.weights.normal_(generator=torch.Generator().manual_seed(0))
    model = Model(1, gaussians, field.detached_copy(), CAMERA, (7.3, 9.1))
    save_bundle(model, tmp_path)
    assert torch.equal(load_bundle(tmp_path).at(8.8).means, model.at(8.8).means)


def test_bundle_folder_has_manifest_and_tensors(make_gaussians, tmp_path):
    save_bundle(make_model(make_gaussians(6)), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["manifest.json", "model.safetensors"]
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["format_version"] == 1 and manifest["version"] == 3
    assert manifest["gaussians"] == {"count": 6, "sh_degree": 0}
    assert manifest["units"] == {"length": "mm", "time": "s"}
    assert manifest["field"]["kind"] == "basis"
    assert manifest["tensors"]["bytes"] == (tmp_path / "model.safetensors").stat().st_size


def test_load_bundle_of_run_folder_names_model_folder(make_gaussians, tmp_path):
    save_bundle(make_model(make_gaussians(6)), tmp_path / "model")
    with pytest.raises(BundleError, match=r"is the folder of a run, whose model is .*model; give that folder"):
        load_bundle(tmp_path)


def test_save_bundle_replaces_earlier_model(make_gaussians, tmp_path):
    save_bundle(make_model(make_gaussians(6), version=1), tmp_path)
    save_bundle(make_model(make_gaussians(9), version=2), tmp_path)
    loaded = load_bundle(tmp_path)
    assert (loaded.version, loaded.gaussians.count) == (2, 9)


@pytest.mark.parametrize("fails_at", ["model.next.safetensors", "manifest.next.json"])
def test_save_bundle_on_full_disk_keeps_previous_bundle(fails_at, make_gaussians, tmp_path, monkeypatch):
    before = make_model(make_gaussians(6))
    save_bundle(before, tmp_path)
    real_fsync = os.fsync

    def full_disk(descriptor):
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith(fails_at):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real_fsync(descriptor)

    monkeypatch.setattr(files.os, "fsync", full_disk)
    with pytest.raises(BundleError, match=r"No space left on device") as raised:
        save_bundle(make_model(make_gaussians(9)), tmp_path)
    assert str(tmp_path) in str(raised.value)
    monkeypatch.undo()
    assert load_bundle(tmp_path).sha256() == before.sha256()
    assert not (tmp_path / fails_at).exists()


@pytest.mark.parametrize("renames", [0, 1])
def test_crash_between_renames_leaves_complete_bundle(renames, make_gaussians, tmp_path, monkeypatch):
    """Without a rename the old model loads. With only the tensors renamed, the new one loads."""
    old, new = make_model(make_gaussians(6)), make_model(make_gaussians(6, seed=4))
    save_bundle(old, tmp_path)
    done = []

    def stop_after(source, target):
        if len(done) == renames:
            raise KeyboardInterrupt
        done.append(target)
        files.replace_durably(source, target)

    monkeypatch.setattr(bundle, "replace_durably", stop_after)
    with pytest.raises(KeyboardInterrupt):
        save_bundle(new, tmp_path)
    monkeypatch.undo()
    assert load_bundle(tmp_path).sha256() == (new if renames else old).sha256()
    save_bundle(old, tmp_path)
    assert load_bundle(tmp_path).sha256() == old.sha256()


def test_first_save_crashed_between_renames_loads(make_gaussians, tmp_path):
    model = make_model(make_gaussians(3))
    save_bundle(model, tmp_path)
    (tmp_path / "manifest.json").rename(tmp_path / "manifest.next.json")
    assert load_bundle(tmp_path).sha256() == model.sha256()


def test_save_bundle_error_names_unwritable_path(make_gaussians, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BundleError, match=r"file/model"):
        save_bundle(make_model(make_gaussians(1)), tmp_path / "file" / "model")


def test_save_bundle_refuses_non_finite_model(make_gaussians, tmp_path):
    good = make_model(make_gaussians(6))
    save_bundle(good, tmp_path)
    bad = make_model(make_gaussians(6))
    bad.field.weights[2, 3, :2] = float("nan")
    with pytest.raises(BundleCorrupt, match=r"field\.weights holds 2 of"):
        save_bundle(bad, tmp_path)
    assert load_bundle(tmp_path).sha256() == good.sha256()


def test_save_bundle_accepts_large_finite_values(make_gaussians, tmp_path):
    gaussians = make_gaussians(6)
    gaussians.means[:] = 3e38
    model = make_model(gaussians, None)
    save_bundle(model, tmp_path)
    assert load_bundle(tmp_path).sha256() == model.sha256()


def test_save_bundle_refuses_float64(make_gaussians, tmp_path):
    with pytest.raises(InvalidInput, match="float64"):
        save_bundle(make_model(make_gaussians(2).to(dtype=torch.float64), None), tmp_path)
