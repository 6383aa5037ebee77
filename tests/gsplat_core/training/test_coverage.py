"""Detection of uncovered pixels, and the number of them from which Gaussians are added."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.training.covering import are_worth_filling, uncovered_pixels


def test_uncovered_pixels_are_tissue_with_alpha_below_half() -> None:
    alpha, mask = torch.tensor([[0.0, 0.49, 0.5, 0.9, 0.0]]), torch.tensor([[1, 255, 1, 1, 0]], dtype=torch.uint8)
    assert uncovered_pixels(alpha, mask).tolist() == [[True, True, False, False, False]]


@pytest.mark.parametrize(("count", "is_worth"), [(0, False), (1, False), (2, True), (1000, True)])
def test_are_worth_filling_from_two_pixels_per_thousand(count: int, is_worth: bool) -> None:
    uncovered = torch.zeros(25, 40, dtype=torch.bool)
    uncovered.view(-1)[:count] = True
    assert are_worth_filling(uncovered) == is_worth
