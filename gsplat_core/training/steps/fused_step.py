"""Training step on an NVIDIA GPU as one CUDA graph without host synchronisation.

The graph contains deformation, rendering, loss, backward pass and update. Its inputs are held at fixed addresses.
Steps that compare rays have a graph of their own, which also renders the rays and backpropagates their losses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.deformation.kinds import CapturedTraining
from gsplat_core.ops.adam import adam_step_at_
from gsplat_core.ops.frame import (
    GAUSSIAN_TENSORS,
    STATUS_NEEDED,
    STATUS_OVERFLOW,
    FrameMode,
    View,
    accumulate_status_,
    render_frame,
)
from gsplat_core.ops.frame_gradients import GaussianAdam, render_frame_backward_adam_
from gsplat_core.ops.image_loss import frame_loss
from gsplat_core.rendering.alpha import (
    CapturedSequence,
    FrameControls,
    FrameStatusCopy,
    GraphMemory,
    capacity_for,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION, Gaussians
from gsplat_core.training.losses import WeightedLosses, compared_rays
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.optimiser import FusedAdam
from gsplat_core.training.steps.photometric import LEFT, RIGHT, LossWeights, ResidualTarget
from gsplat_core.transfers import copy_each

GEOMETRY: Mapping[str, slice | int] = {
    "means": POSITION,
    "quats": ROTATION,
    "log_scales": LOG_SCALE,
    "logit_opacities": OPACITY.start,
}
"""Tensors trained by the losses along rays (depth, normals and classes), with their columns in the raw parameters
[N, 16].
"""


class StepKind(NamedTuple):
    """Properties of a training step for each combination of which a separate CUDA graph is captured."""

    corrects: bool
    """Colours are corrected instead of trained."""
    of_right: bool
    """The right eye is trained."""
    compares_rays: bool
    """The losses that compare depth, normals and classes along rays are evaluated too."""


class StepInputs:
    """Picture, mask and depth buffers for one camera size and device."""

    def __init__(self, camera: Camera, device: torch.device, *, with_depth: bool, ray_depth: bool = False) -> None:
        """Create the buffers.

        Args:
            camera: size of the pictures.
            device: device of the buffers.
            with_depth: hold depth for the loss of a picture.
            ray_depth: hold depth also for steps that correct colours, which compare it along rays only.
        """
        shape = (camera.height_px, camera.width_px)
        self.image = torch.zeros(*shape, 3, dtype=torch.uint8, device=device)
        self.mask = torch.ones(shape, dtype=torch.uint8, device=device)
        self.depth = torch.zeros(shape, device=device) if with_depth or ray_depth else None
        self._ray_depth = ray_depth
        self.target: ResidualTarget | None = None
        """Buffers of the target picture for colour corrections, created when colours are first corrected."""
        self._taken: Observation | None = None
        self._corrects = False

    def take(self, observation: Observation, corrects: bool) -> None:
        """Queue the copy of an observation for a step with or without colour correction. An unchanged observation is
        not copied again.
        """
        if corrects and self.target is None:
            self.target = ResidualTarget(self.image)
        if observation is self._taken and corrects == self._corrects:
            return
        self._taken, self._corrects = observation, corrects
        copy_each([self.image, self.mask], [observation.image, observation.mask])
        if corrects and self.target is not None:
            self.target.take(self.image, self.mask)
        if self.depth is not None and (self._ray_depth or not corrects):
            if observation.depth is None:
                self.depth.zero_()  # unknown everywhere, so the loss term is 0
            else:
                self.depth.copy_(observation.depth, non_blocking=True)


class FusedStep:
    """Training step for one set of tensors and one camera size, captured once and replayed.

    Parameters, moments and the field's state are updated in place. If any tensor is replaced (Gaussians added, the
    field's window moved), the next step captures a new graph.

    A frame that overflows the tile lists changes no parameter or moment; the device checks this. `settle` detects it,
    raises the capacity and returns the number of ineffective steps, which the caller repeats.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        field: CapturedTraining,
        adam: FusedAdam,
        weights: LossWeights,
        camera: Camera,
        losses: WeightedLosses | None = None,
    ) -> None:
        """Create the step without capturing it.

        Args:
            gaussians: parameters.
            field: training of the deformation field.
            adam: optimiser of the parameters.
            weights: weights of the losses of a picture.
            camera: size and projection model of every observation.
            losses: losses along rays, `WeightedLosses.can_be_captured`.
        """
        device = gaussians.device
        self._gaussians, self._field, self._adam = gaussians, field, adam
        self._in_use: tuple[object, object, object] = None, None, None
        self._addresses: tuple[int, ...] = ()
        """Addresses of all tensors at the time of the capture."""
        self._weights = weights
        self._camera = camera
        self._losses = losses if losses else None
        self._inputs = {
            False: StepInputs(camera, device, with_depth=weights.depth > 0, ray_depth=self._losses is not None)
        }
        """Graph inputs by whether they belong to the right eye. Separate inputs save repeated copies when the eyes
        alternate.
        """
        self._controls = FrameControls(device, rates=len(GAUSSIAN_TENSORS) + 1 + field.rates + 1)
        """Controls that include the learning rates of the Gaussians in the backward pass, of
        positions after it, and of the field, followed by the colour relaxation.
        """
        self._kind = StepKind(False, False, False)
        """Kind of the newest step."""
        self._step = torch.full((1,), adam.steps, dtype=torch.int64, device=device)
        self._skipped = torch.zeros(len(GAUSSIAN_TENSORS), dtype=torch.int64, device=device)
        self._totals = torch.zeros(4, dtype=torch.int32, device=device)
        """Accumulated frame status since the last `settle` (see `accumulate_status_`)."""
        self._unread: tuple[Tensor, Tensor] | None = None
        """Dummy Adam moments of the positions for the fused backward pass, if the positions are updated after it."""
        self._status = FrameStatusCopy()
        self._memory = GraphMemory(device)
        self._capacity = capacity_for(4 * gaussians.count)
        self._captured: dict[StepKind, CapturedSequence[Tensor]] = {}
        """Graphs by kind. The graphs share memory. This is safe because they never run concurrently and no graph reads
        another one's buffers.
        """
        self._warm: set[StepKind] = set()

    def __call__(
        self,
        gaussians: Gaussians,
        observation: Observation,
        time: float,
        gaussian_rates: Mapping[str, float],
        field_rates: Sequence[float],
        colour_relaxation: float = 0.0,
    ) -> Tensor:
        """Queue one step on the current stream.

        Args:
            gaussians: parameters, updated in place.
            observation: picture of the camera's size; copied to the device if needed.
            time: normalised time from `FrameDeltas.frame_time`.
            gaussian_rates: Adam's learning rates of the Gaussians' tensors by name.
            field_rates: learning rates of the field.
            colour_relaxation: above 0, colours are corrected (`colour_correction`) and depth is compared only along rays, because
                the correction uses the channel of its gradient. Not possible for a field without colours.

        Returns:
            Loss before the update, [] on the device.
        """
        kind = self._kind = StepKind(
            colour_relaxation > 0,
            observation.of_right and gaussians.right_sh is not None,
            self._losses is not None and self._losses.are_rays_due(observation),
        )
        if kind.of_right not in self._inputs:
            self._inputs[True] = StepInputs(
                self._camera, gaussians.device, with_depth=False, ray_depth=self._losses is not None
            )
        self._inputs[kind.of_right].take(observation, kind.corrects)
        rates = [gaussian_rates[name] for name in self._names]
        in_frame = [0.0, *rates[1:]] if self._field.reads_positions else rates
        self._controls.set(observation.camera, time, [*in_frame, rates[0], *field_rates, colour_relaxation])
        self._gaussians = gaussians
        self._adam.steps += 1
        if kind not in self._warm:  # The first launch loads kernels, which is impossible during a capture.
            self._warm.add(kind)
            return self._sequence()
        if self._was_replaced():
            self._captured.clear()  # frees the graphs' memory for the next captures
        if kind not in self._captured:
            self._captured[kind] = CapturedSequence(self._sequence, self._step.device, self._memory, warm_up=False)
        return self._captured[kind].replay().clone()

    def restart(self) -> None:
        """Restart Adam's step count after the tensors were overwritten with another scene. Graphs stay valid."""
        self._step.fill_(self._adam.steps)

    def settle(self) -> int:
        """Wait for all queued steps and return how many had no effect because of an overflow.

        The tile lists have more capacity afterwards; the caller repeats those steps.
        """
        self._status.queue(self._totals)
        self._status.launched(self._totals.device)
        needs = self._status.wait()
        self._totals.zero_()
        if needs.overflowed:
            self._adam.steps -= needs.overflowed
            self._capacity = capacity_for(needs.instances)
            self._captured.clear()
        return needs.overflowed

    def _was_replaced(self) -> bool:
        """Return True if any tensor has another address or size than at the capture."""
        in_use = self._gaussians, self._adam.first_moments["means"], self._field.tensors()
        if all(now is before for now, before in zip(in_use, self._in_use, strict=True)):
            return False  # identical objects, so their addresses need no comparison
        self._in_use = in_use
        moments = (*self._adam.first_moments.values(), *self._adam.second_moments.values())
        before = self._addresses
        self._addresses = _addresses_of((*self._gaussians.tensors().values(), *moments, *in_use[2]))
        return self._addresses != before

    def _sequence(self) -> Tensor:
        counts = [len(GAUSSIAN_TENSORS), 1, self._field.rates, 1]
        in_frame, of_means, of_field, relaxation = self._controls.rates.split(counts)
        scene, controls, kind = self._gaussians, self._controls, self._kind
        right_sh = scene.right_sh if kind.of_right else None
        seen = scene if right_sh is None else scene.seen_by_right()
        gaussians = seen.left_tensors
        deltas = self._field.deltas(scene, controls.time)
        camera = self._camera
        view = View(controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px, camera_model=camera.model)
        frame = render_frame(gaussians, deltas, view, self._capacity, FrameMode.TRAINING)
        inputs = self._inputs[kind.of_right]
        target = inputs.target if kind.corrects else None
        uses_depth = self._weights.depth > 0 and target is None
        loss = frame_loss(
            frame.image, frame.alphas, inputs.image, inputs.mask, inputs.depth if uses_depth else None,
            self._weights.ssim, self._weights.depth, self._weights.squared,
        )  # fmt: skip
        value, of_rays = loss.loss, None
        if kind.compares_rays:
            of_losses, of_rays = self._compare_rays(scene, deltas, view, inputs, frame.status)
            value = value + of_losses
        fits = accumulate_status_(frame.status, self._totals, self._step)
        adam = GaussianAdam(
            *self._moments(), in_frame, self._step, self._skipped, betas=self._adam.betas, epsilon=self._adam.epsilon
        )
        correction = None if target is None else target.correction(frame.image, relaxation)
        gradient = render_frame_backward_adam_(
            gaussians, adam, deltas, view, frame, loss.grad_image, loss.grad_alphas, correction, of_rays
        )
        assert gradient is not None
        change = None
        if correction is not None:
            change = gradient[:, COLOUR].clone()
        if right_sh is not None:
            right_sh.copy_(seen.sh - scene.sh)  # store Adam's update as the right eye's difference
        if correction is not None or right_sh is not None:
            gradient[:, COLOUR].zero_()
        self._field.update(gradient, controls.time, of_field, self._step, frame.status)
        if change is not None:
            if right_sh is not None:
                right_sh[:, 0].add_(change)
            elif self._field.add_colours is not None:
                self._field.add_colours(change, controls.time)
            else:
                scene.sh[:, 0].add_(change)
        if self._field.reads_positions:
            self._move(scene.means, gradient, of_means, fits)
        return value

    def _compare_rays(
        self, scene: Gaussians, deltas: Tensor | None, view: View, inputs: StepInputs, status: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the losses along rays and their gradient by the raw parameters [N, 16]. Reports an overflow in `status`."""
        assert self._losses is not None
        tensors = {name: tensor.detach() for name, tensor in scene.tensors().items() if name in GEOMETRY}
        if deltas is not None:
            tensors = {name: tensor + deltas[:, GEOMETRY[name]] for name, tensor in tensors.items()}
        # Run the backward pass in this thread, because a CUDA graph capture belongs to one thread.
        with torch.enable_grad(), torch.autograd.set_multithreading_enabled(False):
            leaves = {name: tensor.requires_grad_() for name, tensor in tensors.items()}
            seen = Gaussians.from_tensors({**leaves, LEFT: scene.sh})
            rays, needed = compared_rays(seen, view, inputs.mask, inputs.depth, capacity=self._capacity)
            loss = self._losses.compare(rays)
            found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        assert needed is not None
        status[STATUS_NEEDED] = torch.maximum(status[STATUS_NEEDED], needed[0].int())
        status[STATUS_OVERFLOW].bitwise_or_(needed[0] > self._capacity)
        parts = [
            torch.zeros_like(leaf) if part is None else part for leaf, part in zip(leaves.values(), found, strict=True)
        ]
        means, quats, log_scales, logit_opacities = parts
        none = torch.zeros_like(means)
        return loss.detach(), torch.cat([means, quats, log_scales, none, logit_opacities[:, None], none[:, :2]], 1)

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the trained tensors in the order of the ops, with the colours of the current eye."""
        return (*GAUSSIAN_TENSORS[:-1], RIGHT if self._kind.of_right else LEFT)

    def _moments(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return Adam's moments for the backward pass. If the field contributes to the positions'
        gradient, positions are not updated there: their rate is 0 and scratch moments are passed.
        """
        first = [self._adam.first_moments[name] for name in self._names]
        second = [self._adam.second_moments[name] for name in self._names]
        if self._field.reads_positions:
            if self._unread is None or self._unread[0].shape != first[0].shape:
                self._unread = torch.zeros_like(first[0]), torch.zeros_like(second[0])
            first[0], second[0] = self._unread
        return first, second

    def _move(self, means: Tensor, gradient: Tensor, rate: Tensor, fits: Tensor) -> None:
        """Apply Adam to the positions with the sum of the gradients of the picture and of the deformation field."""
        # The quotient is NaN if the frame overflowed its tile lists. Adam then skips all rows and their moments.
        complete = gradient[:, :3] / fits
        first, second = self._adam.first_moments["means"], self._adam.second_moments["means"]
        adam_step_at_(
            means, complete, first, second, rate, self._step, self._skipped[:1], self._adam.betas,
            self._adam.epsilon, row_size=3,
        )  # fmt: skip


def _addresses_of(tensors: Sequence[Tensor]) -> tuple[int, ...]:
    return tuple(number for tensor in tensors for number in (tensor.data_ptr(), tensor.numel()))
