"""Reading a grid between its cells."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.scene.tangents import at_positions


@pytest.mark.parametrize("shape", [(7, 9), (1, 5), (6, 1), (1, 1)])
@pytest.mark.parametrize("channels", [(), (3,), (2, 3)])
def test_it_reads_what_opencv_reads(shape, channels):
    rng = np.random.default_rng(0)
    grid = rng.random((*shape, *channels))
    # OpenCV knows 32 places between two pixels.
    positions = rng.integers(-32, 32 * 12, (200, 2)) / 32 + 0.5
    planes = grid.reshape(*shape, -1).astype(np.float32)
    x, y = (np.ascontiguousarray(each, np.float32)[None] for each in (positions - 0.5).T)
    wanted = np.stack(
        [cv2.remap(np.ascontiguousarray(planes[..., k]), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0] for k in range(planes.shape[2])], -1
    )  # fmt: skip
    seen = at_positions(grid, positions)
    assert seen.shape == (200, *channels)
    np.testing.assert_allclose(seen.reshape(200, -1), wanted, atol=1e-5)


def test_no_position_is_no_value():
    assert at_positions(np.zeros((4, 5, 2)), np.zeros((0, 2))).shape == (0, 2)
