"""Synthetic scene in COLMAP's format: textured surfaces, seen by cameras around them, with noisy points.

The surfaces are an uneven ground and three spheres. They are covered densely by small opaque Gaussians and rendered by
this project's renderer at twice the size of the pictures. `sparse/0` is written as COLMAP's binary files with the tracks of
all points.
"""

from __future__ import annotations

import argparse
import math
import struct
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

EXTENT = 1.4
"""Half of the side of the ground, in world units."""
SPHERES = ((-0.45, 0.25, 0.35), (0.5, 0.35, 0.28), (0.1, -0.45, 0.22))
"""x, y and radius of each sphere; z is up."""
BINARY_PINHOLE = 1


def texture(points: NDArray[np.float64], shift: float) -> NDArray[np.float64]:
    """Return colours [N, 3] in 0..1 of smooth stripes and spots at several scales."""
    x, y, z = (points * 4.5).T
    waves = [
        np.sin(2.1 * x + 1.3 * np.sin(1.7 * y + shift) + z),
        np.sin(3.7 * y - 2.2 * z + np.cos(2.9 * x - shift)),
        np.sin(7.3 * x + 5.1 * y + shift) * np.cos(6.1 * y - 4.3 * z),
        np.sin(15 * x - 11 * z) * np.sin(13 * y + 9 * z + shift),
    ]
    red = 0.62 + 0.2 * waves[0] + 0.1 * waves[2] + 0.08 * waves[3]
    green = 0.38 + 0.16 * waves[1] + 0.1 * waves[2] - 0.08 * waves[3]
    blue = 0.36 + 0.14 * waves[0] * waves[1] + 0.08 * waves[3]
    return np.clip(np.stack([red, green, blue], 1), 0.02, 0.98)


