"""Measure of how evenly a recording's pictures change, which limits temporal smoothing."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from gsplat_core.training.observations import Observation

NOISE_LEVELS = 2.5
"""Standard deviation of noise in compressed video, in grey levels of 255."""
MOST_FRAMES = 32
"""Number of frames examined, spread over the recording."""


def steadiness(observations: Sequence[Observation]) -> float:
    """Return the ratio of noise to the deviation of frames from the interpolation of their
    neighbours, 0 to 1.

    The value is 1 if the deviation is at most noise, and decreases with its square. Temporal
    smoothing removes this deviation, so the ratio is the admissible amount of smoothing. Only
    tissue counts; without three frames with tissue it is 1. Integer sums make the result
    independent of the order. Synchronises once.
    """
    inner = range(1, len(observations) - 1)
    squared = torch.zeros(2, dtype=torch.int64, device=observations[0].image.device)
    for number in inner[:: max(1, -(-len(inner) // MOST_FRAMES))]:
        before, now, after = observations[number - 1 : number + 2]
        span_s = after.time_s - before.time_s
        share = (now.time_s - before.time_s) / span_s if span_s > 0 else 0.5
        between = torch.lerp(before.image.float(), after.image.float(), share).round()
        tissue = (before.mask != 0) & (now.mask != 0) & (after.mask != 0)
        off = (now.image.float() - between).to(torch.int64).square().sum(-1) * tissue
        squared += torch.stack([off.sum(), 3 * tissue.sum()])
    total, values = squared.tolist()
    # Noise of a frame plus that of the mean of two others.
    noise = 1.5 * NOISE_LEVELS**2
    return min(1.0, noise * values / total) if total else 1.0
