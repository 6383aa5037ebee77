"""Training by a renderer other than alpha blending: loss, growth, bundles and refusals."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import new_renderer
from gsplat_core.errors import ExportError, InvalidSetting
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import FORMATS, ExportWish
from gsplat_core.models import TrainedBy
from gsplat_core.rendering.weighted_sum import OPACITY
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor


@pytest.fixture
def trained(make_frame, camera):
    config = ReconstructorConfig(gaussians=300, renderer="weighted_sum", first_frame_steps=20, steps_per_frame=10)
    online = Reconstructor(config, camera)
    reports = [online.observe(make_frame(seq)) for seq in range(3)]
    return online, reports


def test_weighted_sum_training_lowers_error_and_records_renderer(trained, make_frame, camera):
    online, _ = trained
    model = online.snapshot()
    assert model.trained_by.renderer == "weighted_sum"
    assert set(model.trained_by.values) == {"sigma", "background", "distance"}
    start = Reconstructor(dataclasses.replace(online.config, first_frame_steps=1), camera)
    start.observe(make_frame(0))
    wanted = torch.from_numpy(make_frame(2).image) / 255

    def error(model):
        renderer = new_renderer("weighted_sum", camera)
        renderer.prepare(model)
        return float((renderer.render(camera, model.time_window_s[1]).result().image - wanted).abs().mean())

    assert error(model) < 0.7 * error(start.snapshot())
    first = start.snapshot().trained_by.values
    assert model.trained_by.values["sigma"] != pytest.approx(first["sigma"], rel=1e-4)


def test_weighted_sum_offline_fit_grows_scene(make_frame, camera):
    config = ReconstructorConfig(gaussians=200, max_gaussians=400, renderer="weighted_sum")
    offline = Reconstructor(config, camera)
    offline.fit([make_frame(seq) for seq in range(4)], steps=40)
    model = offline.snapshot()
    assert model.gaussian_count > 200
    assert model.gaussians.extra[OPACITY].shape == (model.gaussian_count, 16)
    assert all(t.isfinite().all() for t in model.tensors().values())


def test_bundle_keeps_renderer_of_weighted_sum_model(trained, tmp_path):
    model = trained[0].snapshot()
    save_bundle(model, tmp_path / "model")
    loaded = load_bundle(tmp_path / "model")
    assert loaded.trained_by == model.trained_by
    assert loaded.sha256() == model.sha256()
    pictures = []
    for each in (model, loaded):
        renderer = new_renderer("weighted_sum", model.camera)
        renderer.prepare(each)
        pictures.append(renderer.render(model.camera, 0.0).result().image)
    assert torch.equal(*pictures)


def test_renderers_refuse_models_trained_by_other_renderer(trained):
    model = trained[0].snapshot()
    with pytest.raises(InvalidSetting, match="'alpha' cannot show this model, which was trained by 'weighted_sum'"):
        new_renderer("alpha", model.camera).prepare(model)
    plain = dataclasses.replace(model, trained_by=TrainedBy())
    with pytest.raises(InvalidSetting, match="choose renderer 'alpha'"):
        new_renderer("weighted_sum", model.camera).prepare(plain)


def test_weighted_sum_model_export_is_refused(trained, tmp_path):
    with pytest.raises(ExportError, match="trained by renderer 'weighted_sum'"):
        export_model(trained[0].snapshot(), tmp_path / "a.ply", ExportWish(FORMATS["ply"]))
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.cuda
@pytest.mark.parametrize("preallocate", [False, True])
def test_weighted_sum_training_on_cuda_is_deterministic(gpu, make_frame, camera, preallocate):
    config = ReconstructorConfig(
        gaussians=300, renderer="weighted_sum", first_frame_steps=20, steps_per_frame=10, preallocate=preallocate
    )
    models = []
    for _ in range(2):
        online = Reconstructor(config, camera, device=gpu)
        for seq in range(3):
            online.observe(make_frame(seq))
        models.append(online.publish().as_model())
    assert models[0].trained_by.renderer == "weighted_sum"
    assert models[0].trained_by == models[1].trained_by
    assert models[0].sha256() == models[1].sha256()
    renderer = new_renderer("weighted_sum", camera, gpu)
    renderer.prepare(models[0])
    image = renderer.render(camera, models[0].time_window_s[1]).result().image.cpu()
    on_cpu = new_renderer("weighted_sum", camera)
    on_cpu.prepare(models[0].to("cpu"))
    difference = (image - on_cpu.render(camera, models[0].time_window_s[1]).result().image).abs()
    # A pixel at the edge of a splat may belong to it on one device only.
    assert float(difference.max()) < 0.01 and float(difference.mean()) < 1e-4
    assert float((image - torch.from_numpy(make_frame(2).image) / 255).abs().mean()) < 0.1
