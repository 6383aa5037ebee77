"""Creation of Gaussians where a frame shows tissue that the scene does not cover."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.deformation.field import DeformationField
from gsplat_core.models.snapshots import SnapshotSlots
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.growth.initialisation import colours_beside_tools, gaussians_at_pixels, tissue_depth
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy

UNCOVERED_ALPHA = 0.5
"""Accumulated opacity below which a pixel counts as uncovered."""
SMALLEST_SHARE = 0.002
"""Uncovered share of the frame from which Gaussians are added. Below it, training closes the single-pixel gaps."""


def uncovered_pixels(alpha: Tensor, mask: Tensor) -> Tensor:
    """Return tissue pixels, bool [H, W], whose accumulated opacity is below `UNCOVERED_ALPHA`.

    Args:
        alpha: accumulated opacity [H, W].
        mask: [H, W], non-zero on tissue.
    """
    return (alpha < UNCOVERED_ALPHA) & (mask > 0)


def are_worth_filling(uncovered: Tensor) -> bool:
    """Return True if the uncovered pixels [H, W] are more than single gaps. Synchronises with the device."""
    return HostCopy(torch.count_nonzero(uncovered)).item() >= SMALLEST_SHARE * uncovered.numel()


class CapturedCoverage:
    """Coverage test of a scene on a GPU by a captured graph.

    The scene is copied to a slot and rendered by a CUDA graph that stays valid while the scene
    grows. This takes a tenth of the launches of deforming and rendering the scene directly.
    """

    def __init__(self, camera: Camera, device: torch.device, rows: int = 0) -> None:
        """Prepare the test for at most `rows` Gaussians; 0 for a quarter more than the scene's first size."""
        self._slots = SnapshotSlots(device, most=2, rows=rows)  # the renderer holds one while the other is written
        self._renderer = AlphaRenderer(camera, device)

    def leaves_much_uncovered(self, gaussians: Gaussians, field: DeformationField, observation: Observation) -> bool:
        """Return True if uncovered tissue of the observation should be filled with Gaussians.
        Synchronises with the device.
        """
        snapshot = self._slots.publish(
            gaussians, field, version=1, camera=observation.camera, time_window_s=field.time_window_s
        )
        self._renderer.prepare(snapshot)
        alpha = self._renderer.render(observation.camera, observation.time_s, outputs=["alpha"]).result().alpha
        return are_worth_filling(uncovered_pixels(alpha, observation.mask))


def grid_spacing(pixels: int, gaussians: int) -> float:
    """Return the grid spacing in pixels for an even spread of Gaussians over a picture."""
    return math.sqrt(pixels / gaussians)


def grid_of(height_px: int, width_px: int, spacing: float) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Return pixel coordinates [rows * columns, 2] of a grid over the picture, and (rows, columns)."""
    columns = np.arange(spacing / 2, width_px, spacing)
    rows = np.arange(spacing / 2, height_px, spacing)
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2), (len(rows), len(columns))


@dataclass(frozen=True)
class Uncovered:
    """Tissue of one frame that the scene does not cover, as tensors that are being copied to the host."""

    pixels: HostCopy
    """Pixels of tissue that no Gaussian covers, bool [H, W]."""
    depth: HostCopy | None
    """Depth of the scene, float32 [H, W], 0 where uncovered; None if the frame's own depth is used."""

    def gaussians(
        self, frame: Frame, observation: Observation, config: ReconstructorConfig, most: int
    ) -> Gaussians | None:
        """Create Gaussians for the uncovered tissue on the observation's device, with the density of the first frame.

        Their depth is the frame's own or extrapolated from the covered pixels around. Waits for the copies.

        Args:
            frame: frame that provides colours and depth.
            observation: the same view as tensors.
            config: settings.
            most: largest number of Gaussians.

        Returns:
            The Gaussians, or None if there are none to create.
        """
        height, width = frame.image.shape[:2]
        grid, _ = grid_of(height, width, grid_spacing(height * width, config.gaussians))
        is_uncovered = self.pixels.numpy()
        wanted = grid[is_uncovered[grid[:, 1].astype(np.int64), grid[:, 0].astype(np.int64)]]
        depth_mm = frame.depth
        if self.depth is not None:
            depth_mm = np.asarray(cv2.medianBlur(self.depth.numpy(), 5))
        assert depth_mm is not None
        return gaussians_beside(wanted, frame, depth_mm, observation, config, most)


