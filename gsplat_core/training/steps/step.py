"""Optimiser step of a scene: deformation, rendering, loss, backward pass and update.

`TrainingStep` holds the scene in training and makes the steps. It uses `AutogradTraining` for deformation fields without a
trainer of their own, and `PictureTraining` for renderers other than alpha blending.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from gsplat_core.choices import RENDERERS, STRATEGIES
from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.kinds import FieldRates, FieldTraining, kind_of
from gsplat_core.errors import InvalidSetting
from gsplat_core.models import TrainedBy
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.renderer import TrainableRenderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import EXTRA_PREFIX, GaussianRows, Gaussians, RowMoves
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.losses import LossContext, WeightedLosses, loss_weights
from gsplat_core.training.observations import Observation, depth_of
from gsplat_core.training.steps.fused_step import FusedStep
from gsplat_core.training.steps.optimiser import FusedAdam
from gsplat_core.training.steps.photometric import (
    LEFT,
    RIGHT,
    Compared,
    LossWeights,
    ScreenGradients,
    loss_and_gradients,
    loss_by_autograd,
    with_eye,
    with_losses,
)
from gsplat_core.training.strategies.strategy import SHRINK


class AutogradTraining:
    """Trainer of any deformation field by autograd. It backpropagates gradients at the deformed Gaussians through
    `field.forward` to the field's parameters and the canonical Gaussians.

    Works for every field on every device. Parameters may be replaced by larger ones when Gaussians
    are added; moments of existing rows are kept.
    """

    def __init__(self, field: DeformationField, rates: FieldRates) -> None:
        self._field = field
        parameters = dict(field.named_parameters())
        self._rate_names = {name: rates.rate_of(name) for name in parameters}
        self._adam = FusedAdam(parameters, rows=False)
        self._canonical: Gaussians | None = None
        self._deformed: Gaussians | None = None

    def deform(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Return the Gaussians at `time_s`, keeping the autograd graph for `update`."""
        self._canonical = gaussians.detach().requires_grad_()
        with torch.enable_grad():
            self._deformed = self._field(self._canonical, time_s)
        assert self._deformed is not None
        return self._deformed.detach()

    def update(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> Mapping[str, Tensor | None]:
        """Do one Adam step for the field's parameters and return the gradients of the canonical Gaussians by tensor
        name, None for a tensor without a gradient.
        """
        assert self._canonical is not None and self._deformed is not None
        tensors = self._deformed.tensors()
        pairs = [
            (tensor, gradients[name]) for name, tensor in tensors.items() if tensor.requires_grad and name in gradients
        ]
        torch.autograd.backward([tensor for tensor, _ in pairs], [gradient for _, gradient in pairs])
        parameters = dict(self._field.named_parameters())
        self._adam.follow(parameters)
        self._adam.step(parameters, learning_rates={name: rates[rate] for name, rate in self._rate_names.items()})
        for parameter in parameters.values():
            parameter.grad = None
        own = {name: tensor.grad for name, tensor in self._canonical.tensors().items()}
        self._canonical = self._deformed = None
        return own


class PictureTraining:
    """Training of a scene by the pictures of a differentiable renderer, together with the renderer's scene-wide scalars."""

    def __init__(self, name: str, distance: float, device: torch.device) -> None:
        """Start training with the values of the renderer for a scene at a distance.

        Args:
            name: name in `RENDERERS` of a renderer with gradients.
            distance: typical distance of the scene from the camera.
            device: device of the scene.
        """
        self.name = name
        self.renderer = cast(TrainableRenderer, RENDERERS[name])
        self._device = device
        self.restart(distance)

    def restart(self, distance: float) -> None:
        """Reset the renderer's scene-wide scalars for another scene, at this typical distance from the camera."""
        first = self.renderer.first_values(distance)
        self._logs = {name: torch.full((1,), math.log(value), device=self._device) for name, value in first.items()}
        self._adam = FusedAdam(self._logs, rows=False)

    @property
    def values(self) -> dict[str, Tensor]:
        """Current scene-wide scalars of the renderer by name, tensors [] each."""
        return {name: log[0].exp() for name, log in self._logs.items()}

    def __call__(
        self, scene: Gaussians, observation: Observation, weights: LossWeights, losses: Callable[[Gaussians], Tensor | None],
        rate_scale: float,
    ) -> Compared:  # fmt: skip
        """Compare the scene with an observation, and do one Adam step for the renderer's scene-wide scalars."""
        values = self.values
        compared = loss_by_autograd(
            scene, values, observation, weights,
            lambda scene, values, depth: self.renderer.picture(scene, observation.camera, None, values, depth), losses,
        )  # fmt: skip
        # The derivative by the logarithm is the value times the derivative by the value.
        gradients = {name: (gradient * values[name])[None] for name, gradient in compared.values.items()}
        rates = {name: self.renderer.rates.get(name, 0.0) * rate_scale for name in self._logs}
        self._adam.step(self._logs, gradients, rates)
        unused = {name: torch.zeros_like(t) for name, t in scene.tensors().items() if name not in compared.gradients}
        return Compared(compared.loss, {**compared.gradients, **unused})


APART = 0.5
"""Distance of the two halves of a split Gaussian from its centre, in its standard deviations along its longest axis."""


def halves(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Split each Gaussian into two smaller ones along its longest axis."""
    longest = parents.log_scales.argmax(1)
    along = torch.nn.functional.one_hot(longest, 3).to(parents.dtype)
    axis = _turned(parents.quats, along)
    reach = parents.log_scales.gather(1, longest[:, None]).exp() * APART
    smaller = parents.log_scales - math.log(SHRINK) * along
    sides = (replace(parents, means=parents.means + side * reach * axis, log_scales=smaller) for side in (-1, 1))
    first, second = sides
    return first, second


def _turned(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [N, 3] by quaternions wxyz [N, 4] of any norm: v + 2 w (q x v) + 2 q x (q x v)."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, q = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(q, vectors)
    return vectors + 2 * (w * across + torch.linalg.cross(q, across))


SETTLE_EVERY = 32
"""Number of captured steps after which the host synchronises to detect overflowing tile lists; also after the first step."""


def mm_per_px(gaussians: Gaussians, camera: Camera) -> float:
    """Return world units per pixel at the scene's median distance, to convert learning rates in pixels."""
    if not gaussians.count:
        return 1 / float(camera.K[0, 0])
    distance = depth_of(gaussians.means, camera).abs().median()
    return float(distance) / float(camera.K[0, 0])


class TrainingStep:
    """Scene in training: its Gaussians, deformation field and optimiser.

    On a GPU the step is captured as a CUDA graph (`FusedStep`) if alpha blending trains the scene, the strategy reads
    no gradients in the picture, and the field and all further losses support it. Otherwise the gradient is computed at
    the deformed Gaussians, and the field's training propagates it to the
    field and the canonical Gaussians.
    """

    def __init__(
        self, gaussians: Gaussians, field: DeformationField, config: ReconstructorConfig, camera: Camera
    ) -> None:
        self.field = field
        self.capabilities = field.capabilities
        """Optional capabilities of the field."""
        self._rates = config.rates
        self._has_no_end = config.history_s is not None
        self._mm_per_px = mm_per_px(gaussians, camera)
        # Inverse depth times distance has no unit, so the weight is independent of the unit of length.
        depth_weight = config.depth_weight * self.distance(camera) if config.depth_weight else 0.0
        self._weights = LossWeights(config.ssim_weight, depth_weight, config.squared_error)
        strategy = STRATEGIES[config.strategy]
        self._losses = WeightedLosses({**strategy.losses, **loss_weights(config.losses)})
        self._pictures: PictureTraining | None = None
        """Training by another renderer than alpha blending; None if alpha blending trains the scene."""
        if config.renderer != "alpha" and RENDERERS[config.renderer].capabilities.differentiable:
            self._pictures = PictureTraining(config.renderer, self.distance(camera), gaussians.device)
        gaussians = self._extended(gaussians)
        self.frames: Callable[[], Sequence[Observation]] = tuple
        """Function that returns the observations available for training, for losses that compare several."""
        self._adam = FusedAdam(gaussians.tensors())
        self._rows: GaussianRows | None = None
        """Preallocated rows in which Gaussians are added and removed without moving tensors."""
        fixed = self.capabilities.fixed_rows
        if config.preallocate and (fixed is not None or self.capabilities.rows is None):
            if fixed is not None:
                fixed.reserve(config.max_gaussians)
            self._rows = GaussianRows(gaussians, config.max_gaussians)
            self._adam.reserve(config.max_gaussians)
            gaussians = self._rows.used
        self.gaussians = gaussians
        """Gaussians of the scene, without unused preallocated rows."""
        kind = kind_of(field.kind)
        self._field_rates = config.rates.field or kind.rates
        if not isinstance(self._field_rates, type(kind.rates)):
            raise InvalidSetting(
                f"the field's learning rates are {type(self._field_rates).__name__}; a {kind.name} field has"
                f" {type(kind.rates).__name__}"
            )
        self._captured: FusedStep | None = None
        self._unsettled_steps = 0
        self._has_settled = False
        self._relaxation = 0.0
        """Share of the colour correction (`colour_relaxation`) of the newest captured step; 0 for a step without correction."""
        self._scaled_for: float | None = None
        self._scaled_rates: tuple[dict[str, float], Sequence[float]] = {}, ()
        frame_deltas = self.capabilities.frame_deltas
        self.screen: ScreenGradients | None = None
        """Gradients of the last step's loss by the Gaussians' centres in the picture; None if the strategy does not
        read them (`Strategy.screen_gradients`).
        """
        self._keeps_screen = strategy.screen_gradients
        captures = (
            gaussians.device.type == "cuda"
            and self._losses.can_be_captured
            and self._pictures is None
            and not self._keeps_screen
        )
        if captures and kind.captured_training is not None and frame_deltas is not None:
            training = kind.captured_training(field)
            self._rate_values, self._frame_time = training.rate_values, frame_deltas.frame_time
            self._captured = FusedStep(self._all_rows, training, self._adam, self._weights, camera, self._losses)
        self._training: FieldTraining = (
            AutogradTraining(field, self._field_rates) if kind.training is None else kind.training(field)
        )

    def __call__(
        self,
        observation: Observation,
        rate_scale: float = 1.0,
        colour_relaxation: float = 0.0,
        corrections_before: int = 0,
    ) -> Tensor:
        """Train on one observation.

        Args:
            observation: target.
            rate_scale: factor of all learning rates.
            colour_relaxation: above 0, colours at the observation's time are corrected (`colour_correction`) instead of
                trained; for a field without temporal colours, those of all times. A captured step then compares depth only
                along rays.
            corrections_before: number of corrections before the comparison, see `loss_and_gradients`; CPU only.

        Returns:
            Loss before the update, [] on the device. A captured step is only queued; reading the loss or `settle` waits
            for it.
        """
        add_colours = self.capabilities.add_colours
        relaxation = 0.0 if self._pictures is not None else colour_relaxation
        if self._captured is not None:
            self._relaxation = relaxation
            return self._captured_step(self._captured, observation, rate_scale)
        deformed = self._training.deform(self.gaussians, observation.time_s)
        right_sh = self.gaussians.right_sh
        of_right = observation.of_right and right_sh is not None
        seen = _seen_by(deformed, observation)
        losses = lambda scene: self._losses(scene, observation, LossContext(self.frames(), self.at))
        if self._pictures is not None:
            compared = self._pictures(seen, observation, self._weights, losses, rate_scale)
        else:
            compared = loss_and_gradients(seen, observation, self._weights, relaxation, corrections_before)
            if self._losses:
                compared = with_losses(compared, seen, losses)
        self.screen = compared.screen if self._keeps_screen else None
        gradients = compared.gradients if right_sh is None else with_eye(compared.gradients, of_right)
        own = self._training.update(gradients, self._field_rates.scaled(self._mm_per_px, rate_scale))
        if right_sh is not None:
            own = {**own, LEFT if of_right else RIGHT: None}  # the other eye's colours are unchanged
        self._adam.step(self.gaussians.tensors(), own, self._gaussian_rates(rate_scale))
        if compared.colour_change is not None:
            if of_right and right_sh is not None:
                right_sh[:, 0] += compared.colour_change
            elif add_colours is not None:
                add_colours(observation.time_s, compared.colour_change)
            else:
                self.gaussians.sh[:, 0] += compared.colour_change
        return compared.loss

    def scale_about(self, camera: Camera, factor: Tensor) -> None:
        """Move every Gaussian at all times to `factor` [N] times its distance from the camera's centre, and scale it
        accordingly. The field must have `Capabilities.motion`.

        The camera sees the same picture. Adam's moments are converted; learning rates follow with `take_distance`.
        """
        motion = self.capabilities.motion
        assert motion is not None
        with torch.no_grad():
            scene, each = self.gaussians, factor[:, None]
            centre = torch.as_tensor(camera.position, dtype=scene.means.dtype).to(scene.device, non_blocking=True)
            scene.means.copy_(centre + each * (scene.means - centre))
            scene.log_scales.add_(each.log())
            motion.scale_positions(factor)
            count = len(factor)
            self._adam.first_moments["means"][:count].div_(each)
            self._adam.second_moments["means"][:count].div_(each.square())

    @property
    def has_colours_in_time(self) -> bool:
        """True if the step can correct the colours of one time with little change at other times (`colour_correction`).

        The field must have `Capabilities.add_colours`, and the step must train by alpha blending. On CUDA the colours
        must not depend on the view.
        """
        view_dependent = self.gaussians.device.type == "cuda" and self.gaussians.sh_degree > 0
        return self.capabilities.add_colours is not None and self._pictures is None and not view_dependent

    @property
    def steps(self) -> int:
        """Number of steps on this scene."""
        return self._adam.steps

    def shorten_rotations(self) -> None:
        """Normalise all quaternions, including the field's part, without changing the scene. Training lengthens
        quaternions, which slows further rotation. Nothing changes without `Capabilities.motion`.
        """
        motion = self.capabilities.motion
        if motion is None:
            return
        quats, count = self.gaussians.quats, self.gaussians.count
        factor = 1 / quats.norm(dim=1).clamp(min=1e-6)
        motion.scale_rotations(factor)
        quats.mul_(factor[:, None])
        self._adam.first_moments["quats"][:count].div_(factor[:, None])
        self._adam.second_moments["quats"][:count].div_(factor.square()[:, None])

    def mean_gradients(self, name: str) -> Tensor:
        """Return the gradients of a tensor of the Gaussians, averaged over the last steps by Adam (its first moment)."""
        return self._adam.first_moments[name][: self.gaussians.count]

    def idle(self, part: float) -> Tensor:
        """Return which Gaussians have a mean squared opacity gradient below `part` times the mean over all, bool [N]."""
        squared = self._adam.second_moments["logit_opacities"][: self.gaussians.count]
        return squared < part * squared.mean()

    def busiest(self, count: int, among: Tensor) -> Tensor:
        """Return indices, int64 [at most count], of the Gaussians in `among`, bool [N], with the
        largest position gradients.
        """
        squared = self._adam.second_moments["means"][: self.gaussians.count].sum(1).masked_fill(~among, -1.0)
        order = squared.argsort(descending=True, stable=True)[:count]
        return order[among[order]]

    def take_distance(self, camera: Camera) -> None:
        """Update learning rates given in pixels to the scene's distance from the camera. Synchronises."""
        self._mm_per_px, self._scaled_for = mm_per_px(self.gaussians, camera), None

    def distance(self, camera: Camera) -> float:
        """Return the typical distance from the camera to the scene, in the scene's unit, as last computed."""
        return self._mm_per_px * float(camera.K[0, 0])

    def settle(self, observation: Observation, rate_scale: float = 1.0) -> None:
        """Wait for captured steps, and repeat on `observation` those that had no effect because of an overflow."""
        self._unsettled_steps, self._has_settled = 0, True
        while self._captured is not None and (lost := self._captured.settle()):
            for _ in range(lost):
                self._captured_step(self._captured, observation, rate_scale)

    def at(self, time_s: float) -> Gaussians:
        """Return the Gaussians deformed to a time in seconds, without gradients."""
        with torch.no_grad():
            deformed: Gaussians = self.field(self.gaussians, time_s)
        return deformed

    def seen_by(self, observation: Observation) -> Gaussians:
        """Return the scene at an observation's time in the colours of its eye."""
        return _seen_by(self.at(observation.time_s), observation)

    def copy(self) -> tuple[Gaussians, DeformationField]:
        """Return copies of the Gaussians and the deformation field, without Adam's moments."""
        return self.gaussians.detach().clone(), self.field.detached_copy()

    def append(self, added: Gaussians, parents: Tensor | None = None) -> None:
        """Add Gaussians that are static, or move like those at `parents` (int64 indices)."""
        added = self._extended(added)
        if self._rows is not None:
            self._rows.append(added)
            self.gaussians = self._rows.used
        else:
            self.gaussians = self.gaussians.append(added)
        if self.capabilities.rows is not None:
            self.capabilities.rows.append(added.count, parents)
        self._adam.append(added.count, usual=self._has_no_end)

    def split(self, parents: Tensor, parts: Callable[[Gaussians], tuple[Gaussians, Gaussians]] = halves) -> None:
        """Replace each Gaussian at `parents` (int64 indices) by two made by `parts`, which move like their parent.

        The second ones are appended. All start with fresh moments, except that in an endless stream the first ones keep
        their parent's.
        """
        first, second = parts(self.gaussians.select(parents))
        for name, tensor in self.gaussians.tensors().items():
            tensor[parents] = first.tensors()[name]
            if not self._has_no_end:
                self._adam.reset(name, parents)
        self.append(second, parents)

    def remove(self, leaving: Tensor) -> RowMoves:
        """Remove the Gaussians marked in `leaving`, bool [N]. Returns the row moves of the others. Synchronises."""
        moves = RowMoves.without(leaving)
        if self._rows is not None:
            self._rows.close_gaps(moves)
            self.gaussians = self._rows.used
            self._adam.close_gaps(moves)
            if self.capabilities.fixed_rows is not None:
                self.capabilities.fixed_rows.close_gaps(moves)
        else:
            self.gaussians = self.gaussians.select(moves.order)
            self._adam.select(moves.order)
            if self.capabilities.rows is not None:
                self.capabilities.rows.select(moves.order)
        return moves

    def moments(self, name: str) -> dict[str, Tensor]:
        """Return copies of Adam's moments of a tensor of the Gaussians, by torch.optim.Adam's names."""
        count, adam = self.gaussians.count, self._adam
        return {
            "exp_avg": adam.first_moments[name][:count].clone(),
            "exp_avg_sq": adam.second_moments[name][:count].clone(),
        }

    def rearrange(self, source: Tensor, gaussians: Gaussians, moments: Mapping[str, Mapping[str, Tensor]]) -> Tensor:
        """Replace the Gaussians by M others, of which each moves as the present one at `source`. Synchronises.

        Args:
            source: present rows, int64 [M]; a row may occur several times, and those that do not occur are removed.
            gaussians: the M Gaussians.
            moments: their moments by tensor, as from `moments`.

        Returns:
            Order of the scene's rows: index into `gaussians`, int64 [M].
        """
        count, total = self.gaussians.count, len(source)
        numbers = torch.arange(total, device=source.device)
        first = numbers.new_full((count,), total).scatter_reduce(0, source, numbers, "amin")
        copies = (first[source] != numbers).nonzero()[:, 0]
        kept = self.remove(first == total).order
        row_of = numbers.new_zeros(count)
        row_of[kept] = numbers[: len(kept)]
        if len(copies):
            self.append(gaussians.select(copies), row_of[source[copies]])
        order = torch.cat([first[kept], copies])
        for name, tensor in self.gaussians.tensors().items():
            tensor.copy_(gaussians.tensors()[name][order])
            self._adam.first_moments[name][:total] = moments[name]["exp_avg"][order]
            self._adam.second_moments[name][:total] = moments[name]["exp_avg_sq"][order]
        return order

    @property
    def means_rate(self) -> float:
        """Learning rate of positions in world units."""
        return self._rates.means_px * self._mm_per_px

    def restart(self, gaussians: Gaussians, time_s: float, camera: Camera) -> bool:
        """Start another scene of the same camera size in the same memory. Returns False, with
        nothing changed, if that is impossible.
        """
        count, fixed = gaussians.count, self.capabilities.fixed_rows
        gaussians = self._extended(gaussians)
        if gaussians.tensors().keys() != self.gaussians.tensors().keys():
            return False
        if self._rows is None or fixed is None or count > self._rows.capacity:
            return False
        fixed.restart(time_s, count)
        self._rows.replace(gaussians)
        self.gaussians = self._rows.used
        self._adam.restart(count)
        if self._captured is not None:
            self._captured.restart()
        self._mm_per_px, self._scaled_for = mm_per_px(gaussians, camera), None
        if self._pictures is not None:
            self._pictures.restart(self.distance(camera))
        return True

    @property
    def is_trained_by_alpha(self) -> bool:
        """True if alpha blending trains the scene."""
        return self._pictures is None

    def trained_by(self) -> TrainedBy:
        """Return the renderer that trains the scene, with its present values. Synchronises unless that is alpha blending."""
        if self._pictures is None:
            return TrainedBy()
        return TrainedBy(self._pictures.name, {name: float(value) for name, value in self._pictures.values.items()})

    def picture(self, scene: Gaussians, camera: Camera, depth: bool = True) -> RenderOutput:
        """Render the scene at one time by the renderer that trains it, differentiable in the scene's tensors."""
        if self._pictures is None:
            return render(scene, camera, depth=depth)
        return self._pictures.renderer.picture(scene, camera, None, self._pictures.values, depth)

    def _extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the tensors of the renderer and of the losses in `extra`."""
        gaussians = gaussians if self._pictures is None else self._pictures.renderer.extended(gaussians)
        return self._losses.extended(gaussians)

    @property
    def fixed_rows(self) -> Gaussians | None:
        """All preallocated rows, or None if tensors are replaced when Gaussians are added."""
        return None if self._rows is None else self._rows.all

    @property
    def _all_rows(self) -> Gaussians:
        return self.gaussians if self._rows is None else self._rows.all

    def _captured_step(self, captured: FusedStep, observation: Observation, rate_scale: float) -> Tensor:
        if rate_scale != self._scaled_for:
            # In a stream the factor of the learning rates stays 1, so the scaled rates are computed once.
            self._scaled_for = rate_scale
            self._scaled_rates = (
                self._gaussian_rates(rate_scale),
                self._rate_values(self._field_rates.scaled(self._mm_per_px, rate_scale)),
            )
        loss = captured(
            self._all_rows, observation, self._frame_time(observation.time_s), *self._scaled_rates, self._relaxation
        )
        first, self._unsettled_steps = not self._has_settled, self._unsettled_steps + 1
        if first or self._unsettled_steps >= SETTLE_EVERY:
            self.settle(observation, rate_scale)
        return loss

    def _gaussian_rates(self, rate_scale: float) -> dict[str, float]:
        rates = self._rates
        right = {} if self.gaussians.right_sh is None else {RIGHT: rates.right_share * rates.sh * rate_scale}
        return {
            "means": rates.means_px * self._mm_per_px * rate_scale,
            "quats": rates.quats * rate_scale,
            "log_scales": rates.log_scales * rate_scale,
            "logit_opacities": rates.logit_opacities * rate_scale,
            LEFT: rates.sh * rate_scale,
            **right,
            **{EXTRA_PREFIX + name: self._extra_rate(name) * rate_scale for name in self.gaussians.extra},
        }

    def _extra_rate(self, name: str) -> float:
        """Return the learning rate of a tensor in `Gaussians.extra`: of the renderer or loss, else that of colours."""
        own = {**self._losses.rates, **({} if self._pictures is None else self._pictures.renderer.rates)}
        return own.get(name, self._rates.sh)


def _seen_by(scene: Gaussians, observation: Observation) -> Gaussians:
    return scene.seen_by_right() if observation.of_right else scene
