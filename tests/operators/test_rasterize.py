"""Rendering gives what is displayed: bytes, depth in the scene's unit, opacity."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import torch

from gsplat_core.choices import RENDERERS
from gsplat_core.models import Model, SnapshotSlots
from gsplat_core.rendering.renderer import Capabilities, FinishedFrame
from gsplat_core.scene.frames import FrameStatus
from operators.messages import DeformedScene
from operators.rasterize import RasterizeOp, displayed


def test_rasterize_scene_initialised_from_frame_matches_frame(frame, model, camera, compute):
    scene = DeformedScene(frame(), model(4), camera, True)
    (shown,) = compute(RasterizeOp(None), scene=scene)
    assert shown.image.dtype == np.uint8 and shown.image.shape == frame().image.shape
    assert shown.model_version == 4 and shown.trained
    covered = shown.alpha > 0.5
    assert covered.mean() > 0.5
    np.testing.assert_allclose(shown.depth[covered], 50, atol=0.5)
    error = np.abs(shown.image.astype(int) - frame().image)[covered].mean()
    # 60 Gaussians for 384 pixels: 10 grey levels. The picture moved by two pixels scores 19, swapped channels 40, its mean colour 42.
    assert error < 14


def test_rasterize_further_outputs_do_not_change_image_or_depth(frame, model, camera, compute):
    scene = DeformedScene(frame(), model(4), camera, True)
    (shown,) = compute(RasterizeOp(None, outputs=("depth", "normals", "ray_depth")), scene=scene)
    (plain,) = compute(RasterizeOp(None), scene=scene)
    assert list(shown.outputs) == ["normals", "ray_depth"] and plain.outputs == {}
    assert shown.outputs["normals"].shape == (*shown.depth.shape, 3)
    np.testing.assert_array_equal(shown.image, plain.image)
    np.testing.assert_array_equal(shown.depth, plain.depth)


def test_rasterize_is_black_outside_loss_mask(frame, model, camera, compute):
    kept = np.ones(frame().image.shape[:2], np.uint8)
    kept[:, :6] = 0
    plain, limited, unseen = (
        compute(RasterizeOp(None), scene=DeformedScene(frame(**fields), model(4), camera, True))[0]
        for fields in ({}, {"loss_mask": kept}, {"loss_mask": 0 * kept, "withheld": "blur"})
    )
    assert plain.image[:, :6].any() and not limited.image[:, :6].any()
    np.testing.assert_array_equal(limited.image[:, 6:], plain.image[:, 6:])
    np.testing.assert_array_equal(unseen.image, plain.image)


def test_displayed_clips_and_rounds_to_nearest():
    image = torch.tensor([[[-1.0, 0.0, 0.5 / 255 + 1e-4], [1.0, 2.0, 0.4 / 255]]])
    np.testing.assert_array_equal(displayed(image), [[[0, 0, 1], [255, 255, 0]]])


def test_rasterize_snapshot_matches_model(frame, model, camera, compute):
    published = model(4)
    snapshot = SnapshotSlots("cpu").publish(
        published.gaussians, None, version=4, camera=camera, time_window_s=(0.0, 1.0)
    )
    scenes = [DeformedScene(frame(), shown, camera, True) for shown in (published, snapshot)]
    first, second = (compute(RasterizeOp(None), scene=scene)[0] for scene in scenes)
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.depth, second.depth)
    assert second.model_version == 4
    assert torch.equal(scenes[1].gaussians.means, scenes[0].gaussians.means)


def test_rasterize_passes_model_to_renderer_without_snapshot_support(frame, model, camera, compute):
    prepared = []

    class Grey:
        capabilities = Capabilities(("image",), {"cpu": ("fp32",)}, differentiable=False, deterministic=True)

        def __init__(self, camera, device, **options):
            self.size = camera.height_px, camera.width_px

        def prepare(self, model):
            prepared.append(model)

        def render(self, camera, time_s, outputs=()):
            return FinishedFrame({"image": torch.full((*self.size, 3), 0.5)})

    RENDERERS.add("grey", Grey)
    try:
        snapshot = SnapshotSlots("cpu").publish(
            model().gaussians, None, version=1, camera=camera, time_window_s=(0.0, 1.0)
        )
        (shown,) = compute(RasterizeOp(None, renderer="grey"), scene=DeformedScene(frame(), snapshot, camera, True))
    finally:
        RENDERERS.remove("grey")
    assert [type(given) for given in prepared] == [Model]
    assert (shown.image == 128).all() and not shown.depth.any() and not shown.alpha.any()


def _run(operator, compute, scenes):
    """Each scene's outputs, by the kind of message."""
    operator.start()
    return [compute(operator, scene=scene) for scene in scenes]


