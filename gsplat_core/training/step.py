"""One optimiser step: deform, render, compare, go back, update."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gsplat_core.deformation import BasisField, BasisRates, DeformationField
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.field_training import training_of
from gsplat_core.training.fused_step import FusedStep
from gsplat_core.training.observations import Observation
from gsplat_core.training.optimiser import FusedAdam
from gsplat_core.training.photometric import LossWeights, loss_and_gradients

SETTLE_EVERY = 32
"""Steps on a GPU after which they are waited for, so that lists that are too short are noticed before long; the first one, too."""


class TrainingStep:
    """The scene being learned, its optimiser, and the step that improves it by one frame.

    What a field adds to a Gaussian's raw parameters has the same gradient as those parameters, so the picture's gradient is taken once, at
    the deformed Gaussians, and handed to both. No autograd graph is built for the basis field.
    """

    def __init__(
        self, gaussians: Gaussians, field: DeformationField, config: ReconstructorConfig, camera: Camera
    ) -> None:
        self.gaussians = gaussians
        self.field = field
        self._config = config
        self._weights = LossWeights(config.ssim_weight, config.depth_weight)
        # World units per pixel at the scene's typical distance: rates given in pixels become rates in millimetres.
        centre = camera.viewmat.to(gaussians.device)
        distance = (
            (gaussians.means @ centre[2, :3] + centre[2, 3]).abs().median() if gaussians.count else torch.ones(())
        )
        self._pixel_mm = float(distance) / float(camera.K[0, 0])
        self._adam = FusedAdam(gaussians.tensors())
        self._fused: FusedStep | None = None
        self._queued = 0
        field_training = training_of(field) if gaussians.device.type == "cuda" else None
        if field_training is not None:
            self._fused = FusedStep(gaussians, field_training, self._adam, self._weights, camera)
        network = {} if isinstance(field, BasisField) else dict(field.named_parameters())
        self._network_adam = FusedAdam(network, rows=False)

    def __call__(self, observation: Observation, rate_scale: float = 1.0) -> Tensor:
        """Train on one observation; returns its loss before the update, [] on the Gaussians' device.

        On a GPU this only queues the step: ask for the loss's value, or `settle`, to wait for it.
        """
        if self._fused is not None:
            return self._fused_step(self._fused, observation, rate_scale)
        if isinstance(self.field, BasisField):
            return self._basis_step(self.field, observation, rate_scale)
        return self._network_step(observation, rate_scale)

    def settle(self, observation: Observation, rate_scale: float = 1.0) -> None:
        """Wait for the queued steps. Those that a GPU had to leave out, because its lists were too short, are taken again on `observation`."""
        while self._fused is not None and (lost := self._fused.settle()):
            for _ in range(lost):
                self._fused_step(self._fused, observation, rate_scale)

    def at(self, time_s: float) -> Gaussians:
        """The scene at a time, as it is now."""
        with torch.no_grad():
            return self.field(self.gaussians, time_s)

    def copy(self) -> tuple[Gaussians, DeformationField]:
        """Gaussians and field with memory of their own, free of training state."""
        return self.gaussians.detach().clone(), self.field.detached_copy()

    def append(self, added: Gaussians) -> None:
        """Add Gaussians, which start still."""
        self.gaussians = self.gaussians.append(added)
        self.field.append(added)
        self._adam.append(added.count)

    def _fused_step(self, fused: FusedStep, observation: Observation, rate_scale: float) -> Tensor:
        if isinstance(self.field, BasisField):
            field_rates = list(vars(self._basis_rates(rate_scale)).values())
        else:
            rates = self._config.rates
            field_rates = [rates.hexplane_planes * rate_scale, rates.hexplane_network * rate_scale]
        time = self.field.frame_time(observation.time_s)
        loss = fused(self.gaussians, observation, time, self._gaussian_rates(rate_scale), field_rates)
        self._queued += 1
        if self._queued % SETTLE_EVERY == 1:
            self.settle(observation, rate_scale)
        return loss

    def _basis_step(self, field: BasisField, observation: Observation, rate_scale: float) -> Tensor:
        deformed = self.at(observation.time_s)
        loss, gradients = loss_and_gradients(deformed, observation, self._weights)
        deltas = torch.cat(
            [gradients["means"], gradients["quats"], gradients["log_scales"], gradients["sh"][:, 0]], dim=1
        )
        field.adam_step(observation.time_s, deltas, self._basis_rates(rate_scale))
        self._update_gaussians(gradients, rate_scale)
        return loss

    def _network_step(self, observation: Observation, rate_scale: float) -> Tensor:
        canonical = self.gaussians.detach().requires_grad_()
        with torch.enable_grad():
            deformed = self.field(canonical, observation.time_s)
        loss, gradients = loss_and_gradients(deformed.detach(), observation, self._weights)
        pairs = [(tensor, gradients[name]) for name, tensor in deformed.tensors().items() if tensor.requires_grad]
        torch.autograd.backward([tensor for tensor, _ in pairs], [gradient for _, gradient in pairs])
        parameters = dict(self.field.named_parameters())
        rates = self._config.rates
        self._network_adam.step(
            parameters,
            learning_rates={
                name: (rates.hexplane_planes if name.startswith("planes") else rates.hexplane_network) * rate_scale
                for name in parameters
            },
        )
        for parameter in parameters.values():
            parameter.grad = None
        own = {name: tensor.grad for name, tensor in canonical.tensors().items()}
        self._update_gaussians(own, rate_scale)
        return loss

    def _update_gaussians(self, gradients: Mapping[str, Tensor | None], rate_scale: float) -> None:
        self._adam.step(self.gaussians.tensors(), gradients, self._gaussian_rates(rate_scale))

    def _gaussian_rates(self, rate_scale: float) -> dict[str, float]:
        rates = self._config.rates
        return {
            "means": rates.means_px * self._pixel_mm * rate_scale,
            "quats": rates.quats * rate_scale,
            "log_scales": rates.log_scales * rate_scale,
            "logit_opacities": rates.logit_opacities * rate_scale,
            "sh": rates.sh * rate_scale,
        }

    def _basis_rates(self, rate_scale: float) -> BasisRates:
        rates = self._config.rates
        return BasisRates(
            position=rates.basis_means_px * self._pixel_mm * rate_scale,
            rotation=rates.basis_quats * rate_scale,
            log_scale=rates.basis_log_scales * rate_scale,
            colour=rates.basis_sh * rate_scale,
            centers=rates.basis_timing * rate_scale,
            widths=rates.basis_timing * rate_scale,
        )
