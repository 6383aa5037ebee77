"""New Gaussians join a scene where a frame shows tissue that it does not cover."""

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
    """Looks for uncovered tissue in one frame after another.

    With `beside` the host makes the Gaussians in a thread of its own, which takes longer than a live frame has, and they join with the next look,
    whether that comes soon or late: the same looks give the same scene.
    """

    def __init__(self, config: ReconstructorConfig, *, beside: bool = False) -> None:
        self._config = config
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="new tissue") if beside else None
        self._coverage: CapturedCoverage | None = None
        self._under_way: list[Future[Gaussians | None]] = []

    def begin(self, camera: Camera | None, device: torch.device, rows: int) -> None:
        """Another scene. camera: with it a scene on a GPU is asked by a captured graph first, which holds for `rows` Gaussians; None: it is not."""
        self.forget()
        self._coverage = None if camera is None else CapturedCoverage(camera, device, rows)

    def forget(self) -> None:
        """What is under way belongs to a scene that is left."""
        self._under_way.clear()

    def join(self, step: TrainingStep) -> None:
        """Let the Gaussians join that were made since the last look; waits for them."""
        under_way, self._under_way = self._under_way, []
        for each in under_way:
            self._append(step, each.result())

    def look(
        self, step: TrainingStep, observation: Observation, frame: Callable[[], Frame], *, has_depth: bool = False
    ) -> None:
        """Find what the scene leaves uncovered of what one eye sees; `frame` is that as pictures, and with depth if that is said."""
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
