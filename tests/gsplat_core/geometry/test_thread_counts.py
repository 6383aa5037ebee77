"""Geometry has the same bytes with any number of threads, at sizes where BLAS, LAPACK and torch's reductions share their work among threads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.poses import bundle, moving_bundle
from gsplat_core.poses.breathing import _bundle, refined, separability, waves
from gsplat_core.poses.moving_bundle import Rhythm, SurfaceField, learned_from
from tests.gsplat_core.geometry.breathing_points import BREATHING_HZ, HEART_HZ
from tests.gsplat_core.geometry.breathing_sightings import bundle_of, seen_for
from tests.gsplat_core.geometry.test_bundle import disturbed, first_only, known_scene

THREADS = (1, 2, 3)


def bytes_with(threads, work):
    """The bytes of the tensors that `work` returns, with a number of threads that other tests do not see."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return [np.asarray(each).tobytes() for each in work()]
    finally:
        torch.set_num_threads(before)


def check(work):
    first, *others = (bytes_with(threads, work) for threads in THREADS)
    for threads, other in zip(THREADS[1:], others, strict=True):
        differing = [number for number, (a, b) in enumerate(zip(first, other, strict=True)) if a != b]
        assert not differing, f"results {differing} differ between 1 and {threads} threads"


@pytest.fixture(scope="module")
def breathing():
    sightings, _ = seen_for(10.0, rate_hz=5.0)
    return bundle_of(sightings, waves(sightings.times_s, (BREATHING_HZ, HEART_HZ))), sightings


# 6 unknowns a camera: LAPACK shares a system of more than about 128 unknowns among threads, and BLAS even short products.
@pytest.mark.parametrize(("cameras", "points"), [(3, 400), (8, 60), (26, 200), (40, 400)])
@pytest.mark.parametrize("points_move", [True, False])
def test_bundle_adjustment_is_identical_for_any_thread_count(cameras, points, points_move):
    start = disturbed(known_scene(cameras, points))

    def adjusted():
        if not points_move:
            return (bundle.place_cameras(start, fixed=first_only(start), rounds=3),)
        found = bundle.adjust(start, fixed=first_only(start), rounds=3)
        return found.poses, found.points

    check(adjusted)


@pytest.mark.slow
@pytest.mark.parametrize("with_prior", [False, True])
def test_moving_bundle_adjustment_is_identical_for_any_thread_count(breathing, with_prior):
    start, sightings = breathing

    def adjusted():
        prior = learned_from(start.poses, sightings.times_s, start.waves) if with_prior else None
        found, cost = moving_bundle.adjust(start, 0.004, 2, prior)
        return found.poses, found.rest, found.amplitudes, cost

    check(adjusted)


def test_priors_and_fields_are_identical_for_any_thread_count(breathing):
    start, sightings = breathing

    def learned():
        prior = learned_from(start.poses, sightings.times_s, start.waves)
        field = SurfaceField.over(start.rest)
        separated = separability(
            start.poses, start.poses, sightings.times_s, Rhythm.steady(sightings.times_s, (BREATHING_HZ,)).phases
        )
        return (
            prior.precision, prior.uncertain, prior.cost(start.poses), *prior.terms(start.poses), field.nodes,
            field.stiffness, field.influence(start.rest), separated[1],
        )  # fmt: skip

    check(learned)


@pytest.mark.slow
def test_breathing_trajectory_is_identical_for_any_thread_count(breathing, monkeypatch):
    monkeypatch.setattr("gsplat_core.poses.breathing.STAGES", ((0.007, 2),))
    _, sightings = breathing

    def found():
        start, numbers = _bundle(sightings, torch.arange(len(sightings.times_s)), 300, 30)
        end, rhythm, prior = refined(start, sightings.times_s, (BREATHING_HZ, HEART_HZ))
        return end.poses, end.rest, end.amplitudes, numbers, rhythm.phases, prior.precision

    check(found)
