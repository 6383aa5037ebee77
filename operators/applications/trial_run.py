"""Short run of a live graph on synthetic pictures, so that one-time initialisation precedes the
stream.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.frames import Frame, FrameStatus
from operators.applications.device import seeded
from operators.applications.live_settings import LiveSettings
from operators.graph import Application, run
from operators.sources.source import FrameSource, SourceDescription
from operators.sources.threaded import ThreadedSource

TRIAL_FRAMES = 10
TRIAL_INTERVAL_S = 0.02


class MadeUpTissue(ThreadedSource):
    """A few moving synthetic tissue pictures, of the size of `like`."""

    def __init__(self, like: SourceDescription) -> None:
        super().__init__(ahead=1)
        self.description = replace(
            like, name="trial run", fps=1 / TRIAL_INTERVAL_S, frame_count=None, digest=None, notes=()
        )

    def frames(self) -> Iterator[Frame]:
        """Yield the pictures in real time."""
        camera = self.description.camera
        picture = made_up_tissue(camera.height_px, camera.width_px)
        for seq in range(TRIAL_FRAMES):
            time.sleep(TRIAL_INTERVAL_S)
            moved = np.roll(picture, 2 * seq, axis=1)
            yield Frame(
                seq,
                round(seq * TRIAL_INTERVAL_S * 1e9),
                moved,
                status=FrameStatus.LIVE,
                arrived_ns=time.monotonic_ns(),
            )


def made_up_tissue(height_px: int, width_px: int) -> NDArray[np.uint8]:
    """Return a synthetic tissue picture of smooth red patches, uint8 RGB [H, W, 3]."""
    random = np.random.default_rng(0)
    patches = random.uniform(0.4, 1.0, (24, 30)).astype(np.float32)
    light = cv2.resize(patches, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    return np.clip(light[..., None] * np.array([190, 90, 80], np.float32), 0, 255).astype(np.uint8)


def trial_run(
    settings: LiveSettings, source: FrameSource, new_graph: Callable[[FrameSource, LiveSettings], Application]
) -> None:
    """Run the graph made by `new_graph` on synthetic pictures, to detect failures before the
    stream.

    Args:
        settings: settings of the live run.
        source: source of the stream; only its description is used.
        new_graph: creates the graph from a source and settings.

    Raises:
        OperatorsError: the errors of a run, such as OperatorFailed.
    """
    run_on_trial(settings, lambda inside: new_graph(MadeUpTissue(source.description), inside))


def run_on_trial(settings: LiveSettings, new_graph: Callable[[LiveSettings], Application]) -> None:
    """Run a live graph without recording, in a temporary folder. Raises the errors of a run."""
    with TemporaryDirectory(prefix="intrasplat-trial-") as folder:
        inside = replace(settings, out=Path(folder), record=None, out_of_body="off", seconds=None, max_frames=None)
        with seeded(settings.seed, settings.device):
            run(new_graph(inside), "embedded")
