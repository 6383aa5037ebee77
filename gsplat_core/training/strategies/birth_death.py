"""The strategy `birth_death`, birth-death moves between offline training steps: Gaussians that raise the loss make place for copies of others.

Births and deaths are drawn from φ = ∂L/∂ln o (`gsplat_core.regression`), which follows from the gradients that the
optimiser has averaged. Copies take the opacities and scales that keep the picture (Kheradmand et al. 2024, "3D Gaussian
Splatting as Markov Chain Monte Carlo", eq. 9, for two copies).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.regression import probabilities
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.strategy import StrategyKind
from gsplat_core.training.strategies.streaming import UNSEEN_PX, Rounds, Shares, halves

RATE = 0.05
"""Death rate per round of a Gaussian whose φ is one standard deviation above the mean of all Gaussians. φ is the mean
gradient of the loss by the logarithm of the opacity.
"""
MOST_DEATHS = 0.05
"""Largest share of Gaussians that die in a round."""


@torch.no_grad()
def birth_death(step: TrainingStep, shares: Shares, count: int) -> None:
    """Remove invisible Gaussians and draw deaths, then split drawn parents until there are `count`.

    Each is split once at most. Nothing changes if `count` or more would remain. The same scene at the same step gives
    the same moves.
    """
    gaussians = step.gaussians
    phi = (step.mean_gradients("logit_opacities") / (1 - gaussians.opacities).clamp(min=1e-3)).cpu().double()
    random = torch.Generator().manual_seed(step.steps)
    draw = lambda: torch.rand(gaussians.count, generator=random, dtype=phi.dtype)
    death, birth = probabilities(phi, RATE)
    unseen = (shares.seen_px < UNSEEN_PX).cpu()
    # Sampling without replacement: the smallest exponential waiting times.
    dying = _first(-draw().log() / death, round(MOST_DEATHS * gaussians.count)) & (draw() < death)
    leaving = unseen | dying
    left = gaussians.count - int(torch.count_nonzero(leaving))
    wanted = min(count - left, left)
    if wanted <= 0:
        return
    waiting = (-draw().log() / birth.clamp(min=1e-12)).to(gaussians.device)
    order = step.remove(leaving.to(gaussians.device)).order
    step.split(waiting[order].argsort(stable=True)[:wanted], relocated)


def _first(waiting: Tensor, most: int) -> Tensor:
    """Mark the `most` smallest of the values [N]; returns bool [N]."""
    marks = torch.zeros(len(waiting), dtype=torch.bool)
    marks[waiting.argsort(stable=True)[:most]] = True
    return marks


def relocated(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Replace each Gaussian by two copies with the opacity and the scale that keep the picture.

    o' = 1 - √(1 - o) and s' = s o / (2 o' - o'²/√2). The centres are apart as those of `halves`, because copies at one place
    would have equal gradients for ever.
    """
    before = parents.opacities.double().clamp(1e-6, 1 - 1e-6)
    after = 1 - (1 - before).sqrt()
    scale = before / (2 * after - after.square() / math.sqrt(2))
    logits = (after / (1 - after)).log().to(parents.dtype)
    log_scales = parents.log_scales + scale.log()[:, None].to(parents.dtype)
    first, second = (
        replace(each, logit_opacities=logits.clone(), log_scales=log_scales.clone()) for each in halves(parents)
    )
    return first, second


KIND = StrategyKind(lambda plan: Rounds(plan, birth_death))
"""Entry of this module's strategy in the registry `STRATEGIES`."""
