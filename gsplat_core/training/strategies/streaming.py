"""The strategy `streaming`, for scenes that start complete: removes invisible Gaussians and splits those with large errors.

A Gaussian's share of the error is computed by the gradient trick of Rota Bulò et al. 2024 ("Revising Densification in
Gaussian Splatting", section 3.1). The gradient of a colour common to all Gaussians, for a picture weighted by the
error, is the error under their blending weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.training.image_motion import Seen
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.strategy import Plan, StrategyKind

UNSEEN_PX = 0.5
"""Sum of a Gaussian's blending weights over the pixels of a picture, in pixels. A Gaussian with a smaller sum in every picture
counts as invisible.
"""


@dataclass(frozen=True)
class Shares:
    """Visibility and error of each Gaussian in a set of pictures; tensors [N]."""

    seen_px: Tensor
    """Largest sum of blending weights over tissue in one picture, in pixels."""
    error: Tensor
    """Sum over all pictures of blending weights times absolute error (mean of the channels)."""


def shares_of(step: TrainingStep, observations: Sequence[Observation]) -> Shares:
    """Compute visibility and error of each Gaussian for the current scene."""
    count = step.gaussians.count
    seen, error = (step.gaussians.means.new_zeros(count) for _ in range(2))
    for one in observations:
        now = step.seen_by(one)
        with torch.no_grad():
            picture = step.picture(now, one.camera, depth=False).image
            tissue = (one.mask > 0).to(picture.dtype)
            off = (picture - one.image.to(picture.dtype) / 255).abs().mean(-1) * tissue
        # A uniform grey is not clamped. The gradient of a Gaussian's colour is therefore the sum over pixels of its
        # blending weight times the pixel's weight: tissue mask in the first channel, error in the second.
        grey = torch.zeros_like(now.sh).requires_grad_()
        picture = step.picture(replace(now, sh=grey), one.camera, depth=False).image
        weighted = (picture * torch.stack([tissue, off, torch.zeros_like(off)], -1)).sum()
        (gradient,) = torch.autograd.grad(weighted, grey)
        of_constant = gradient[:, 0] / SH_C0
        seen = torch.maximum(seen, of_constant[:, 0])
        error += of_constant[:, 1]
    return Shares(seen, error)


@torch.no_grad()
def on_tissue(step: TrainingStep, observations: Sequence[Observation]) -> Tensor:
    """Return a mask, bool [N], of the Gaussians whose centre is on tissue in at least one picture; all True if a camera is not a
    pinhole.
    """
    if any(one.camera.model != "pinhole" for one in observations):
        return torch.ones(step.gaussians.count, dtype=torch.bool, device=step.gaussians.device)
    found = torch.zeros(step.gaussians.count, dtype=torch.bool, device=step.gaussians.device)
    for one in observations:
        seen = Seen(one.camera, step.at(one.time_s).means)
        found |= seen.inside[:, 0] & (seen.read(one.mask) > 0)
    return found


DENSIFY_ROUNDS = 6
"""Number of rounds of densification, spread evenly over the training."""
DENSIFY_UNTIL = 0.7
"""Share of the training steps after which the last densification round takes place."""
DENSIFY_FRAMES = 12
"""Number of random frames in which each round measures the error."""


def densification_rounds(steps: int) -> list[int]:
    """Return the step numbers of the densification rounds, evenly spaced up to the share `DENSIFY_UNTIL` of `steps`."""
    return [round(steps * DENSIFY_UNTIL * (k + 1) / DENSIFY_ROUNDS) for k in range(DENSIFY_ROUNDS)]


class Rounds:
    """Strategy that changes the Gaussians in a few rounds, by their visibility and error in random frames."""

    def __init__(self, plan: Plan, change: Callable[[TrainingStep, Shares, int], None]) -> None:
        """Create a strategy whose rounds change the scene by `change`.

        Args:
            plan: the training.
            change: called in each round with the step, the Gaussians' visibility and error, and their wanted number.
        """
        self._plan, self._change = plan, change
        self._first_count = plan.step.gaussians.count
        self._rounds = densification_rounds(plan.steps)

    def before_step(self, number: int, rate_scale: float) -> bool:
        """Run each round of changes that is due before this step. Return True if one was run; see `SceneStrategy`."""
        changed = False
        while self._rounds and number >= self._rounds[0] > 0:
            self._round(1 - (len(self._rounds) - 1) / DENSIFY_ROUNDS, rate_scale)
            self._rounds.pop(0)
            changed = True
        return changed

    def _round(self, share: float, rate_scale: float) -> None:
        """Run a round that raises the number of Gaussians in proportion to `share`, the share of all rounds completed
        with it.
        """
        step, observations = self._plan.step, self._plan.observations
        step.settle(observations[-1], rate_scale=rate_scale)
        order = self._plan.random.permutation(len(observations)).tolist()
        chosen, others = (
            [observations[index] for index in part] for part in (order[:DENSIFY_FRAMES], order[DENSIFY_FRAMES:])
        )
        shares = shares_of(step, chosen)
        # Gaussians hidden in all chosen pictures may be visible in others.
        hidden = ~on_tissue(step, chosen)
        if bool(hidden.any()):
            seen_px = torch.where(hidden & on_tissue(step, others), shares.seen_px.clamp(min=UNSEEN_PX), shares.seen_px)
            shares = replace(shares, seen_px=seen_px)
        first, most = self._first_count, self._plan.most_gaussians
        self._change(step, shares, round(first + (most - first) * share))


@torch.no_grad()
def densify(step: TrainingStep, shares: Shares, count: int) -> None:
    """Remove invisible Gaussians, and split those with the largest error until there are `count` Gaussians.

    Each is split at most once. Nothing changes if `count` or more Gaussians would remain.

    Args:
        step: scene and optimiser.
        shares: visibility and error of each Gaussian.
        count: wanted number of Gaussians.
    """
    unseen = shares.seen_px < UNSEEN_PX
    left = step.gaussians.count - int(torch.count_nonzero(unseen))
    wanted = min(count - left, left)
    if wanted <= 0:
        return
    order = step.remove(unseen).order
    step.split(shares.error[order].argsort(descending=True, stable=True)[:wanted])


KIND = StrategyKind(lambda plan: Rounds(plan, densify))
"""Entry of the strategy `streaming` in the registry `STRATEGIES`."""
