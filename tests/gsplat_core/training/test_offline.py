"""Offline training: its schedule, that every frame is seen equally often, and when Gaussians are added."""

import dataclasses
import itertools
from collections import Counter

import numpy as np
import pytest
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.gaussians import POSITION
from gsplat_core.training import offline
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.offline import MOST_AT_ONCE, SMOOTH_EVERY
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies import streaming
from tests.gsplat_core.training.two_eyes import LEFT, stereo_frame

CONFIG = ReconstructorConfig(field="basis", gaussians=300, max_gaussians=500, squared_error=True)


def test_offline_rate_falls_from_1_to_0_02():
    rates = [offline.rate_at(share / 10) for share in range(11)]
    assert rates[0] == 1
    assert rates[5] == pytest.approx(0.51)
    assert rates[10] == pytest.approx(0.02)
    assert rates == sorted(rates, reverse=True)


def test_densification_rounds_are_evenly_spaced():
    assert streaming.densification_rounds(600) == [70, 140, 210, 280, 350, 420]


def fitted(camera, frames, steps, config=CONFIG, **constants):
    learning = Reconstructor(config, camera)
    counts = []
    with pytest.MonkeyPatch.context() as patch:
        for name, value in constants.items():
            patch.setattr(streaming if name.startswith("DENSIFY") else offline, name, value)
        learning.fit(frames, steps, lambda *_: counts.append(learning.gaussians))
    return learning, counts


def test_offline_fit_grows_per_round_to_max_gaussians(tissue_video, camera):
    learning, counts = fitted(camera, tissue_video(4), 40, DENSIFY_ROUNDS=4, DENSIFY_UNTIL=0.8)
    grown = [step for step, (before, after) in enumerate(itertools.pairwise(counts), 1) if after > before]
    assert grown == [8, 16, 24, 32]
    assert counts[-1] == learning.gaussians == CONFIG.max_gaussians
    assert learning.snapshot().field.count == CONFIG.max_gaussians


def test_offline_fit_with_fewer_steps_than_rounds(tissue_video, camera):
    for steps in (1, 2, 3):
        _, counts = fitted(camera, tissue_video(2), steps, DENSIFY_ROUNDS=10)
        assert len(counts) == steps


def test_offline_fit_without_rounds_keeps_count(tissue_video, camera):
    _, counts = fitted(camera, tissue_video(3), 6, DENSIFY_ROUNDS=0)
    assert set(counts) == {counts[0]}


def test_offline_fit_reports_progress_after_each_step(tissue_video, camera):
    done = []
    report = Reconstructor(CONFIG, camera).fit(tissue_video(2), 4, progress=lambda *step: done.append(step))
    assert [number for number, _ in done] == [1, 2, 3, 4]
    assert report.loss == done[-1][1]


def test_offline_fit_trains_on_every_frame_equally_often(tissue_video, camera, monkeypatch):
    seen = Counter()
    take = TrainingStep.__call__

    def counted(self, observation, *others):
        seen[observation.seq] += 1
        return take(self, observation, *others)

    monkeypatch.setattr(TrainingStep, "__call__", counted)
    fitted(camera, tissue_video(5), 15)
    assert seen == dict.fromkeys(range(5), 3)


def test_offline_fit_keeps_timing_of_bumps(tissue_video, camera):
    config = dataclasses.replace(ReconstructorConfig.offline("basis"), gaussians=100, max_gaussians=100)
    field = fitted(camera, tissue_video(4), 6, config)[0].snapshot().field
    assert field.weights.abs().max() > 0
    assert torch.equal(field.centers, torch.arange(field.centers.shape[1]).expand_as(field.centers).float())
    assert field.log_widths.abs().max() == 0


def test_offline_smoothing_reduces_temporal_roughness(tissue_video, camera):
    def roughness(smoothing):
        learning, _ = fitted(camera, tissue_video(12), 60, DENSIFY_ROUNDS=0, SMOOTHING=smoothing)
        weights = learning.snapshot().field.weights
        return float(weights.diff(dim=1).square().sum() / weights.square().sum())

    assert roughness(2.0) < 0.8 * roughness(0.0)


@pytest.mark.slow
def test_offline_smoothing_amount_is_limited(tissue_video, camera, monkeypatch):
    amounts = []
    monkeypatch.setattr(BasisField, "smooth_in_time", lambda self, amount: amounts.append(amount))
    fitted(camera, tissue_video(2), 100, SMOOTHING=5.0)
    assert len(amounts) == 100 // SMOOTH_EVERY
    assert max(amounts) == MOST_AT_ONCE
    fitted(camera, tissue_video(2), 100, SMOOTHING=0.0)
    assert len(amounts) == 100 // SMOOTH_EVERY


