"""Render a few hundred Gaussians to a picture.

Places small, flat Gaussians on a sphere, colours them by position, and renders them once with `render` (one camera, our
own dataclasses) and once with `rasterization` (gsplat's names, arguments and results). Both give the same pixels.

Usage: python examples/01_render.py [--out out/examples/sphere.png]
"""

import argparse
import math
from pathlib import Path

import cv2
import torch

import gsplat_core
from gsplat_core import Camera, Gaussians
from gsplat_core.scene.gaussians import SH_C0


def sphere(count: int, radius_mm: float, z_mm: float) -> Gaussians:
    """Return Gaussians spread evenly over a sphere (Fibonacci lattice) at distance `z_mm` in front of the camera."""
    k = torch.arange(count) + 0.5
    polar, azimuth = torch.acos(1 - 2 * k / count), math.pi * (1 + math.sqrt(5)) * k
    unit = torch.stack([azimuth.cos() * polar.sin(), azimuth.sin() * polar.sin(), polar.cos()], -1)
    spacing_mm = radius_mm * math.sqrt(4 * math.pi / count)
    colour = 0.5 + 0.5 * unit
    return Gaussians(
        means=radius_mm * unit + torch.tensor([0.0, 0.0, z_mm]),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),  # wxyz
        log_scales=torch.full((count, 3), math.log(0.6 * spacing_mm)),
        logit_opacities=torch.full((count,), 3.0),
        sh=((colour - 0.5) / SH_C0)[:, None],  # degree 0: one coefficient per channel
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/examples/sphere.png"))
    out = parser.parse_args().out

    gaussians = sphere(600, radius_mm=20, z_mm=80)
    camera = Camera.from_focal(300, width_px=320, height_px=256)
    output = gsplat_core.render(gaussians, camera)

    colours, _, meta = gsplat_core.rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.viewmat[None],
        camera.intrinsics[None],
        camera.width_px,
        camera.height_px,
        sh_degree=0,
        packed=False,
    )
    assert torch.allclose(colours[0], output.image, atol=1e-6)

    rgb = (output.image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), rgb[..., ::-1])
    seen = output.depth[output.alpha > 0.5]
    print(
        f"{gaussians.count} Gaussians, {int((meta['radii'] > 0).all(-1).sum())} in view, depth from {seen.min():.1f} mm"
    )
    print(out)


if __name__ == "__main__":
    main()
