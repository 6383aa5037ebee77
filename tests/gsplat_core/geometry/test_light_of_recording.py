"""Depth by light of a whole recording: the motion along the line of sight is found, and nothing is done where it cannot be."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gsplat_core.depth.light import frames_with_light
from gsplat_core.scene.frames import DepthOrigin
from tests.gsplat_core.geometry.lit_sheet import CAMERA, HEIGHT, WIDTH, error, frame, pigment, rays

X, Y = rays()
LIT = {"depth": np.ones((HEIGHT, WIDTH), np.float32), "depth_origin": DepthOrigin.LIGHT}


def depth_at(number):
    return 60 * np.exp(0.3 * X + 0.15 * np.cos(4 * Y) + 0.04 * np.sin(0.9 * number) * np.sin(3 * X))


def recording(count, **fields):
    return [frame(number, depth_at(number), pigment(), **(LIT | fields)) for number in range(count)]


@pytest.mark.parametrize("count", [5, 30])
def test_depth_follows_the_tissue(count):
    frames = recording(count)
    found, moves = frames_with_light(frames, [CAMERA] * count)
    assert moves
    assert all(one.depth_origin is DepthOrigin.LIGHT for one in found)
    mean = np.exp(np.mean([np.log(one.depth) for one in found], axis=0))
    true_mean = np.exp(np.mean([np.log(depth_at(number)) for number in range(count)], axis=0))
    assert error(mean, true_mean) < 0.5 * error(np.ones_like(mean), true_mean)
    changes = [error(one.depth / mean, depth_at(number) / true_mean) for number, one in enumerate(found)]
    none = [error(np.ones_like(mean), depth_at(number) / true_mean) for number in range(count)]
    assert np.mean(changes) < 0.5 * np.mean(none)


def test_frames_between_looks_have_depth_between():
    frames = [frame(number, depth_at(number / 4), pigment(), every_s=0.1, **LIT) for number in range(13)]
    found, _ = frames_with_light(frames, [CAMERA] * 13)
    steps = [np.abs(np.log(b.depth / a.depth)).max() for a, b in pairwise(found)]
    assert 0 < max(steps) < 0.03


def test_the_same_frames_give_the_same_bytes():
    first, second = (frames_with_light(recording(5), [CAMERA] * 5)[0] for _ in range(2))
    assert all(np.array_equal(a.depth, b.depth) for a, b in zip(first, second, strict=True))


def moved_camera():
    pose = np.eye(4)
    pose[0, 3] = 1
    return CAMERA.with_pose(pose)


@pytest.mark.parametrize("why", ["not asked for", "the scope moves", "another scene", "nothing to see", "flat"])
def test_nothing_is_done(why):
    frames, cameras = recording(5), [CAMERA] * 5
    if why == "not asked for":
        frames = recording(5, depth_origin=DepthOrigin.MEASURED)
    elif why == "the scope moves":
        cameras = [*cameras[:4], moved_camera()]
    elif why == "another scene":
        frames[3] = frames[3].with_fields(new_scene="cut")
    elif why == "nothing to see":
        frames[2] = frames[2].with_fields(image=np.zeros_like(frames[2].image))
    else:
        # Brightness that no distance changes: as of a sphere round the scope.
        frames = [frame(number, 60 / np.sqrt(1 + X * X + Y * Y), pigment(), **LIT) for number in range(5)]
        frames = [one.with_fields(image=np.full_like(one.image, (180, 90, 80))) for one in frames]
    found, moves = frames_with_light(frames, cameras)
    assert not moves
    assert all(a is b for a, b in zip(found, frames, strict=True))
