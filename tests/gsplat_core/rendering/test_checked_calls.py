"""Repeated calls of `rasterization` are checked once, and a call of another kind is checked like the first."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.rendering import pipeline
from gsplat_core.rendering.pipeline import Operations
from gsplat_core.rendering.rasterization import step_by_step
from gsplat_core.rendering.settings import Arguments, RenderSettings, check_tensors


@pytest.fixture
def checks(monkeypatch) -> list[int]:
    """Record the number of Gaussians of each call whose tensors are checked."""
    found: list[int] = []

    def checked(arguments, has_colors):
        found.append(len(arguments.means))
        check_tensors(arguments, has_colors)

    monkeypatch.setattr(pipeline, "check_tensors", checked)
    return found


@pytest.fixture
def operations() -> Operations:
    """Operations that have not been called yet."""
    return replace(step_by_step)


def scene(count: int = 2, z: float = 5.0) -> dict:
    return {
        "means": torch.tensor([[0.0, 0, z]] * count), "quats": torch.tensor([[1.0, 0, 0, 0]] * count), "scales": torch.ones(count, 3),
        "opacities": torch.full((count,), 0.5), "colors": torch.ones(count, 3), "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]), "width": 16, "height": 16, "packed": False,
    }  # fmt: skip


def test_equal_calls_checked_once_without_caching_values(operations, checks):
    near, _, _ = operations.rasterization(**scene())
    hidden, _, meta = operations.rasterization(**scene(z=-5.0))
    assert checks == [2]
    assert near.max() > 0.5 and hidden.max() == 0 and not meta["radii"].any()


@pytest.mark.parametrize(
    "change",
    [
        {"width": 17}, {"render_mode": "RGB+ED"}, {"near_plane": 1.0}, {"packed": True}, {"backgrounds": torch.ones(1, 3)},
        {"means": torch.zeros(2, 3, requires_grad=True)}, {"scales": torch.nn.Parameter(torch.ones(2, 3))},
        {"with_ut": True}, {"global_z_order": False}, {"return_normals": True},
    ],
)  # fmt: skip
def test_changed_call_is_checked_again(operations, checks, change):
    first, _, _ = operations.rasterization(**scene())
    changed, _, _ = operations.rasterization(**(scene() | change))
    again, _, _ = operations.rasterization(**scene())
    assert checks == [2, 2]
    assert torch.equal(first, again)
    fresh = replace(step_by_step)
    assert torch.equal(changed, fresh.rasterization(**(scene() | change))[0])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width": 16.0}, "width"), ({"width": True}, "width"), ({"sh_degree": True}, "sh_degree"), ({"eps2d": False}, "eps2d"),
        ({"means": torch.zeros(2, 3).double()}, "means"), ({"opacities": torch.ones(3)}, "opacities"),
        ({"means": torch.zeros(2, 3).to_sparse()}, "means"), ({"Ks": [[1.0]]}, "Ks"), ({"render_mode": []}, "render_mode"),
        ({"quats": None}, "quats"), ({"opacities": torch.ones(2, device="meta")}, "opacities"),
    ],
)  # fmt: skip
def test_invalid_call_rejected_repeatedly_after_valid_call(operations, change, named):
    right = scene() | {"eps2d": 0, "width": 1} if change.get("width") is True or "eps2d" in change else scene()
    if "sh_degree" in change:
        right |= {"sh_degree": 1, "colors": torch.ones(2, 4, 3)}
    operations.rasterization(**right)
    for _ in range(2):
        with pytest.raises((InvalidInput, NotImplementedError), match=named):
            operations.rasterization(**(right | change))


def test_number_of_cached_call_kinds_is_limited(operations, checks, monkeypatch):
    monkeypatch.setattr(pipeline, "MOST_CHECKED_CALLS", 2)
    for count in (1, 2, 3, 3, 1):
        operations.rasterization(**scene(count))
        assert len(operations.checked) <= 2
    assert checks == [1, 2, 3, 1]


def test_native_call_selected_once_and_receives_tensors_of_each_call():
    chosen, rendered = [], []

    def native(arguments):
        rendered.append(arguments)
        raise StopIteration  # no picture is needed

    operations = replace(step_by_step, single_call=lambda arguments, settings: chosen.append(settings.width) or native)
    calls = [scene(), scene(z=6.0)]
    for call in calls:
        with pytest.raises(StopIteration):
            operations.rasterization(**call)
    assert chosen == [16]
    assert [arguments.means is call["means"] for arguments, call in zip(rendered, calls, strict=True)] == [True, True]


def test_pictures_selects_native_call_once_independently_of_rasterization(operations):
    chosen = []
    operations = replace(operations, single_call=lambda arguments, settings: chosen.append(settings.width))
    call = scene()
    tensors = [call.get(name) for name in Arguments._fields]
    settings = RenderSettings(16, 16)
    with_meta = operations.rasterization(**call)
    for _ in range(2):
        image, alphas = operations.pictures(Arguments(*tensors), settings)
        assert torch.equal(image, with_meta[0]) and torch.equal(alphas, with_meta[1])
    assert chosen == [16, 16]
