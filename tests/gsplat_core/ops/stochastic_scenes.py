"""Scenes and statistics for the tests of stochastic rendering, shared with those on CUDA."""

from __future__ import annotations

import torch

from gsplat_core.ops.stochastic import SplatScene, new_sums, sample_splats
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

CAMERA = Camera.from_focal(60, 32, 24)
RATES = torch.logspace(-3, 4, 20, dtype=torch.float64)


def random_scene(count=60, smallest=0.02, largest=0.3, seed=0, degree=3):
    """Return Gaussians about 4 units in front of the camera."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=g) * torch.tensor([0.6, 0.5, 0.5]) + torch.tensor([0, 0, 4.0])
    scales = torch.rand(count, 3, generator=g) * (largest - smallest) + smallest
    return Gaussians(
        means,
        torch.randn(count, 4, generator=g),
        scales.log(),
        torch.randn(count, generator=g) * 2,
        torch.randn(count, (degree + 1) ** 2, 3, generator=g) * 0.3,
    )


def raw(gaussians, index=None):
    """Return the raw format of a scene."""
    return SplatScene(
        means=gaussians.means,
        quats=gaussians.quats,
        log_scales=gaussians.log_scales,
        logits=gaussians.logit_opacities,
        sh=gaussians.sh,
        file_index=index,
    )


def sampled(scene, camera=CAMERA, **options):
    """Return the sums of a picture."""
    device = scene.tensors()[0].device
    sums = new_sums(camera, device)
    sample_splats(scene, camera, sums, **options)
    return sums


def z_scores(sums, moments, samples, supersampling=1):
    """Return (mean - expectation) / standard error where a normal distribution approximates the mean."""
    drawn = samples * supersampling**2
    mean, variance = (t.cpu() for t in moments)
    z = (sums.cpu().double() / drawn - mean) / (variance / samples).sqrt()
    hits = drawn * mean[..., 3:4]
    return z[((hits > 50) & (hits < drawn - 50)).expand(z.shape) & (variance > 1e-12)]


def poisson_p_values(draws):
    """Return the p-value of a chi-square test of the draws [R, n] for each of RATES."""
    values = []
    for rate, counts in zip(RATES.tolist(), draws.cpu(), strict=True):
        spread = 6 * rate**0.5
        k = torch.arange(max(0, int(rate - spread)), int(rate + spread) + 8, dtype=torch.float64)
        chance = (k * torch.tensor(rate, dtype=torch.float64).log() - rate - torch.lgamma(k + 1)).exp()
        expected = chance * len(counts)
        seen = torch.bincount((counts - int(k[0])).clamp(0, len(k) - 1), minlength=len(k)).double()
        # Neighbouring counts are joined until each bin expects at least 20 draws.
        bins, total, found = [], 0.0, 0.0
        for e, s in zip(expected.tolist(), seen.tolist(), strict=True):
            total, found = total + e, found + s
            if total >= 20:
                bins.append([total, found])
                total = found = 0.0
        rest = len(counts) - sum(b[0] for b in bins)
        bins[-1][0] += rest
        bins[-1][1] += found
        if len(bins) < 2:
            values.append(1.0)
            continue
        chi = sum((s - e) ** 2 / e for e, s in bins)
        values.append(float(torch.special.gammaincc(torch.tensor((len(bins) - 1) / 2), torch.tensor(chi / 2))))
    return values
