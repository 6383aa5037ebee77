"""Renderers by name: what each can do, what it refuses, and that alpha blending is `render` of the deformed model."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import RENDERERS, Camera, InvalidInput, Model, SnapshotSlots, new_renderer, render
from gsplat_core.deformation import new_field
from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.flow import render_flow
from gsplat_core.rendering.renderer import (
    FLOW_OUTPUTS,
    FLOW_STEP_S,
    Capabilities,
    FinishedFrame,
    RendererOptions,
    checked_outputs,
)

CAMERA = Camera.from_focal(40.0, 32, 24)
WINDOW_S = (1.0, 3.0)


@pytest.fixture
def moving(make_gaussians) -> Model:
    gaussians = make_gaussians(60)
    field = new_field("basis", gaussians, WINDOW_S).detached_copy()
    for parameter in field.parameters():
        parameter += 0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    return Model(1, gaussians, field, CAMERA, WINDOW_S)


def assert_equal(output, expected):
    for name in ("image", "alpha", "depth"):
        assert torch.equal(getattr(output, name), getattr(expected, name)), name


@pytest.mark.parametrize("time_s", [1.0, 2.2, 9.0])
def test_alpha_renderer_equals_render_of_deformed_model(moving, time_s):
    background = torch.tensor([0.1, 0.5, 0.9])
    renderer = new_renderer("alpha", CAMERA, background=background)
    renderer.prepare(moving)
    assert_equal(renderer.render(CAMERA, time_s).result(), render(moving.at(time_s), CAMERA, background))


def test_renderer_gives_same_image_for_snapshot_and_source_model(moving):
    snapshot = SnapshotSlots("cpu").publish(
        moving.gaussians, moving.field, version=1, camera=CAMERA, time_window_s=WINDOW_S
    )
    renderer = new_renderer("alpha", CAMERA)
    pictures = []
    for model in (moving, snapshot):
        renderer.prepare(model)
        pictures.append(renderer.render(CAMERA, 2.2).result())
    assert_equal(*pictures)


def test_renderer_shows_newest_prepared_model(moving, make_gaussians):
    renderer = new_renderer("alpha", CAMERA)
    other = Model(2, make_gaussians(60, seed=1), None, CAMERA, WINDOW_S)
    for model in (moving, other, moving):
        renderer.prepare(model)
        assert_equal(renderer.render(CAMERA, 2.0).result(), render(model.at(2.0), CAMERA))


def test_renderer_outputs_surface_on_request(moving):
    renderer = new_renderer("alpha", CAMERA)
    renderer.prepare(moving)
    outputs = renderer.render(CAMERA, 2.0, outputs=["depth", "normals", "median_depth"]).outputs()
    assert list(outputs) == ["image", "depth", "normals", "median_depth"]
    surface = moving.surface(2.0)
    assert torch.equal(outputs["normals"], surface.normals)
    assert torch.equal(outputs["median_depth"], surface.median_depth)
    assert torch.equal(outputs["depth"], moving.render(2.0).depth)


def test_renderer_outputs_selected_by_name(moving):
    renderer = new_renderer("alpha", CAMERA)
    renderer.prepare(moving)
    frame = renderer.render(CAMERA, 2.0, outputs=["alpha"])
    assert list(frame.outputs()) == ["image", "alpha"]
    assert not frame.result().depth.any() and frame.result().alpha.any()
    with pytest.raises(InvalidSetting, match="'alpha' has no output 'heat'; it has image, alpha, depth, ray_depth"):
        renderer.render(CAMERA, 2.0, outputs=["depth", "heat"])


def test_renderer_flow_output_is_motion_to_later_time(moving):
    renderer = new_renderer("alpha", CAMERA)
    renderer.prepare(moving)
    outputs = renderer.render(CAMERA, 2.0, FLOW_OUTPUTS).outputs()
    assert list(outputs) == ["image", *FLOW_OUTPUTS]
    wanted = render_flow(moving.at(2.0), moving.at(2.0 + FLOW_STEP_S), CAMERA, CAMERA)
    assert torch.equal(outputs["flow"], wanted.flow) and outputs["flow"].any()
    assert outputs["occlusion"].shape == (CAMERA.height_px, CAMERA.width_px)
    assert not bool(outputs["occlusion"][~wanted.observed].any())


def test_checked_outputs_follow_renderer_capabilities():
    capabilities = Capabilities(("image", "normals"), {"cpu": ("fp32",)}, differentiable=False, deterministic=True)
    assert checked_outputs("mine", ["normals"], capabilities) == ("image", "normals")
    frame = FinishedFrame({"image": torch.ones(2, 3, 3), "normals": torch.ones(2, 3, 3)})
    assert frame.result().alpha.shape == (2, 3) and not frame.result().alpha.any()
    with pytest.raises(InvalidSetting, match="has no output 'depth'"):
        checked_outputs("mine", ["depth"], capabilities)


def test_new_renderer_error_lists_available_choices():
    for arguments, sentence in (
        (("beta", CAMERA), "unknown renderer 'beta'; known are alpha"),
        (("alpha", CAMERA, "mps"), "does not run on mps, only on cpu, cuda"),
    ):
        with pytest.raises(InvalidSetting, match=sentence):
            new_renderer(*arguments)
    with pytest.raises(InvalidSetting, match="does not render in fp16 on cpu, only in fp32"):
        new_renderer("alpha", CAMERA, precision="fp16")
    with pytest.raises(InvalidSetting, match="unknown precision 'fp8'"):
        new_renderer("alpha", CAMERA, precision="fp8")


def test_new_renderer_rejects_unsupported_options():
    new_renderer("alpha", CAMERA, options=RendererOptions())
    with pytest.raises(InvalidSetting, match="renderer 'alpha' has no option samples; choose "):
        new_renderer("alpha", CAMERA, options=RendererOptions(samples=4))
    for options, sentence in (
        ({"samples": 0}, "samples must be from 1 to"),
        ({"supersampling": 9}, "supersampling must be from 1 to 8, got 9"),
        ({"order": "tile"}, "unknown order 'tile'; choose splat or pixel"),
        ({"seed": -1}, "seed must be from 0"),
    ):
        with pytest.raises(InvalidSetting, match=sentence):
            RendererOptions(**options)


def test_renderer_rejects_misuse(moving):
    renderer = new_renderer("alpha", CAMERA)
    with pytest.raises(InvalidInput, match="prepare"):
        renderer.render(CAMERA, 0.0)
    renderer.prepare(moving)
    for camera in (CAMERA.scaled(2), dataclasses.replace(CAMERA, model="fisheye")):
        with pytest.raises(InvalidInput, match="make another renderer"):
            renderer.render(camera, 0.0)
    with pytest.raises(InvalidInput, match=r"background must be \[3\]"):
        new_renderer("alpha", CAMERA, background=torch.zeros(4))
    with pytest.raises(InvalidInput, match="nan"):
        renderer.render(CAMERA, float("nan"))


def test_renderer_registry_lists_capabilities_without_instantiation():
    capabilities = RENDERERS["alpha"].capabilities
    assert capabilities.outputs[:3] == ("image", "alpha", "depth") and "normals" in capabilities.outputs
    assert capabilities.devices == ("cpu", "cuda")
    assert capabilities.precisions["cuda"] == ("fp32", "fp16") and capabilities.deterministic