def test_prediction_uses_previous_model_at_frame_time(frame, camera, model, compute):
    asked = []

    class Moving(Model):
        """Says at which time it is looked at."""

        def at(self, time_s):
            asked.append((self.version, time_s))
            return super().at(time_s)

    def moving(version):
        made = model(version, index=version)
        return Moving(version, made.gaussians, None, camera, (0.0, 1.0))

    scenes = [DeformedScene(frame(k), moving(k + 1), camera, True) for k in range(3)]
    outputs = _run(RasterizeOp(None, predict_every=1), compute, scenes)
    assert [[type(message).__name__ for message in each] for each in outputs] == [["RenderedFrame", "Prediction"]] * 3
    first, second, third = (each[1] for each in outputs)
    assert first.image is None, "nothing was learned before the first frame"
    assert (second.frame.seq, third.frame.seq) == (1, 2)
    assert asked == [(1, 0.0), (2, 0.04), (1, 0.04), (3, 0.08), (2, 0.08)]
    # The model of a resting scene shows the same at any time.
    np.testing.assert_array_equal(third.image, outputs[1][0].image)
    assert (third.image != outputs[2][0].image).any()


def test_prediction_uses_pose_of_frame(frame, model, camera, compute):
    pose = np.eye(4)
    pose[0, 3] = 8.0
    shown = [model(1), model(2)]
    still = DeformedScene(frame(0), shown[0], camera, True)
    moved = DeformedScene(frame(1, pose=pose), shown[1], camera.with_pose(pose), True)
    (_, (_, predicted)) = _run(RasterizeOp(None, predict_every=1), compute, [still, moved])
    unseen = DeformedScene(frame(1, pose=pose), shown[0], camera.with_pose(pose), True)
    np.testing.assert_array_equal(predicted.image, compute(RasterizeOp(None), scene=unseen)[0].image)


@pytest.mark.parametrize(
    "unlike", [{"status": FrameStatus.DAMAGED}, {"withheld": "blur"}, {"scene": 1}, {"new_scene": "cut"}]
)
def test_no_prediction_for_unscored_frame_or_new_scene(frame, model, camera, compute, unlike):
    scenes = [
        DeformedScene(frame(0), model(1), camera, True),
        DeformedScene(frame(1, **unlike), model(2), camera, True),
    ]
    (_, (_, predicted)) = _run(RasterizeOp(None, predict_every=1), compute, scenes)
    assert predicted.image is None


def test_no_prediction_for_frame_of_other_size(frame, model, camera, compute):
    small, half = frame(0), camera.scaled(0.5)
    other = frame(1, image=np.ascontiguousarray(frame(1).image[::2, ::2]))
    scenes = [DeformedScene(small, model(1), camera, True), DeformedScene(other, model(2), half, True)]
    (_, (_, predicted)) = _run(RasterizeOp(None, predict_every=1), compute, scenes)
    assert predicted.image is None


def test_predict_every_third_frame_and_release_model_on_stop(frame, model, camera, compute):
    operator = RasterizeOp(None, predict_every=3)
    scenes = [DeformedScene(frame(k), model(k + 1), camera, True) for k in range(7)]
    predicted = [each[1].image is not None for each in _run(operator, compute, scenes)]
    assert predicted == [False, False, True, False, False, True, False]
    operator.stop()
    held = weakref.ref(scenes[-1].model)
    del scenes
    gc.collect()
    assert held() is None


def test_no_prediction_by_default(frame, model, camera, compute):
    scenes = [DeformedScene(frame(k), model(k + 1), camera, True) for k in range(2)]
    assert [len(each) for each in _run(RasterizeOp(None), compute, scenes)] == [1, 1]
