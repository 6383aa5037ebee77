"""Random scenes that a camera sees, and comparison of a float32 result with the float64 oracle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Scene:
    """Float64 inputs of `rasterization`; `to(float32)` rounds them for the compiled ops."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def to(self, dtype: torch.dtype) -> Scene:
        """Return the scene in another dtype, as new leaves."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("width", "height")}
        return replace(self, **{name: tensor.detach().to(dtype).clone() for name, tensor in tensors.items()})

    def leaves(self) -> list[Tensor]:
        """Means, quats, scales, opacities, sh and viewmats, asked for gradients."""
        return [
            tensor.requires_grad_()
            for tensor in (self.means, self.quats, self.scales, self.opacities, self.sh, self.viewmats)
        ]


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """`make_scene(count, batch, cameras, model, degree, seed)`: some Gaussians outside of the view, most in it."""

    def make(
        count: int = 60,
        batch: tuple[int, ...] = (),
        cameras: int = 1,
        model: str = "pinhole",
        degree: int = 3,
        seed: int = 0,
        width: int = 52,
        height: int = 37,
    ) -> Scene:
        g = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            # Rounded to float32, so that both precisions start from the same numbers.
            return torch.randn(*batch, *shape, generator=g, dtype=torch.float64).float().double()

        means = normal(count, 3) * torch.tensor([1.5, 1.2, 2.0]) + torch.tensor([0.0, 0.0, 6.0])
        means[..., :1, :] = torch.tensor([0.1, 0.2, 5.0])  # one at least is seen
        viewmats = torch.eye(4, dtype=torch.float64).repeat(*batch, cameras, 1, 1)
        viewmats[..., :3, :] += 0.05 * normal(cameras, 3, 4)
        focal = 8.0 if model == "ortho" else 45.0
        K = torch.tensor([[focal, 0, width / 2 + 1], [0, focal * 1.1, height / 2 - 2], [0, 0, 1]], dtype=torch.float64)
        return Scene(
            means=means.float().double(),
            quats=normal(count, 4),
            scales=(normal(count, 3) * 0.5 - 1.5).exp().float().double(),
            opacities=(normal(count) * 1.5 + 1.0).sigmoid().float().double(),
            sh=normal(count, (degree + 1) ** 2, 3) * 0.3,
            viewmats=viewmats.float().double(),
            Ks=K.repeat(*batch, cameras, 1, 1).float().double(),
            width=width,
            height=height,
        )

    return make


@pytest.fixture
def assert_near() -> Callable[..., None]:
    """Assert that float32 `actual` is `expected` up to rounding: relative, and relative to the largest element."""

    def check(actual: Tensor | None, expected: Tensor | None, relative: float = 2e-3, of_largest: float = 2e-5) -> None:
        if expected is None or actual is None:
            assert actual is expected
            return
        assert actual.shape == expected.shape
        if expected.numel():
            absolute = of_largest * float(expected.detach().abs().max())
            torch.testing.assert_close(
                actual.detach().double(), expected.detach().double(), rtol=relative, atol=absolute
            )

    return check


@pytest.fixture
def assert_compiled_equal() -> Iterator[Callable[..., None]]:
    """Assert that `torch.compile` of a function of some leaves gives its values and gradients."""

    def check(function: Callable[..., tuple[Tensor, ...]], leaves: list[Tensor], **options: Any) -> None:
        def run(render: Callable[..., tuple[Tensor, ...]]) -> list[Tensor]:
            outputs = render(*leaves)
            weights = [torch.linspace(-1, 1, t.numel()).view(t.shape).to(t) for t in outputs]
            total = torch.stack([(t * w).sum() for t, w in zip(outputs, weights, strict=True)]).sum()
            return [*outputs, *torch.autograd.grad(total, leaves)]

        wanted = run(function)
        assert any(w.any() for w in wanted)
        for seen, w in zip(run(torch.compile(function, **options)), wanted, strict=True):
            largest = float(w.detach().abs().max()) if w.numel() else 0.0
            torch.testing.assert_close(seen, w, rtol=1e-4, atol=1e-5 * largest)

    torch.compiler.reset()
    yield check
    torch.compiler.reset()


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
