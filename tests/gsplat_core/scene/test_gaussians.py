"""The set of Gaussians: checks, activations, picking and joining."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import Gaussians, InvalidInput


def gaussians(count=5, bases=4, dtype=torch.float32):
    g = torch.Generator().manual_seed(count)
    return Gaussians(*(torch.randn(count, *s, generator=g).to(dtype) for s in ((3,), (4,), (3,), (), (bases, 3))))


def test_gaussians_names_and_activations():
    it = gaussians()
    assert list(it.tensors()) == ["means", "quats", "log_scales", "logit_opacities", "sh"]
    assert it.count == len(it) == 5
    torch.testing.assert_close(it.scales, it.log_scales.exp())
    torch.testing.assert_close(it.opacities, 1 / (1 + (-it.logit_opacities).exp()))


@pytest.mark.parametrize(("bases", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3), (25, 4)])
def test_gaussians_sh_degree(bases, degree):
    assert gaussians(bases=bases).sh_degree == degree


def test_gaussians_select_by_mask_indices_and_slice():
    it = gaussians()
    mask = torch.tensor([True, False, True, False, False])
    for index in (mask, torch.tensor([0, 2]), slice(0, 3, 2)):
        picked = it.select(index)
        assert picked.count == 2
        for name, tensor in picked.tensors().items():
            assert torch.equal(tensor, it.tensors()[name][[0, 2]])
    assert it.select(torch.zeros(5, dtype=torch.bool)).count == 0


def test_gaussians_append_inverts_select():
    it = gaussians()
    joined = it.select(slice(0, 2)).append(it.select(slice(2, None)))
    for name, tensor in joined.tensors().items():
        assert torch.equal(tensor, it.tensors()[name])
    with pytest.raises(InvalidInput, match="SH degree 2 to degree 1"):
        it.append(gaussians(bases=9))
    with pytest.raises(InvalidInput, match="float64"):
        it.append(gaussians(dtype=torch.float64))


def test_gaussians_gradients_and_detach():
    it = gaussians().requires_grad_()
    copy = it.clone()
    (copy.means.sum() + it.to(dtype=torch.float64).sh.sum()).backward()
    assert torch.equal(it.means.grad, torch.ones(5, 3)) and torch.equal(it.sh.grad, torch.ones(5, 4, 3))
    assert copy.means.data_ptr() != it.means.data_ptr()
    assert not any(tensor.requires_grad for tensor in it.detach().tensors().values())
    assert it.detach().means.data_ptr() == it.means.data_ptr()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": torch.zeros(5, 2)}, r"means must be \[N, 3\] with N = 5, got \[5, 2\]"),
        ({"quats": torch.zeros(4, 4)}, r"quats must be \[N, 4\] with N = 5, got \[4, 4\]"),
        ({"logit_opacities": torch.zeros(5, 1)}, r"logit_opacities must be \[N\]"),
        ({"sh": torch.zeros(5, 3)}, r"sh must be \[N, K, 3\]"),
        ({"sh": torch.zeros(5, 5, 3)}, r"K one of \[1, 4, 9, 16, 25\], got \[5, 5, 3\]"),
        ({"quats": torch.zeros(5, 4).double()}, "one floating-point dtype"),
        ({"quats": torch.zeros(5, 4).numpy()}, "quats must be a tensor, got ndarray; convert it"),
    ],
)
def test_gaussians_reject_invalid_shapes(change, message):
    with pytest.raises(InvalidInput, match=message):
        Gaussians(**(gaussians().tensors() | change))
    with pytest.raises(InvalidInput, match="floating-point"):
        gaussians().map(lambda tensor: tensor.int())


def test_gaussians_seen_by_right_adds_right_sh():
    left = gaussians()
    assert left.seen_by_right() is left and len(left.tensors()) == 5
    both = dataclasses.replace(left, right_sh=torch.full_like(left.sh, 0.25))
    assert list(both.tensors()) == [*left.tensors(), "right_sh"] and both.left_tensors == left.left_tensors
    right = both.seen_by_right()
    assert right.right_sh is None and torch.equal(right.sh, left.sh + 0.25)
    assert torch.equal(both.select(slice(1, 3)).seen_by_right().sh, right.sh[1:3])


def test_gaussians_append_follows_eyes_of_first():
    left = gaussians()
    both = dataclasses.replace(left, right_sh=torch.ones_like(left.sh))
    assert both.append(left).right_sh[:, 0, 0].tolist() == [1] * 5 + [0] * 5
    assert left.append(both).right_sh is None
    assert left.with_right().with_right(False).tensors().keys() == left.tensors().keys()


def test_gaussians_right_sh_requires_shape_of_sh():
    left = gaussians()
    with pytest.raises(InvalidInput, match="right_sh must be"):
        dataclasses.replace(left, right_sh=left.sh[:, :1, :2])


def test_gaussians_extra_tensors_follow_rows():
    scene = dataclasses.replace(gaussians(), extra={"semantics": torch.arange(15.0).reshape(5, 3)})
    assert list(scene.tensors())[-1] == "extra.semantics"
    assert torch.equal(scene.select(torch.tensor([3, 1])).extra["semantics"], scene.extra["semantics"][[3, 1]])
    grown = scene.append(gaussians())
    assert grown.extra["semantics"].shape == (10, 3) and not grown.extra["semantics"][5:].any()
    assert not gaussians().append(scene).extra
    same = Gaussians.from_tensors(scene.tensors())
    assert all(same.tensors()[name] is tensor for name, tensor in scene.tensors().items())
    with pytest.raises(InvalidInput, match=r"extra 'semantics' must be \[N, \.\.\.\] with N = 5, got \[4, 3\]"):
        dataclasses.replace(scene, extra={"semantics": torch.zeros(4, 3)})
