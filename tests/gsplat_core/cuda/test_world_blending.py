"""Blending along rays on CUDA, forward and backward, against plain torch in float64."""

from __future__ import annotations

import math

import pytest
import torch

from tests.gsplat_core.ops.test_world_blending import blend, cast, gradients, two_pictures


@pytest.mark.parametrize(("channels", "masked"), [(1, False), (3, True), (8, False), (11, False), (35, False)])
def test_world_blending_equals_reference(gpu, channels, masked):
    given, colors, offsets, ids, more = two_pictures(channels, masked)
    expected = blend(given, colors, offsets, ids, **more)
    single = {name: value.to(gpu) for name, value in cast({**given, **more}, torch.float32).items()}
    own, others = {name: single[name] for name in given}, {name: single[name] for name in more}
    found = blend(own, colors.float().to(gpu), offsets.to(gpu), ids.to(gpu), **others)
    for wanted, seen in zip(expected, found, strict=True):
        assert (seen.double().cpu() - wanted).abs().max() < 2e-3
    of_plain = gradients(given, colors, offsets, ids, more, torch.float64)
    of_device = gradients(given, colors, offsets, ids, more, torch.float32, gpu)
    for name, wanted in of_plain.items():
        scale = wanted.abs().max()
        assert (of_device[name] - wanted).abs().mean() < 2e-4 * scale, name
        assert (of_device[name] - wanted).abs().max() < 0.05 * scale, name


def test_world_blending_gradients_are_deterministic(gpu):
    inputs = two_pictures(3, False)
    first, second = (gradients(*inputs, torch.float32, gpu) for _ in range(2))
    for name in ("means", "quats", "scales", "colors", "opacities"):
        assert torch.equal(first[name], second[name]), name


def test_world_blending_omits_non_finite_gaussians(gpu):
    given, colors, offsets, ids, more = two_pictures(3, False)
    hidden = {**given, "opacities": given["opacities"].clone()}
    hidden["opacities"][[3, 5]] = 0
    given["means"][3, 1], given["quats"][5] = math.inf, math.nan
    pictures = []
    for scene in (hidden, given):
        single = {name: value.to(gpu) for name, value in cast({**scene, **more}, torch.float32).items()}
        own, others = {name: single[name] for name in given}, {name: single[name] for name in more}
        pictures.append(blend(own, colors.float().to(gpu), offsets.to(gpu), ids.to(gpu), **others)[0])
    assert torch.equal(*pictures)


def test_world_blending_skips_ids_out_of_range(gpu):
    given, colors, offsets, ids, more = two_pictures(3, False)
    single = {name: value.to(gpu) for name, value in cast({**given, **more}, torch.float32).items()}
    own, others = {name: single[name] for name in given}, {name: single[name] for name in more}
    broken = ids.clone()
    broken[::3] = 2**30
    image, alphas = blend(own, colors.float().to(gpu), offsets.to(gpu), broken.to(gpu), **others)
    assert image.isfinite().all() and alphas.max() > 0
