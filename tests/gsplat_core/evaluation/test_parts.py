"""Attribution of a sequence's change to the parts of a deformation, on sequences with known cause."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.evaluation.geometry import PARTS, PartShares, PartSums
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians

CAMERA = Camera.from_focal(40.0, 48, 40)
TIMES = (0.0, 0.5, 1.0, 1.5)


def _scene() -> Gaussians:
    random = torch.Generator().manual_seed(0)
    place = torch.rand(120, 3, generator=random) * torch.tensor([60.0, 50.0, 1.0]) + torch.tensor([-30.0, -25.0, 50.0])
    return Gaussians(
        means=place,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(120, 1),
        log_scales=torch.full((120, 3), 1.0),
        logit_opacities=torch.full((120,), 2.0),
        sh=torch.rand(120, 1, 3, generator=random) * 3 - 1.5,
    )


def _changed(gaussians: Gaussians, name: str, time_s: float) -> Gaussians:
    tensors = gaussians.tensors()
    change = {
        "means": torch.tensor([3.0, -2.0, 0.0]),
        "sh": torch.tensor([0.6, -0.5, 0.4]),
        "log_scales": torch.tensor([0.4, -0.3, 0.2]),
    }[name]
    return Gaussians(**{**tensors, name: tensors[name] + time_s * change})


def _shares(of_world: tuple[str, ...], of_model: tuple[str, ...]) -> PartShares | None:
    """Scene in which some tensors change, and a model that changes some of its tensors in the same way."""

    def at(names: tuple[str, ...], time_s: float) -> Gaussians:
        changed = _scene()
        for name in names:
            changed = _changed(changed, name, time_s)
        return changed

    picture_of = lambda gaussians: render(gaussians, CAMERA, depth=False).image.clamp(0, 1).numpy()
    sums = PartSums(lambda time_s: at(of_model, time_s), 0.0)
    for number, time_s in enumerate(TIMES):
        image = (picture_of(at(of_world, time_s)) * 255).round().astype(np.uint8)
        sums.add(Frame(number, round(time_s * 1e9), image), picture_of)
    return sums.shares


@pytest.mark.parametrize(("name", "part"), [("means", "motion"), ("sh", "colour"), ("log_scales", "size")])
def test_part_shares_assign_change_to_changing_part(name: str, part: str) -> None:
    shares = _shares((name,), (name,))
    assert shares is not None and shares.frames == len(TIMES)
    for other in PARTS:
        assert getattr(shares, other) == pytest.approx(1.0 if other == part else 0.0, abs=0.02)
    assert shares.explained == pytest.approx(1, abs=0.02)


def test_part_shares_split_joint_change() -> None:
    shares = _shares(("means", "sh"), ("means", "sh"))
    assert shares is not None
    assert shares.motion > 0.1 and shares.colour > 0.1 and shares.size == pytest.approx(0, abs=1e-6)
    assert shares.motion + shares.colour + shares.size == pytest.approx(shares.explained)
    assert shares.explained == pytest.approx(1, abs=0.02)


def test_part_shares_do_not_count_recolouring_as_motion() -> None:
    """A model that changes colours where the scene moves explains little, and no share of it is motion."""
    shares = _shares(("means",), ("sh",))
    assert shares is not None and shares.motion == pytest.approx(0, abs=1e-9) and shares.explained < 0.2


def test_part_shares_none_without_change() -> None:
    sums = PartSums(lambda time_s: _scene(), 0.0)
    assert sums.shares is None
    sums.add(Frame(0, 0, np.zeros((40, 48, 3), np.uint8)), lambda gaussians: np.zeros((40, 48, 3), np.float32))
    assert sums.shares is None
