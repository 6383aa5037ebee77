"""A model as it looks from where the scope never was."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.evaluation.views import seen_by_both
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.extras import Extras
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.scene.scope_path import ScopePath
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor

FRAMES = 16
CONFIG = ReconstructorConfig(
    field="basis", gaussians=6000, max_gaussians=8000, bump_spacing_s=0.1, squared_error=True, depth_weight=1.0
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Tissue that breathes before a scope at rest, with a camera elsewhere, its depth known; and the model of it."""
    folder = tmp_path_factory.mktemp("elsewhere") / "recording"
    synthesize(folder, frames=FRAMES, fps=8, width_px=160, height_px=128, stereo=False, extras=Extras(third=True))
    recording = open_recording(folder)
    learning = Reconstructor(CONFIG, recording.camera)
    learning.fit(list(recording), 150)
    return recording, open_truth(folder, FRAMES), learning.snapshot()


def at(model, time_s, centre):
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(centre, float)
    return model.seen_from(model.camera.with_pose(pose), time_s)


def squared_error(recorded, shown):
    """Return the error of the third camera's pictures on tissue that the scope sees as well."""
    recording, truth, model = recorded
    errors = []
    for frame in recording:
        (third,) = truth.views
        view = third.read(frame.seq)
        seen = seen_by_both(recording.camera, frame, truth.depth_of(frame), third.camera, view)
        image = shown(model, third.camera, frame.time_s).render(frame.time_s, third.camera).image
        errors.append(np.square(255 * image.clamp(0, 1).numpy() - view.image)[seen].mean())
    return np.mean(errors)


@pytest.mark.slow
def test_a_camera_that_training_never_had_sees_highlights_nearer_to_where_they_are(recorded):
    before = squared_error(recorded, lambda model, *_: model)
    after = squared_error(recorded, lambda model, camera, time_s: model.seen_from(camera, time_s))
    assert after < 0.97 * before


def test_the_scopes_eye_sees_what_was_learned_and_the_model_stays_as_it_was(recorded):
    *_, model = recorded
    digest, time_s = model.sha256(), 0.7
    own = model.render(time_s).image
    assert not torch.equal(at(model, time_s, (-7, -5, 3)).render(time_s).image, own)
    torch.testing.assert_close(at(model, time_s, (0, 0, 0.01)).render(time_s).image, own, rtol=0, atol=0)
    torch.testing.assert_close(model.render(time_s).image, own, rtol=0, atol=0)
    assert model.sha256() == digest


def test_only_colours_change_and_the_same_question_has_the_same_answer(recorded):
    *_, model = recorded
    there, again = at(model, 1.1, (5, 0, 0)), at(dataclasses.replace(model), 1.1, (5, 0, 0))
    now = model.at(1.1).tensors()
    for name, tensor in there.at(1.1).tensors().items():
        assert torch.equal(tensor, again.at(1.1).tensors()[name]), name
        assert torch.equal(tensor, now[name]) == (name != "sh"), name


def test_times_beyond_the_window_are_its_ends(recorded):
    *_, model = recorded
    end = model.time_window_s[1]
    assert torch.equal(at(model, end + 60, (5, 0, 0)).gaussians.sh, at(model, end, (5, 0, 0)).gaussians.sh)


def test_a_saved_model_knows_where_the_scope_was(recorded, tmp_path):
    *_, model = recorded
    save_bundle(model, tmp_path)
    loaded = load_bundle(tmp_path)
    assert loaded.sha256() == model.sha256()
    assert torch.equal(at(loaded, 0.3, (5, 0, 0)).gaussians.sh, at(model, 0.3, (5, 0, 0)).gaussians.sh)


@pytest.mark.parametrize(
    "change",
    [
        lambda model: {"scope_path": None},
        lambda model: {"scope_path": ScopePath((0.0, 1.0), np.eye(4)[None])},
        lambda model: {"gaussians": model.at(0.5), "field": None},
        lambda model: {"camera": dataclasses.replace(model.camera, model="fisheye")},
    ],
    ids=["unknown path", "two looks", "nothing moves", "no pinhole"],
)
def test_where_nothing_can_be_known_the_model_is_what_it_is(recorded, change):
    model = dataclasses.replace(recorded[2], **change(recorded[2]))
    assert at(model, 0.5, (5, 0, 0)) is model


def test_a_scope_that_never_saw_the_tissue_changes_nothing(recorded):
    *_, model = recorded
    away = np.diag([-1.0, 1, -1, 1])  # it looks the other way
    model = dataclasses.replace(model, scope_path=ScopePath(model.scope_path.times_s, away[None]))
    assert torch.equal(at(model, 0.5, (5, 0, 0)).gaussians.sh, model.at(0.5).sh)
