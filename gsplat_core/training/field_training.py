"""Training of any deformation field through autograd."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, FieldRates
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.optimiser import FusedAdam


class AutogradTraining:
    """Backpropagates gradients at the deformed Gaussians through `field.forward` to the field's
    parameters and the canonical Gaussians.

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
        """Do one Adam step for the field's parameters and return the gradients of the canonical
        Gaussians.
        """
        assert self._canonical is not None and self._deformed is not None
        pairs = [(tensor, gradients[name]) for name, tensor in self._deformed.tensors().items() if tensor.requires_grad]
        torch.autograd.backward([tensor for tensor, _ in pairs], [gradient for _, gradient in pairs])
        parameters = dict(self._field.named_parameters())
        self._adam.follow(parameters)
        self._adam.step(parameters, learning_rates={name: rates[rate] for name, rate in self._rate_names.items()})
        for parameter in parameters.values():
            parameter.grad = None
        own = {name: tensor.grad for name, tensor in self._canonical.tensors().items()}
        self._canonical = self._deformed = None
        return own
