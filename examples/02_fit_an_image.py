"""Fit Gaussians to one picture by gradient descent.

The renderer is an ordinary differentiable torch function, so any optimiser works. Here 400 Gaussians on a plane learn a
synthetic picture with torch's own Adam; the loss is the masked L1 that the reconstructor uses too.

Usage: python examples/02_fit_an_image.py [--steps 150]
"""

import argparse
import math

import torch

from gsplat_core import Camera, Gaussians, render
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.training.metrics import psnr_tissue_db

WIDTH_PX, HEIGHT_PX, DISTANCE_MM = 96, 80, 60.0


def target_picture() -> torch.Tensor:
    """Return soft stripes with a bright disc [H, W, 3]."""
    v, u = torch.meshgrid(torch.linspace(-1, 1, HEIGHT_PX), torch.linspace(-1, 1, WIDTH_PX), indexing="ij")
    stripes = 0.5 + 0.3 * torch.sin(7 * u + 3 * v)
    disc = torch.sigmoid(20 * (0.45 - (u * u + v * v).sqrt()))
    return torch.stack([stripes, 0.4 * stripes + 0.5 * disc, 0.3 + 0.4 * disc], -1)


def grid(camera: Camera, columns: int, rows: int) -> Gaussians:
    """Return a grid of grey Gaussians on the plane z = DISTANCE_MM."""
    half_width = DISTANCE_MM * camera.width_px / 2 / camera.K[0, 0]
    half_height = DISTANCE_MM * camera.height_px / 2 / camera.K[1, 1]
    x, y = torch.meshgrid(
        torch.linspace(-half_width, half_width, columns), torch.linspace(-half_height, half_height, rows), indexing="xy"
    )
    count = columns * rows
    return Gaussians(
        means=torch.stack([x.ravel(), y.ravel(), torch.full((count,), DISTANCE_MM)], -1),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(half_width / columns)),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150)
    steps = parser.parse_args().steps

    target = target_picture()
    tissue = torch.ones(HEIGHT_PX, WIDTH_PX)  # 1 = tissue: every pixel counts
    camera = Camera.from_focal(90, WIDTH_PX, HEIGHT_PX)
    start = grid(camera, 22, 18)
    learned = {name: tensor.requires_grad_() for name, tensor in start.tensors().items()}
    optimiser = torch.optim.Adam(list(learned.values()), lr=0.03)

    before_db = psnr_tissue_db(render(start, camera).image, target)
    for _ in range(steps):
        optimiser.zero_grad()
        image_loss(render(Gaussians(**learned), camera).image, target, tissue).loss.backward()
        optimiser.step()
    after_db = psnr_tissue_db(render(Gaussians(**learned), camera).image, target)
    print(f"{start.count} Gaussians, {steps} steps: {before_db:.1f} dB before, {after_db:.1f} dB after")


if __name__ == "__main__":
    main()