def uncovered_tissue(
    observation: Observation,
    current: Gaussians,
    *,
    has_depth: bool = False,
    picture: Callable[..., RenderOutput] = render,
) -> Uncovered | None:
    """Find tissue of an observation that the scene does not cover.

    The search runs on the observation's device and transfers a single number if there is little.

    Args:
        observation: the view.
        current: the scene at the observation's time.
        has_depth: True if the frame has depth, so that the scene's depth is not needed.
        picture: renderer of the scene.

    Returns:
        The uncovered tissue, or None if it is not worth filling.
    """
    with torch.no_grad():
        output = picture(current, observation.camera, depth=not has_depth)
        uncovered = uncovered_pixels(output.alpha, observation.mask)
        if not are_worth_filling(uncovered):
            return None
        shown = None if has_depth else HostCopy(torch.where(output.alpha >= UNCOVERED_ALPHA, output.depth, 0))
        return Uncovered(HostCopy(uncovered), shown)


def gaussians_beside(
    wanted: NDArray[np.float64],
    frame: Frame,
    depth_mm: NDArray[np.floating],
    observation: Observation,
    config: ReconstructorConfig,
    most: int,
) -> Gaussians | None:
    """Create one Gaussian at each of the given pixels, or at an even subset of them.

    Args:
        wanted: pixel positions [M, 2] on tissue.
        frame: frame that provides colours.
        depth_mm: depth [H, W], 0 = unknown. Unknown pixels get extrapolated depth.
        observation: the same view as tensors; determines camera and device.
        config: settings.
        most: largest number of Gaussians.

    Returns:
        The Gaussians, or None if there are none to create.
    """
    if len(wanted) == 0 or most <= 0:
        return None
    height, width = frame.image.shape[:2]
    depth = tissue_depth(frame.with_fields(depth=depth_mm), config.default_depth_mm)
    added = gaussians_at_pixels(
        wanted[:: math.ceil(len(wanted) / most)],
        grid_spacing(height * width, config.gaussians),
        colours_beside_tools(frame),
        depth,
        observation.camera,
        sh_degree=config.sh_degree,
    )
    return added.to(observation.image.device)


class Covering:
    """Search for uncovered tissue in consecutive frames, and creation of Gaussians for it in another thread.

    With `beside`, a host thread creates the Gaussians, because creation takes longer than a live frame interval. The
    next search adds them whenever it happens, so the same sequence of searches gives the same scene.
    """

    def __init__(self, config: ReconstructorConfig, *, beside: bool = False) -> None:
        self._config = config
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="new tissue") if beside else None
        self._coverage: CapturedCoverage | None = None
        self._under_way: list[Future[Gaussians | None]] = []

    def begin(self, camera: Camera | None, device: torch.device, rows: int) -> None:
        """Prepare for a new scene, cancelling the creation of Gaussians for the previous one.

        Args:
            camera: camera for a captured coverage test on a GPU, or None for no such test.
            device: device of the scene.
            rows: largest number of Gaussians.
        """
        self.forget()
        self._coverage = None if camera is None else CapturedCoverage(camera, device, rows)

    def forget(self) -> None:
        """Cancel the creation of Gaussians for a scene that the stream has left."""
        self._under_way.clear()

    def join(self, step: TrainingStep) -> None:
        """Add the Gaussians whose creation was started by the last search; waits until they are created."""
        under_way, self._under_way = self._under_way, []
        for each in under_way:
            self._append(step, each.result())

    def cover(self, step: TrainingStep, frame: Frame, observation: Observation, *, first: bool = False) -> None:
        """Add Gaussians where an eye of the frame shows uncovered tissue.

        Args:
            step: training step of the scene.
            frame: the frame.
            observation: the same frame as tensors.
            first: the scene was created from the left picture of this frame, which is skipped.
        """
        self.join(step)
        if not first:
            self.look(step, observation, lambda: frame, has_depth=frame.depth is not None)
        if (right := observation.right) is not None:
            self.look(step, right, right.as_frame)

    def look(
        self, step: TrainingStep, observation: Observation, frame: Callable[[], Frame], *, has_depth: bool = False
    ) -> None:
        """Find tissue in one eye's view that the scene does not cover, and create Gaussians for it.

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
        found = uncovered_tissue(observation, step.at(observation.time_s), has_depth=has_depth, picture=step.picture)
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
