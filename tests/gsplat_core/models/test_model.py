"""`Model`: state at a time, digest and rendering."""

import dataclasses

import pytest
import torch

from gsplat_core.deformation import new_field
from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera

CAMERA = Camera.from_focal(40.0, 32, 24)
KINDS = pytest.mark.parametrize("kind", ["basis", "hexplane", None])


def make_model(gaussians, kind="basis", version=1, window=(1.0, 3.0)):
    torch.manual_seed(0)
    field = None
    if kind is not None:
        field = new_field(kind, gaussians, window).detached_copy()
        for parameter in field.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return Model(version, gaussians, field, CAMERA, window, "ab" * 32)


@KINDS
def test_model_at_equals_field_at_time(kind, make_gaussians):
    gaussians = make_gaussians(30)
    model = make_model(gaussians, kind)
    wanted = gaussians if kind is None else model.field(gaussians, 2.2)
    torch.testing.assert_close(model.at(2.2).means, wanted.means, rtol=1e-5, atol=1e-5)


def test_model_at_caches_last_time(make_gaussians):
    model = make_model(make_gaussians(30))
    first = model.at(2.0)
    assert model.at(2.0) is first
    other = model.at(2.5)
    assert not torch.equal(other.means, first.means)
    assert torch.equal(model.at(2.0).means, first.means)


def test_model_at_clamps_time_to_window(make_gaussians):
    model = make_model(make_gaussians(10))
    assert torch.equal(model.at(-4.0).means, model.at(1.0).means)
    assert torch.equal(model.at(400.0).means, model.at(3.0).means)
    with pytest.raises(InvalidInput, match="nan"):
        model.at(float("nan"))


@KINDS
def test_model_render_at_time(kind, make_gaussians):
    model = make_model(make_gaussians(60), kind)
    out = model.render(2.0)
    assert out.image.shape == (24, 32, 3) and out.depth.shape == (24, 32)
    assert out.image.isfinite().all() and float(out.alpha.max()) > 0.1
    assert not out.image.requires_grad
    small = model.render(2.0, CAMERA.scaled(0.5))
    assert small.image.shape == (12, 16, 3)


@KINDS
def test_empty_model_renders_background(kind, make_gaussians):
    out = make_model(make_gaussians(0), kind).render(2.0, background=torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(out.image[5, 5], torch.tensor([0.1, 0.2, 0.3]))


def test_model_digest_depends_on_content_not_version(make_gaussians):
    model = make_model(make_gaussians(20), version=1)
    digest = model.sha256()
    assert len(digest) == 64
    assert make_model(make_gaussians(20), version=7).sha256() == digest
    for changed in (
        dataclasses.replace(model, time_window_s=(1.0, 2.0)),
        dataclasses.replace(model, camera=CAMERA.scaled(2.0)),
        dataclasses.replace(model, training_digest=None),
        make_model(make_gaussians(20, seed=1)),
        make_model(make_gaussians(20), "hexplane"),
        make_model(make_gaussians(20), None),
    ):
        assert changed.sha256() != digest
    with torch.no_grad():
        model.field.weights[3, 2, 1] += 1e-6
    assert model.sha256() != digest


def test_model_parameter_count(make_gaussians):
    gaussians = make_gaussians(7, sh_degree=1)
    assert make_model(gaussians, None).parameter_count == 7 * (3 + 4 + 3 + 1 + 12)
    assert make_model(gaussians).parameter_count == 7 * (3 + 4 + 3 + 1 + 12) + 7 * 26 * 15


def test_model_rejects_invalid_arguments(make_gaussians):
    gaussians = make_gaussians(4)
    with pytest.raises(InvalidInput, match=r"field\.weights.*require gradients"):
        Model(1, gaussians, new_field("basis", gaussians, (0.0, 1.0)), CAMERA, (0.0, 1.0))
    with pytest.raises(InvalidInput, match=r"gaussians\.means"):
        Model(1, make_gaussians(4).requires_grad_(), None, CAMERA, (0.0, 1.0))
    field = new_field("basis", make_gaussians(5), (0.0, 1.0)).detached_copy()
    with pytest.raises(InvalidInput, match="5 Gaussians, the model has 4"):
        Model(1, gaussians, field, CAMERA, (0.0, 1.0))
    with pytest.raises(InvalidInput, match="version"):
        Model(0, gaussians, None, CAMERA, (0.0, 1.0))
    with pytest.raises(InvalidInput, match="time_window_s"):
        Model(1, gaussians, None, CAMERA, (1.0, 0.0))


def test_model_is_frozen(make_gaussians):
    with pytest.raises(dataclasses.FrozenInstanceError):
        make_model(make_gaussians(2)).version = 3


@KINDS
@pytest.mark.cuda
def test_model_to_device_keeps_content_and_image(gpu, kind, make_gaussians):
    model = make_model(make_gaussians(60), kind)
    there = model.to(gpu)
    assert model.to("cpu") is model and there.to(gpu) is there
    assert {tensor.device for tensor in there.tensors().values()} == {gpu}
    assert {tensor.device.type for tensor in model.tensors().values()} == {"cpu"}
    assert there.sha256() == there.to("cpu").sha256() == model.sha256()
    seen, expected = there.render(2.0), model.render(2.0)
    assert seen.image.device == gpu
    torch.testing.assert_close(seen.image.cpu(), expected.image, rtol=0, atol=5e-3)
