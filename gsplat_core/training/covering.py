"""Addition of Gaussians where a frame shows tissue that the scene does not cover."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.coverage import CapturedCoverage
from gsplat_core.training.growth import uncovered_tissue
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep


class Covering:
    """Search for uncovered tissue in consecutive frames.

    With `beside`, a host thread creates the Gaussians, which takes longer than a live frame. They
    are added at the next search, independent of its time, so the same sequence of searches gives
    the same scene.
    """

    def __init__(self, config: ReconstructorConfig, *, beside: bool = False) -> None:
        self._config = config
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="new tissue") if beside else None
        self._coverage: CapturedCoverage | None = None
        self._under_way: list[Future[Gaussians | None]] = []

    def begin(self, camera: Camera | None, device: torch.device, rows: int) -> None:
        """Start another scene.

        Args:
            camera: camera for a captured coverage test on a GPU, or None for no such test.
            device: device of the scene.
            rows: largest number of Gaussians.
        """
        self.forget()
        self._coverage = None if camera is None else CapturedCoverage(camera, device, rows)

    def forget(self) -> None:
        """Discard Gaussians that are being created for a scene that is left."""
        self._under_way.clear()

    def join(self, step: TrainingStep) -> None:
        """Add the Gaussians created since the last search; waits for them."""
        under_way, self._under_way = self._under_way, []
        for each in under_way:
            self._append(step, each.result())

    def look(
        self, step: TrainingStep, observation: Observation, frame: Callable[[], Frame], *, has_depth: bool = False
    ) -> None:
        """Search the tissue of one eye's view that the scene does not cover.

        Args:
            step: training step of the scene.
            observation: the view.
            frame: returns the view as a frame; called only if needed.
            has_depth: True if the frame has depth to place Gaussians at.
        """
        most = self._config.max_gaussians - step.gaussians.count
        if most <= 0:
            return
        coverage = self._coverage
        if coverage is not None and not coverage.leaves_much_uncovered(step.gaussians, step.field, observation):
            return
        found = uncovered_tissue(observation, step.at(observation.time_s), has_depth=has_depth)
        if found is None:
            return
        make = lambda: found.gaussians(frame(), observation, self._config, most)
        if self._thread is None:
            self._append(step, make())
        else:
            self._under_way.append(self._thread.submit(make))

    def _append(self, step: TrainingStep, added: Gaussians | None) -> None:
        room = self._config.max_gaussians - step.gaussians.count
        if added is None or room <= 0:
            return
        every = math.ceil(added.count / room)
        step.append(added if every <= 1 else added.map(lambda tensor: tensor[::every]))
