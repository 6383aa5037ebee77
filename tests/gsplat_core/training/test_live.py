"""Training during a live stream: repeatable for given step counts, steps only on given frames, reset at any time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from gsplat_core.training.steps import photometric
from gsplat_core.training.steps.step import TrainingStep

WIDTH, HEIGHT = 48, 40
CAMERA = Camera.from_focal(40.0, WIDTH, HEIGHT)


def frame_at(k, width=WIDTH, height=HEIGHT):
    x = np.linspace(0, 3, width)[None, :] + 0.05 * k
    y = np.linspace(0, 2, height)[:, None]
    planes = np.stack([np.sin(x + y), np.cos(x - y), np.sin(2 * x) * np.cos(y)], -1)
    return Frame(k, k * 33_000_000, ((planes + 1) * 95 + 10).astype(np.uint8))


def reconstructor(*, preallocate=False, **live):
    config = ReconstructorConfig(gaussians=120, max_gaussians=240, window_frames=8, preallocate=preallocate)
    return Reconstructor(config, Camera.from_focal(40.0, WIDTH, HEIGHT), live=LiveTraining(**live))


def run(made, steps=((10, 4), (3, 0), (5, 7))):
    for k, (observed, rehearsed) in enumerate(steps):
        made.observe(frame_at(k), budget=Budget.of_steps(observed))
        made.rehearse(rehearsed)
    return made.snapshot()


def test_live_training_is_deterministic_for_given_steps():
    assert run(reconstructor()).sha256() == run(reconstructor()).sha256()


def test_split_rehearsal_calls_equal_single_call():
    whole, cut = reconstructor(), reconstructor()
    for made, pieces in ((whole, [6]), (cut, [1, 3, 2])):
        made.observe(frame_at(0), budget=Budget.of_steps(4))
        made.observe(frame_at(1), budget=Budget.of_steps(4))
        for steps in pieces:
            made.rehearse(steps)
    assert whole.snapshot().sha256() == cut.snapshot().sha256()


def test_live_deadline_equals_its_step_count():
    clock = iter(range(10**6))
    timed, counted = reconstructor(), reconstructor()
    reports = [
        timed.observe(frame_at(k), budget=Budget.until(10**9, at_least=2, at_most=6 + k, clock=lambda: next(clock)))
        for k in range(3)
    ]
    for k, report in enumerate(reports):
        counted.observe(frame_at(k), budget=Budget.of_steps(report.steps))
    assert [report.steps for report in reports] == [6, 7, 8]
    assert timed.snapshot().sha256() == counted.snapshot().sha256()


def test_expired_deadline_still_makes_at_least_steps():
    made = reconstructor()
    made.observe(frame_at(0), budget=Budget.of_steps(2))
    report = made.observe(frame_at(1), budget=Budget.until(0.0, at_least=3, at_most=50, clock=lambda: 1.0))
    assert (report.steps, report.ending) == (3, "deadline")


def test_rehearsal_before_the_first_frame_is_refused():
    with pytest.raises(InvalidInput, match="observe a frame first"):
        reconstructor().rehearse(1)


@pytest.mark.slow
def test_rehearsal_preserves_earlier_frames():
    forgetful, keeping = reconstructor(), reconstructor(recent_share=0.0)
    for k in range(6):
        forgetful.observe(frame_at(6 * k), budget=Budget.of_steps(20))
        keeping.observe(frame_at(6 * k), budget=Budget.of_steps(20))
        keeping.rehearse(20)

    def past_db(made):
        model = made.snapshot()
        return np.mean(
            [psnr_tissue_db(model.render(frame_at(6 * k).time_s).image, frame_at(6 * k).image) for k in range(5)]
        )

    assert past_db(keeping) > past_db(forgetful) + 1


def test_begin_scene_with_other_picture_size():
    made = reconstructor()
    run(made)
    wide = frame_at(50, width=64, height=32)
    made.begin_scene(wide)
    made.observe(wide, budget=Budget.of_steps(30))
    model = made.snapshot()
    assert (model.camera.width_px, model.camera.height_px) == (64, 32)
    assert model.version == 2
    assert psnr_tissue_db(model.render(wide.time_s).image, wide.image) > 20


@pytest.mark.parametrize("preallocate", [False, True])
def test_model_after_forget_equals_fresh_model(preallocate):
    """A model depends only on the frames since the reset, not on earlier training."""
    fresh, used = reconstructor(preallocate=preallocate), reconstructor(preallocate=preallocate)
    for k in range(10, 14):
        used.observe(frame_at(k), budget=Budget.of_steps(5))
    used.forget()
    assert run(fresh).sha256() == run(used).sha256()


def test_begin_scene_reuses_preallocated_memory():
    made = reconstructor(preallocate=True)
    run(made)
    address = made._step.gaussians.means.data_ptr()
    made.begin_scene(frame_at(20))
    made.observe(frame_at(20), budget=Budget.of_steps(2))
    assert made._step.gaussians.means.data_ptr() == address


def test_observe_without_train_changes_no_parameter():
    made = reconstructor()
    before = run(made)
    made.observe(frame_at(3), budget=Budget.of_steps(5), train=False)
    after = made.snapshot()
    assert torch.equal(before.gaussians.means, after.gaussians.means)


def test_live_rate_falls_from_first_to_last():
    training = LiveTraining(first_rate=2.0, last_rate=0.5, rate_steps=5)
    rates = [training.rate_at(k) for k in range(8)]
    assert rates[0] == 2.0
    assert rates[4:] == pytest.approx([0.5] * 4)
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize(
    "wrong",
    [{"first_rate": 0.0}, {"last_rate": float("nan")}, {"rate_steps": 0}, {"recent_share": 1.5}]
    + [{"colour_relaxation": wrong} for wrong in (-0.1, 2.0, float("nan"))],
)
def test_live_training_refuses_invalid_settings(wrong):
    with pytest.raises(InvalidSetting):
        LiveTraining(**wrong)


def test_corrections_before_is_refused_on_cuda():
    with pytest.raises(InvalidSetting, match=r"corrections_before is 2 on cuda.*set it to 0"):
        Reconstructor(ReconstructorConfig(), CAMERA, live=LiveTraining(corrections_before=2), device="cuda")


@pytest.mark.parametrize(("corrections", "relaxation"), [(3, 1.5), (3, 0.0), (0, 1.5)])
def test_corrections_before_applies_to_newest_frame_only(monkeypatch, corrections, relaxation):
    found = []
    monkeypatch.setattr(
        photometric, "correct_colours", lambda *given, **options: (found.append(options["steps"]), given[2])[1]
    )
    run(reconstructor(colour_relaxation=relaxation, corrections_before=corrections), [(2, 2), (1, 3)])
    assert found == ([corrections] * 3 if corrections and relaxation else [])


def test_colour_relaxation_with_sh_is_refused_on_cuda():
    with pytest.raises(InvalidSetting, match="set sh_degree or colour_relaxation to 0"):
        Reconstructor(ReconstructorConfig(sh_degree=1), CAMERA, live=LiveTraining(colour_relaxation=1.0), device="cuda")


def test_colour_relaxation_follows_changing_light_with_one_step():
    """Trained colours change by their learning rate, independently of the residual."""

    def shown_db(relaxation):
        config = ReconstructorConfig(gaussians=400, max_gaussians=400, squared_error=True)
        made = Reconstructor(config, CAMERA, live=LiveTraining(colour_relaxation=relaxation))
        made.observe(frame_at(0), budget=Budget.of_steps(30))
        for k in range(1, 6):
            frame = frame_at(k)
            frame = Frame(k, k * 33_000_000, (frame.image * (1 - 0.1 * k)).astype(np.uint8))
            made.observe(frame, budget=Budget.of_steps(1))
        return psnr_tissue_db(made.snapshot().render(frame.time_s).image, frame.image)

    assert shown_db(1.5) > shown_db(0.0) + 3


def test_published_model_at_trained_frame_equals_training_state():
    """The motion prior does not examine every frame and predicts nothing for unexamined frames."""
    config = ReconstructorConfig(gaussians=120, max_gaussians=240, motion_prior="flow")
    made = Reconstructor(config, Camera.from_focal(40.0, WIDTH, HEIGHT), live=LiveTraining())
    for k in range(4):
        frame = frame_at(6 * k)
        made.observe(frame, budget=Budget.of_steps(20))
        shown = made.publish().at(frame.time_s)
        assert torch.equal(shown.means, made._step.at(frame.time_s).means)
        made.grow(frame)


def test_published_model_continues_motion_over_untrained_frame():
    config = ReconstructorConfig(gaussians=300, max_gaussians=600, motion_prior="flow")
    made = Reconstructor(config, Camera.from_focal(80.0, 2 * WIDTH, 2 * HEIGHT), live=LiveTraining())
    frames = [frame_at(k, 2 * WIDTH, 2 * HEIGHT) for k in range(5)]
    for frame in frames[:4]:
        made.observe(frame, budget=Budget.of_steps(20))
        made.grow(frame)
    made.observe(frames[4], train=False)
    held = made._step.at(frames[3].time_s).means
    moved = made.publish().at(frames[4].time_s).means - held
    assert float(moved[:, 0].median()) < 0  # the pattern moves to the left
    made.forget()
    made.observe(frames[0], budget=Budget.of_steps(5))
    made.observe(frames[1], train=False)  # after one frame there is no motion yet
    assert torch.equal(made.publish().at(frames[1].time_s).means, made._step.at(frames[0].time_s).means)


def test_revealed_strip_is_covered_before_publish():
    config = ReconstructorConfig(
        gaussians=600, max_gaussians=1200, motion_prior="flow", motion_detail="half", start_from_motion=True
    )
    made = Reconstructor(config, Camera.from_focal(120.0, 2 * WIDTH, 2 * HEIGHT), live=LiveTraining())
    wide = frame_at(0, 4 * WIDTH, 2 * HEIGHT).image
    for k in range(8):
        left = WIDTH - 3 * k  # content moves to the right, 3 pixels a frame
        image = np.ascontiguousarray(wide[:, left : left + 2 * WIDTH])
        made.observe(Frame(k, k * 33_000_000, image), budget=Budget.of_steps(2))
    alpha = made.publish().render(7 * 0.033).alpha
    assert float(alpha[:, :6].mean()) > 0.8


def test_published_model_is_unchanged_by_later_training():
    config = ReconstructorConfig(gaussians=120, max_gaussians=240, motion_prior="flow", start_from_motion=True)
    made = Reconstructor(config, Camera.from_focal(40.0, WIDTH, HEIGHT), live=LiveTraining())
    made.observe(frame_at(0), budget=Budget.of_steps(4))
    published = made.publish()
    before = {name: tensor.clone() for name, tensor in published.gaussians.tensors().items()}
    made.rehearse(5)
    made.observe(frame_at(1), budget=Budget.of_steps(4))
    assert all(torch.equal(tensor, before[name]) for name, tensor in published.gaussians.tensors().items())
    trained = made._step.gaussians.logit_opacities
    assert not torch.equal(trained, before["logit_opacities"])


def test_rehearsed_relaxation_is_half_and_zero_at_every_fourth_depth_step():
    training = LiveTraining(colour_relaxation=1.2)
    assert [training.rehearsed_relaxation(k, False) for k in range(1, 9)] == pytest.approx([0.6] * 8)
    with_depth = [training.rehearsed_relaxation(k, True) for k in range(1, 9)]
    assert with_depth == pytest.approx([0.6, 0.6, 0.6, 0.0] * 2)


def test_default_live_rate_falls_from_2_to_half_in_30_steps():
    training = LiveTraining()
    assert (training.rate_at(0), training.rate_at(29), training.rate_at(500)) == pytest.approx((2.0, 0.5, 0.5))
    assert training.rate_at(14.5) == pytest.approx(1.0)


@pytest.fixture
def steps_taken(monkeypatch):
    """Rate and relaxation of every training step, with the number of its frame."""
    taken = []
    plain = TrainingStep.__call__

    def recorded(self, observation, rate_scale=1.0, colour_relaxation=0.0, corrections_before=0):
        taken.append((observation.seq, rate_scale, colour_relaxation))
        return plain(self, observation, rate_scale, colour_relaxation, corrections_before)

    monkeypatch.setattr(TrainingStep, "__call__", recorded)
    return taken


def test_first_frame_of_scene_trains_at_plain_rate(steps_taken):
    made = reconstructor(first_rate=3.0, last_rate=0.25, rate_steps=3, colour_relaxation=0.8)
    run(made, [(2, 0), (4, 1)])
    assert [rate for _, rate, _ in steps_taken] == pytest.approx([1, 1, 3, 0.75**0.5, 0.25, 0.25, 0.25])
    assert [relaxation for *_, relaxation in steps_taken] == pytest.approx([0.8] * 6 + [0.4])


@pytest.mark.slow
def test_rehearsal_gives_newest_frame_60_percent_of_steps(steps_taken):
    made = reconstructor()
    run(made, [(1, 0)] * 8)
    del steps_taken[:]
    made.rehearse(400)
    counts = np.bincount([seq for seq, *_ in steps_taken], minlength=8)
    assert counts[7] / 400 == pytest.approx(0.6 + 0.4 / 8, abs=0.06)
    assert counts[:7] == pytest.approx([0.4 / 8 * 400] * 7, abs=13)


@pytest.mark.parametrize(("newer", "is_taken"), [(0, True), (29, True), (30, False)])
def test_take_depth_accepts_newest_30_frames(newer, is_taken):
    config = ReconstructorConfig(gaussians=60, max_gaussians=60, window_frames=60)
    made = Reconstructor(config, CAMERA, live=LiveTraining())
    for k in range(newer + 1):
        made.observe(frame_at(k), budget=Budget.of_steps(1))
    depth = np.full((HEIGHT, WIDTH), 40.0, np.float32)
    deep = frame_at(0).with_fields(depth=depth, depth_origin=DEPTH_ORIGINS["stereo"])
    assert made.take_depth(deep) == is_taken
    source = made.snapshot().depth_source
    assert (source is not None and "stereo" in str(source).lower()) == is_taken


def test_left_scene_excludes_training_on_doubtful_frame():
    """The next scene is not mistaken for the left one, although the left scene was trained on the first frame of the next."""
    left = reconstructor()
    other = Frame(1, 33_000_000, np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    left.observe(frame_at(0), budget=Budget.of_steps(10))
    left.observe(other, budget=Budget.of_steps(8), doubtful=True)
    assert not left.begin_scene(dataclasses.replace(other, seq=2, pts_ns=66_000_000))
    (place,) = left._left.places._left
    assert place.left_s == 0.0
    left.observe(dataclasses.replace(other, seq=2, pts_ns=66_000_000), budget=Budget.of_steps(8))
    assert left.begin_scene(dataclasses.replace(frame_at(0), seq=3, pts_ns=99_000_000))
