"""Classes of Gaussians trained by labels on some frames, and their bundle."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core import Camera, InvalidInput, load_bundle, save_bundle
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.losses import LossContext, Semantics
from gsplat_core.training.reconstructor import Reconstructor
from tests.gsplat_core.training.test_surface_losses import SMALL, observation, wall

CAMERA = Camera.from_focal(90.0, 64, 48)


def frames(count: int, labelled: int) -> list[Frame]:
    """Return frames of three stripes that move to the right, with labels on one in `labelled` frames."""
    made = []
    for seq in range(count):
        column = (np.arange(64) - 6 * seq / count) % 64
        classes = np.broadcast_to((column // 22).astype(np.uint8), (48, 64)).copy()
        image = np.array([[200, 60, 60], [60, 200, 60], [60, 60, 200]], np.uint8)[classes]
        labels = classes if seq % labelled == 0 else None
        depth = np.full((48, 64), 60.0, np.float32)
        made.append(Frame(seq, seq * 100_000_000, image, depth=depth, labels=labels))
    return made


def intersection_over_union(shown: np.ndarray, wanted: np.ndarray) -> float:
    return float(
        np.mean([((shown == k) & (wanted == k)).sum() / ((shown == k) | (wanted == k)).sum() for k in range(3)])
    )


@pytest.mark.slow
@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_semantics_of_labelled_frames_classify_other_frames(field, tmp_path):
    config = replace(ReconstructorConfig.offline(field), losses=("semantics",), gaussians=800)
    reconstructor = Reconstructor(config, CAMERA, seed=0)
    reconstructor.fit(frames(10, 5), 60)
    model = reconstructor.snapshot()
    assert model.gaussians.extra["semantics"].shape[1] == 4
    wanted = frames(10, 1)[3].labels
    shown = model.surface(0.3).semantics.argmax(-1).numpy()
    assert intersection_over_union(shown, wanted) > 0.85
    save_bundle(model, tmp_path / "model")
    again = load_bundle(tmp_path / "model")
    assert torch.equal(again.surface(0.3).semantics, model.surface(0.3).semantics)


@pytest.mark.slow
def test_semantics_loss_keeps_colours_and_geometry():
    models = []
    for losses in ((), ("semantics",)):
        config = replace(ReconstructorConfig.offline(), losses=losses, gaussians=300)
        reconstructor = Reconstructor(config, CAMERA, seed=0)
        reconstructor.fit(frames(4, 2), 10)
        models.append(reconstructor.snapshot().gaussians)
    plain, labelled = (each.tensors() for each in models)
    assert all(torch.equal(labelled[name], tensor) for name, tensor in plain.items())
    assert labelled["extra.semantics"].any()


def test_frame_refuses_labels_of_other_size():
    with pytest.raises(InvalidInput, match="labels is \\[2, 2\\]"):
        Frame(0, 0, np.zeros((4, 4, 3), np.uint8), labels=np.zeros((2, 2), np.uint8))


def test_semantics_loss_ignores_labels_above_3():
    """Without logits all four classes are as likely, and only pixels with a class count."""
    loss, context = Semantics(), LossContext([], lambda _: wall(0.0))
    scene = loss.extended(wall(0.0))
    assert scene.extra["semantics"].shape == (scene.count, 4) and not scene.extra["semantics"].any()
    assert loss.extended(scene) is scene
    logits = torch.zeros(scene.count, 4)
    logits[:, 3] = 1.0
    sure = replace(scene, extra={"semantics": logits})
    seen = observation(SMALL)
    assert loss(scene, seen, context) is None
    labels = torch.full((SMALL[1], SMALL[0]), 4, dtype=torch.uint8)
    assert float(loss(sure, replace(seen, labels=labels), context)) == 0
    labels[:, :45] = 3
    assert float(loss(scene, replace(seen, labels=labels), context)) == pytest.approx(np.log(4), rel=1e-3)
    expected = np.log(3 + np.e) - 1
    assert float(loss(sure, replace(seen, labels=labels), context)) == pytest.approx(expected, rel=0.02)
