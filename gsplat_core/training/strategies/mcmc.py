"""Strategies that move Gaussians at random: `mcmc` (Kheradmand et al. 2024), in which transparent Gaussians move to visible
places and positions diffuse, and `birth_death`.

`birth_death` removes Gaussians that raise the loss and copies others, between offline training steps. Births and deaths are
drawn from φ = ∂L/∂ln o (`gsplat_core.regression`), which follows from the gradients that the optimiser has averaged. Copies
take the opacities and scales that keep the picture (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte
Carlo", eq. 9, for two copies).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsplat_core.regression import probabilities
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.steps.step import TrainingStep, halves
from gsplat_core.training.strategies.strategy import (
    GEOMETRY,
    Optimizers,
    Params,
    Plan,
    Strategy,
    StrategyKind,
    binomials,
    change_rows,
    every_of,
    inject_noise_to_position,
    relocate_rows,
    sample_add,
    views_of,
)
from gsplat_core.training.strategies.streaming import UNSEEN_PX, Rounds, Shares

GROWTH = 1.05
"""Factor by which the number of Gaussians grows in each refinement, up to the cap."""


class NoLiveGaussians(RuntimeError):
    """Error: all Gaussians are too transparent to be copied, so the training has failed."""


@dataclass
class MCMCStrategy(Strategy):
    """Move dead Gaussians to visible places, add copies up to a cap, and add noise to positions in every step.

    The training loss should contain 0.01 times the mean opacity and 0.01 times the mean scale, which let Gaussians die.
    """

    cap_max: int = 1_000_000
    """Largest number of Gaussians."""
    noise_lr: float = 5e5
    """Factor of the noise, multiplied by the learning rate of the positions."""
    refine_start_iter: int = 500
    """Step after which dead Gaussians are moved and copies are added."""
    refine_stop_iter: int = 25_000
    """Step at which moves and additions of Gaussians end."""
    refine_every: int = 100
    """Number of training steps between two refinements, in which dead Gaussians move and copies are added."""
    min_opacity: float = 0.005
    """Opacity up to which a Gaussian is dead."""
    verbose: bool = False
    """Print the numbers of moved and added Gaussians."""
    noise_injection_stop_iter: int = field(default=-1, kw_only=True)
    """Step at which the noise ends; below 0: never."""
    noise_opacity_t: float = field(default=0.005, kw_only=True)
    """Opacity at which the noise is halved."""
    noise_opacity_k: float = field(default=100.0, kw_only=True)
    """Slope of the decrease of noise with opacity."""
    generator: torch.Generator | None = field(default=None, kw_only=True)
    """Source of the random numbers; None for torch's default generator of the device."""

    REQUIRED: ClassVar[tuple[str, ...]] = GEOMETRY

    def initialize_state(self) -> dict[str, Any]:
        """Return the table of binomial coefficients that `compute_relocation` needs."""
        return {"binoms": binomials()}

    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        """Move and add Gaussians if it is time, and add noise; call after `loss.backward()`.

        Args:
            params: tensors of the Gaussians.
            optimizers: optimisers by the same names.
            state: result of `initialize_state`.
            step: number of the training step, from 0.
            info: not used.
            lr: learning rate of the positions.

        Raises:
            NoLiveGaussians: if all Gaussians are dead.
        """
        binoms = state["binoms"] = state["binoms"].to(params["means"].device)
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            moved = self._relocate_gs(params, optimizers, binoms)
            added = self._add_new_gs(params, optimizers, binoms)
            if self.verbose:
                print(f"step {step}: {moved} Gaussians moved, {added} added; {len(params['means'])} now")  # noqa: T201
        if self.noise_injection_stop_iter < 0 or step < self.noise_injection_stop_iter:
            inject_noise_to_position(
                params, optimizers, {}, lr * self.noise_lr, opacity_at_half=self.noise_opacity_t,
                steepness=self.noise_opacity_k, generator=self.generator,
            )  # fmt: skip

    @torch.no_grad()
    def _relocate_gs(self, params: Params, optimizers: Optimizers, binoms: Tensor) -> int:
        """Move dead Gaussians to visible places. Returns their number; synchronises."""
        # A Gaussian whose opacity is NaN counts as dead, too.
        live = params["opacities"].flatten().sigmoid() > self.min_opacity
        alive = live.nonzero()[:, 0]
        self._check_alive(len(alive))
        count = len(live) - len(alive)
        if count:
            dead = (~live).nonzero()[:, 0]
            relocate_rows(params, optimizers, {}, dead, alive, binoms, self.min_opacity, self.generator)
        return count

    @torch.no_grad()
    def _add_new_gs(self, params: Params, optimizers: Optimizers, binoms: Tensor) -> int:
        """Add copies of visible Gaussians. Returns their number."""
        present = len(params["means"])
        added = max(0, min(self.cap_max, int(GROWTH * present)) - present)
        if added:
            opacities = params["opacities"].sigmoid()
            self._check_alive(int(torch.count_nonzero(opacities > self.min_opacity)))
            sample_add(params, optimizers, {}, added, binoms, self.min_opacity, generator=self.generator)
        return added

    def _check_alive(self, count: int) -> None:
        if not count:
            raise NoLiveGaussians(
                f"no live Gaussians: all opacities are at most min_opacity={self.min_opacity}; lower the learning rates or"
                " the weight of the mean opacity"
            )


