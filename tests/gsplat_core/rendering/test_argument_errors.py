"""Arguments of `rasterization` that cannot be used: a sentence that names the argument and nothing of the implementation."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch

import gsplat_core
from gsplat_core.errors import InvalidInput


def arguments() -> dict:
    return {
        "means": torch.tensor([[0.0, 0, 5], [1, 0, 6]]), "quats": torch.tensor([[1.0, 0, 0, 0]] * 2), "scales": torch.ones(2, 3),
        "opacities": torch.ones(2), "colors": torch.ones(2, 3), "viewmats": torch.eye(4)[None], "Ks": torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]),
        "width": 16, "height": 16,
    }  # fmt: skip


TENSORS = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"]
WRONG = {
    "None": lambda t: None, "a list": lambda t: t.tolist(), "an array": lambda t: t.numpy(), "text": lambda t: "x", "a number": lambda t: 1.0,
    "integers": lambda t: t.int(), "booleans": lambda t: t.bool(), "complex": lambda t: t.to(torch.complex64), "a scalar": lambda t: torch.tensor(1.0), "meta": lambda t: t.to("meta"),
    "half": lambda t: t.half(), "sparse": lambda t: t.to_sparse(), "one more dimension": lambda t: t[..., None], "a longer end": lambda t: torch.cat([t, t, t], -1),
    "empty": lambda t: t[..., :0],
}  # fmt: skip


ANY_NUMBER_OF_CHANNELS = {("colors", "a longer end"), ("colors", "empty")}
"""Calls with unusual arguments that are accepted."""


@pytest.mark.parametrize(
    ("name", "wrong"),
    [(name, wrong) for wrong in WRONG for name in TENSORS if (name, wrong) not in ANY_NUMBER_OF_CHANNELS],
)
def test_rasterization_names_invalid_tensor(name, wrong):
    given = arguments()
    given[name] = WRONG[wrong](given[name])
    with pytest.raises((InvalidInput, NotImplementedError), match=name) as refused:
        gsplat_core.rasterization(**given)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize("name", ["width", "height", "tile_size"])
@pytest.mark.parametrize("value", [0, -1, 1.5, 16.0, "16", True, [16], 10**30, np.float32(16)])
def test_rasterization_names_invalid_size(name, value):
    with pytest.raises(InvalidInput, match=name):
        gsplat_core.rasterization(**{**arguments(), name: value})


NUMBERS = {
    "width": 16,
    "height": 16,
    "tile_size": 8,
    "sh_degree": 0,
    "near_plane": 1.0,
    "far_plane": 9.0,
    "radius_clip": 0.0,
    "eps2d": 0.25,
}


@pytest.mark.parametrize("render", [gsplat_core.rasterization, gsplat_core.rasterization_2dgs])
def test_rasterization_truncates_size_tensor(render):
    """Programs give `width=K[0, 2] * 2`, a floating-point tensor, which gsplat truncates."""
    given = arguments()
    expected = render(**given)[0]
    for more in (0.0, 0.75):
        sizes = {"width": given["Ks"][0, 0, 2] * 2 + more, "height": given["Ks"][0, 1, 2] * 2 + more}
        assert torch.equal(render(**{**given, **sizes})[0], expected)
    for value in (0.5, -3.0, float("nan"), float("inf"), [16.0, 16.0]):
        with pytest.raises(InvalidInput, match="width"):
            render(**{**given, "width": torch.tensor(value)})


@pytest.mark.parametrize("render", [gsplat_core.rasterization, gsplat_core.rasterization_2dgs])
@pytest.mark.parametrize(
    "kind", [np.array, lambda v: np.float32(v) if isinstance(v, float) else np.int64(v), torch.tensor]
)
def test_rasterization_accepts_numpy_and_torch_numbers(render, kind):
    given = {**arguments(), **NUMBERS, "colors": torch.ones(2, 1, 3), "packed": False, "render_mode": "RGB+ED"}
    other = render(**{**given, **{name: kind(value) for name, value in NUMBERS.items()}})
    expected = render(**given)
    assert torch.equal(other[0], expected[0]) and expected[0].any()
    for name in ("width", "height", "tile_size"):
        assert type(other[-1][name]) is int and other[-1][name] == NUMBERS[name]


@pytest.mark.parametrize("name", ["width", "height"])
def test_rasterization_names_missing_size(name):
    with pytest.raises(InvalidInput, match=name):
        gsplat_core.rasterization(**{**arguments(), name: None})


@pytest.mark.parametrize("name", ["near_plane", "far_plane", "radius_clip", "eps2d"])
@pytest.mark.parametrize("value", [None, "x", [1], True, float("nan"), torch.ones(2), "1", 10**400])
def test_rasterization_names_invalid_number(name, value):
    with pytest.raises(InvalidInput, match=name):
        gsplat_core.rasterization(**{**arguments(), name: value})


@pytest.mark.parametrize("name", ["render_mode", "rasterize_mode", "camera_model", "constants", "sh_degree"])
@pytest.mark.parametrize("value", ["x", [], 9, 1.5])
def test_rasterization_names_invalid_mode(name, value):
    with pytest.raises(InvalidInput, match=name):
        gsplat_core.rasterization(**{**arguments(), name: value})


@pytest.mark.parametrize(
    ("keyword", "close"),
    [
        ("colours", "colors"),
        ("sh_degre", "sh_degree"),
        ("background", "backgrounds"),
        ("K", "Ks"),
        ("zzz", "takes means"),
        ("image_width", "width"),
        ("viewmat", "viewmats"),
    ],
)
def test_rasterization_names_unknown_keyword_and_similar_ones(keyword, close):
    with pytest.raises(TypeError, match=rf"^rasterization\(\) has no argument '{keyword}'; .*{close}"):
        gsplat_core.rasterization(**arguments(), **{keyword: 1})


@pytest.mark.parametrize("name", list(arguments()))
def test_rasterization_names_missing_argument(name):
    given = arguments()
    del given[name]
    with pytest.raises(TypeError, match=rf"^rasterization\(\) needs {name}; "):
        gsplat_core.rasterization(**given)


def test_rasterization_names_surplus_and_duplicate_arguments():
    with pytest.raises(TypeError, match="by position, got 60"):
        gsplat_core.rasterization(*[None] * 60)
    given = arguments()
    with pytest.raises(TypeError, match="means by position and by name"):
        gsplat_core.rasterization(given["means"], **given)


def test_rasterization_keeps_signature_and_positional_call():
    assert next(iter(inspect.signature(gsplat_core.rasterization).parameters)) == "means"
    image, _, _ = gsplat_core.rasterization(*arguments().values())
    assert image.shape == (1, 16, 16, 3) and float(image.max()) > 0.5
