"""Triangulation loss on a static synthetic multi-view set: Chamfer distance of the surface without and with the loss.

    python benchmarks/methods/triangulation.py [--seeds 1] [--views 9] [--steps N] [--full] [--device cpu|cuda] [--out FILE]

The tissue of a synthetic recording is held still and seen by cameras on a square of 16 mm, which look at one point of it. Training
gets pictures and poses. It starts from a plane (`plane`) or from the depth that parallax shows (`parallax`), without and with the
loss `triangulation`. The Chamfer distance is the mean of both directions between points of the rendered and of the true depth in
all views, in mm. The first two figures are the loss of the true surface and of one displaced by 5 % along the rays.
"""

from __future__ import annotations

import time
from dataclasses import replace

import log
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core import Camera
from gsplat_core.io.recordings.synthetic.optics import Lamp
from gsplat_core.io.recordings.synthetic.renderer import render_eye
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import NO_TUG
from gsplat_core.rendering.flow import render_depth
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.measured_losses import consensus_loss, triangulated
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor

REACH_MM = 8.0
APART_S = 1e-3
"""Interval of the frames; far below the resolution of the deformation field, so that the scene is static."""
POINTS = 4000


def views(
    seed: int, count: int, width: int, height: int
) -> tuple[list[Frame], list[Camera], list[NDArray[np.float32]]]:
    """Return frames with poses, their cameras and their true depth."""
    scene = SyntheticScene.from_seed(seed, width, height, 1.0, True)
    side = int(np.ceil(np.sqrt(count)))
    places = np.stack(np.meshgrid(*(np.linspace(-REACH_MM, REACH_MM, side),) * 2), -1).reshape(-1, 2)[:count]
    # A serpentine path, whose neighbours are near each other.
    places = places.reshape(-1, side, 2) if count == side * side else places[None]
    places = np.concatenate([row if k % 2 == 0 else row[::-1] for k, row in enumerate(places)])
    frames, cameras, depths = [], [], []
    for number, (x, y) in enumerate(places):
        centre = np.array([x, y, 0.0])
        forward = np.array([0, 0, scene.tissue.looked_at_mm]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross([0, 1, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        camera = scene.camera.with_pose(pose)
        lamp = Lamp.of_eye(0.0, scene.tissue.exposed_mm)
        eye = render_eye(scene.tissue, NO_TUG, [], camera, 0.0, lamp, None)
        frames.append(Frame(number, round(number * APART_S * 1e9), eye.image, pose=pose))
        cameras.append(camera)
        depths.append(eye.depth.astype(np.float32))
    return frames, cameras, depths


def cloud(depths: list[NDArray[np.float32]], cameras: list[Camera]) -> torch.Tensor:
    """Return random points [POINTS, 3] of depth maps in the world."""
    points = []
    for depth, camera in zip(depths, cameras, strict=True):
        y, x = np.nonzero(depth > 0)
        z = depth[y, x].astype(np.float64)
        rays = np.stack([(x + 0.5 - camera.K[0, 2]) / camera.K[0, 0], (y + 0.5 - camera.K[1, 2]) / camera.K[1, 1]], 1)
        local = np.concatenate([rays * z[:, None], z[:, None]], 1) - camera.world_to_camera[:3, 3]
        points.append(local @ camera.world_to_camera[:3, :3])
    together = np.concatenate(points)
    chosen = np.random.default_rng(0).choice(len(together), min(POINTS, len(together)), replace=False)
    return torch.tensor(together[chosen])


def chamfer(found: torch.Tensor, true: torch.Tensor) -> float:
    """Return the mean distance to the nearest point, averaged over both directions."""
    apart = torch.cdist(found, true)
    return 0.5 * float(apart.min(0).values.mean() + apart.min(1).values.mean())


def loss_of_displaced(
    frames: list[Frame], cameras: list[Camera], depths: list[NDArray[np.float32]]
) -> dict[str, float]:
    """Return the loss of the true depth and of the depth displaced by 5 %, with the part of gradients that point back."""
    seen = [Observation.of(frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    middle = len(seen) // 2
    target = triangulated(seen[middle], [one for k, one in enumerate(seen) if k != middle][:8])
    assert target is not None
    exact = torch.tensor(depths[middle])
    displaced = (1.05 * exact).requires_grad_()
    wrong = consensus_loss(displaced, target, cameras[middle])
    wrong.backward()
    gradient = displaced.grad
    assert gradient is not None
    back = float((gradient[gradient != 0] > 0).float().mean())
    return {
        "loss_of_true_surface": round(float(consensus_loss(exact, target, cameras[middle])), 4),
        "loss_of_surface_displaced_by_5_percent": round(float(wrong.detach()), 4),
        "gradients_that_move_it_back": round(back, 4),
    }


def main() -> None:
    """Measure and log."""
    parser = log.options(__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--steps", type=int, default=0, help="training steps; 0 for 250, or 3,000 with --full")
    parser.add_argument("--starts", nargs="+", choices=["plane", "parallax"], default=["plane", "parallax"])
    parser.add_argument("--weight", type=float, default=0.0, help="weight of the loss; 0 for its default")
    chosen = parser.parse_args()
    size = (640, 512) if chosen.full else (160, 128)
    steps = chosen.steps or (3000 if chosen.full else 250)
    loss = f"triangulation:{chosen.weight}" if chosen.weight else "triangulation"
    figures: dict[str, object] = {}
    for seed in range(chosen.seeds):
        frames, cameras, depths = views(seed, chosen.views, *size)
        figures |= {f"seed{seed}_{name}": value for name, value in loss_of_displaced(frames, cameras, depths).items()}
        true = cloud(depths, cameras)
        for start in chosen.starts:
            distances = []
            for losses in ((), (loss,)):
                config = replace(
                    ReconstructorConfig.offline(), depth_of_recording=None if start == "plane" else start, losses=losses
                )
                if not chosen.full:
                    config = replace(config, gaussians=6000, max_gaussians=8000)
                reconstructor = Reconstructor(config, cameras[0], seed=seed, device=chosen.device)
                begun = time.perf_counter()
                reconstructor.fit(frames, steps)
                seconds = time.perf_counter() - begun
                model = reconstructor.snapshot()
                with torch.no_grad():
                    found = [
                        render_depth(model.at(frame.time_s), camera).cpu().numpy()
                        for frame, camera in zip(frames, cameras, strict=True)
                    ]
                name = f"seed{seed}_{start}_{'triangulation' if losses else 'today'}"
                distances.append(chamfer(cloud(found, cameras), true))
                figures[f"{name}_chamfer_mm"] = round(distances[-1], 4)
                figures[f"{name}_train_s"] = round(seconds, 1)
            figures[f"seed{seed}_{start}_chamfer_ratio"] = round(distances[1] / distances[0], 4)
    log.write("triangulation", chosen, figures)


if __name__ == "__main__":
    main()