class SceneMcmc:
    """Markov chain of an offline reconstruction, on gsplat's schedule relative to 30,000 steps.

    The noise is computed in units of the scene's distance from the camera, so that it does not depend on the unit of length.
    """

    def __init__(self, plan: Plan) -> None:
        self._step = plan.step
        distance = plan.step.distance(plan.observations[0].camera)
        self._strategy = MCMCStrategy(
            cap_max=plan.most_gaussians,
            noise_lr=MCMCStrategy.noise_lr / distance**2,
            refine_start_iter=plan.steps // 60,
            refine_stop_iter=plan.steps * 5 // 6,
            refine_every=every_of(plan.steps),
            generator=torch.Generator(plan.step.gaussians.device).manual_seed(plan.seed),
        )
        self._state = self._strategy.initialize_state()

    def before_step(self, number: int, rate_scale: float) -> bool:
        """Add noise to the positions before each step of an offline training except the first. Relocate and add Gaussians every
        `refine_every` steps, and then return True; see `SceneStrategy`.
        """
        if number == 0:
            return False
        strategy, rate = self._strategy, self._step.means_rate * rate_scale
        change = lambda params, optimizers: strategy.step_post_backward(
            params, optimizers, self._state, number, {}, lr=rate
        )
        if number % strategy.refine_every:
            change(views_of(self._step), {})
            return False
        change_rows(self._step, self._state, change)
        return True


KIND = StrategyKind(SceneMcmc, MCMCStrategy, losses={"opacity": 0.01, "scale": 0.01})
"""Entry of the strategy `mcmc` in the registry `STRATEGIES`."""


RATE = 0.05
"""Death rate per round of a Gaussian whose φ is one standard deviation above the mean of all Gaussians. φ is the mean
gradient of the loss by the logarithm of the opacity.
"""
MOST_DEATHS = 0.05
"""Largest share of Gaussians that die in a round."""


@torch.no_grad()
def birth_death(step: TrainingStep, shares: Shares, count: int) -> None:
    """Remove invisible Gaussians and randomly drawn others, then split randomly drawn parents until there are `count` Gaussians.

    Each parent is split at most once. Nothing changes if `count` or more Gaussians would remain. The random numbers depend
    only on the number of the step, so that the same scene gives the same changes.

    Args:
        step: scene and optimiser.
        shares: visibility of each Gaussian.
        count: wanted number of Gaussians.
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
    """Return a mask, bool [N], of the `most` smallest waiting times [N]."""
    marks = torch.zeros(len(waiting), dtype=torch.bool)
    marks[waiting.argsort(stable=True)[:most]] = True
    return marks


def relocated(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Replace each Gaussian by two copies with the opacity and the scale that keep the picture.

    o' = 1 - √(1 - o) and s' = s o / (2 o' - o'²/√2). The centres are separated as by `halves`, because copies at one place
    would always have equal gradients.
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


BIRTH_DEATH = StrategyKind(lambda plan: Rounds(plan, birth_death))
"""Entry of the strategy `birth_death` in the registry `STRATEGIES`."""
