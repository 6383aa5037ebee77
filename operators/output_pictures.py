"""Pictures of a renderer's outputs: colours as they are, everything else in false colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from operators.layer_pictures import DepthColours, confidence_picture, mark_unobserved

Values = NDArray[np.float32]
CLASS_COLOURS = np.array(
    [
        (228, 26, 28), (55, 126, 184), (77, 175, 74), (152, 78, 163), (255, 127, 0), (255, 255, 51), (166, 86, 40),
        (247, 129, 191), (153, 153, 153),
    ],
    np.uint8,
)  # fmt: skip
"""Colours of classes (ColorBrewer's Set1); they repeat after the last one."""
UNDECIDED = (96, 96, 96)
"""Colour of pixels on which no class was learned."""
LEAST_LOGIT = 0.05
"""Smallest lead of the largest logit over the mean of a pixel with a class."""
FULL = 0.98
"""Quantile of the values that has the last colour, for values without a fixed range."""
RANGE_FOLLOWS = 0.3
"""Weight of the newest picture in the moving average of a range."""
LEAST_FLOW_PX = 0.25
"""Smallest speed in pixels that is drawn in full saturation, so that noise of a still scene stays pale."""


class OutputPictures:
    """Pictures of the outputs of one view. Ranges of colours follow the pictures slowly. Not thread-safe."""

    def __init__(self) -> None:
        self._depths: dict[str, DepthColours] = {}
        self._full: dict[str, float] = {}

    def picture(self, name: str, values: Values, alpha: Values) -> NDArray[np.uint8]:
        """Return the picture of an output, with unobserved pixels hatched except in `image` and `alpha`.

        Args:
            name: name of the output.
            values: float32 [H, W] or [H, W, C], as the renderer returns them.
            alpha: opacity, float32 [H, W].

        Returns:
            uint8 RGB [H, W, 3].

        Raises:
            InvalidSetting: for classes of a model that was trained without labels.
        """
        kinds: Mapping[str, Callable[[], NDArray[np.uint8]]] = {
            "image": lambda: _bytes(values),
            "alpha": lambda: _grey(values),
            "occlusion": lambda: _grey(values),
            "normals": lambda: normal_colours(values),
            "depth_normals": lambda: normal_colours(values),
            "confidence": lambda: confidence_picture(values, alpha)[0],
            "semantics": lambda: class_colours(values),
            "flow": lambda: flow_colours(values, self._full_scale(name, np.hypot(*np.moveaxis(values, -1, 0)), alpha)),
            "spread": lambda: _viridis(values, self._full_scale(name, values, alpha)),
        }
        if name in kinds:
            image = kinds[name]()
        elif values.ndim == 2:
            alpha = np.where(values > 0, alpha, 0)  # a pixel without a depth is not observed
            image = self._depths.setdefault(name, DepthColours()).picture(values, alpha, metric=True)[0]
        else:
            image = _bytes(values[..., :3])
        if name not in ("image", "alpha"):
            mark_unobserved(image, alpha)
        return image

    def _full_scale(self, name: str, values: Values, alpha: Values) -> float:
        known = values[(alpha >= 0.5) & np.isfinite(values)]
        now = float(np.quantile(known, FULL)) if known.size else 0.0
        before = self._full.get(name)
        self._full[name] = full = now if before is None else before + RANGE_FOLLOWS * (now - before)
        return full


def normal_colours(normals: Values) -> NDArray[np.uint8]:
    """Return the usual colours of normals: red to the right, green up, blue towards the camera; black where unknown.

    Args:
        normals: float32 [H, W, 3] in camera axes (x right, y down, z forward).
    """
    image = _bytes(0.5 + 0.5 * normals * np.array([1, -1, -1], np.float32))
    image[~(np.linalg.norm(normals, axis=-1) > 0.5)] = 0
    return image


def flow_colours(flow: Values, full_px: float) -> NDArray[np.uint8]:
    """Return the direction of a flow as hue (right red, down green) and its length as saturation; white is at rest.

    Args:
        flow: float32 [H, W, 2], to the right and down.
        full_px: length in pixels with full saturation.
    """
    right, down = np.nan_to_num(flow[..., 0]), np.nan_to_num(flow[..., 1])
    hue = np.rad2deg(np.arctan2(down, right)) % 360
    share = np.clip(np.hypot(right, down) / max(full_px, LEAST_FLOW_PX), 0, 1)
    hsv = np.stack([hue, share, np.ones_like(share)], -1).astype(np.float32)
    return _bytes(np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.float32))


def class_colours(logits: Values) -> NDArray[np.uint8]:
    """Return the colour of the most probable class of each pixel; grey where all classes are about equally probable.

    Raises:
        InvalidSetting: without classes.
    """
    if logits.shape[-1] == 0:
        raise InvalidSetting(
            "the model has no classes, because it was trained without labels; train with --losses semantics, or leave the"
            " output semantics out"
        )
    image = CLASS_COLOURS[logits.argmax(-1) % len(CLASS_COLOURS)]
    image[~(logits.max(-1) - logits.mean(-1) > LEAST_LOGIT)] = UNDECIDED
    return image


def _viridis(values: Values, full: float) -> NDArray[np.uint8]:
    share = np.clip(np.nan_to_num(values) / max(full, 1e-12), 0, 1)
    return np.ascontiguousarray(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1])


def _grey(values: Values) -> NDArray[np.uint8]:
    return np.repeat(_bytes(values)[..., None], 3, -1)


def _bytes(values: Values) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(values), 0, 1)), np.uint8)
