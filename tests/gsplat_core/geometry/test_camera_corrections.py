"""Corrections of camera poses: recovered from pictures, and held by their priors."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput, rasterization
from gsplat_core.poses.se3 import CameraCorrections, exp, inverse, log
from tests.gsplat_core.rendering.test_unscented import H, W, scene

SIGMAS = {"translation_sigma": 0.05, "rotation_sigma": 0.02}


@pytest.mark.slow
def test_perturbed_poses_are_recovered_from_pictures():
    given = scene()
    deeper = torch.linspace(0.5, 2.5, 60)[:, None]
    given |= {
        "means": given["means"] * deeper,
        "scales": 2 * given["scales"] * deeper,
        "Ks": given["Ks"].expand(2, 3, 3),
    }
    generator = torch.Generator().manual_seed(1)
    random = lambda *sigmas: torch.randn(6, generator=generator) * torch.tensor(sigmas).repeat_interleave(3)
    true = torch.stack([exp(random(0.1, 0.03)), exp(random(0.1, 0.03))])
    wrong = torch.stack([true[0], exp(random(0.03, 0.015)) @ true[1]])
    render = lambda viewmats: rasterization(**given | {"viewmats": viewmats}, width=W, height=H)[0]
    pictures = render(true)
    corrections = CameraCorrections(2, **SIGMAS)
    optimiser = torch.optim.Adam(corrections.parameters(), lr=0.3, betas=(0.8, 0.95))
    for _ in range(50):
        loss = (render(corrections(wrong)) - pictures).square().mean() + 1e-9 * corrections.prior()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        optimiser.param_groups[0]["lr"] *= 0.95
    error = lambda poses: float(log(poses @ inverse(true)).abs().amax())
    found = corrections(wrong).detach()
    assert torch.equal(found[0], wrong[0])  # the fixed camera
    assert error(found) < 0.05 * error(wrong)


def test_camera_corrections_by_ids_and_batches():
    corrections = CameraCorrections(4, **SIGMAS, fixed=(2,))
    corrections.normalised.data.normal_(generator=torch.Generator().manual_seed(0))
    poses = torch.eye(4).expand(2, 3, 4, 4)
    ids = torch.tensor([[0, 1, 2], [3, 2, 1]])
    corrected = corrections(poses, ids)
    assert torch.equal(corrected[0, 2], torch.eye(4)) and torch.equal(corrected[0, 1], corrected[1, 2])
    torch.testing.assert_close(log(corrected[1, 0]), corrections.normalised[3] * corrections.sigmas)


def test_camera_corrections_priors_equal_normal_distributions():
    corrections = CameraCorrections(3, **SIGMAS, fixed=())
    corrections.normalised.data[1, 4] = 2.0
    corrections.requires_grad_(False)
    assert float(corrections.twists()[1, 4]) == pytest.approx(0.04)
    assert float(corrections.prior()) == pytest.approx(2 / 3)
    assert float(corrections.prior(torch.tensor([1]))) == pytest.approx(2)
    assert float(corrections.smoothness(0.5)) == pytest.approx(8)
    assert float(CameraCorrections(1, **SIGMAS).smoothness().detach()) == 0


def test_camera_corrections_refuse_invalid_arguments():
    with pytest.raises(InvalidInput, match="must be positive"):
        CameraCorrections(2, translation_sigma=0, rotation_sigma=1)
    with pytest.raises(InvalidInput, match="no camera 2"):
        CameraCorrections(2, **SIGMAS, fixed=(2,))
    with pytest.raises(InvalidInput, match="one for each camera of ids"):
        CameraCorrections(2, **SIGMAS)(torch.eye(4)[None])


def test_camera_corrections_priors_treat_fixed_cameras_as_zero():
    corrections = CameraCorrections(4, **SIGMAS, fixed=(2,))
    corrections.normalised.data.normal_(generator=torch.Generator().manual_seed(0))
    free = corrections.normalised.detach().clone()
    free[2] = 0
    torch.testing.assert_close(corrections.prior(), 0.5 * free.square().sum(1).mean())
    torch.testing.assert_close(corrections.prior(torch.tensor([1, 2])), 0.5 * free[1:3].square().sum(1).mean())
    steps = free[1:] - free[:-1]
    torch.testing.assert_close(corrections.smoothness(0.5), 0.5 * (steps / 0.5).square().sum(1).mean())
    assert CameraCorrections(1, **SIGMAS, fixed=()).smoothness().item() == 0