def relaxations(camera, frames, steps, monkeypatch, config=CONFIG):
    """Train and return the relaxation of every step with its observation."""
    found, usual = [], TrainingStep.__call__

    def step(self, observation, rate_scale=1.0, colour_relaxation=0.0, **others):
        found.append((colour_relaxation, observation))
        return usual(self, observation, rate_scale, colour_relaxation, **others)

    monkeypatch.setattr(TrainingStep, "__call__", step)
    fitted(camera, frames, steps, config)
    return found


def test_offline_colour_relaxation_rises_in_second_half(tissue_video, camera, monkeypatch):
    # Equal frames are as steady as frames can be.
    still = [frame.with_fields(image=tissue_video(1)[0].image) for frame in tissue_video(4)]
    values = [value for value, _ in relaxations(camera, still, 40, monkeypatch)]
    assert values[:21] == [0.0] * 21
    assert values[21:] == pytest.approx([number / 20 for number in range(1, 20)])


def test_offline_colours_of_unsteady_frames_are_not_corrected(tissue_video, camera, monkeypatch):
    frames = tissue_video(4)
    dimmed = [frame.with_fields(image=frame.image // (1 + frame.seq % 2)) for frame in frames]
    assert {value for value, _ in relaxations(camera, dimmed, 40, monkeypatch)} == {0.0}


def test_offline_colours_of_hexplane_are_not_corrected(tissue_video, camera, monkeypatch):
    config = dataclasses.replace(CONFIG, field="hexplane")
    still = [frame.with_fields(image=tissue_video(1)[0].image) for frame in tissue_video(2)]
    assert {value for value, _ in relaxations(camera, still, 6, monkeypatch, config)} == {0.0}


def test_offline_colours_with_depth_are_corrected_every_second_step(tissue_video, camera, monkeypatch):
    shape = tissue_video(1)[0].image.shape[:2]
    still = [
        frame.with_fields(image=tissue_video(1)[0].image, depth=np.full(shape, 90.0, np.float32))
        for frame in tissue_video(4)
    ]
    values = [value for value, _ in relaxations(camera, still, 40, monkeypatch)]
    assert all(values[22::2])
    assert not any(values[21::2])


def test_offline_colours_of_right_eye_are_not_corrected(monkeypatch):
    config = dataclasses.replace(CONFIG, eyes="both")
    still = [dataclasses.replace(stereo_frame(0), seq=seq, pts_ns=seq * 33_000_000) for seq in range(4)]
    found = relaxations(LEFT, still, 40, monkeypatch, config)
    assert {value for value, one in found if one.of_right} == {0.0}
    assert max(value for value, one in found if not one.of_right) > 0.5


def test_offline_colour_correction_reduces_error(tissue_video, camera):
    def error(correction):
        learning, _ = fitted(camera, frames, 40, CORRECTION=correction)
        pictures = [
            torch.from_numpy(learning.picture(frame) * 255) - torch.from_numpy(frame.image).float() for frame in frames
        ]
        return float(torch.stack(pictures).square().mean())

    frames = [frame.with_fields(image=tissue_video(1)[0].image) for frame in tissue_video(4)]
    assert error(1.0) < 0.9 * error(0.0)


def test_offline_rigidity_makes_neighbours_move_alike(tissue_video, camera):
    def unlike(rigidity):
        learning, _ = fitted(camera, tissue_video(6), 60, DENSIFY_ROUNDS=1, RIGIDITY=rigidity)
        model = learning.snapshot()
        motion = model.field.weights[..., POSITION].flatten(1)
        others = motion[nearest_others(model.gaussians.means)].mean(dim=1)
        return float((motion - others).square().sum() / motion.square().sum())

    assert unlike(2.0) < 0.7 * unlike(0.0)


@pytest.mark.slow
def test_densification_reduces_error_of_coarse_start(tissue_video, camera):
    frames = tissue_video(5)
    config = dataclasses.replace(CONFIG, gaussians=60, max_gaussians=240)

    def error(rounds):
        learning, _ = fitted(camera, frames, 150, config, DENSIFY_ROUNDS=rounds)
        model = learning.snapshot()
        target = torch.from_numpy(frames[2].image) / 255
        return float((model.render(frames[2].time_s).image - target).square().mean())

    assert error(5) < 0.7 * error(0)


def test_densification_keeps_tissue_shown_in_few_frames(tissue_video, camera):
    """A tool that goes away at the end: pictures that are chosen for a round seldom show what was below it."""
    frames = list(tissue_video(12))
    mask = np.ones(frames[0].image.shape[:2], np.uint8)
    mask[10:30, 14:40] = 0
    frames = [frame.with_fields(mask=mask) if frame.seq < 11 else frame for frame in frames]
    learning, _ = fitted(camera, frames, 36, DENSIFY_ROUNDS=6, DENSIFY_FRAMES=1)
    shown = render(learning.snapshot().at(frames[-1].time_s), camera).alpha.numpy()
    assert (shown[12:28, 16:38] > 0.5).mean() > 0.95
