"""Training of a field without gradients of its own, by those at its Gaussians."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import torch

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.steps.step import AutogradTraining


class Drift(torch.nn.Module):
    """Moves all Gaussians with one velocity, and passes on opacities that receive no gradient."""

    def __init__(self) -> None:
        super().__init__()
        self.velocity = torch.nn.Parameter(torch.zeros(3))

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        moved = 2 * gaussians.means + time_s * self.velocity
        return replace(gaussians, means=moved, logit_opacities=gaussians.logit_opacities.detach())


def test_autograd_training_passes_gradients_to_field_and_canonical_gaussians():
    field = Drift()
    training = AutogradTraining(field, SimpleNamespace(rate_of=lambda name: f"rate of {name}"))
    scene = Gaussians(torch.ones(4, 3), torch.eye(4), torch.zeros(4, 3), torch.zeros(4), torch.zeros(4, 1, 3))
    shown = training.deform(scene, 0.5)
    assert not any(tensor.requires_grad for tensor in shown.tensors().values())
    assert torch.equal(shown.means, 2 * scene.means)
    push = torch.tensor([[1.0, -2.0, 0.0]]).repeat(4, 1)
    given = {"means": push, "logit_opacities": torch.ones(4)}  # none of the others
    own = training.update(given, {"rate of velocity": 0.1})
    torch.testing.assert_close(own["means"], 2 * push)
    assert all(own[name] is None or not own[name].any() for name in own if name != "means")
    # The first step of Adam has the length of the rate, against the gradient.
    torch.testing.assert_close(field.velocity.detach(), torch.tensor([-0.1, 0.1, 0.0]), atol=1e-6, rtol=1e-4)
    assert field.velocity.grad is None and not scene.means.requires_grad
