"""Relative depth by a network of the user's, an ONNX model.

Networks that see one picture say depth, or mostly its inverse, up to a factor and a summand, and another pair of them for each picture. Where a frame came with
depth the pair is found by that; else by the answer before, so that depth does not flicker; and in a stream's first frame it is assumed.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx_network import OnnxNetwork
from gsplat_core.endoscope.onnx_settings import Finite, PictureSettings, Positive
from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.affine_depth import ENDS, MOST_SPAN, Affine, fitted, is_constant, with_assumed_zero
from gsplat_core.geometry.depth_map import BELIEVED, DepthMap, doubted
from gsplat_core.geometry.light import DISTANCE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

Values = Literal["inverse", "depth"]
VALUES_IN_ADDRESS = "?values="
MULTIPLES_PX = (14, 32)
"""Sides of pictures for a network that takes any size are multiples of the first of these with which it works: vision transformers have patches of 14."""
SMALLEST_PX = 4
GRID_PX = 80
"""Longer side of the grid on which answers are compared."""
EVERY_S = 0.3
"""Time from one look to the next; the answer holds on meanwhile, unless the scope moves."""
ALIKE = 0.6
"""Correlation with the depth before from which it is the same scene."""
LEAST_SEEN = 0.05
"""Share of the picture that must be tissue."""

UNSEEN = "too little of the picture is tissue for a depth network"
NOT_FINITE = "the depth network gave values that are not finite"
FLAT = "the depth network says that everything is at one distance"
AGAINST = "the depth network's answer runs against the depth that the frame came with; its values are of the other kind (values=depth or values=inverse)"
UNLIKE = "the depth network's answer has little to do with the depth that the frame came with"
GIVEN = "factor and summand of the depth network's answers were found by the depth that frames came with"


class DepthSettings(PictureSettings):
    """What cannot be seen in the shapes of a network that finds depth."""

    mean: tuple[Finite, Finite, Finite] = (0.485, 0.456, 0.406)
    std: tuple[Positive, Positive, Positive] = (0.229, 0.224, 0.225)
    values: Values = "inverse"
    """What comes out: depth along the camera's axis, or its inverse."""


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:  # what is wrong with it is said by who reads it
        return None
    return about.st_mtime_ns, about.st_size


@lru_cache(maxsize=1)
def _network(path: Path, stamps: tuple[tuple[int, int] | None, ...]) -> OnnxNetwork[DepthSettings]:
    """Loaded and tried out once for all streams, and for the check before them; stamps: of its files, which may change."""
    network = OnnxNetwork(path, "depth network", DepthSettings, multiple_px=MULTIPLES_PX[0])
    noise = np.random.default_rng(0).integers(0, 256, (256, 320, 3), np.uint8)
    try:
        output = network.run(noise)
    except InvalidSetting:
        network.multiple_px = MULTIPLES_PX[1]
        output = network.run(noise)
    shape = output.shape
    fits = len(shape) in (3, 4) and set(shape[:-2]) == {1} and SMALLEST_PX <= min(shape[-2:]) <= max(shape) <= 4096
    if not fits or not np.issubdtype(output.dtype, np.floating):
        raise network.refused(f"gives {output.dtype} {list(shape)}; it must give floats [1, h, w] or [1, 1, h, w]")
    return network


