"""Adaptive density control (Kerbl et al. 2023, section 5): Gaussians with large gradients in the picture are duplicated or split,
and transparent ones are removed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from gsplat_core.ops.densification import accumulate_gradient_norms_
from gsplat_core.training.strategies.strategy import (
    GEOMETRY,
    InvalidParameters,
    Optimizers,
    Params,
    Plan,
    Rows,
    Strategy,
    StrategyKind,
    change_rows,
    every_of,
    multiplied,
    rearrange,
    remove,
    reset_opa,
    views_of,
)


@dataclass
class DefaultStrategy(Strategy):
    """Multiply Gaussians with large gradients of their projected centre, remove transparent ones, and reset opacities.

    Every `refine_every` steps, a Gaussian whose mean gradient exceeds `grow_grad2d` is duplicated if it is small, and split
    if it is large. Gradients are those of the loss by the centre in units of half the picture, times the number of cameras.
    """

    prune_opa: float = 0.005
    """Opacity below which a Gaussian is removed."""
    grow_grad2d: float = 0.0002
    """Mean gradient by the centre, in half pictures, above which a Gaussian is multiplied. 0.0008 suits `absgrad`."""
    grow_scale3d: float = 0.01
    """Largest scale, in units of the scene's size, of a Gaussian that is duplicated instead of split."""
    grow_scale2d: float = 0.05
    """Radius above which a Gaussian is split, in units of the picture's longer side, until `refine_scale2d_stop_iter`."""
    prune_scale3d: float = 0.1
    """Scale above which a Gaussian is removed after the first reset, in units of the scene's size."""
    prune_scale2d: float = 0.15
    """Radius above which a Gaussian is removed, in the unit of `grow_scale2d`, until `refine_scale2d_stop_iter`."""
    refine_scale2d_stop_iter: int = 0
    """Step at which splitting and removal of Gaussians by their radius in the picture end; 0 never uses the radius."""
    refine_start_iter: int = 500
    """Training step after which Gaussians begin to be duplicated, split and removed."""
    refine_stop_iter: int = 15_000
    """Step at which refinement and resets end."""
    reset_every: int = 3000
    """Steps between two resets of the opacities to twice `prune_opa`."""
    refine_every: int = 100
    """Number of training steps between two refinements, in which Gaussians are duplicated, split and removed."""
    pause_refine_after_reset: int = 0
    """Number of training steps after a reset of the opacities in which no refinement is made."""
    absgrad: bool = False
    """Use sums of absolute gradients (Ye et al. 2024); `rasterization` needs `absgrad=True`, too."""
    revised_opacity: bool = False
    """Give split Gaussians opacities that keep the picture (Rota Bulò et al. 2024)."""
    verbose: bool = False
    """Print the numbers of added and removed Gaussians."""
    key_for_gradient: Literal["means2d", "gradient_2dgs"] = "means2d"
    """Entry of `info` whose gradient counts: `gradient_2dgs` for `rasterization_2dgs`."""
    compat: Literal["1.5.3", "1.6"] = field(default="1.6", kw_only=True)
    """Version of gsplat to follow. 1.5.3 never resets opacities, because of the precedence of its operators."""
    generator: torch.Generator | None = field(default=None, kw_only=True)
    """Source of the random numbers; None for torch's default generator of the device."""

    REQUIRED: ClassVar[tuple[str, ...]] = GEOMETRY

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return empty statistics for a scene of size `scene_scale`, to which the limits of scales are relative."""
        state: dict[str, Any] = {"grad2d": None, "count": None, "scene_scale": scene_scale}
        if self.refine_scale2d_stop_iter > 0:
            state["radii"] = None
        return state

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Keep the gradient of the projected centres; call before `loss.backward()`.

        Raises:
            InvalidParameters: if `info` lacks the centres, or they were rendered without gradients.
        """
        centres = self._needed(info, self.key_for_gradient)
        if not centres.requires_grad:
            raise InvalidParameters(
                f"{self.key_for_gradient} was rendered without gradients; render trainable means outside torch.no_grad()"
            )
        centres.retain_grad()

    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Update the statistics, and refine and reset if it is time; call after `loss.backward()`.

        Args:
            params: tensors of the Gaussians.
            optimizers: optimisers by the same names.
            state: result of `initialize_state`.
            step: number of the training step, from 0.
            info: third result of `rasterization`.
            packed: accepted as in gsplat; `info` tells whether its rows are packed.

        Raises:
            InvalidParameters: if `info` lacks an entry or has no gradient.
        """
        if step >= self.refine_stop_iter:
            return
        self._update_state(params, state, info, packed=packed)
        paused = step % self.reset_every < self.pause_refine_after_reset
        if step > self.refine_start_iter and step % self.refine_every == 0 and not paused:
            duplicated, divided, removed = self._refine(params, optimizers, state, step)
            if self.verbose:
                print(  # noqa: T201
                    f"step {step}: {duplicated} Gaussians duplicated, {divided} split, {removed} removed;"
                    f" {len(params['means'])} now"
                )
            for name in ("grad2d", "count", "radii"):
                if state.get(name) is not None:
                    state[name].zero_()
        if self.compat == "1.6" and step > 0 and step % self.reset_every == 0:
            reset_opa(params, optimizers, state, value=2 * self.prune_opa)

    def _update_state(self, params: Params, state: dict[str, Any], info: dict[str, Any], packed: bool = False) -> None:
        """Add the gradients, views and, if used, radii of one step to the statistics.

        Args:
            params: tensors of the Gaussians.
            state: statistics.
            info: third result of `rasterization`.
            packed: not used; `info` has `gaussian_ids` if its rows are packed.
        """
        centres, width, height, cameras, radii = (
            self._needed(info, name) for name in (self.key_for_gradient, "width", "height", "n_cameras", "radii")
        )
        gradients = getattr(centres, "absgrad", None) if self.absgrad else centres.grad
        if gradients is None and self.absgrad:
            raise InvalidParameters(
                f"{self.key_for_gradient} has no absolute gradient; render with absgrad=True and call backward first, or use"
                " absgrad=False. with_eval3d and gradient_2dgs have none"
            )
        if gradients is None:
            raise InvalidParameters(
                f"{self.key_for_gradient} has no gradient; call step_pre_backward before backward. Pictures with"
                " with_eval3d=True have none: use MCMCStrategy for them"
            )
        scale = (width / 2 * cameras, height / 2 * cameras)
        extent_scale = 1 / max(width, height)
        count = len(next(iter(params.values())))
        for name in ("grad2d", "count", *(("radii",) if self.refine_scale2d_stop_iter > 0 else ())):
            if state.get(name) is None:
                state[name] = torch.zeros(count, device=gradients.device)
        radii = (radii if radii.dim() == gradients.dim() else radii[..., None]).int().expand(gradients.shape)
        if info.get("gaussian_ids") is not None:
            self._add_packed(state, gradients, radii, scale, extent_scale, info["gaussian_ids"])
            return
        shape = (gradients.shape[:-2].numel(), count, 2)
        accumulate_gradient_norms_(
            gradients.float().reshape(shape), radii.reshape(shape), scale, extent_scale, state["grad2d"], state["count"],
            state["radii"] if self.refine_scale2d_stop_iter > 0 else None,
        )  # fmt: skip

    def _add_packed(
        self,
        state: dict[str, Any],
        gradients: Tensor,
        radii: Tensor,
        scale: tuple[float, float],
        extent_scale: float,
        rows: Tensor,
    ) -> None:
        """Add gradients and radii [M, 2] of visible Gaussians to the rows [M] of the statistics."""
        norms = torch.hypot(gradients[:, 0] * scale[0], gradients[:, 1] * scale[1])
        state["grad2d"].index_put_((rows,), norms, accumulate=True)
        state["count"].index_put_((rows,), torch.ones_like(norms), accumulate=True)
        if self.refine_scale2d_stop_iter > 0:
            state["radii"].scatter_reduce_(0, rows, radii.amax(-1) * extent_scale, "amax")

    @torch.no_grad()
    def _refine(self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int) -> tuple[int, int, int]:
        """Duplicate, split and remove Gaussians as `_grow_gs` and `_prune_gs` do, but replace every tensor only once.

        Replacements of the two methods are called. Returns the numbers of duplicated, split and removed ones; synchronises.
        """
        if tuple(getattr(method, "__func__", None) for method in (self._grow_gs, self._prune_gs)) != SEPARATE:
            return *self._grow_gs(params, optimizers, state, step), self._prune_gs(params, optimizers, state, step)
        grown, copies, splits = self._grown(params, state, step)
        tested = {name: grown.of(name, params[name]) for name in ("opacities", "scales")}
        rows = grown.select(~self._to_prune(tested, state, step, grown.sources))
        removed = len(grown.sources) - len(rows.sources)
        if copies or splits or removed:
            rearrange(params, optimizers, state, rows)
        return copies, splits, removed

    @torch.no_grad()
    def _grow_gs(self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int) -> tuple[int, int]:
        """Duplicate and split Gaussians. Returns the numbers of duplicated and of split ones; synchronises."""
        grown, copies, splits = self._grown(params, state, step)
        if copies or splits:
            rearrange(params, optimizers, state, grown)
        return copies, splits

    def _grown(self, params: Params, state: dict[str, Any], step: int) -> tuple[Rows, int, int]:
        """Return the Gaussians after growth, and the numbers of duplicated and of split ones."""
        grown = multiplied(params, *self._to_grow(params, state, step), self.revised_opacity, self.generator)
        present = len(params["means"])
        splits = present - grown.old
        return grown, len(grown.sources) - present - splits, splits

    def _to_grow(self, params: Params, state: dict[str, Any], step: int) -> tuple[Tensor, Tensor]:
        """Return the Gaussians to duplicate and those to split, bool [N] each."""
        steep = state["grad2d"] / state["count"].clamp(min=1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        divided = steep & ~small
        if step < self.refine_scale2d_stop_iter:
            divided |= state["radii"] > self.grow_scale2d
        return steep & small, divided

    @torch.no_grad()
    def _prune_gs(self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int) -> int:
        """Remove transparent and, after the first reset, oversized Gaussians. Returns their number; synchronises."""
        leaving = self._to_prune(params, state, step)
        removed = int(torch.count_nonzero(leaving))
        if removed:
            remove(params, optimizers, state, leaving)
        return removed

    def _to_prune(
        self, params: Params | dict[str, Tensor], state: dict[str, Any], step: int, rows: Tensor | slice = slice(None)
    ) -> Tensor:
        """Return the Gaussians to remove, bool [M]; their statistics are in the rows `rows` of `state`."""
        leaving = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            leaving |= params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                leaving |= state["radii"][rows] > self.prune_scale2d
        return leaving

    @staticmethod
    def _needed(info: dict[str, Any], name: str) -> Any:
        if name not in info:
            raise InvalidParameters(f"info lacks {name!r}; pass the third result of rasterization")
        return info[name]


SEPARATE = (DefaultStrategy._grow_gs, DefaultStrategy._prune_gs)
"""Methods that `DefaultStrategy` replaces by one pass, unless a program overrides one of them."""


@dataclass
class CappedAdc(DefaultStrategy):
    """Adaptive density control that multiplies the Gaussians with the largest gradients first, up to `cap_max`."""

    cap_max: int = field(default=1_000_000, kw_only=True)
    """Largest number of Gaussians."""

    def _to_grow(self, params: Params, state: dict[str, Any], step: int) -> tuple[Tensor, Tensor]:
        copied, divided = super()._to_grow(params, state, step)
        mean = state["grad2d"] / state["count"].clamp(min=1)
        order = mean.masked_fill(~(copied | divided), -1.0).argsort(descending=True, stable=True)
        allowed = torch.zeros_like(copied)
        allowed[order[: max(0, self.cap_max - len(order))]] = True
        return copied & allowed, divided & allowed


FEWEST_STEPS_TO_RESET = 1000
"""Smallest number of steps between two resets of a scene's opacities, which need several hundred steps to recover."""


