"""The training step on an NVIDIA GPU: deform, render, compare, go back and update in one CUDA graph, without a wait of the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsplat_core.cameras import Camera
from gsplat_core.captured import CapturedSequence, GraphMemory
from gsplat_core.frame_renderer import FrameControls, FrameStatus, capacity_for
from gsplat_core.gaussians import Gaussians
from gsplat_core.ops.adam.adam import adam_step_at_
from gsplat_core.ops.frame.frame import STATUS_CUT, render_frame
from gsplat_core.ops.frame.frame_gradients import DC, render_frame_backward, render_frame_backward_adam_
from gsplat_core.ops.image_loss.frame_loss import frame_loss
from gsplat_core.ops.scalars.scalars import store_scalars_
from gsplat_core.training.field_training import FieldTraining
from gsplat_core.training.observations import Observation
from gsplat_core.training.optimiser import FusedAdam
from gsplat_core.training.photometric import LossWeights

GAUSSIAN_TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh")
"""The Gaussians' tensors in the order in which the ops take them, their moments and their learning rates."""


class FusedStep:
    """Training steps for one set of tensors and one camera size, captured once and replayed.

    Parameters, moments and the field's state change in place. Where any of them was replaced by another tensor (Gaussians added, the
    field's window moved), the next step is recorded anew.

    A frame whose splats do not fit its lists changes nothing: the device sees it and leaves every parameter and moment alone. `settle`
    notices, makes room and says how many steps were lost, which the owner then takes again.
    """

    def __init__(
        self, gaussians: Gaussians, field: FieldTraining, adam: FusedAdam, weights: LossWeights, camera: Camera
    ) -> None:
        device = gaussians.device
        self._gaussians, self._field, self._adam = gaussians, field, adam
        self._recorded: tuple[int, ...] = ()
        """Where the tensors were when the graph was recorded."""
        self._weights = weights
        self._camera = camera
        shape = (camera.height_px, camera.width_px)
        self._image = torch.zeros(*shape, 3, dtype=torch.uint8, device=device)
        self._mask = torch.ones(shape, dtype=torch.uint8, device=device)
        self._depth = torch.zeros(shape, device=device) if weights.depth > 0 else None
        self._controls = FrameControls(device)
        self._rates = torch.zeros(len(GAUSSIAN_TENSORS) + field.rates, device=device)
        self._step = torch.full((1,), adam.steps, dtype=torch.int64, device=device)
        self._skipped = torch.zeros(len(GAUSSIAN_TENSORS), dtype=torch.int64, device=device)
        self._most = torch.zeros(4, dtype=torch.int32, device=device)
        """The frames' status since the last `settle`: the largest of each value, but the sum of those that were cut."""
        self._status = FrameStatus()
        self._memory = GraphMemory(device)
        self._capacity = capacity_for(4 * gaussians.count)
        self._captured: CapturedSequence[Tensor] | None = None
        self._warm = False

    def __call__(
        self,
        gaussians: Gaussians,
        observation: Observation,
        time: float,
        gaussian_rates: Mapping[str, float],
        field_rates: Sequence[float],
    ) -> Tensor:
        """Queue one step on the current stream; returns the loss before the update, [] on the device.

        Args:
            gaussians: what is trained, in place.
            observation: of the camera's size; on the device, else it is copied there.
            time: the field's own, of `DeformationField.frame_time`.
            gaussian_rates: Adam's learning rates of the Gaussians' tensors, by name.
            field_rates: those of the field, as many as it takes.
        """
        self._image.copy_(observation.image, non_blocking=True)
        self._mask.copy_(observation.mask, non_blocking=True)
        if self._depth is not None:
            if observation.depth is None:
                self._depth.zero_()  # unknown everywhere: the term is 0
            else:
                self._depth.copy_(observation.depth, non_blocking=True)
        self._controls.set(observation.camera, time)
        rates = [gaussian_rates[name] for name in GAUSSIAN_TENSORS]
        store_scalars_(self._rates, [*rates, *field_rates])
        self._gaussians = gaussians
        self._adam.steps += 1
        if not self._warm:  # kernels are loaded by their first launch, which a recording does not allow
            self._warm = True
            return self._sequence()
        in_use = self._places()
        if self._captured is None or in_use != self._recorded:
            self._captured = None  # its memory serves the next recording
            self._captured = CapturedSequence(self._sequence, self._image.device, self._memory, warm_up=False)
            self._recorded = in_use
        return self._captured.replay().clone()

    def settle(self) -> int:
        """Wait for the steps since the last call; returns how many of them changed nothing because their splats did not fit.

        There is room for them now: take them again.
        """
        self._status.fetch(self._most)
        needed, lost = self._status.wait()
        self._most.zero_()
        if lost:
            self._adam.steps -= lost
            self._capacity = capacity_for(needed)
            self._captured = None
        return lost

    def _places(self) -> tuple[int, ...]:
        moments = (*self._adam.first_moments.values(), *self._adam.second_moments.values())
        tensors = (*self._gaussians.tensors().values(), *moments, *self._field.tensors())
        return tuple(number for tensor in tensors for number in (tensor.data_ptr(), tensor.numel()))

    def _sequence(self) -> Tensor:
        gaussian_rates, field_rates = self._rates[: len(GAUSSIAN_TENSORS)], self._rates[len(GAUSSIAN_TENSORS) :]
        scene, controls = self._gaussians, self._controls
        gaussians = tuple(scene.tensors().values())
        deltas = self._field.deltas(scene, controls.time)
        view = (deltas, controls.viewmat, controls.intrinsics, None)
        size, model = (self._camera.width_px, self._camera.height_px), self._camera.model
        frame = render_frame(
            scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh, *view, *size, self._capacity,
            camera_model=model, training=True,
        )  # fmt: skip
        loss = frame_loss(
            frame.image, frame.alphas, self._image, self._mask, self._depth, self._weights.ssim, self._weights.depth
        )
        fits = 1 - frame.status[STATUS_CUT : STATUS_CUT + 1]
        self._step.add_(fits)
        pictures = (frame, loss.grad_image, loss.grad_alphas)
        first = tuple(self._adam.first_moments[name] for name in GAUSSIAN_TENSORS)
        second = tuple(self._adam.second_moments[name] for name in GAUSSIAN_TENSORS)
        if self._field.reads_positions:
            raw, sh = render_frame_backward(gaussians, *view, *pictures, camera_model=model)
            self._field.update(raw, controls.time, field_rates, self._step, frame.status)
            raw.div_(fits)  # not a number where the frame was cut: Adam leaves such rows alone, moments and all
            v_sh = raw[:, None, DC] if sh.numel() == 0 else sh.div_(fits)
            self._update_gaussians(gaussians, first, second, (*_columns(raw), v_sh), gaussian_rates)
        else:
            gradient = render_frame_backward_adam_(
                gaussians, first, second, gaussian_rates, self._step, self._skipped, *view, *pictures, camera_model=model,
                betas=self._adam.betas, epsilon=self._adam.epsilon,
            )  # fmt: skip
            assert gradient is not None
            self._field.update(gradient, controls.time, field_rates, self._step, frame.status)
        cut_so_far = self._most[STATUS_CUT] + frame.status[STATUS_CUT]
        torch.maximum(self._most, frame.status, out=self._most)
        self._most[STATUS_CUT] = cut_so_far
        return loss.loss

    def _update_gaussians(
        self,
        gaussians: Sequence[Tensor],
        first: Sequence[Tensor],
        second: Sequence[Tensor],
        gradients: Sequence[Tensor],
        rates: Tensor,
    ) -> None:
        for i, (parameter, gradient) in enumerate(zip(gaussians, gradients, strict=True)):
            adam_step_at_(
                parameter, gradient.reshape(parameter.shape).contiguous(), first[i], second[i], rates[i : i + 1], self._step,
                self._skipped[i : i + 1], *self._adam.betas, self._adam.epsilon, row_size=parameter[:1].numel() or 1,
            )  # fmt: skip


def _columns(raw: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The gradients of means, quats, log-scales and logit opacities out of the frame path's rows."""
    return raw[:, :3], raw[:, 3:7], raw[:, 7:10], raw[:, 13]