def surfaces(per_unit: float, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sample positions [N, 3] and colours [N, 3] of the surfaces, `per_unit` points per unit of length."""
    side = round(2 * EXTENT * per_unit)
    x, y = np.meshgrid(np.linspace(-EXTENT, EXTENT, side), np.linspace(-EXTENT, EXTENT, side))
    x, y = (each.ravel() + rng.normal(0, 0.15 / per_unit, side * side) for each in (x, y))
    height = 0.06 * np.sin(3 * x) * np.cos(2.5 * y) + 0.03 * np.sin(7 * x + 4 * y)
    parts = [np.stack([x, y, height], 1)]
    for cx, cy, radius in SPHERES:
        count = round(4 * math.pi * (radius * per_unit) ** 2)
        k = np.arange(count) + 0.5
        up, turn = 1 - 2 * k / count, math.pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - up * up)
        ball = np.stack([ring * np.cos(turn), ring * np.sin(turn), up], 1) * radius
        parts.append(ball + [cx, cy, radius * 0.8])
    colours = [texture(part, 1.9 * number) for number, part in enumerate(parts)]
    return np.concatenate(parts), np.concatenate(colours)


def cameras(count: int, width_px: int, height_px: int) -> list[Camera]:
    """Return cameras on a half sphere of two radii around the scene, in a spiral from the horizon to the top."""
    found = []
    for k in range(count):
        turn, rise = 2.399963 * k, math.radians(22 + 50 * ((k * 0.618034) % 1))
        radius = 2.6 + 0.3 * math.sin(1.7 * k)
        position = radius * np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
        target = np.array([0.1 * math.sin(k), 0.1 * math.cos(2 * k), 0.15])
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ position
        found.append(Camera.from_focal(0.9 * width_px, width_px, height_px, pose))
    return found


def picture(gaussians: Gaussians, camera: Camera) -> NDArray[np.uint8]:
    """Render a picture [H, W, 3] at twice its size, and average each four pixels."""
    with torch.inference_mode():
        background = torch.tensor([0.05, 0.06, 0.09], device=gaussians.means.device)
        large = render(gaussians, camera.scaled(2), background, depth=False).image
    large = (large.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    size_px = camera.width_px, camera.height_px
    return np.asarray(cv2.resize(large, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def write_scene(
    folder: Path,
    *,
    views: int = 32,
    width_px: int = 160,
    height_px: int = 120,
    points: int = 1500,
    noise: float = 0.01,
    per_unit: float = 70,
    seed: int = 0,
    device: str = "cpu",
) -> None:
    """Write a scene: `images/` with PNG files, and `sparse/0`.

    Args:
        folder: new folder.
        views: number of cameras.
        width_px: width of the pictures.
        height_px: height of the pictures.
        points: number of points from structure from motion.
        noise: standard error of their positions, in world units.
        per_unit: rendered Gaussians per unit of length of a surface.
        seed: seed of the points.
        device: device that renders the pictures.
    """
    rng = np.random.default_rng(seed)
    positions, colours = surfaces(per_unit, rng)
    count = len(positions)
    gaussians = Gaussians(
        torch.tensor(positions, dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), math.log(0.55 / per_unit)),
        torch.full((count,), 3.0),
        torch.tensor((colours - 0.5) / SH_C0, dtype=torch.float32)[:, None],
    ).to(device)
    (folder / "images").mkdir(parents=True)
    posed = [(f"view_{k:03d}.png", camera) for k, camera in enumerate(cameras(views, width_px, height_px))]
    for name, camera in posed:
        cv2.imwrite(str(folder / "images" / name), picture(gaussians, camera)[..., ::-1])
    chosen = rng.choice(count, points, replace=False)
    noisy = positions[chosen] + rng.normal(0, noise, (points, 3))
    write_sparse(folder / "sparse/0", posed, noisy, (colours[chosen] * 255).round().astype(np.uint8))


def write_sparse(
    folder: Path, posed: list[tuple[str, Camera]], positions: NDArray[np.float64], colours: NDArray[np.uint8]
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin`; all images share one camera."""
    folder.mkdir(parents=True)
    K, first = posed[0][1].K, posed[0][1]
    data = struct.pack("<QiiQQ", 1, 1, BINARY_PINHOLE, first.width_px, first.height_px)
    (folder / "cameras.bin").write_bytes(data + struct.pack("<4d", K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    tracks: list[list[tuple[int, int]]] = [[] for _ in positions]
    images = [struct.pack("<Q", len(posed))]
    for number, (name, camera) in enumerate(posed, 1):
        pose = camera.world_to_camera
        moved = positions @ pose[:3, :3].T + pose[:3, 3]
        pixels = moved[:, :2] / moved[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
        inside = (pixels >= 0).all(1) & (pixels < [camera.width_px, camera.height_px]).all(1) & (moved[:, 2] > 0)
        seen = np.flatnonzero(inside)
        images.append(struct.pack("<i7di", number, *_quaternion(pose[:3, :3]), *pose[:3, 3], 1) + name.encode() + b"\0")
        observed = np.empty(len(seen), [("pixel", "<f8", 2), ("point", "<i8")])
        observed["pixel"], observed["point"] = pixels[seen], seen + 1
        images += [struct.pack("<Q", len(seen)), observed.tobytes()]
        for at, point in enumerate(seen):
            tracks[point].append((number, at))
    (folder / "images.bin").write_bytes(b"".join(images))
    points = [struct.pack("<Q", len(positions))]
    for point, track in enumerate(tracks):
        points.append(struct.pack("<Q3d3Bd", point + 1, *positions[point], *(int(c) for c in colours[point]), 0.5))
        points += [struct.pack("<Q", len(track)), np.array(track, "<i4").tobytes()]
    (folder / "points3D.bin").write_bytes(b"".join(points))


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return wxyz of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix / 3)[1][:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def main() -> None:
    """Write the scene of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="new folder of the scene")
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=120)
    parser.add_argument("--points", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    write_scene(
        chosen.folder, views=chosen.views, width_px=chosen.width, height_px=chosen.height, points=chosen.points, seed=chosen.seed
    )  # fmt: skip


if __name__ == "__main__":
    main()
