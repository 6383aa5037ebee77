"""Tissue that enters and leaves the view: creation of Gaussians where a frame shows tissue that the scene does not cover, and
an archive of Gaussians that are out of view.

For a moving camera, the time at which each Gaussian was last visible is known. Gaussians that have been out of view are
archived, to free capacity in a scene of fixed size, and return with their tissue. Tissue that comes into view is filled
before training.
"""

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
from gsplat_core.models import SnapshotSlots
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians, RowMoves
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import colours_beside_tools, depth_at_pixels, gaussians_at_pixels
from gsplat_core.training.observations import Observation, depth_of, pixels_of, unprojected, value_at
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy, tensor_of

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
    """Return True if the marked pixels, bool [H, W], are at least the share `SMALLEST_SHARE` of the picture. Synchronises."""
    return HostCopy(torch.count_nonzero(uncovered)).item() >= SMALLEST_SHARE * uncovered.numel()


class CapturedCoverage:
    """Coverage test of a scene on a GPU by a captured graph.

    The scene is copied to a slot and rendered by a CUDA graph that stays valid while the scene
    grows. This takes a tenth of the launches of deforming and rendering the scene directly.
    """

    def __init__(self, camera: Camera, device: torch.device, rows: int = 0) -> None:
        """Prepare the test for at most `rows` Gaussians; 0 for a quarter more than the scene's first size."""
        self._slots = SnapshotSlots(
            device, most=2, rows=rows
        )  # two slots: the renderer reads one while the other is written
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
    """True for tissue pixels that Gaussians cover by less than `UNCOVERED_ALPHA`, bool [H, W]."""
    depth: HostCopy | None
    """Rendered depth of the scene, float32 [H, W], 0 where uncovered; None if the frame has depth, which is used instead."""

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
    spacing_px = grid_spacing(height * width, config.gaussians)
    pixels = wanted[:: math.ceil(len(wanted) / most)]
    added = gaussians_at_pixels(
        pixels,
        spacing_px,
        colours_beside_tools(frame),
        depth_at_pixels(pixels, frame.with_fields(depth=depth_mm), config.default_depth_mm),
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
        """Prepare for a new scene, and discard Gaussians that are being created for the previous one.

        Args:
            camera: camera for a captured coverage test on a GPU, or None for no such test.
            device: device of the scene.
            rows: largest number of Gaussians.
        """
        self.forget()
        self._coverage = None if camera is None else CapturedCoverage(camera, device, rows)

    def forget(self) -> None:
        """Discard the Gaussians that the host thread is creating, because the stream has left their scene.

        The thread itself is not interrupted.
        """
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
            self.check(step, observation, lambda: frame, has_depth=frame.depth is not None)
        if (right := observation.right) is not None:
            self.check(step, right, right.as_frame)

    def check(
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


SEE_EVERY = 8
"""Number of frames between two visibility tests. With little free capacity, every frame is tested."""
ROOM_SHARE = 0.1
"""Share of the capacity kept free for new tissue, as long as there are Gaussians to archive."""
UNSEEN_S = 0.5
"""Seconds out of view after which a Gaussian may be archived."""
MARGIN_SHARE = 0.1
"""Width of a margin around the picture, as a share of its width, in which Gaussians are not archived because their extent may
reach into the picture.
"""
ARCHIVED_SCENES = 8
"""Capacity of the archive, in multiples of the scene's capacity."""
REACH_PX = 5
"""Distance from an uncovered pixel, in pixels, within which archived Gaussians are restored."""


class OutOfView:
    """Visibility times of a scene's Gaussians, and the archive of those that left the camera's view."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._capacity = capacity
        self.last_seen = LastSeen(capacity, device)
        self.archive = Archive(ARCHIVED_SCENES * capacity)
        self._frames = 0
        self._checked_from: Camera | None = None
        """Camera for which the archive was last searched."""
        self._unseen_s: torch.Tensor | None = None
        """Cached result of `unseen_s` since the last test."""

    def restart(self) -> None:
        """Empty the archive and forget when Gaussians were visible, for a new scene."""
        self.last_seen.restart()
        self._unseen_s = None
        self.archive = Archive(ARCHIVED_SCENES * self._capacity)
        self._frames = 0

    def unseen_s(self, count: int) -> torch.Tensor:
        """Return for each of the `count` Gaussians how long it was out of view at the last test, in
        seconds (`Model.unseen_s`). The returned tensor is never modified.
        """
        if self._unseen_s is None or len(self._unseen_s) != count:
            self._unseen_s = self.last_seen.unseen_s(count)
        return self._unseen_s

    def follow(self, step: TrainingStep, observation: Observation) -> None:
        """Process the newest observation before the scene grows: test visibility, archive Gaussians
        if capacity is short, and restore those that come into view.
        """
        self._unseen_s = None
        kept_free = round(ROOM_SHARE * self._capacity)
        if self._frames % SEE_EVERY == 0 or self._capacity - step.gaussians.count < kept_free // 2:
            self.last_seen.see(step.at(observation.time_s), observation)
            self.make_room(step, observation, kept_free, UNSEEN_S)
        self._frames += 1
        if len(self.archive) and observation.camera != self._checked_from:
            self._checked_from = observation.camera
            if self.has_in_view(observation.camera):
                with torch.no_grad():
                    alpha = step.picture(step.at(observation.time_s), observation.camera, depth=False).alpha
                self.bring_back(step, observation, uncovered_pixels(alpha, torch.ones_like(observation.mask)))

    def has_in_view(self, camera: Camera) -> bool:
        """Return True if any archived Gaussian projects into a camera's picture."""
        return bool(self.archive.in_view(camera).any())

    def make_room(self, step: TrainingStep, observation: Observation, wanted: int, unseen_s: float) -> None:
        """Archive Gaussians until enough rows are free, as far as possible.

        Only Gaussians outside the picture are archived. Those hidden by a tool stay, since they
        can be uncovered at any moment.

        Args:
            step: training step of the scene.
            observation: newest observation.
            wanted: number of rows to free.
            unseen_s: seconds for which a Gaussian must have been out of view.
        """
        short = wanted - (self._capacity - step.gaussians.count)
        if short <= 0:
            return
        now = step.at(observation.time_s)
        margin_px = MARGIN_SHARE * observation.camera.width_px
        outside = ~pixels_of(now.means, observation.camera, margin_px)[1]
        leaving = self.last_seen.longest_unseen(short, observation.time_s - unseen_s, outside)
        if bool(leaving.any()):
            self.archive.put(now.select(leaving))
            self.last_seen.close_gaps(step.remove(leaving))

    def bring_back(self, step: TrainingStep, observation: Observation, wanted: Tensor) -> None:
        """Restore archived Gaussians whose centre is near a marked pixel of `wanted`, bool [H, W], as many as the
        capacity allows.
        Synchronises with the device.
        """
        marks = HostCopy(wanted).numpy().astype(np.uint8)
        if not marks.any():
            return
        near = torch.from_numpy(cv2.dilate(marks, np.ones((2 * REACH_PX + 1,) * 2, np.uint8)) > 0)
        back = self.archive.take_uncovered(observation.camera, near, self._capacity)
        if back is None:
            return
        self.last_seen.see(step.at(observation.time_s), observation)
        self.make_room(step, observation, back.count, unseen_s=0.0)
        room = self._capacity - step.gaussians.count
        if back.count > room:
            self.archive.put(back.select(slice(room, None)))
        step.append(back.select(slice(0, room)).to(wanted.device))
        self.last_seen.join(step.gaussians.count, observation.time_s)


class LastSeen:
    """Time at which each Gaussian was last visible, in seconds of the stream, in constant memory."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._times = torch.zeros(capacity, dtype=torch.float64, device=device)
        self._count = 0
        self._checked_s = 0.0

    def times(self) -> Tensor:
        """Return the times of the Gaussians in use, float64 [N], without a copy."""
        return self._times[: self._count]

    def join(self, count: int, time_s: float) -> None:
        """Set the number of Gaussians. Added Gaussians count as visible at `time_s`."""
        self._times[self._count : count] = time_s
        self._count = count

    def unseen_s(self, count: int) -> Tensor:
        """Return for each of `count` Gaussians how long it was out of view at the last update,
        float64 [count] seconds, as a copy. Visible and newly added ones get 0.
        """
        unseen = torch.zeros(count, dtype=self._times.dtype, device=self._times.device)
        unseen[: self._count] = (self._checked_s - self.times()).clamp(min=0)
        return unseen

    def restart(self) -> None:
        """Discard all visibility times, for a new scene whose Gaussians get theirs in `join`. The memory is kept."""
        self._count = 0

    def see(self, now: Gaussians, observation: Observation) -> None:
        """Mark Gaussians as visible whose centre is on tissue of the observation, and newly added ones.

        `now` is the scene at the observation's time. Occluded Gaussians count as visible.
        """
        self.join(now.count, observation.time_s)
        self._checked_s = observation.time_s
        pixels, inside = pixels_of(now.means, observation.camera)
        seen = inside & (value_at(observation.mask, pixels) > 0)
        self.times().masked_fill_(seen, observation.time_s)

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove the times of removed Gaussians. `moves` overwrites their rows with the last remaining rows."""
        moves.apply(self._times, 0.0)
        self._count = moves.count

    def longest_unseen(self, count: int, before_s: float, among: Tensor) -> Tensor:
        """Mark at most `count` Gaussians in `among`, bool [N], that were not visible since
        `before_s`, longest first. Returns bool [N].
        """
        times = self.times().masked_fill(~among, torch.inf)
        marks = torch.zeros(self._count, dtype=torch.bool, device=times.device)
        oldest = torch.argsort(times, stable=True)[:count]
        marks[oldest] = times[oldest] < before_s
        return marks


class Archive:
    """Gaussians removed from the scene in their last state, in bounded host memory."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._kept: Gaussians | None = None
        self.forgotten = 0
        """Number of Gaussians deleted from the full archive to make space for new ones, oldest first."""

    def __len__(self) -> int:
        return 0 if self._kept is None else self._kept.count

    def put(self, gaussians: Gaussians) -> None:
        """Copy Gaussians to the archive, from which they return when the camera sees their tissue again."""
        added = gaussians.map(lambda tensor: tensor.detach().to("cpu"))
        kept = added if self._kept is None else self._kept.append(added)
        self.forgotten += max(0, kept.count - self._capacity)
        self._kept = kept.map(lambda tensor: tensor[-self._capacity :].clone()) if self._capacity else None

    def in_view(self, camera: Camera) -> Tensor:
        """Return a mask of the archived Gaussians whose centre is in a camera's picture, one bool for each."""
        return torch.zeros(0, dtype=torch.bool) if self._kept is None else pixels_of(self._kept.means, camera)[1]

    def take_uncovered(self, camera: Camera, uncovered: Tensor, most: int) -> Gaussians | None:
        """Remove and return at most `most` Gaussians whose centre is on a marked pixel of
        `uncovered`, bool [H, W], newest first; None without any.
        """
        if self._kept is None or most <= 0:
            return None
        pixels, inside = pixels_of(self._kept.means, camera)
        wanted = torch.nonzero(inside & value_at(uncovered.cpu(), pixels)).flatten()[-most:]
        if len(wanted) == 0:
            return None
        taken = self._kept.select(wanted)
        stays = torch.ones(self._kept.count, dtype=torch.bool)
        stays[wanted] = False
        self._kept = self._kept.select(stays) if bool(stays.any()) else None
        return taken


USUAL_DENSITY = 0.3
"""Mean number of Gaussians per cell, over a cell and its eight neighbours, below which the cell counts as empty. A new
scene has about 1 per cell.
"""
MOVED_SHARE = 0.02
"""Motion of the picture, as a share of its width, after which the picture is searched again for new tissue; each search
takes some milliseconds.
"""
EDGE_CELLS = 1.0
"""Width in cells of the margin inside the previous picture's edge that counts as not yet seen, so that slow camera motion
leaves no gap.
"""


def has_moved(camera: Camera, before: Camera, distance: float) -> bool:
    """Return True if a point at `distance` moves in the picture by the share `MOVED_SHARE` of its width or more between two
    cameras, at the edges or the centre of the picture.
    """
    sides = np.array([0.0, 0.5, 1.0])
    pixels = np.stack(np.meshgrid(sides * camera.width_px, sides * camera.height_px), -1).reshape(-1, 2)
    if camera.model == before.model == "pinhole":
        x, y, z = _by_homography(pixels, camera, before, distance)
        earlier = np.stack([x, y], axis=1) / np.where(z > 0, z, np.inf)[:, None]
    else:
        earlier = pixels_of(_points_of(pixels, camera, distance), before)[0].numpy()
    return bool(np.abs(earlier - pixels).max() >= MOVED_SHARE * camera.width_px)


def _points_of(pixels: NDArray[np.float64], camera: Camera, distance: float) -> Tensor:
    """Return world points [M, 3] at `pixels` [M, 2] and a distance from a camera."""
    points, _ = unprojected(pixels, np.full(len(pixels), distance), camera)
    to_world = np.linalg.inv(camera.world_to_camera)
    return torch.from_numpy((points @ to_world[:3, :3].T + to_world[:3, 3]).astype(np.float32))


def _by_homography(
    pixels: NDArray[np.float64], camera: Camera, before: Camera, distance: float
) -> NDArray[np.floating]:
    """Return homogeneous pixel coordinates [3, M] in an earlier camera of the points that `pixels` [M, 2] show at a distance.

    Training waits for the result. Unprojecting and projecting each point instead takes ten times as long.
    """
    between = before.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    homography = distance * before.K @ between[:3, :3] @ np.linalg.inv(camera.K)
    moved: NDArray[np.floating] = homography[:, :2] @ pixels.T
    return moved + (homography[:, 2] + before.K @ between[:3, 3])[:, None]


def entered(
    pixels: NDArray[np.float64], camera: Camera, before: Camera, distance: float, edge_px: float = 0.0
) -> NDArray[np.bool_]:
    """Find pixels that show points outside of an earlier camera's picture.

    Args:
        pixels: positions [M, 2].
        camera: present camera.
        before: earlier camera.
        distance: assumed distance of the points from the present camera.
        edge_px: margin at the edge of the earlier picture that counts as not visible.

    Returns:
        bool [M]; True for pixels that came into view.
    """
    if camera.model == before.model == "pinhole":
        x, y, z = _by_homography(pixels, camera, before, distance)
        across = (x >= edge_px * z) & (x < (before.width_px - edge_px) * z)
        down = (y >= edge_px * z) & (y < (before.height_px - edge_px) * z)
        return ~(across & down & (z > 0))
    return ~pixels_of(_points_of(pixels, camera, distance), before, -edge_px)[1].numpy()


class NewTissue:
    """Grid cells of the picture that came into view with the newest frame."""

    def __init__(self, observation: Observation, before: Camera, spacing: float, distance: float) -> None:
        self._camera, self._spacing = observation.camera, spacing
        self._grid, self._shape = grid_of(self._camera.height_px, self._camera.width_px, spacing)
        self._entered = entered(self._grid, self._camera, before, distance, EDGE_CELLS * spacing)

    def __bool__(self) -> bool:
        return bool(self._entered.any())

    def _empty(self, now: Gaussians) -> tuple[Tensor, Tensor]:
        """Return the cells that came into view and have almost no Gaussians, bool [rows, columns], and the mean depth
        around each cell.
        """
        count, depth = around_cells(now, self._camera, self._spacing, self._shape)
        return tensor_of(self._entered.reshape(self._shape), now.device) & (count < 9 * USUAL_DENSITY), depth

    def pixels(self, now: Gaussians) -> Tensor:
        """Return the pixels of the grid cells that came into view and have almost no Gaussians, bool [H, W].

        Does not synchronise with the device.
        """
        return self._of_cells(self._empty(now)[0])

    def unfilled(self, now: Gaussians, mask: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the centres [M, 2] of empty new cells on tissue, and the scene's depth [H, W], 0 where unknown.

        Depth is the mean over Gaussians. A rendered depth is biased towards the camera. Tissue created at it would come
        nearer with every step of a moving camera. Synchronises with the device.
        """
        empty, depth = self._empty(now)
        wanted = HostCopy(empty.flatten() & (value_at(mask, tensor_of(self._grid, mask.device)) > 0))
        depth_mm = HostCopy(self._of_cells(depth))
        return self._grid[wanted.numpy()], depth_mm.numpy()

    def _of_cells(self, values: Tensor) -> Tensor:
        """Expand the values of grid cells [rows, columns] to all pixels of each cell, [H, W]."""
        size = self._camera.height_px, self._camera.width_px
        row, column = (
            (torch.arange(pixels, device=values.device) / self._spacing).long().clamp(max=cells - 1)
            for pixels, cells in zip(size, self._shape, strict=True)
        )
        return values[row][:, column]


def fill_new_tissue(
    step: TrainingStep,
    frame: Frame,
    observation: Observation,
    before: Camera,
    config: ReconstructorConfig,
    out_of_view: OutOfView | None,
) -> None:
    """Fill tissue that came into view before the first step on a frame, from the archive or with new Gaussians.

    Without this, training would stretch neighbouring Gaussians over the new tissue. They would then follow the
    picture's edge as the camera moves.

    Args:
        step: training step of the scene.
        frame: newest frame.
        observation: the same frame as tensors.
        before: camera at the last search for new tissue.
        config: settings.
        out_of_view: archive of the scene, or None.
    """
    camera = observation.camera
    spacing = grid_spacing(camera.width_px * camera.height_px, config.gaussians)
    new = NewTissue(observation, before, spacing, step.distance(camera))
    if not new:
        return
    if out_of_view is not None and out_of_view.has_in_view(camera):
        out_of_view.bring_back(step, observation, new.pixels(step.at(observation.time_s)))
    now = step.at(observation.time_s)
    wanted, depth_mm = new.unfilled(now, observation.mask)
    if out_of_view is not None and len(wanted):
        out_of_view.last_seen.see(now, observation)
        out_of_view.make_room(step, observation, len(wanted), unseen_s=0.0)
    most = config.max_gaussians - step.gaussians.count
    known_mm = depth_mm if frame.depth is None else frame.depth
    added = gaussians_beside(wanted, frame, known_mm, observation, config, most)
    if added is not None:
        step.append(added)


DEPTH_STEPS = 2**24
"""Number of quantisation steps from 0 to the largest depth in integer sums of depths; as fine as float32."""


def around_cells(
    now: Gaussians, camera: Camera, spacing: float, shape: tuple[int, int], reach: int = 1
) -> tuple[Tensor, Tensor]:
    """Count Gaussian centres around each cell of a picture grid and average their depth.

    Args:
        now: the scene at the camera's time.
        camera: camera of the picture.
        spacing: side of a cell in pixels.
        shape: number of rows and columns of cells.
        reach: number of neighbouring cells on each side that are included, also beyond the picture's edge.

    Returns:
        Number of centres and their mean depth (0 for none), float32 [rows, columns] each.
    """
    rows, columns = (cells + 2 * reach for cells in shape)
    pixels, near = pixels_of(now.means, camera, margin_px=reach * spacing)
    cells = torch.floor(pixels / spacing).long() + reach
    inside = near & (cells[:, 0] < columns) & (cells[:, 1] < rows) & (cells >= 0).all(1)
    index = torch.where(inside, cells[:, 1] * columns + cells[:, 0], 0)
    depth = depth_of(now.means, camera)
    # Integer sums on a GPU do not depend on the order of summation.
    quantum = depth.abs().amax().clamp(min=1e-30) / DEPTH_STEPS if len(depth) else depth.new_ones(())
    each = torch.stack([torch.ones_like(index), torch.round(depth / quantum).long()]) * inside
    sums = each.new_zeros(2, rows * columns).index_add_(1, index, each).to(torch.float32)
    width = 2 * reach + 1
    count, total = torch.nn.functional.avg_pool2d(sums.view(2, rows, columns), width, stride=1) * width**2
    return count, total / count.clamp(min=1) * quantum
