"""The fused SSIM against the reference in float64: values, gradients, sizes around every block and strip, threads."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ssim import fused_ssim, ssim_map
from gsplat_core.reference.training import gaussian_window
from gsplat_core.reference.training import ssim_map as reference_ssim_map

# 700 x 3 is wider than one strip; 49 and 100 rows end inside a band.
SHAPES = [
    (1, 1, 3),
    (1, 700, 3),
    (13, 1, 1),
    (3, 4, 3),
    (11, 11, 3),
    (49, 31, 2),
    (100, 17, 4),
    (20, 700, 3),
    (9, 50, 32),
]


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def images(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator)
    return (target + 0.2 * torch.randn(shape, generator=generator)), target


def test_ssim_window_is_normalised_gaussian():
    window = gaussian_window()
    assert window.sum().item() == pytest.approx(1)
    assert (window[5] / window[6]).log().item() == pytest.approx(0.5 / 1.5**2)


def test_ssim_reference_on_one_pixel_in_closed_form():
    # One pixel in zeros: each moment is the centre weight times the pixel's.
    weight = gaussian_window()[5].item() ** 2
    x, y = 0.5, 0.8
    means = (2 * weight**2 * x * y + 1e-4) / (weight**2 * (x * x + y * y) + 1e-4)
    shape = weight - weight**2
    expected = means * (2 * shape * x * y + 9e-4) / (shape * (x * x + y * y) + 9e-4)
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    assert reference_ssim_map(x * one, y * one).item() == pytest.approx(expected)


def test_ssim_reference_passes_gradcheck():
    image, target = (t.double().requires_grad_() for t in images((6, 7, 2)))
    assert torch.autograd.gradcheck(reference_ssim_map, (image, target), fast_mode=True)


@pytest.mark.parametrize("shape", SHAPES)
def test_ssim_map_values_and_gradients_equal_reference(shape):
    image, target = images(shape)
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(5))
    results = []
    for function, dtype in ((ssim_map, torch.float32), (reference_ssim_map, torch.float64)):
        x, y = image.to(dtype, copy=True).requires_grad_(), target.to(dtype, copy=True).requires_grad_()
        similarity = function(x, y)
        (similarity * weights).sum().backward()
        results.append((similarity.detach(), x.grad, y.grad))
    for ours, expected in zip(*results, strict=True):
        scale = expected.abs().max().clamp(min=1)
        torch.testing.assert_close(ours.double() / scale, expected / scale, rtol=0, atol=1e-4)


def test_ssim_map_of_smooth_dark_images_equals_reference():
    ramp = torch.linspace(0.02, 0.05, 40 * 60).reshape(40, 60, 1).expand(-1, -1, 3).contiguous()
    other = ramp + 0.001
    torch.testing.assert_close(
        ssim_map(other, ramp).double(), reference_ssim_map(other.double(), ramp.double()), rtol=0, atol=1e-5
    )


def test_ssim_map_accepts_non_contiguous_inputs():
    image, target = images((3, 40, 52))
    x, y = image.permute(1, 2, 0), target.permute(1, 2, 0)
    assert torch.equal(ssim_map(x, y), ssim_map(x.contiguous(), y.contiguous()))


def test_ssim_independent_of_thread_count(two_threads):
    image, target = images((200, 90, 3))

    def run():
        x = image.clone().requires_grad_()
        similarity = ssim_map(x, target)
        similarity.square().sum().backward()
        y = image.movedim(-1, 0)[None].requires_grad_()
        score = fused_ssim(y, target.movedim(-1, 0)[None], "valid")
        return similarity.detach(), x.grad, score.detach(), *torch.autograd.grad(score, y)

    two = run()
    torch.set_num_threads(1)
    for a, b in zip(two, run(), strict=True):
        assert torch.equal(a, b)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize("differentiable", [False, True])
def test_ssim_ops_pass_opcheck(differentiable):
    image, target = images((12, 9, 3))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_map, (image.requires_grad_(differentiable), target))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_map_backward, (target, image.detach(), target))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_mean, (image.detach(), target, 2))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_mean_backward, (torch.ones(()), image.detach(), target, 2))


def test_ssim_map_rejects_invalid_inputs():
    image, target = images((4, 5, 3))
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        ssim_map(image.double(), target.double())
    with pytest.raises(InvalidInput, match=r"\[4, 5, 3\] and \[4, 4, 3\]"):
        ssim_map(image, target[:, :4])
    with pytest.raises(InvalidInput, match="32 channels"):
        ssim_map(torch.zeros(2, 2, 33), torch.zeros(2, 2, 33))


# 750 px with 3 channels are wider than one strip; 33 channels in all take two calls.
PICTURES = [
    (1, 3, 11, 11),
    (1, 1, 11, 90),
    (1, 3, 70, 13),
    (2, 3, 16, 40),
    (1, 3, 12, 750),
    (2, 16, 14, 17),
    (3, 11, 14, 17),
]


@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("layout", ["planes", "pixels"])
@pytest.mark.parametrize("shape", PICTURES)
def test_fused_ssim_equals_mean_of_ssim_maps(shape, layout, padding):
    pair = [t.movedim(-1, 0).reshape(shape) for t in images((*shape[2:], shape[0] * shape[1]), seed=2)]
    if layout == "pixels":
        pair = [t.movedim(1, -1).contiguous().movedim(-1, 1) for t in pair]
    ours = [t.clone().requires_grad_() for t in pair]
    exact = [t.double().requires_grad_() for t in pair]
    score = fused_ssim(*ours, padding)
    maps = torch.stack([reference_ssim_map(a.movedim(0, -1), b.movedim(0, -1)) for a, b in zip(*exact, strict=True)])
    wanted = (maps if padding == "same" else maps[:, 5:-5, 5:-5]).mean()
    assert score.shape == () and score.item() == pytest.approx(wanted.item(), abs=1e-6)
    (1.7 * score).backward()
    (1.7 * wanted).backward()
    for one, other in zip(ours, exact, strict=True):
        scale = other.grad.abs().max()
        torch.testing.assert_close(one.grad.double() / scale, other.grad / scale, rtol=0, atol=1e-5)


@pytest.mark.parametrize("border", [0, 1, 5, 8, 15])
def test_ssim_mean_excludes_border_from_value_and_gradient(border):
    image, target = (t.requires_grad_() for t in images((31, 720, 3)))
    inner = ssim_map(image, target)[border : 31 - border, border : 720 - border]
    mean = torch.ops.gsplat_core.ssim_mean(image.detach(), target.detach(), border)
    torch.testing.assert_close(mean, inner.mean(), rtol=1e-6, atol=1e-7)
    upstream = torch.tensor(0.7)
    for one, other in ((image, target), (target, image)):
        (wanted,) = torch.autograd.grad(inner.mean(), one, upstream, retain_graph=True)
        found = torch.ops.gsplat_core.ssim_mean_backward(upstream, one.detach(), other.detach(), border)
        torch.testing.assert_close(found / wanted.abs().max(), wanted / wanted.abs().max(), rtol=0, atol=2e-6)


def test_fused_ssim_computes_requested_gradients_only():
    first, second = (torch.rand(2, 3, 14, 17, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    both = [t.clone().requires_grad_() for t in (first, second)]
    gradients = torch.autograd.grad(fused_ssim(*both), both)
    for index in (0, 1):
        pair = [first, second]
        pair[index] = both[index]
        assert torch.equal(torch.autograd.grad(fused_ssim(*pair), both[index])[0], gradients[index])
    assert not fused_ssim(*both, train=False).requires_grad
    assert fused_ssim(*both, train=False) == fused_ssim(*both)
    (differentiable,) = torch.autograd.grad(fused_ssim(*both), both[:1], create_graph=True)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        differentiable.sum().backward()


def test_fused_ssim_rejects_invalid_inputs():
    picture = torch.zeros(2, 3, 14, 17)
    with pytest.raises(InvalidInput, match="'same' or 'valid'"):
        fused_ssim(picture, picture, "full")
    with pytest.raises(InvalidInput, match="larger than 10 pixels"):
        fused_ssim(picture[..., :10], picture[..., :10], "valid")
    with pytest.raises(InvalidInput, match=r"must be float32, got torch\.float64"):
        fused_ssim(picture, picture.double())
    with pytest.raises(RuntimeError, match="border of 7 pixels leaves none of 17 x 14"):
        torch.ops.gsplat_core.ssim_mean(picture[0].movedim(0, -1), picture[0].movedim(0, -1), 7)
