"""Arguments that `fully_fused_projection` refuses, with their error messages."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput, fully_fused_projection


def test_projection_rejects_invalid_arguments(make_scene):
    scene = make_scene(5).to(torch.float32)

    def call(**changes):
        arguments = dict(
            means=scene.means, covars=None, quats=scene.quats, scales=scene.scales, viewmats=scene.viewmats,
            Ks=scene.Ks, width=10, height=10,
        )  # fmt: skip
        return fully_fused_projection(**(arguments | changes))

    for changes, message in [
        ({"means": scene.means[:, :2]}, r"means must be \[..., N, 3\].*\[5, 2\]"),
        ({"means": scene.means[0, 0]}, "means must be"),
        ({"quats": scene.quats[:4]}, r"quats .*\[5, 4\], got \[4, 4\]"),
        ({"quats": None}, "give covars, or both"),
        ({"covars": torch.zeros(5, 6)}, "not both"),
        ({"covars": torch.zeros(5, 9), "quats": None, "scales": None}, r"\[5, 6\], got \[5, 9\]"),
        ({"viewmats": scene.viewmats[0]}, "viewmats"),
        ({"Ks": scene.Ks[0]}, "Ks"),
        ({"width": 0}, "width=0"),
        ({"camera_model": "mirror"}, "'mirror'"),
        ({"means": scene.means.double()}, "one floating-point dtype"),
        ({"opacities": torch.ones(4)}, r"opacities .*\[5\], got \[4\]"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            call(**changes)
    double = scene.to(torch.float64)
    with pytest.raises(InvalidInput, match=r"float32.*float64.*gsplat_core\.reference"):
        call(means=double.means, quats=double.quats, scales=double.scales, viewmats=double.viewmats, Ks=double.Ks)
    meta = {name: getattr(scene, name).to("meta") for name in ("means", "quats", "scales", "viewmats", "Ks")}
    with pytest.raises(InvalidInput, match="for the CPU"):
        call(**meta)
    with pytest.raises(InvalidInput, match="sparse_grad=True needs packed=True"):
        call(sparse_grad=True)
    with pytest.raises(NotImplementedError, match="ftheta"):
        call(camera_model="ftheta")
