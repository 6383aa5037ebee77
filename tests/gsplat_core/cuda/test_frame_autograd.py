"""Autograd through render_frame on CUDA."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.frame import FrameMode, render_frame
from tests.gsplat_core.cuda.frame_scenes import NAMES, backward, by_name, frame_scene, on_gpu, rendered


@pytest.mark.parametrize("degree", [0, 2])
def test_frame_autograd_equals_direct_backward(degree: int) -> None:
    scene = on_gpu(frame_scene(300, degree=degree, deltas=True))
    wanted = by_name(backward(scene), scene.sh.shape[1])
    leaves = {name: getattr(scene, name).clone().requires_grad_() for name in (*NAMES, "deltas")}
    frame = rendered(replace(scene, **leaves))
    v_image, v_alphas = (t.cuda() for t in scene.picture_gradients())
    ((frame.image * v_image).sum() + (frame.alphas * v_alphas).sum()).backward()
    for name in NAMES:
        assert torch.equal(leaves[name].grad.cpu().double(), wanted[name].reshape(leaves[name].shape))
    assert torch.equal(leaves["deltas"].grad, backward(scene).raw)


def test_frame_autograd_registration_passes_opcheck() -> None:
    scene = on_gpu(frame_scene(30, 20, 18, deltas=True))
    leaves = [t.clone().requires_grad_() for t in (*scene.gaussians, scene.deltas)]
    arguments = (leaves[:5], leaves[5], *scene.view.tensors, 20, 18, 0.3, 0.01, 1e10, 0, 1000, int(FrameMode.TRAINING))
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.gsplat_core.render_frame.default, arguments, test_utils=checks)


def test_frame_autograd_rejects_unsupported_gradients() -> None:
    scene = on_gpu(frame_scene(30, 20, 18))
    means = scene.means.clone().requires_grad_()
    gaussians = [means, *scene.gaussians[1:]]
    with pytest.raises(InvalidInput, match=r"FrameMode\.TRAINING"):
        render_frame(gaussians, None, scene.view, 1000).image.sum().backward()
    camera = scene.viewmat.clone().requires_grad_()
    with pytest.raises(InvalidInput, match="no gradient for the camera"):
        view = scene.view._replace(viewmat=camera)
        render_frame(gaussians, None, view, 1000, FrameMode.TRAINING).image.sum().backward()
