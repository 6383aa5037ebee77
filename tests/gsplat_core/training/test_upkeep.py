"""Gaussians that no picture shows stay in place, and Gaussians that no picture needs are removed."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import LastSeen
from gsplat_core.training.initialisation import SIGMA_IN_SPACINGS
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.observations import pixels_of
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from gsplat_core.training.upkeep import MOST_SPLIT, RELAX_EVERY, RENEW_EVERY, SURFACE_STEPS, THINNEST_PX, Upkeep

CONFIG = ReconstructorConfig(
    gaussians=300, max_gaussians=600, window_frames=10, motion_spacing_s=0.1, history_s=1.0, preallocate=True
)
SPACING_PX = math.sqrt(48 * 40 / 300)


def trained(make_frame, camera, frames=6, **fields):
    """The step of a scene that was trained on a moving pattern, and its newest observation."""
    made = Reconstructor(CONFIG, camera, live=LiveTraining())
    for seq in range(frames):
        made.observe(make_frame(seq, shift_px=seq, **fields), budget=Budget.of_steps(4))
    return made._step, made._window.newest


def round_of(step, observation, camera, upkeep=None):
    upkeep = upkeep or Upkeep(camera, CONFIG)
    step._adam.steps = upkeep._renewed_at + RENEW_EVERY
    upkeep._relaxed_at = step._adam.steps - RELAX_EVERY
    last_seen = LastSeen(CONFIG.max_gaussians, torch.device("cpu"))
    upkeep(step, observation, last_seen)
    assert len(last_seen.times()) == step.gaussians.count


def with_room(most):
    return dataclasses.replace(CONFIG, gaussians=300, max_gaussians=most)


def test_shorten_rotations_keeps_picture_at_all_times(make_frame, camera):
    step, _ = trained(make_frame, camera)
    step.gaussians.quats.mul_(torch.linspace(0.5, 4, step.gaussians.count)[:, None])
    times = [0.0, 0.1, 0.17]
    before = [render(step.at(time_s), camera).image for time_s in times]
    step.shorten_rotations()
    torch.testing.assert_close(step.gaussians.quats.norm(dim=1), torch.ones(step.gaussians.count))
    for time_s, image in zip(times, before, strict=True):
        torch.testing.assert_close(render(step.at(time_s), camera).image, image, atol=2e-5, rtol=0)


def test_shorten_rotations_is_skipped_for_hexplane(make_frame, camera):
    config = dataclasses.replace(CONFIG, field="hexplane", history_s=None)
    made = Reconstructor(config, camera, live=LiveTraining())
    made.observe(make_frame(0), budget=Budget.of_steps(2))
    made._step.gaussians.quats.mul_(3)
    made._step.shorten_rotations()
    assert float(made._step.gaussians.quats.norm(dim=1).min()) > 2


def test_upkeep_relaxes_only_visible_gaussians(make_frame, camera):
    mask = np.ones((40, 48), np.uint8)
    mask[:, 24:] = 0
    step, observation = trained(make_frame, camera, mask=mask)
    scene = step.gaussians
    scene.logit_opacities.fill_(4.0)
    pixels, inside = pixels_of(step.at(observation.time_s).means, camera)
    shown = inside & (pixels[:, 0] < 24)
    assert 50 < int(shown.sum()) < 250
    colours = scene.sh.clone()
    step._adam.second_moments["logit_opacities"].fill_(1.0)  # no Gaussian is removed
    round_of(step, observation, camera, Upkeep(camera, with_room(scene.count)))
    assert bool((scene.logit_opacities[shown] < 4).all()) and bool((scene.logit_opacities[~shown] == 4).all())
    assert bool((scene.sh[shown].abs() <= colours[shown].abs()).all()) and torch.equal(
        scene.sh[~shown], colours[~shown]
    )


@pytest.mark.parametrize("every", [128, 400])
def test_upkeep_relaxation_time_is_3600_steps(make_frame, camera, every):
    """The rate is one per step, independent of the number of upkeep rounds."""
    step, observation = trained(make_frame, camera)
    scene = step.gaussians
    usual = math.log(SIGMA_IN_SPACINGS * SPACING_PX * step.distance(camera) / float(camera.K[0, 0]))
    scene.logit_opacities.fill_(3.0)
    scene.log_scales.fill_(usual + 1.0)
    colours = scene.sh.clone()
    step._adam.steps = 0
    upkeep = Upkeep(camera, with_room(scene.count))
    for passed in range(every, 3601, every):
        step._adam.steps = passed
        seen = upkeep._examine(step, observation)
        upkeep._relax(step, seen, camera)
    shown = seen.shown & (pixels_of(step.at(observation.time_s).means, camera)[1])
    kept = math.exp(-passed / 3600)
    assert scene.logit_opacities[shown].median() == pytest.approx(3 * kept, rel=0.05)
    share = (scene.sh[shown].abs().sum() / colours[shown].abs().sum()).item()
    assert share == pytest.approx(kept, rel=0.05)
    left = (scene.log_scales[shown] - usual).median().item()
    assert left == pytest.approx(kept, rel=0.05)
    assert bool((scene.logit_opacities[~seen.shown] == 3).all())


def test_upkeep_limits_scale_of_needles_and_sheets(make_frame, camera):
    step, observation = trained(make_frame, camera)
    step.gaussians.log_scales[:20, 0] = -20
    step.gaussians.log_scales[20:40, 1] = 20
    round_of(step, observation, camera)
    pixel = 60 / 50
    assert float(step.gaussians.log_scales.min()) == pytest.approx(math.log(THINNEST_PX * pixel), abs=0.02)
    assert float(step.gaussians.log_scales.max()) < math.log(10 * SPACING_PX * pixel)


def test_upkeep_removes_idle_duplicate_and_unreachable_gaussians(make_frame, camera):
    step, observation = trained(make_frame, camera)
    moments = step._adam.second_moments["logit_opacities"]
    moments[: step.gaussians.count] = 1.0
    count = step.gaussians.count
    moved = Upkeep(camera, with_room(300))  # no room to split any
    moved._has_moved = True
    round_of(step, observation, camera, moved)
    assert step.gaussians.count == count
    step.gaussians.means[:3] = step.gaussians.means[:1]
    step.field.weights.data[:3] = step.field.weights.data[:1]
    step.gaussians.means[10, 0] = 1000.0
    moments[:3] = moments[10] = 0.0
    assert step.idle(1e-3).sum() == 4
    round_of(step, observation, camera, moved)
    assert step.gaussians.count == count - 2
    assert float(step.gaussians.means[:, 0].max()) == 1000
    still = Upkeep(camera, with_room(300))
    round_of(step, observation, camera, still)
    assert float(step.gaussians.means[:, 0].max()) < 1000


def test_upkeep_splits_busiest_gaussians_of_sparse_tissue(make_frame, camera):
    step, observation = trained(make_frame, camera)
    seen = step.at(observation.time_s)
    inside = pixels_of(seen.means, camera)[1]
    step.remove(inside & (torch.arange(seen.count) % 3 == 0))
    step._adam.second_moments["logit_opacities"][: step.gaussians.count] = 1.0
    count = step.gaussians.count
    busiest = int(step._adam.second_moments["means"][:count].sum(1).argmax())
    sizes, picture = step.gaussians.log_scales.clone(), render(step.at(observation.time_s), camera).image
    round_of(step, observation, camera, upkeep := Upkeep(camera, CONFIG))
    assert step.gaussians.count == count + round(MOST_SPLIT * count)
    assert float(step.gaussians.log_scales[busiest].sum()) < float(sizes[busiest].sum()) - 0.3
    assert float((render(step.at(observation.time_s), camera).image - picture).abs().mean()) < 0.02
    for _ in range(40):
        round_of(step, observation, camera, upkeep)
    shown = pixels_of(step.at(observation.time_s).means, camera)[1]
    assert int(shown.sum()) == pytest.approx(300, abs=6)
    full = Upkeep(camera, with_room(step.gaussians.count))
    step.remove(shown & (torch.arange(len(shown)) % 3 == 0))
    full._capacity = count = step.gaussians.count
    round_of(step, observation, camera, full)
    assert step.gaussians.count == count


@pytest.mark.slow
def test_training_is_identical_after_100_hours_of_stream_time(make_frame, camera, monkeypatch):
    """Bit for bit: 100 hours and all frame times, bump spacings and the history are multiples of 1/32 s, which float64 adds without rounding."""
    monkeypatch.setattr("gsplat_core.training.upkeep.RELAX_EVERY", 16)
    monkeypatch.setattr("gsplat_core.training.upkeep.RENEW_EVERY", 32)
    config = dataclasses.replace(CONFIG, motion_spacing_s=0.125, history_s=0.5)
    images = []
    for start_ns in (0, 360_000 * 10**9):
        made = Reconstructor(config, camera, live=LiveTraining())
        for seq in range(24):  # longer than the history: bumps and archived Gaussians leave
            frame = make_frame(seq, shift_px=0.2 * seq)
            frame = dataclasses.replace(frame, pts_ns=start_ns + seq * 31_250_000)
            made.observe(frame, budget=Budget.of_steps(3))
            made.grow(frame)
            made.rehearse(1)
        assert made._step.steps > 2 * 32
        images.append(made.snapshot().render(frame.time_s).image)
    assert torch.equal(*images)
    assert psnr_tissue_db((images[0].clamp(0, 1) * 255).round().to(torch.uint8).numpy(), frame.image) > 20


@pytest.mark.parametrize("every", [RELAX_EVERY, 3 * RELAX_EVERY])
def test_relaxation_time_is_3600_steps_for_shown_gaussians_only(make_frame, camera, every):
    """Independent of the interval between rounds. Mutants of the rate and disabled upkeep fail here."""
    mask = np.ones((40, 48), np.uint8)
    mask[:, 24:] = 0
    step, observation = trained(make_frame, camera, frames=1, mask=mask)
    scene = step.gaussians
    pixels, inside = pixels_of(step.at(observation.time_s).means, camera)
    shown = inside & (pixels[:, 0] < 23)
    hidden = ~(inside & (pixels[:, 0] < 25))
    assert shown.sum() > 50 and hidden.sum() > 50
    upkeep = Upkeep(camera, with_room(scene.count))
    usual = math.log(SIGMA_IN_SPACINGS * SPACING_PX * step.distance(camera) / 50.0)
    scene.log_scales.fill_(usual + 0.5)
    scene.logit_opacities.fill_(3.0)
    scene.sh.fill_(0.4)
    upkeep._renewed_at = 10**9  # no renewal among these steps
    start = step._adam.steps
    upkeep._relaxed_at = start
    for taken in range(every, 3600 + every, every):
        step._adam.steps = start + min(taken, 3600)
        if step.steps - upkeep._relaxed_at >= RELAX_EVERY:
            upkeep(step, observation)
    left = math.exp((start - upkeep._relaxed_at) / 3600)
    assert left == pytest.approx(math.exp(-1), rel=0.05)
    torch.testing.assert_close(scene.logit_opacities[shown], torch.full_like(scene.logit_opacities[shown], 3 * left))
    torch.testing.assert_close(scene.sh[shown], torch.full_like(scene.sh[shown], 0.4 * left))
    sizes = scene.log_scales[shown]
    torch.testing.assert_close(sizes, torch.full_like(sizes, usual + 0.5 * left), atol=2e-3, rtol=0)
    assert bool((scene.logit_opacities[hidden] == 3).all()) and bool((scene.sh[hidden] == 0.4).all())


def test_upkeep_between_renewals_only_relaxes(make_frame, camera):
    step, observation = trained(make_frame, camera)
    seen = step.at(observation.time_s)
    step.remove(pixels_of(seen.means, camera)[1] & (torch.arange(seen.count) % 3 == 0))
    count, opacities = step.gaussians.count, step.gaussians.logit_opacities.clone()
    upkeep = Upkeep(camera, CONFIG)
    step._adam.steps = RELAX_EVERY - 1
    upkeep(step, observation)
    assert torch.equal(step.gaussians.logit_opacities, opacities)
    step._adam.steps = RELAX_EVERY
    upkeep(step, observation)
    assert step.gaussians.count == count
    assert not torch.equal(step.gaussians.logit_opacities, opacities)
    step._adam.steps = RENEW_EVERY
    upkeep(step, observation)
    assert step.gaussians.count > count


def spread_of(depth, pixels):
    """Return the standard deviation of depths from their best-fit plane, relative to their mean."""
    plane = torch.cat([pixels, torch.ones(len(pixels), 1)], 1)
    rest = depth - plane @ torch.linalg.lstsq(plane, depth[:, None]).solution[:, 0]
    return float(rest.std() / depth.mean())


@pytest.mark.slow
def test_upkeep_pulls_depths_to_surface_and_keeps_slope_and_picture(make_frame, camera):
    mask = np.ones((40, 48), np.uint8)
    mask[:, 24:] = 0
    step, observation = trained(make_frame, camera, mask=mask)
    step._adam.second_moments["logit_opacities"].fill_(1.0)  # no Gaussian is removed
    pixels, inside = pixels_of(step.at(observation.time_s).means, camera)
    shown = inside & (pixels[:, 0] < 24)
    random = torch.Generator().manual_seed(3)
    step.scale_about(camera, 0.7 + 0.01 * pixels[:, 0] + 0.3 * torch.rand(len(pixels), generator=random))
    upkeep = Upkeep(camera, with_room(step.gaussians.count))
    before, hidden = step.at(observation.time_s).means.clone(), step.gaussians.means[~shown].clone()
    for _ in range(round(3 * SURFACE_STEPS / RENEW_EVERY)):
        step.scale_about(
            camera, upkeep._towards_surface(step, upkeep._examine(step, observation), RENEW_EVERY, observation)
        )
    after = step.at(observation.time_s).means
    torch.testing.assert_close(pixels_of(after, camera)[0], pixels, atol=1e-3, rtol=0)
    assert torch.equal(step.gaussians.means[~shown], hidden)
    assert spread_of(before[shown, 2], pixels[shown]) > 0.06 > 0.03 > spread_of(after[shown, 2], pixels[shown])
    left, right = shown & (pixels[:, 0] < 8), shown & (pixels[:, 0] > 16)
    slope = [float(means[right, 2].mean() - means[left, 2].mean()) for means in (before, after)]
    assert slope[1] > 0.4 * slope[0] > 0


@pytest.mark.parametrize("told_by", ["nothing", "depth", "moved"])
def test_upkeep_restores_distance_only_without_depth_and_camera_motion(make_frame, camera, told_by):
    step, observation = trained(make_frame, camera)
    upkeep, distance = Upkeep(camera, CONFIG), step.distance(camera)
    upkeep._has_moved = told_by == "moved"
    if told_by == "depth":
        observation = dataclasses.replace(observation, depth=torch.full((40, 48), 50.0))
    seen = upkeep._examine(step, observation)
    was = float(seen.now.means[seen.shown, 2].median())
    step.scale_about(camera, torch.full((step.gaussians.count,), 0.6))
    before = render(step.at(observation.time_s), camera).image
    step.scale_about(
        camera, upkeep._towards_surface(step, upkeep._examine(step, observation), RENEW_EVERY, observation)
    )
    seen = upkeep._examine(step, observation)
    median = float(seen.now.means[seen.shown, 2].median())
    assert median == pytest.approx(distance if told_by == "nothing" else 0.6 * was, rel=0.01)
    # What reaches in from beyond the edge stays where it was.
    inner = (slice(10, -10), slice(10, -10))
    assert float((render(step.at(observation.time_s), camera).image - before)[inner].abs().mean()) < 2e-3


def test_upkeep_once_runs_relaxation_and_renewal(make_frame, camera):
    step, observation = trained(make_frame, camera)
    last_seen = LastSeen(CONFIG.max_gaussians, torch.device("cpu"))
    first, count = step.gaussians.means[0].clone(), step.gaussians.count
    sizes = step.gaussians.log_scales.clone()
    Upkeep(camera, with_room(count)).once(step, observation, last_seen)
    assert step.gaussians.count == count == len(last_seen.times())
    Upkeep(camera, CONFIG).once(step, observation, last_seen)
    assert step.gaussians.count == len(last_seen.times()) >= count
    assert not bool((step.gaussians.means == first).all(1).any())
    assert not torch.equal(step.gaussians.log_scales, sizes)


def test_upkeep_relaxes_every_128_and_renews_every_512_steps(make_frame, camera, monkeypatch):
    step, observation = trained(make_frame, camera)
    done = []
    monkeypatch.setattr(Upkeep, "_relax", lambda *_: done.append("relax"))
    monkeypatch.setattr(Upkeep, "_renew", lambda self, step, *_: done.append("renew"))
    upkeep = Upkeep(camera, CONFIG)
    for steps, expected in ((127, []), (128, ["relax"]), (511, ["relax"]), (512, ["relax", "renew"])):
        del done[:]
        step._adam.steps = steps
        upkeep(step, observation)
        assert done == expected


def test_upkeep_scale_limits_are_fifth_of_pixel_and_eight_usual_sizes(make_frame, camera):
    step, observation = trained(make_frame, camera)
    pixel = step.distance(camera) / float(camera.K[0, 0])
    step.gaussians.log_scales[:, 0], step.gaussians.log_scales[:, 1] = -20.0, 20.0
    step._adam.second_moments["logit_opacities"].fill_(1.0)  # none leaves
    upkeep = Upkeep(camera, with_room(step.gaussians.count))
    upkeep._relax(step, upkeep._examine(step, observation), camera)
    across, along = (step.gaussians.log_scales[:, axis].exp() / pixel for axis in (0, 1))
    assert across == pytest.approx(0.2, rel=1e-3)
    assert along == pytest.approx(8 * SIGMA_IN_SPACINGS * SPACING_PX, rel=1e-3)


@pytest.mark.parametrize(("part", "are_idle"), [(2e-3, False), (0.5e-3, True)])
def test_upkeep_treats_gaussians_unseen_for_7000_steps_as_idle(make_frame, camera, part, are_idle):
    """The mean of squared gradients falls by 0.999 per step, to a thousandth of the usual one in 7,000."""
    step, observation = trained(make_frame, camera)
    step.gaussians.means[:20] += 1000.0  # out of the picture
    moments = step._adam.second_moments["logit_opacities"]
    moments[: step.gaussians.count] = 1.0
    moments[:20] = part
    upkeep = Upkeep(camera, CONFIG)
    assert bool(upkeep._useless(step, upkeep._examine(step, observation))[:20].any()) == are_idle


def test_upkeep_depth_relaxation_time_is_100000_steps(make_frame, camera):
    step, observation = trained(make_frame, camera)
    upkeep = Upkeep(camera, CONFIG)
    upkeep._has_moved = True  # distances are left to training
    seen = upkeep._examine(step, observation)
    whole, some = (
        upkeep._towards_surface(step, seen, since, observation)[seen.shown] - 1 for since in (10**9, 100_000)
    )
    assert float((some / whole).nanmedian()) == pytest.approx(1 - math.exp(-1), rel=0.01)


def test_upkeep_splits_at_most_a_fiftieth_per_round(make_frame, camera):
    step, observation = trained(make_frame, camera)
    inside = pixels_of(step.at(observation.time_s).means, camera)[1]
    step.remove(inside & (torch.arange(len(inside)) % 3 == 0))
    step._adam.second_moments["logit_opacities"][: step.gaussians.count] = 1.0
    count = step.gaussians.count
    round_of(step, observation, camera, Upkeep(camera, CONFIG))
    assert step.gaussians.count - count == round(0.02 * count) > 0