class SceneAdc:
    """Adaptive density control of an offline reconstruction, on gsplat's schedule relative to 30,000 steps."""

    def __init__(self, plan: Plan) -> None:
        self._step = plan.step
        self._strategy = CappedAdc(
            refine_start_iter=plan.steps // 60,
            refine_stop_iter=plan.steps // 2,
            refine_every=every_of(plan.steps),
            reset_every=max(FEWEST_STEPS_TO_RESET, plan.steps // 10),
            generator=torch.Generator(plan.step.gaussians.device).manual_seed(plan.seed),
            cap_max=plan.most_gaussians,
        )
        self._state = self._strategy.initialize_state(plan.step.distance(plan.observations[0].camera))

    def before_step(self, number: int, rate_scale: float) -> bool:
        """Multiply, remove and reset Gaussians before a step of an offline training if the schedule demands it. Return True if
        their number may have changed; see `SceneStrategy`.
        """
        strategy, screen = self._strategy, self._step.screen
        if screen is None or number >= strategy.refine_stop_iter:
            return False
        centres = torch.empty_like(screen.means2d)[None]
        centres.grad = screen.means2d[None]
        info = {
            "means2d": centres, "radii": screen.radii[None], "width": screen.width, "height": screen.height,
            "n_cameras": 1,
        }  # fmt: skip
        if number % strategy.refine_every and number % strategy.reset_every:
            strategy._update_state(views_of(self._step), self._state, info)
            return False
        change_rows(
            self._step,
            self._state,
            lambda params, optimizers: strategy.step_post_backward(params, optimizers, self._state, number, info),
        )
        return True


KIND = StrategyKind(SceneAdc, DefaultStrategy, screen_gradients=True)
"""Entry of the strategy `adc` (adaptive density control) in the registry `STRATEGIES`."""
