"""Training step on an NVIDIA GPU as one CUDA graph without host synchronisation.

The graph contains deformation, rendering, loss, backward pass and update. Its inputs are held at fixed addresses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsplat_core.deformation.kinds import CapturedTraining
from gsplat_core.ops.adam.adam import adam_step_at_
from gsplat_core.ops.frame.frame import GAUSSIAN_TENSORS, FrameMode, View, accumulate_status_, render_frame
from gsplat_core.ops.frame_gradients.frame_gradients import GaussianAdam, render_frame_backward_adam_
from gsplat_core.ops.image_loss.frame_loss import frame_loss
from gsplat_core.rendering.frame_renderer import (
    CapturedSequence,
    FrameControls,
    FrameStatusCopy,
    GraphMemory,
    capacity_for,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import COLOUR, Gaussians
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.colour_correction import ResidualTarget
from gsplat_core.training.steps.optimiser import FusedAdam
from gsplat_core.training.steps.photometric import LEFT, RIGHT, LossWeights
from gsplat_core.transfers import copy_each


class StepInputs:
    """Picture, mask and depth buffers for one camera size and device."""

    def __init__(self, camera: Camera, device: torch.device, *, with_depth: bool) -> None:
        shape = (camera.height_px, camera.width_px)
        self.image = torch.zeros(*shape, 3, dtype=torch.uint8, device=device)
        self.mask = torch.ones(shape, dtype=torch.uint8, device=device)
        self.depth = torch.zeros(shape, device=device) if with_depth else None
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
        elif self.depth is not None:
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
        self, gaussians: Gaussians, field: CapturedTraining, adam: FusedAdam, weights: LossWeights, camera: Camera
    ) -> None:
        device = gaussians.device
        self._gaussians, self._field, self._adam = gaussians, field, adam
        self._in_use: tuple[object, object, object] = None, None, None
        self._addresses: tuple[int, ...] = ()
        """Addresses of all tensors at the time of the capture."""
        self._weights = weights
        self._camera = camera
        self._inputs = {False: StepInputs(camera, device, with_depth=weights.depth > 0)}
        """Graph inputs by whether they belong to the right eye. Separate inputs save repeated copies when the eyes
        alternate.
        """
        self._controls = FrameControls(device, rates=len(GAUSSIAN_TENSORS) + 1 + field.rates + 1)
        """Controls that include the learning rates of the Gaussians in the backward pass, of
        positions after it, and of the field, followed by the colour relaxation.
        """
        self._corrects = False
        self._step = torch.full((1,), adam.steps, dtype=torch.int64, device=device)
        self._skipped = torch.zeros(len(GAUSSIAN_TENSORS), dtype=torch.int64, device=device)
        self._totals = torch.zeros(4, dtype=torch.int32, device=device)
        """Accumulated frame status since the last `settle` (see `accumulate_status_`)."""
        self._unread: tuple[Tensor, Tensor] | None = None
        self._status = FrameStatusCopy()
        self._memory = GraphMemory(device)
        self._capacity = capacity_for(4 * gaussians.count)
        self._captured: dict[tuple[bool, bool], CapturedSequence[Tensor]] = {}
        """Graphs by whether colours are corrected and whether they train the right eye. The graphs share memory. This
        is safe because they never run concurrently and no graph reads another one's buffers.
        """
        self._warm: set[tuple[bool, bool]] = set()
        self._of_right = False

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
            colour_relaxation: above 0, colours are corrected (`colour_correction`) and depth is not compared, because
                the correction uses the channel of its gradient. Not possible for a field without colours.

        Returns:
            Loss before the update, [] on the device.
        """
        self._corrects = corrects = colour_relaxation > 0
        self._of_right = observation.of_right and gaussians.right_sh is not None
        if self._of_right not in self._inputs:
            self._inputs[True] = StepInputs(self._camera, gaussians.device, with_depth=False)
        self._inputs[self._of_right].take(observation, corrects)
        rates = [gaussian_rates[name] for name in self._names]
        in_frame = [0.0, *rates[1:]] if self._field.reads_positions else rates
        self._controls.set(observation.camera, time, [*in_frame, rates[0], *field_rates, colour_relaxation])
        self._gaussians = gaussians
        self._adam.steps += 1
        kind = corrects, self._of_right
        if kind not in self._warm:  # The first launch loads kernels, which is impossible during a capture.
            self._warm.add(kind)
            return self._sequence()
        if self._was_replaced():
            self._captured.clear()  # frees their memory for the next captures
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
        scene, controls = self._gaussians, self._controls
        right_sh = scene.right_sh if self._of_right else None
        seen = scene if right_sh is None else scene.seen_by_right()
        gaussians = seen.left_tensors
        deltas = self._field.deltas(scene, controls.time)
        camera = self._camera
        view = View(controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px, camera_model=camera.model)
        frame = render_frame(gaussians, deltas, view, self._capacity, FrameMode.TRAINING)
        inputs = self._inputs[self._of_right]
        target = inputs.target if self._corrects else None
        loss = frame_loss(
            frame.image, frame.alphas, inputs.image, inputs.mask, None if target is not None else inputs.depth,
            self._weights.ssim, self._weights.depth, self._weights.squared,
        )  # fmt: skip
        fits = accumulate_status_(frame.status, self._totals, self._step)
        adam = GaussianAdam(
            *self._moments(), in_frame, self._step, self._skipped, betas=self._adam.betas, epsilon=self._adam.epsilon
        )
        correction = None if target is None else target.correction(frame.image, relaxation)
        gradient = render_frame_backward_adam_(
            gaussians, adam, deltas, view, frame, loss.grad_image, loss.grad_alphas, correction
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
        if self._field.reads_positions:
            self._move(scene.means, gradient, of_means, fits)
        return loss.loss

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the trained tensors in the order of the ops, with the colours of the current eye."""
        return (*GAUSSIAN_TENSORS[:-1], RIGHT if self._of_right else LEFT)

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
        """Apply Adam to the positions with the complete gradient."""
        # The quotient is NaN if the frame overflowed its tile lists. Adam then skips all rows and their moments.
        complete = gradient[:, :3] / fits
        first, second = self._adam.first_moments["means"], self._adam.second_moments["means"]
        adam_step_at_(
            means, complete, first, second, rate, self._step, self._skipped[:1], self._adam.betas,
            self._adam.epsilon, row_size=3,
        )  # fmt: skip


def _addresses_of(tensors: Sequence[Tensor]) -> tuple[int, ...]:
    return tuple(number for tensor in tensors for number in (tensor.data_ptr(), tensor.numel()))
