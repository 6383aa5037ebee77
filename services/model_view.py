"""Viewers of a model in a browser, with free viewpoint and a time slider.

`Pictures` and `PictureView` serve pictures that this machine renders, with any renderer and for models of any size. The page asks for one
picture after the other. While the camera stands still, a renderer of random samples adds samples to the same picture, up to
`PROGRESSIVE_SAMPLES`. They need only the standard library. `ModelView` shows the Gaussians themselves by viser (extra `viser`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.files import rows_of
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import PROGRESSIVE_SAMPLES, Renderer, RendererOptions, check_renderer, new_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.value_ranges import plain_float
from operators.applications.render import typical_depth
from operators.rasterize import displayed

log = logging.getLogger(__name__)
MOST_SIDE_PX = 4096
JPEG_QUALITY = 92
RANGES = {
    "azimuth": (-1e6, 1e6),
    "elevation": (-89.0, 89.0),
    "distance": (1e-3, 1e3),
    "right": (-1e3, 1e3),
    "down": (-1e3, 1e3),
    "time": (-1e10, 1e10),
    "width": (16.0, MOST_SIDE_PX),
    "height": (16.0, MOST_SIDE_PX),
}
"""Smallest and largest value of each parameter in a browser's request for a picture."""


@dataclass(frozen=True)
class Viewpoint:
    """Viewpoint of a picture. Lengths are shares of the distance of the scene's middle from the model's camera."""

    azimuth: float
    """Rotation to the right around the pivot, in degrees."""
    elevation: float
    """Upward rotation around the pivot, in degrees."""
    distance: float
    """Distance of the camera from the pivot, over that of the scene's middle from the model's camera."""
    right: float
    """Shift of the pivot to the right in the axes of the model's camera, in the unit of `distance`."""
    down: float
    time: float
    """Time in seconds, in the model's window."""
    width: float
    height: float

    @classmethod
    def parse(cls, query: str) -> Viewpoint:
        """Parse a query string.

        Raises:
            ValueError: if a parameter is missing, unknown or out of its range.
        """
        values = {name: plain_float(text) for name, text in parse_qsl(query, max_num_fields=len(RANGES))}
        if set(values) != set(RANGES):
            raise ValueError(f"the parameters must be {', '.join(RANGES)}")
        for name, (low, high) in RANGES.items():
            if not low <= values[name] <= high:
                raise ValueError(f"{name} must be from {low:g} to {high:g}")
        return cls(**values)

    def camera(self, start: Camera, depth: float) -> Camera:
        """Return the camera of this viewpoint; `start` is the model's, and `depth` its distance from the pivot."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        sin_a, cos_a, sin_e, cos_e = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
        turn = np.eye(4)
        turn[:3, :3] = np.array([[1, 0, 0], [0, cos_e, -sin_e], [0, sin_e, cos_e]]) @ np.array(
            [[cos_a, 0, sin_a], [0, 1, 0], [-sin_a, 0, cos_a]]
        )
        to_pivot, back = np.eye(4), np.eye(4)
        to_pivot[:3, 3] = -depth * np.array([self.right, self.down, 1.0])
        back[2, 3] = depth * self.distance
        fitted = start.fitted(round(self.width), round(self.height))
        return fitted.with_pose(back @ turn @ to_pivot @ start.world_to_camera)


class Pictures:
    """Renders a model from the viewpoints that browsers request, one request at a time. Thread-safe."""

    def __init__(self, model: Model, renderer: str, options: RendererOptions, device: str) -> None:
        """Select the renderer.

        Raises:
            InvalidSetting: for an unknown renderer, an option or device that it does not have, or a model that it cannot show.
        """
        check_renderer(renderer, device, options=options)
        self.progressive = "progressive" in RENDERERS[renderer].capabilities.options
        self._options = replace(options, progressive=True) if self.progressive else options
        self._model, self._name, self._device = model, renderer, device
        # A renderer that cannot show the model refuses it here, not in answers to the browser.
        new_renderer(renderer, model.camera, device, options=self._options).prepare(model)
        self._depth = typical_depth(model, model.camera)
        self._lock = threading.Lock()
        self._renderer: Renderer | None = None
        self._shown: Viewpoint | None = None
        self._drawn = 0

    def jpeg(self, viewpoint: Viewpoint) -> tuple[bytes, int]:
        """Render the next picture of a viewpoint.

        Returns:
            JPEG file, and the number of samples per pixel in it; 0 for renderers without samples.
        """
        with self._lock, torch.inference_mode():
            camera = viewpoint.camera(self._model.camera, self._depth)
            shown = self._shown
            if (
                self._renderer is None
                or shown is None
                or shown.width != viewpoint.width
                or shown.height != viewpoint.height
            ):
                self._renderer = new_renderer(self._name, camera, self._device, options=self._options)
                self._renderer.prepare(self._model)
                shown = None
            self._drawn = (self._drawn if shown == viewpoint else 0) + self._options.samples
            self._shown = viewpoint
            picture = displayed(self._renderer.render(camera, viewpoint.time, ("image",)).result().image)
            coded, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if not coded:
                raise RuntimeError(f"OpenCV {cv2.__version__} cannot code a picture {list(picture.shape)} as JPEG")
            return data.tobytes(), self._drawn if self.progressive else 0


class PictureView:
    """Viewer server, used as context manager."""

    def __init__(self, pictures: Pictures, window_s: tuple[float, float], host: str, port: int) -> None:
        """Start the server in a thread.

        Raises:
            InvalidSetting: if the address cannot be listened on.
        """
        page = _page(window_s).encode()
        local = host if host not in ("127.0.0.1", "::1", "localhost") else None

        class Handler(_Handler):
            made, document, only_host = pictures, page, local

        try:
            self._server = ThreadingHTTPServer((host, port), Handler)
        except OSError as error:
            raise InvalidSetting(
                f"cannot listen on {host}:{port}: {error.strerror or error}; choose another --port"
            ) from error
        self._server.daemon_threads = True
        self.address: tuple[str, int] = host, self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name="picture-view", daemon=True)
        self._thread.start()

    def __enter__(self) -> PictureView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def run(self, stop_requested: Callable[[], bool]) -> None:
        """Serve until a stop is requested."""
        wait = threading.Event()
        while not stop_requested():
            wait.wait(0.05)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60
    made: Pictures
    document: bytes
    only_host: str | None

    def do_GET(self) -> None:
        """Answer with the page or a picture."""
        parts = urlsplit(self.path)
        if not self._is_addressed():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"unknown host name")
        elif parts.path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self.document)
        elif parts.path == "/picture":
            try:
                viewpoint = Viewpoint.parse(parts.query)
            except ValueError as error:
                self._answer(HTTPStatus.BAD_REQUEST, "text/plain", str(error).encode())
                return
            data, samples = self.made.jpeg(viewpoint)
            complete = not self.made.progressive or samples >= PROGRESSIVE_SAMPLES
            self._answer(
                HTTPStatus.OK, "image/jpeg", data, {"X-Samples": str(samples), "X-Complete": str(int(complete))}
            )
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is nothing here")

    def _is_addressed(self) -> bool:
        """Return False for a request to another name than this machine's, if only this machine is served. Pages of
        other sites could read the pictures by a name that resolves to this machine.
        """
        name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        return self.only_host is not None or name in ("127.0.0.1", "::1", "localhost")

    def _answer(self, status: HTTPStatus, kind: str, data: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        fixed = {
            "Content-Type": kind,
            "Content-Length": str(len(data)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Content-Security-Policy": "default-src 'none'; connect-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'",
        }
        for name, value in {**fixed, **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        """Log requests as debug messages."""
        log.debug(format, *args)


def _page(window_s: tuple[float, float]) -> str:
    start_s, end_s = window_s
    return PAGE.replace("START", f"{start_s:.6f}").replace("END", f"{end_s:.6f}")


PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>IntraSplat</title><style>
html, body { margin: 0; height: 100%; background: #111; color: #ccc; font: 13px sans-serif; overflow: hidden }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none; cursor: grab }
footer { position: absolute; left: 8px; bottom: 8px; background: #000a; padding: 4px 8px }
</style></head><body><canvas tabindex="0" aria-label="Picture of the model"></canvas><footer>
Research use only, not a medical device. <b>Not a live view.</b> Drag: rotate. Shift and drag: move. Wheel: zoom.
<label>Time <input type="range" min="START" max="END" step="any" value="END"></label> <span role="status"></span>
</footer><script>
"use strict";
const canvas = document.querySelector("canvas"), slider = document.querySelector("input"), said = document.querySelector("span");
const view = { azimuth: 0, elevation: 0, distance: 1, right: 0, down: 0 };
let shown = "", complete = false;
const query = () => new URLSearchParams({ ...view, time: slider.value,
  width: Math.min(4096, Math.max(16, innerWidth)), height: Math.min(4096, Math.max(16, innerHeight)) }).toString();
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  const x = event.movementX / innerHeight, y = event.movementY / innerHeight;
  if (event.shiftKey || event.buttons === 2) {
    view.right = clamp(view.right - x * view.distance, -1e3, 1e3);
    view.down = clamp(view.down - y * view.distance, -1e3, 1e3);
  } else {
    view.azimuth += 180 * x;
    view.elevation = clamp(view.elevation - 180 * y, -89, 89);
  }
});
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  view.distance = clamp(view.distance * Math.exp(event.deltaY * 1e-3), 1e-3, 1e3);
}, { passive: false });
async function next() {
  const wanted = query();
  if (wanted !== shown || !complete) {
    const begun = performance.now();
    try {
      const answer = await fetch(`/picture?${wanted}`);
      if (!answer.ok) throw new Error(await answer.text());
      const picture = await createImageBitmap(await answer.blob());
      canvas.width = picture.width;
      canvas.height = picture.height;
      canvas.getContext("2d").drawImage(picture, 0, 0);
      shown = wanted;
      complete = answer.headers.get("X-Complete") === "1";
      const samples = answer.headers.get("X-Samples");
      said.textContent = `${(performance.now() - begun).toFixed(0)} ms${samples === "0" ? "" : `, ${samples} samples per pixel`}`;
    } catch (error) {
      said.textContent = error.message;
      await new Promise((done) => setTimeout(done, 1000));
    }
  }
  requestAnimationFrame(next);
}
next();
</script></body></html>
"""


DISTANCE = 100.0
"""Distance from the camera to the scene's centre in viewer units. viser stores sizes in half
precision, which is most accurate at this scale."""
STEPS = 200
"""Number of positions of the time slider."""
POLL_S = 0.05


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
        self._server.on_client_connect(self._view_from_scope)
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
            wait.wait(POLL_S)

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

    def _view_from_scope(self, client: Any) -> None:
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
