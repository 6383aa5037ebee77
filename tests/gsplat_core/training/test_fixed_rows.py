"""A scene in memory of fixed size learns what one that grows learns, and nothing of it moves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor

CONFIG = ReconstructorConfig(gaussians=300, max_gaussians=700, first_frame_steps=10, steps_per_frame=4)
FIELDS = pytest.mark.parametrize("field", ["basis", "hexplane"])


def memory_of(reconstructor):
    step = reconstructor._step
    tensors = [
        *step._rows.all.tensors().values(),
        *step._adam.first_moments.values(),
        *step._adam.second_moments.values(),
    ]
    if step.field.kind == "basis":
        tensors += step.field.training_tensors()
    return [(tensor.data_ptr(), tuple(tensor.shape)) for tensor in tensors]


def moving_away(make_frame, count):
    """The camera moves to the right, so that tissue is uncovered again and again."""
    for seq in range(count):
        pose = np.eye(4)
        pose[0, 3] = -1.2 * seq
        yield make_frame(seq, shift_px=-seq, pose=pose)


@pytest.mark.slow
@FIELDS
def test_preallocated_scene_equals_growing_scene(make_frame, camera, field):
    config = dataclasses.replace(CONFIG, field=field)
    fixed = Reconstructor(dataclasses.replace(config, preallocate=True), camera)
    grown = Reconstructor(config, camera)
    counts = set()
    for frame in moving_away(make_frame, 14):
        for reconstructor in (fixed, grown):
            reconstructor.observe(frame)
        counts.add(fixed.gaussians)
    assert len(counts) > 2
    assert fixed.snapshot().sha256() == grown.snapshot().sha256()


@pytest.mark.slow
def test_preallocated_memory_stays_in_place_as_gaussians_change(make_frame, camera):
    config = dataclasses.replace(CONFIG, preallocate=True, history_s=1.0, window_frames=10)
    reconstructor = Reconstructor(config, camera)
    at = None
    counts = set()
    for frame in moving_away(make_frame, 60):
        reconstructor.observe(frame)
        at = at or memory_of(reconstructor)
        counts.add(reconstructor.gaussians)
        if frame.seq % 20 == 19:
            step = reconstructor._step
            leaving = step.gaussians.means[:, 0] < step.gaussians.means[:, 0].median()
            step.remove(leaving)
        assert memory_of(reconstructor) == at
        assert reconstructor.gaussians == reconstructor.snapshot().gaussians.count
    assert len(counts) > 3
    assert reconstructor.snapshot().time_window_s[0] > 0.5
    spare = reconstructor._step._rows.all.select(slice(reconstructor.gaussians, None))
    assert (spare.logit_opacities == -torch.inf).all() and (spare.means == 0).all()


def test_removing_gaussians_from_preallocated_scene_equals_growing_scene(make_frame, camera):
    config = dataclasses.replace(CONFIG, preallocate=True)
    both = [Reconstructor(each, camera) for each in (config, dataclasses.replace(config, preallocate=False))]
    for reconstructor in both:
        for seq in range(4):
            reconstructor.observe(make_frame(seq, shift_px=0.5 * seq))
        leaving = torch.zeros(reconstructor.gaussians, dtype=torch.bool)
        leaving[::3] = True
        reconstructor._step.remove(leaving)
        for seq in range(4, 7):
            reconstructor.observe(make_frame(seq, shift_px=0.5 * seq))
    assert both[0].snapshot().sha256() == both[1].snapshot().sha256()


def test_restarted_scene_reuses_memory_and_equals_fresh_scene(make_frame, camera):
    config = dataclasses.replace(CONFIG, preallocate=True, history_s=1.0)
    used, alone = Reconstructor(config, camera), Reconstructor(config, camera)
    for seq in range(6):
        used.observe(make_frame(seq, shift_px=seq))
    at = memory_of(used)
    alone.observe(make_frame(10), steps=0)
    assert used._step.restart(alone._step.gaussians.clone(), 0.5, camera)
    assert memory_of(used) == at
    other = Reconstructor(config, camera)
    other.observe(make_frame(10), steps=0)
    for reconstructor in (used, other):
        for seq in range(11, 15):
            reconstructor._step.field.cover(seq / 20, (seq - 1) / 20)
            observation = observed(make_frame(seq, shift_px=seq - 10), camera)
            for _ in range(3):
                reconstructor._step(observation)
    assert torch.equal(used._step.at(14 / 20).means, other._step.at(14 / 20).means)


def observed(frame, camera):
    from gsplat_core.training.observations import Observation

    return Observation.of(frame, camera)


@pytest.mark.cuda
def test_preallocated_step_and_pictures_are_captured_once_on_cuda(gpu, make_frame, camera):
    from gsplat_core.rendering.alpha import AlphaRenderer

    config = dataclasses.replace(CONFIG, preallocate=True, history_s=1.0, window_frames=10)
    reconstructor = Reconstructor(config, camera, device=gpu)
    renderer = AlphaRenderer(camera, gpu)
    graphs, by_slot, counts = set(), {}, set()
    for frame in moving_away(make_frame, 60):
        reconstructor.observe(frame)
        renderer.prepare(reconstructor.publish())
        renderer.render(camera, frame.time_s).result()
        counts.add(reconstructor.gaussians)
        if frame.seq % 20 == 19:
            step = reconstructor._step
            step.remove(step.gaussians.means[:, 0] < step.gaussians.means[:, 0].median())
        if frame.seq >= 3:  # tile lists may have had to become longer before
            graphs.add(id(reconstructor._step._captured._captured))
            for number, (key, _) in renderer._by_slot.items():
                by_slot.setdefault(number, set()).add(key)
    assert len(counts) > 3
    assert len(graphs) == 1
    assert all(len(keys) == 1 for keys in by_slot.values())


@pytest.mark.cuda
def test_spare_rows_stay_inert_on_cuda(gpu, make_frame, camera):
    config = dataclasses.replace(CONFIG, preallocate=True)
    fixed = Reconstructor(config, camera, device=gpu)
    grown = Reconstructor(dataclasses.replace(config, preallocate=False), camera, device=gpu)
    for frame in moving_away(make_frame, 12):
        for reconstructor in (fixed, grown):
            reconstructor.observe(frame)
    spare = fixed._step._rows.all.select(slice(fixed.gaussians, None))
    assert (spare.logit_opacities == -torch.inf).all() and (spare.means == 0).all() and (spare.sh == 0).all()
    assert fixed.gaussians == grown.gaussians
    torch.testing.assert_close(fixed.snapshot().at(0.5).means, grown.snapshot().at(0.5).means, rtol=1e-3, atol=1e-3)
