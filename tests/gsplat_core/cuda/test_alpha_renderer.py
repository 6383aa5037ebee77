"""Alpha blending of published snapshots on a GPU: one captured graph per slot, with the result of uncaptured rendering."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import Camera, Model, SnapshotSlots, new_renderer, render
from gsplat_core.deformation import BasisField, new_field
from gsplat_core.rendering import alpha

WIDTH_PX, HEIGHT_PX = 150, 101
WINDOW_S = (0.0, 1.0)


@pytest.fixture
def camera() -> Camera:
    return Camera.from_focal(120.0, WIDTH_PX, HEIGHT_PX)


@pytest.fixture
def scene(make_gaussians):
    return make_gaussians(800, sh_degree=1).to("cuda")


@pytest.fixture
def captures(monkeypatch):
    """Count the captured graphs."""
    made = []
    original = alpha._capture
    monkeypatch.setattr(alpha, "_capture", lambda *arguments: made.append(1) or original(*arguments))
    return made


def moving(gaussians, kind="basis", seed=0):
    torch.manual_seed(seed)
    field = new_field(kind, gaussians, WINDOW_S).to("cuda")
    for parameter in field.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return field


def publish(slots, gaussians, field, camera, version=1):
    window_s = WINDOW_S if field is None else field.time_window_s
    return slots.publish(gaussians, field, version=version, camera=camera, time_window_s=window_s)


def assert_same_bits(output, expected):
    for name in ("image", "alpha", "depth"):
        assert torch.equal(getattr(output, name), getattr(expected, name)), name


def assert_same_shapes(output, expected):
    """Results are bit-identical except for colours, to which the captured path adds the field's part in another order."""
    assert torch.equal(output.alpha, expected.alpha) and torch.equal(output.depth, expected.depth)
    torch.testing.assert_close(output.image, expected.image, rtol=1e-5, atol=1e-5)


def assert_near(output, expected):
    torch.testing.assert_close(output.image, expected.image, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(output.alpha, expected.alpha, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", ["basis", "hexplane", None])
def test_alpha_renderer_snapshot_equals_single_launches(scene, camera, kind):
    field = None if kind is None else moving(scene, kind)
    snapshot = publish(SnapshotSlots("cuda"), scene, field, camera)
    renderer = new_renderer("alpha", camera, "cuda")
    renderer.prepare(snapshot)
    for time_s in (-1.0, 0.0, 0.4, 1.0, 9.0):
        expected = render(snapshot.as_model().at(time_s), camera)
        check = {"hexplane": assert_near, "basis": assert_same_shapes, None: assert_same_bits}[kind]
        check(renderer.render(camera, time_s).result(), expected)


def test_alpha_renderer_recaptures_nothing_for_growing_scene(make_gaussians, scene, camera, captures):
    field = BasisField(scene.count, WINDOW_S, bumps=6).to("cuda")
    slots, renderer = SnapshotSlots("cuda"), new_renderer("alpha", camera, "cuda")
    held = None
    for version in range(1, 9):
        torch.nn.init.normal_(field.weights, std=0.05)
        snapshot = publish(slots, scene, field, camera, version)
        renderer.prepare(snapshot)
        assert_same_shapes(renderer.render(camera, 0.5).result(), render(snapshot.as_model().at(0.5), camera))
        if version == 3:
            captured = len(captures)
        more = make_gaussians(20, sh_degree=1, seed=version).to("cuda")
        scene = scene.append(more)
        field.append(more.count)
        field.extend((0.0, field.time_window_s[1] + field.spacing_s), hold_at_s=0.5)
        held = snapshot  # noqa: F841 - the last one is held while the next one is published
    assert slots.count <= 3
    assert len(captures) == captured, "a graph was captured although the scene stayed within its capacity"


def test_alpha_renderer_frame_unaffected_by_later_snapshots(scene, camera):
    slots, renderer = SnapshotSlots("cuda"), new_renderer("alpha", camera, "cuda")
    expected = render(scene, camera)
    training, showing = torch.cuda.Stream(), torch.cuda.Stream()
    training.wait_stream(torch.cuda.current_stream())
    pictures = []
    for version in range(1, 20):
        with torch.cuda.stream(training):
            brighter = scene.map(torch.clone)
            brighter.sh[:, 0] += 0.1 * (version % 3)
            snapshot = publish(slots, brighter, None, camera, version)
        with torch.cuda.stream(showing):
            torch.cuda._sleep(2_000_000)  # the picture is late, the next snapshots are not
            renderer.prepare(snapshot)
            frame = renderer.render(camera, 0.0)
            del snapshot
            pictures.append((version % 3, frame.result().image.clone()))
    torch.cuda.synchronize()
    assert torch.equal(next(image for kind, image in pictures if kind == 0), expected.image)
    for kind in range(3):
        same = [image for k, image in pictures if k == kind]
        assert all(torch.equal(image, same[0]) for image in same[1:])
    assert not torch.equal(pictures[0][1], pictures[1][1])


def test_alpha_renderer_repeats_overflowing_frame_in_every_slot(make_gaussians, camera):
    scene = make_gaussians(3000).to("cuda")
    large = scene.map(torch.clone)
    large.log_scales.fill_(2.3)  # each covers most of the picture: no initial capacity holds them
    slots, renderer = SnapshotSlots("cuda"), new_renderer("alpha", camera, "cuda")
    held = []
    for version, gaussians in enumerate([scene, large, large, scene], start=1):
        held = [*held[-1:], publish(slots, gaussians, None, camera, version)]
        renderer.prepare(held[-1])
        assert_same_bits(renderer.render(camera, 0.0).result(), render(gaussians, camera))


def test_alpha_renderer_accepts_model_and_half_precision(scene, camera):
    field = moving(scene).requires_grad_(False)
    model = Model(1, scene, field, camera, WINDOW_S)
    expected = render(model.at(0.4), camera)
    for published in (model, publish(SnapshotSlots("cuda"), scene, field, camera)):
        exact, near = (new_renderer("alpha", camera, "cuda", precision=p) for p in ("fp32", "fp16"))
        for renderer in (exact, near):
            renderer.prepare(published)
        assert_same_shapes(exact.render(camera, 0.4).result(), expected)
        error = (near.render(camera, 0.4).result().image - expected.image).square().mean()
        assert 0 < float(error) < 10 ** -(50 / 10)


def test_snapshot_spare_rows_do_not_change_image(scene, camera):
    snapshot = publish(SnapshotSlots("cuda"), scene, None, camera)
    everything = snapshot.slot.gaussians
    assert everything.count > scene.count and (everything.logit_opacities[scene.count :] == -math.inf).all()
    assert_same_bits(render(everything, camera), render(scene, camera))
