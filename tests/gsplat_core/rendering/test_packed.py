"""Packed rendering: the picture and gradients of the dense path, and gradients that hold visible Gaussians only."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput, rasterization, reference

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def render(scene, function=rasterization, colors=None, sh_degree=2, **options):
    """The picture, the intermediate results, and the leaves with gradients of a weighting of the picture."""
    given = {"colors": scene.sh if colors is None else colors}
    leaves = {name: given.get(name, getattr(scene, name, None)).detach().clone().requires_grad_() for name in NAMES}
    image, _, meta = function(
        **leaves, Ks=scene.Ks, width=scene.width, height=scene.height, sh_degree=sh_degree, **options
    )
    weights = torch.linspace(0, 1, image.numel(), dtype=image.dtype).reshape(image.shape)
    (image * weights).sum().backward()
    return image, meta, leaves


@pytest.mark.parametrize("kind", ["shared", "of each camera", "plain"])
@pytest.mark.parametrize(("batch", "cameras"), [((), 1), ((2,), 2)])
def test_packed_equals_dense_image_and_gradients(make_scene, assert_near, kind, batch, cameras):
    scene = make_scene(50, batch, cameras).to(torch.float32)
    generator = torch.Generator().manual_seed(1)
    shapes = {"shared": (50, 16, 3), "of each camera": (cameras, 50, 16, 3), "plain": (cameras, 50, 5)}
    colors = torch.rand(*batch, *shapes[kind], generator=generator)
    options = {"colors": colors, "sh_degree": None if kind == "plain" else 2, "render_mode": "RGB+ED"}
    wanted, _, dense = render(scene, packed=False, **options)
    image, _, packed = render(scene, packed=True, **options)
    torch.testing.assert_close(image, wanted, rtol=0, atol=1e-6)
    for name in NAMES:
        assert_near(packed[name].grad, dense[name].grad.double(), of_largest=1e-5)


def test_packed_matches_reference(make_scene, assert_near):
    scene = make_scene(30, (), 2)
    wanted, _, exact = render(scene.to(torch.float64), reference.rasterization)
    image, _, ours = render(scene.to(torch.float32))
    assert_near(image, wanted, of_largest=1e-4)
    for name in NAMES:
        assert_near(ours[name].grad, exact[name].grad, relative=5e-3, of_largest=5e-4)


@pytest.mark.parametrize("cameras", [1, 2])
def test_sparse_gradients_cover_visible_gaussians(make_scene, assert_near, cameras):
    scene = make_scene(200, (), cameras).to(torch.float32)
    _, meta, dense = render(scene)
    for wish, names in ((True, NAMES[:3]), ("all", NAMES[:5])):
        _, _, sparse = render(scene, sparse_grad=wish)
        for name in NAMES[:5]:
            gradient = sparse[name].grad
            assert gradient.is_sparse == (name in names)
            if gradient.is_sparse:
                held = gradient.coalesce()
                assert torch.equal(held.indices()[0], meta["gaussian_ids"].unique())
                gradient = held.to_dense()
            assert_near(gradient, dense[name].grad.double(), of_largest=1e-5)


@pytest.mark.parametrize("share", [1.0, 0.1, 0.0])
def test_sparse_gradient_memory_proportional_to_visible_share(make_scene, share):
    scene = make_scene(100).to(torch.float32)
    scene.means[:, :2] *= 0.1
    scene.means[round(100 * share) :, 2] = -5  # behind the camera
    scene.opacities[:] = 0.9
    _, meta, leaves = render(scene, sparse_grad="all")
    assert len(meta["gaussian_ids"]) == round(100 * share)
    for name in NAMES[:5]:
        assert leaves[name].grad.coalesce().values().numel() == share * leaves[name].numel()


def test_packed_omits_gaussians_with_non_finite_colours(make_scene):
    scene = make_scene(50).to(torch.float32)
    _, meta, _ = render(scene)
    lost = int(meta["gaussian_ids"][3])
    scene.sh[lost, 2, 1] = torch.nan
    image, without, leaves = render(scene)
    assert image.isfinite().all() and lost not in without["gaussian_ids"]
    assert len(without["gaussian_ids"]) == len(meta["gaussian_ids"]) - 1
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


def test_invalid_sparse_grad_options_rejected(make_scene):
    scene = make_scene(5).to(torch.float32)
    with pytest.raises(InvalidInput, match="needs packed=True"):
        render(scene, sparse_grad=True, packed=False)
    with pytest.raises(InvalidInput, match="'some'"):
        render(scene, sparse_grad="some")
    with pytest.raises(InvalidInput, match="needs quats and scales, got covars"):
        render(scene, sparse_grad=True, covars=torch.eye(3).expand(5, 3, 3))
    with pytest.raises(InvalidInput, match="without batch dimensions"):
        render(make_scene(5, (2,)).to(torch.float32), sparse_grad=True)
