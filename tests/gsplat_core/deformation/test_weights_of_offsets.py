"""Weights of bumps that follow given offsets have the same bytes with any number of threads."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.deformation.basis_bumps import kept_weights, least_squares_weights


@pytest.mark.parametrize("bumps", [5, 11, 40, 130])
@pytest.mark.parametrize("times", [17, 200])
def test_least_squares_weights_independent_of_thread_count(bumps, times):
    taus = torch.linspace(0, bumps - 1, times).tolist()
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3, 5):
            torch.set_num_threads(threads)
            found.append(least_squares_weights(taus, bumps))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[0], each) for each in found[1:])


def test_kept_weights_are_those_of_the_given_times_and_bumps():
    for taus, bumps in [((0.0, 1.5, 3.0), 5), ((0.0, 1.5, 3.5), 5), ((0.0, 1.5, 3.0), 6), ((0.0, 1.5, 3.0), 5)]:
        assert torch.equal(kept_weights(taus, bumps), least_squares_weights(taus, bumps))
    assert kept_weights(taus, bumps) is kept_weights(taus, bumps)
