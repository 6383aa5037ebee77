"""Scenes shared by the tests of the core."""

from collections.abc import Callable

import pytest
import torch

from gsplat_core.gaussians import Gaussians


@pytest.fixture
def make_gaussians() -> Callable[..., Gaussians]:
    """`make_gaussians(count, sh_degree=0, seed=0, dtype=float32)`: random Gaussians some 60 mm before the camera."""

    def make(count: int, sh_degree: int = 0, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
        random = torch.Generator().manual_seed(seed)
        draw = lambda *shape: torch.randn(*shape, generator=random).to(dtype)
        return Gaussians(
            means=draw(count, 3) * 10 + torch.tensor([0.0, 0.0, 60.0], dtype=dtype),
            quats=draw(count, 4),
            log_scales=draw(count, 3) * 0.3,
            logit_opacities=draw(count),
            sh=draw(count, (sh_degree + 1) ** 2, 3) * 0.3,
        )

    return make
