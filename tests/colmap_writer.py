"""Writer of scenes in COLMAP's format for tests, from its published description."""

import math
import struct

import numpy as np


def quaternion(rotation):
    """Return wxyz of a rotation matrix whose angle is below 180 degrees."""
    w = math.sqrt(max(0.0, 1 + np.trace(rotation))) / 2
    return (
        w,
        (rotation[2, 1] - rotation[1, 2]) / (4 * w),
        (rotation[0, 2] - rotation[2, 0]) / (4 * w),
        (rotation[1, 0] - rotation[0, 1]) / (4 * w),
    )


def write_scene(sparse, images, *, text, points=(), model="PINHOLE"):
    """Write the reconstruction of a scene.

    Args:
        sparse: new folder of the reconstruction.
        images: (name, Camera) of each image; all have different COLMAP cameras.
        text: True for .txt, False for .bin.
        points: (x, y, z, r, g, b) of each point.
        model: PINHOLE, SIMPLE_PINHOLE or OPENCV (with distortion of 0).
    """
    sparse.mkdir(parents=True)
    cameras, posed = [], []
    for number, (name, camera) in enumerate(images, 1):
        fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
        values = {"PINHOLE": [fx, fy, cx, cy], "SIMPLE_PINHOLE": [fx, cx, cy], "OPENCV": [fx, fy, cx, cy, 0, 0, 0, 0]}
        cameras.append((10 * number, camera.width_px, camera.height_px, values[model]))
        pose = camera.world_to_camera
        posed.append((number, (*quaternion(pose[:3, :3]), *pose[:3, 3]), 10 * number, name))
    (_write_text if text else _write_binary)(sparse, cameras, posed, points, model)


def _write_text(sparse, cameras, posed, points, model):
    lines = ["# Camera list with one line of data per camera:"]
    lines += [
        f"{number} {model} {width} {height} {' '.join(map(repr, map(float, values)))}"
        for number, width, height, values in cameras
    ]
    (sparse / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for k, (number, pose, camera, name) in enumerate(posed):
        lines += [
            f"{number} {' '.join(map(repr, map(float, pose)))} {camera} {name}",
            "1.5 2.5 1 3.0 4.0 -1" if k % 2 else "",
        ]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [f"{k} {' '.join(map(str, point))} 0.5 1 2 3 4" for k, point in enumerate(points, 1)]
    (sparse / "points3D.txt").write_text("\n".join(lines) + "\n")


def _write_binary(sparse, cameras, posed, points, model):
    ids = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "OPENCV": 4}
    data = struct.pack("<Q", len(cameras))
    for number, width, height, values in cameras:
        data += struct.pack(f"<iiQQ{len(values)}d", number, ids[model], width, height, *values)
    (sparse / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(posed))
    for k, (number, pose, camera, name) in enumerate(posed):
        seen = k % 3
        data += struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", seen) + struct.pack("<ddq", 1.0, 2.0, -1) * seen
    (sparse / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for k, point in enumerate(points, 1):
        data += (
            struct.pack("<Q3d3Bd", k, *point[:3], *point[3:], 0.5)
            + struct.pack("<Q", 2)
            + struct.pack("<4i", 1, 2, 3, 4)
        )
    (sparse / "points3D.bin").write_bytes(data)
