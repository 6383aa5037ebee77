"""Viewer of a model's Gaussians in a browser, with free viewpoint and a time slider, by viser (extra `viser`)."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.files import rows_of
from gsplat_core.models import Model
from gsplat_core.scene.gaussians import SH_C0

log = logging.getLogger(__name__)
DISTANCE = 100.0
"""Distance from the camera to the scene's centre in viewer units. viser stores sizes in half
precision, which is most accurate at this scale."""
STEPS = 200
"""Number of positions of the time slider."""
LOOK_S = 0.05


def viser() -> Any:
    """Import viser.

    Raises:
        InvalidSetting: if it is not installed.
    """
    try:
        import viser as library
    except ImportError:
        raise InvalidSetting(
            "the viewer needs viser; install it with: pip install 'intrasplat[viser]', or show pictures with --renderer alpha"
        ) from None
    return library


class ModelView:
    """Viewer server, used as context manager. Colours have no view dependence, a limitation of viser."""

    def __init__(self, model: Model, host: str, port: int) -> None:
        """Start the server.

        Raises:
            InvalidSetting: if viser is not installed.
            ExportError: if the model has non-finite values.
        """
        library = viser()
        self._model = model
        self._place = scene_to_view(model)
        self._drawn_s: float | None = None
        start_s, end_s = model.time_window_s
        splats = self._splats(end_s)
        self._server = _private(library)(host=host, port=port, label="IntraSplat", verbose=False)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.address: tuple[str, int] = host, self._server.get_port()
        self._server.scene.set_up_direction("-y")
        self._server.on_client_connect(self._look_from_the_scope)
        self._server.gui.add_markdown("Research use only, not a medical device. **Not a live view.**")
        steps = (end_s - start_s) / STEPS
        moves = model.field is not None and steps > 0
        self._time = self._server.gui.add_slider(
            "Time, s", min=start_s, max=end_s if moves else start_s + 1, step=steps or 1.0, initial_value=end_s if moves else start_s, disabled=not moves
        )  # fmt: skip
        self._play = self._server.gui.add_checkbox("Play", initial_value=False, disabled=not moves)
        self._show(end_s, splats)

    def __enter__(self) -> ModelView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()

    def run(self, stop_requested: Callable[[], bool]) -> None:
        """Show the model at the slider's time, and advance the slider during playback, until a stop is requested."""
        start_s, end_s = self._model.time_window_s
        wait = threading.Event()
        before_s = time.monotonic()
        while not stop_requested():
            now_s = time.monotonic()
            if self._play.value and not self._play.disabled:
                self._time.value = start_s + (self._time.value - start_s + now_s - before_s) % (end_s - start_s)
            before_s = now_s
            if not self._time.disabled and self._time.value != self._drawn_s:
                self._show(self._time.value, self._splats(self._time.value))
            wait.wait(LOOK_S)

    def _show(self, time_s: float, splats: dict[str, NDArray[np.float32]]) -> None:
        self._drawn_s = time_s
        with self._server.atomic():
            self._server.scene.add_gaussian_splats("/model", **splats)

    def _splats(self, time_s: float) -> dict[str, NDArray[np.float32]]:
        """Return viser's splat arrays at a time, in the endoscope's camera axes, scaled."""
        with torch.inference_mode():
            rows = rows_of(self._model.at(time_s))
        rotation, offset, scale = self._place
        shape = scale * (rotation @ rotation_matrices(rows.rotations)) * rows.scales[:, None, :]
        return {
            "centers": np.asarray(scale * (rows.means @ rotation.T + offset), np.float32),
            "covariances": np.asarray(shape @ shape.transpose(0, 2, 1), np.float32),
            "rgbs": np.clip(0.5 + SH_C0 * rows.sh[:, 0], 0, 1),
            "opacities": rows.opacities[:, None],
        }

    def _look_from_the_scope(self, client: Any) -> None:
        """Place a new browser's camera at the endoscope's position."""
        client.camera.position = (0.0, 0.0, 0.0)
        client.camera.look_at = (0.0, 0.0, DISTANCE)
        client.camera.up_direction = (0.0, -1.0, 0.0)
        camera = self._model.camera
        client.camera.fov = float(2 * np.arctan(camera.height_px / 2 / camera.K[1, 1]))


def _private(library: Any) -> Any:
    """Return viser's server class without the public share URL, which any browser could otherwise request."""

    class PrivateServer(library.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            log.warning("a browser requested a public address of the model, which has none")

    return PrivateServer


def scene_to_view(model: Model) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return rotation and translation into camera axes, and the scale that moves the scene's centre to `DISTANCE`."""
    pose = model.camera.world_to_camera
    rotation, offset = pose[:3, :3], pose[:3, 3]
    depths = model.gaussians.means.detach().cpu().double().numpy() @ rotation[2] + offset[2]
    ahead = depths[depths > 0]
    return rotation, offset, DISTANCE / float(np.median(ahead)) if ahead.size else 1.0


def rotation_matrices(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    """Convert unit quaternions wxyz [N, 4] to rotation matrices [N, 3, 3]."""
    w, x, y, z = quats.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