class LearnedDepth:
    """Asks a network from time to time for one stream's depth; steady from one answer to the next. Without a unit, whatever the network says."""

    def __init__(self, address: str) -> None:
        """address: the path of the model; `?values=depth` or `?values=inverse` behind it goes before its own settings.

        Raises InvalidSetting, with a sentence, for a network that cannot be used.
        """
        name, found, values = address.rpartition(VALUES_IN_ADDRESS)
        if found and values not in get_args(Values):
            raise InvalidSetting(
                f"depth 'onnx:{address}' has values {values!r}; choose {' or '.join(get_args(Values))}"
            )
        path = Path(name if found else address)
        self._network = _network(path, (_stamp(path), _stamp(path.with_name(path.name + ".json"))))
        self._inverse = (values if found else self._network.settings.values) == "inverse"
        self._forget()

    def _forget(self) -> None:
        self._looked_ns: int | None = None
        self._answer: DepthMap | None = None
        self._before: NDArray[np.float64] | None = None
        """The last believed answer on the grid, as values of the network's kind."""
        self._pose: NDArray[np.float64] | None = None

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`. Raises InvalidSetting where the network fails on a picture."""
        if frame.new_scene is not None or self._resized(frame):
            self._forget()
        if self._looked_ns is not None and 0 <= frame.pts_ns - self._looked_ns < EVERY_S * 1e9:
            stands_still = self._pose is not None and np.array_equal(self._pose, camera.world_to_camera)
            return self._answer if stands_still else None
        self._answer = self._look(frame)
        self._looked_ns, self._pose = frame.pts_ns, camera.world_to_camera.copy()
        return self._answer

    def _resized(self, frame: Frame) -> bool:
        return self._answer is not None and self._answer.depth.shape != frame.image.shape[:2]

    def _look(self, frame: Frame) -> DepthMap:
        size = frame.height_px, frame.width_px
        output = self._network.run(frame.image)
        values = np.asarray(output.reshape(output.shape[-2:]), np.float32)
        if not np.isfinite(values).all():
            return doubted(size, DepthOrigin.LEARNED, NOT_FINITE)
        grid, seen = _on_grid(values, size, cv2.INTER_AREA), _on_grid(_tissue(frame), size) > 0
        if seen.mean() < LEAST_SEEN:
            return doubted(size, DepthOrigin.LEARNED, UNSEEN)
        if is_constant(grid[seen]):
            return doubted(size, DepthOrigin.LEARNED, FLAT)
        solved = self._by_given(grid, seen, frame)
        if isinstance(solved, str):
            return doubted(size, DepthOrigin.LEARNED, solved)
        remark = None if solved is None else GIVEN
        solved = solved or self._by_before(grid, seen) or self._assumed(grid[seen])
        self._before = solved.of(grid)
        low, middle = np.percentile(self._before[seen], (ENDS[0], 50))
        least = max(low / 2, middle / MOST_SPAN**2)
        large = cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR).astype(np.float64)
        found = solved.of(large)
        depth = self._kind(np.maximum(found, least)).astype(np.float32)
        # Nothing tells how far a network is right, nor where.
        return DepthMap(
            depth,
            np.where(found > least, BELIEVED, 0).astype(np.float32),
            DepthOrigin.LEARNED,
            metric=False,
            remark=remark,
        )

    def _kind(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth to values of the network's kind, or back."""
        return 1 / values if self._inverse else values

    def _by_given(self, grid: NDArray[np.float64], seen: NDArray[np.bool_], frame: Frame) -> Affine | str | None:
        """Solved by the depth that the frame came with; None where it has too little of it, a doubt where the two do not go together."""
        if frame.depth is None:
            return None
        depth = frame.depth
        if frame.depth_confidence is not None:
            depth = np.where(frame.depth_confidence >= BELIEVED, depth, 0)
        given = _on_grid(depth, (frame.height_px, frame.width_px))
        both = seen & (given > 0)
        found = fitted(grid[both], self._kind(given[both]))
        if found is None or found.alike >= ALIKE:
            return found
        return AGAINST if found.alike <= -ALIKE else UNLIKE

    def _by_before(self, grid: NDArray[np.float64], seen: NDArray[np.bool_]) -> Affine | None:
        """Solved by the answer before; None where there is none, or where it is of another scene."""
        if self._before is None:
            return None
        found = fitted(grid[seen], self._before[seen])
        return found if found is not None and found.alike >= ALIKE else None

    def _assumed(self, values: NDArray[np.float64]) -> Affine:
        """Of values of which nothing else is known."""
        zero = with_assumed_zero(values)
        positive = np.clip(zero.of(values), *np.percentile(zero.of(values), ENDS))
        factor = self._kind(np.array(DISTANCE)) / np.exp(np.log(positive).mean())
        return Affine(float(factor), float(factor) * zero.summand, 1.0)


def _tissue(frame: Frame) -> NDArray[np.uint8]:
    """[H, W]; 0 where a tool is, or what is outside of the field of view."""
    masks = [mask for mask in (frame.mask, frame.loss_mask) if mask is not None]
    whole = np.ones((frame.height_px, frame.width_px), np.bool_)
    return np.logical_and.reduce([whole, *masks]).astype(np.uint8)


def _on_grid(plane: NDArray[np.generic], size: tuple[int, int], how: int = cv2.INTER_NEAREST) -> NDArray[np.float64]:
    """A plane of any size as it covers a picture of `size`, on the grid."""
    scale = GRID_PX / max(size)
    columns, rows = (max(1, round(side * scale)) for side in (size[1], size[0]))
    return np.asarray(cv2.resize(np.asarray(plane, np.float32), (columns, rows), interpolation=how), np.float64)
