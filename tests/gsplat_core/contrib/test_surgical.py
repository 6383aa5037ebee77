"""gsplat's names for training surgical scenes: initialisation, losses and schedule."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import contrib, rasterization
from gsplat_core.contrib import DeformNetwork, DynamicStrategy, HexPlaneField, hexplane_regularization
from gsplat_core.reference.training import ssim_map

K = torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])


def test_depth_unprojection_converts_pixels_to_world_points():
    images = torch.zeros(2, 12, 16, 3, dtype=torch.uint8)
    images[1, 3, 5] = torch.tensor([255, 51, 0], dtype=torch.uint8)
    depths, masks = torch.zeros(2, 12, 16), torch.ones(2, 12, 16)
    depths[1, 3, 5], depths[0, 0, 0], masks[0, 0, 0] = 4.0, 4.0, 0
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses[1, :3, 3] = torch.tensor([10.0, 20, 30])
    points, colours = contrib.multi_frame_depth_unprojection(images, depths, masks, poses, K.repeat(2, 1, 1))
    in_camera = torch.tensor([(5 - 8) * 4 / 20, (3 - 6) * 4 / 20, 4])
    assert torch.allclose(points, (poses[1, :3, :3] @ in_camera + poses[1, :3, 3])[None])
    assert torch.allclose(colours, torch.tensor([[1.0, 0.2, 0]]))
    arguments = images, torch.ones(2, 12, 16), masks, poses, K.repeat(2, 1, 1)
    assert len(contrib.multi_frame_depth_unprojection(*arguments, max_points=7)[0]) == 7
    with pytest.raises(ValueError, match="leading dim mismatch"):
        contrib.multi_frame_depth_unprojection(images, depths, masks[:1], poses, K.repeat(2, 1, 1))


def test_knn_scale_init_equals_neighbour_distances():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2], [50, 0, 0]])
    assert contrib.knn_scale_init(points)[0].item() == pytest.approx(math.log(math.sqrt((1 + 4 + 4) / 3)))
    assert contrib.knn_scale_init(torch.zeros(4, 3)).tolist() == pytest.approx([math.log(1e-7)] * 4)
    with pytest.raises(ValueError, match="at least k\\+1=4"):
        contrib.knn_scale_init(points[:3])


def test_masked_losses_ignore_masked_pixels():
    own, other = torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16)
    mask = (torch.rand(1, 1, 16, 16) > 0.5).float()
    difference = ((own - other).abs() * mask).sum() / (3 * mask.sum())
    assert contrib.masked_l1(own, other, mask).item() == pytest.approx(difference.item(), rel=1e-5)
    assert contrib.masked_l1(own, other, 0 * mask).item() == 0
    channels_last = [(each * mask)[0].permute(1, 2, 0).double() for each in (own, other)]
    wanted = 1 - ssim_map(*channels_last).mean()
    assert contrib.masked_ssim(own, other, mask).item() == pytest.approx(wanted.item(), abs=1e-5)
    with pytest.raises(ValueError, match="shapes must match"):
        contrib.masked_ssim(own, other[:, :1], mask)


def test_depth_losses_count_known_pairs_only():
    own, other = torch.tensor([[2.0, 0, 4, 5]], requires_grad=True), torch.tensor([[4.0, 3, 0, 2]])
    assert contrib.binocular_disparity_l1(own, other).item() == pytest.approx((0.25 + 0.3) / 2)
    kept = torch.tensor([[1, 1, 1, 0]])
    assert contrib.binocular_disparity_l1(own, other, kept).item() == pytest.approx(0.25)
    (gradient,) = torch.autograd.grad(contrib.binocular_disparity_l1(own, other), own)
    assert gradient.isfinite().all() and gradient[0, 1] == 0
    line = torch.linspace(1, 2, 12).view(1, 3, 4)
    assert contrib.pearson_depth_loss(line, 3 * line + 1).item() == pytest.approx(0, abs=1e-5)
    assert contrib.pearson_depth_loss(line, -line).item() == pytest.approx(2, abs=1e-5)
    assert contrib.pearson_depth_loss(line, line, torch.zeros_like(line)).item() == 0
    assert contrib.pearson_depth_loss(0 * line, line).isfinite()


def test_targeted_total_variation_closed_form():
    image = torch.zeros(1, 2, 4, 5)
    image[..., 3:] = 0.5  # one step in each of 4 rows of both channels
    assert contrib.compute_tv_loss_targeted(image).item() == pytest.approx(4 * 2 * 0.5 / 40)
    mask = torch.zeros(1, 1, 4, 5)
    mask[:, :, :2] = 1
    # Of the 8 differences across in the two rows of the mask, 2 are 0.5.
    assert contrib.compute_tv_loss_targeted(image, mask).item() == pytest.approx(2 * 2 * 0.5 / (8 * 2))
    with pytest.raises(ValueError, match="4D"):
        contrib.compute_tv_loss_targeted(image[0])


def test_two_stage_scheduler_starts_with_single_frame():
    schedule = contrib.TwoStageScheduler(coarse_steps=2, fine_steps=10, coarse_frame_index=1)
    steps = [schedule.step(k, 3) for k in range(6)]
    assert [each.frame_index for each in steps] == [1, 1, 0, 1, 2, 0]
    assert [each.stage for each in steps] == ["coarse"] * 2 + ["fine"] * 4
    assert [each.shuffle for each in steps] == [False] * 2 + [True] * 4
    for wrong in ((-1, 3), (0, 0), (0, 1)):
        with pytest.raises(ValueError):
            schedule.step(*wrong)
    with pytest.raises(ValueError, match="fine_steps"):
        contrib.TwoStageScheduler(1, -1)


def test_surgical_training_steps_lower_loss():
    """The steps of gsplat's surgical trainer on one frame."""
    torch.manual_seed(0)
    image, depth, mask = torch.rand(1, 12, 16, 3) * 0.2 + 0.4, torch.full((1, 12, 16), 3.0), torch.ones(1, 12, 16)
    points, colours = contrib.multi_frame_depth_unprojection(image, depth, mask, torch.eye(4)[None], K[None], 60)
    values = {
        "means": points,
        "quats": torch.nn.functional.normalize(torch.randn(60, 4), dim=-1),
        "scales": contrib.knn_scale_init(points)[:, None].repeat(1, 3),
        "opacities": torch.zeros(60, 1),
        "colors": torch.zeros_like(colours),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    field = HexPlaneField(8.0, {"output_coordinate_dim": 4, "resolution": [8, 8, 8, 4]})
    network = DeformNetwork(field.feat_dim, 8, 1)
    optimizers = {name: torch.optim.Adam([value], 1e-2) for name, value in params.items()}
    further = torch.optim.Adam(
        [*(each for each in field.parameters() if each.requires_grad), *network.parameters()], 1e-3
    )
    strategy = DynamicStrategy()
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(num_gaussians=60)
    losses = []
    for step in range(8):
        time = torch.full((60, 1), 0.3)
        features = field(torch.cat([params["means"], time], 1))
        means, quats, opacities = network(params["means"], params["quats"], params["opacities"], time, features)
        rendered, _, info = rasterization(
            means, quats, params["scales"].exp(), opacities.sigmoid()[:, 0], params["colors"], torch.eye(4)[None], K[None],
            16, 12, render_mode="RGB+ED", packed=True,
        )  # fmt: skip
        own, true = rendered[..., :3].permute(0, 3, 1, 2), image.permute(0, 3, 1, 2)
        loss = (
            0.8 * contrib.masked_l1(own, true, mask[:, None]) + 0.2 * contrib.masked_ssim(own, true, mask[:, None])
            + contrib.binocular_disparity_l1(rendered[..., 3], depth, mask) + 1e-3 * contrib.compute_tv_loss_targeted(own)
            + 1e-4 * hexplane_regularization(field)
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        for optimizer in (*optimizers.values(), further):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=True)
        losses.append(loss.item())
    assert losses[-1] < losses[0] - 0.01
