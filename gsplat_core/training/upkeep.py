"""Maintenance of a scene that is trained without end, and recognition of earlier scenes to which a stream returns.

Adam moves every parameter by about its learning rate even if pictures hardly constrain it. Unconstrained parameters
therefore drift. Thin Gaussians become needles, opacities and colours diverge, quaternions grow, depths spread along the
line of sight of a static camera, and Gaussians that drift off the tissue never return. The tissue then gets holes. New
Gaussians fill the holes until the capacity is exhausted and the quality falls.

Scenes that a stream has left are kept to recognise a scene that returns, and to reuse the memory of the last one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.endoscope.reduced import averaged
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import (
    Covering,
    LastSeen,
    OutOfView,
    around_cells,
    fill_new_tissue,
    grid_spacing,
    has_moved,
)
from gsplat_core.training.initialisation import SIGMA_IN_SPACINGS
from gsplat_core.training.motion_prior import Following
from gsplat_core.training.observations import Observation, depth_of, pixels_of, value_at
from gsplat_core.training.steps.step import TrainingStep

RELAX_EVERY = 128
"""Number of training steps between two rounds in which sizes, opacities and colours relax towards default values."""
RENEW_EVERY = 512
"""Training steps between two searches for useless Gaussians and sparse tissue, which take milliseconds on a GPU."""
RELAXING_STEPS = 3600
"""Time constant in steps with which sizes, opacities and colours relax to default values where
training does not hold them.
"""
THINNEST_PX = 0.2
"""Smallest standard deviation in pixels; smaller ones give equal pictures because of the renderer's blur of 0.55 px."""
WIDEST = 8.0
"""Largest standard deviation of a Gaussian, in multiples of the default size of new Gaussians."""
MOST_SPLIT = 0.02
"""Largest share of the Gaussians that are split in one round."""
SURFACE_STEPS = 100_000
"""Time constant in steps with which depths relax to those of the Gaussians around. It is long, because training also
learns the order along a line of sight.
"""
SURFACE_CELL = 2.0
"""Side of the cells with averaged depth, in default spacings of Gaussians."""
SURFACE_REACH = 2
"""Number of neighbouring cells on each side whose Gaussians count in the mean depth around a cell."""
IDLE = 1e-3
"""Ratio of a Gaussian's mean squared opacity gradient to the mean over all Gaussians, below which the Gaussian counts as idle.
The ratio falls below it after about 7,000 steps without visibility.
"""


@dataclass(frozen=True)
class Seen:
    """Gaussians of a scene at a frame's time, projected to that frame's picture."""

    now: Gaussians
    """Gaussians of the scene at the frame's time."""
    pixels: Tensor
    """Pixel positions of the Gaussians' centres, [N, 2]."""
    inside: Tensor
    """True for Gaussians whose centre is in the picture, bool [N]."""
    shown: Tensor
    """True for Gaussians whose centre is in the picture and on tissue, bool [N]."""


class Upkeep:
    """Maintenance of one scene, whose first camera is `camera`."""

    def __init__(self, camera: Camera, config: ReconstructorConfig) -> None:
        self._first_camera, self._capacity = camera, config.max_gaussians
        self._spacing_px = grid_spacing(camera.width_px * camera.height_px, config.gaussians)
        self._relaxed_at = self._renewed_at = 0
        self._has_moved = False

    def __call__(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Run the maintenance that is due, which synchronises with the device. Rows of `last_seen` follow the scene's."""
        self._has_moved = self._has_moved or observation.camera != self._first_camera
        if step.steps - self._relaxed_at < RELAX_EVERY:
            return
        with torch.no_grad():
            seen = self._examine(step, observation)
            self._relax(step, seen, observation.camera)
            if step.steps - self._renewed_at >= RENEW_EVERY:
                self._renew(step, seen, observation, last_seen, self._useless(step, seen))

    def once(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Run all maintenance immediately, as if the first Gaussian were useless. For warm-up."""
        with torch.no_grad():
            seen = self._examine(step, observation)
            self._relax(step, seen, observation.camera)
            self._useless(step, seen)
            first = torch.arange(step.gaussians.count, device=seen.shown.device) == 0
            self._renew(step, seen, observation, last_seen, first)
            count = step.gaussians.count
            if count < self._capacity:
                step.split(step.busiest(1, first.new_ones(count)))
            if last_seen is not None:
                last_seen.join(step.gaussians.count, observation.time_s)

    def _examine(self, step: TrainingStep, observation: Observation) -> Seen:
        now = step.at(observation.time_s)
        pixels, inside = pixels_of(now.means, observation.camera)
        return Seen(now, pixels, inside, inside & (value_at(observation.mask, pixels) > 0))

    def _renew(
        self, step: TrainingStep, seen: Seen, observation: Observation, last_seen: LastSeen | None, leaving: Tensor
    ) -> None:
        """Relax depths and rotations if the field supports it, remove Gaussians in `leaving`, bool
        [N], and split others in sparse tissue.
        """
        since, self._renewed_at = step.steps - self._renewed_at, step.steps
        if step.capabilities.motion is not None:
            step.scale_about(observation.camera, self._towards_surface(step, seen, since, observation))
        step.shorten_rotations()
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)
        shown = seen.shown & ~leaving
        if bool(leaving.any()):
            moves = step.remove(leaving)
            shown = shown[moves.order]
            if last_seen is not None:
                last_seen.close_gaps(moves)
        self._fill_up(step, observation, shown)
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)

    def _relax(self, step: TrainingStep, seen: Seen, camera: Camera) -> None:
        """Relax visible Gaussians towards the default size, opacity 0.5 and grey. Limit the sizes of all Gaussians."""
        share = 1 - math.exp((self._relaxed_at - step.steps) / RELAXING_STEPS)
        self._relaxed_at = step.steps
        scene, pixel = step.gaussians, step.distance(camera) / float(camera.K[0, 0])
        usual = SIGMA_IN_SPACINGS * self._spacing_px * pixel
        part = share * seen.shown.to(scene.means.dtype)
        scene.log_scales.add_(part[:, None] * (math.log(usual) - scene.log_scales))
        scene.log_scales.clamp_(math.log(THINNEST_PX * pixel), math.log(WIDEST * usual))
        scene.logit_opacities.sub_(part * scene.logit_opacities)
        for colours in (scene.sh, scene.right_sh):
            if colours is not None:
                colours.sub_(part[:, None, None] * colours)

    def _towards_surface(self, step: TrainingStep, seen: Seen, since: int, observation: Observation) -> Tensor:
        """Return distance factors [N] that relax visible Gaussians to the depth around them, for `since` steps.

        The camera sees the same picture. If it moves or depth is known, training counteracts errors. Otherwise all
        depths would drift together, because equal steps along the line of sight are unequal in the picture. The median
        distance of visible Gaussians is then kept constant.
        """
        camera = observation.camera
        spacing = SURFACE_CELL * self._spacing_px
        cells = math.ceil(camera.height_px / spacing), math.ceil(camera.width_px / spacing)
        _, around = around_cells(seen.now, camera, spacing, cells, SURFACE_REACH)
        depth = depth_of(seen.now.means, camera)
        share = 1 - math.exp(-since / SURFACE_STEPS)
        factor = 1 + share * (value_at(around, seen.pixels / spacing) / depth - 1)
        if observation.depth is None and not self._has_moved:
            factor = factor * (step.distance(camera) / depth.masked_fill(~seen.shown, torch.nan).nanmedian())
        return torch.where(seen.shown, factor, 1.0)

    def _useless(self, step: TrainingStep, seen: Seen) -> Tensor:
        """Return which idle Gaussians can be removed, bool [N].

        Inside the picture, these are all but one per grid cell, since a tool that hides them may leave. Outside the
        picture, these are all if the camera never moved, otherwise none.
        """
        idle = step.idle(IDLE)
        inside = idle & seen.inside
        crowded = inside & _repeated(torch.floor(seen.pixels / self._spacing_px), inside)
        return crowded if self._has_moved else crowded | (idle & ~seen.inside)

    def _fill_up(self, step: TrainingStep, observation: Observation, shown: Tensor) -> None:
        """Split those of the `shown` Gaussians, bool [N], that have the largest gradients, towards the initial density;
        at most the share `MOST_SPLIT` of all Gaussians.
        """
        wanted = torch.count_nonzero(observation.mask) / self._spacing_px**2
        missing = int(wanted - torch.count_nonzero(shown))
        count = min(missing, round(MOST_SPLIT * step.gaussians.count), self._capacity - step.gaussians.count)
        if count > 0:
            step.split(step.busiest(count, shown))


REVEALED_SHARE = 0.01
"""Width of a newly revealed strip, as a share of the picture's width, from which new tissue is
searched before the first step.
"""


class PostponedGrowth:
    """Growth and maintenance of live scenes, most of which waits until a frame has been displayed."""

    def __init__(self, config: ReconstructorConfig, device: torch.device, covering: Covering) -> None:
        self._config, self._covering = config, covering
        self._out_of_view = OutOfView(config.max_gaussians, device) if config.preallocate else None
        self._upkeep: Upkeep | None = None
        self._camera_before: Camera
        """Camera of the scene's first frame, or at the last search for tissue that came into view."""

    @property
    def archived(self) -> int:
        return 0 if self._out_of_view is None else len(self._out_of_view.archive)

    def unseen_s(self, count: int) -> Tensor | None:
        """Return `Model.unseen_s` of the scene's `count` Gaussians; None if it is not recorded."""
        return None if self._out_of_view is None else self._out_of_view.unseen_s(count)

    def begin(self, camera: Camera) -> None:
        """Start a scene whose first frame is observed by `camera`."""
        if self._out_of_view is not None:
            self._out_of_view.restart()
        self._upkeep = None if self._config.history_s is None else Upkeep(camera, self._config)
        self._camera_before = camera

    def prepare(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        """Fill tissue that came into view because the camera moved or because the motion prior moved the scene away
        from an edge. Called before the first training step on every frame but the first of a scene.
        """
        before, camera = self._camera_before, observation.camera
        if before != camera and has_moved(camera, before, step.distance(camera)):
            self._camera_before = camera
            fill_new_tissue(step, frame, observation, before, self._config, self._out_of_view)
        if motion.has_revealed(REVEALED_SHARE * camera.width_px):
            self._cover(step, frame, observation, motion)

    def finish(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        """Archive, restore, maintain and add Gaussians after the display of the newest frame."""
        if self._out_of_view is not None:
            self._out_of_view.follow(step, observation)
        if self._upkeep is not None:
            self._upkeep(step, observation, self._last_seen)
        self._cover(step, frame, observation, motion)

    def once(self, step: TrainingStep, observation: Observation) -> None:
        """Run all maintenance immediately, forcing eviction. For warm-up."""
        if self._upkeep is not None:
            self._upkeep.once(step, observation, self._last_seen)

    @property
    def _last_seen(self) -> LastSeen | None:
        return None if self._out_of_view is None else self._out_of_view.last_seen

    def _cover(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        self._covering.cover(step, frame, observation)
        motion.cover_revealed()


def _repeated(cells: Tensor, counted: Tensor) -> Tensor:
    """Mark elements whose integer cell [N, 2] an earlier element has, too, bool [N]. Only `counted` elements take part."""
    count = len(cells)
    number = cells[:, 1].double() * 2**20 + cells[:, 0].double()
    # Give every element that is not counted a cell of its own, so that it repeats none.
    number = torch.where(counted, number, -1.0 - torch.arange(count, device=cells.device))
    ordered, order = number.sort(stable=True)
    marks = torch.zeros(count, dtype=torch.bool, device=cells.device)
    marks[order[1:]] = ordered[1:] == ordered[:-1]
    return marks & counted


MOST_PLACES = 8
"""Largest number of earlier scenes that are stored. The oldest is dropped."""
RENDERED_PX = 160
"""Width in pixels at which an earlier scene is rendered for comparison."""
COMPARED_PX = 64
"""Width at which pictures are compared, in pixels; small enough to tolerate motion of a few pixels."""
SAMPLES = 4
"""Number of samples of a frame, along each axis, that are averaged for one pixel of a compared picture."""
FINE_PX, COARSE_PX = 1.0, 16.0
"""Standard deviations, in pixels of the compared pictures, of the band-pass filter that removes noise and illumination.
"""
SAME_PLACE = 0.75
"""Correlation from which a picture counts as showing an earlier scene. See benchmarks/results/constants.md."""
LEAST_SHARE = 0.3
"""Smallest share of the picture that must be both tissue and covered by the earlier scene."""


@dataclass(frozen=True)
class Structure:
    """Band-pass filtered small picture, which is compared with others.

    Noise, illumination, gain and offset of its channels have no effect on comparisons.
    """

    values: NDArray[np.float32]
    """Filtered colours [H, W, 3]; only those of known pixels are meaningful."""
    known: NDArray[np.bool_]
    """[H, W]; True where the picture shows tissue."""

    @classmethod
    def of(cls, image: NDArray[np.float32], known: NDArray[np.bool_]) -> Structure:
        """Filter a picture.

        Args:
            image: colours [H, W, 3] in 0..1, `COMPARED_PX` wide.
            known: [H, W]; other pixels have no effect.
        """
        weight = known.astype(np.float32)
        image = np.asarray(image, np.float32) * weight[..., None]
        near = _blurred(image, FINE_PX) / (_blurred(weight, FINE_PX) + 1e-6)[..., None]
        far = _blurred(image, COARSE_PX) / (_blurred(weight, COARSE_PX) + 1e-6)[..., None]
        return cls(near - far, known)

    def likeness(self, other: Structure) -> float:
        """Return the correlation with another structure of the same size, -1 to 1, where both are known: the mean over
        the channels. 0 if too little is known.
        """
        known = self.known & other.known
        if np.count_nonzero(known) < LEAST_SHARE * known.size:
            return 0.0
        at = np.flatnonzero(known)
        of_channels = []
        for channel in range(3):
            first, second = (each.values[..., channel].reshape(-1)[at] for each in (self, other))
            first, second = first - first.mean(), second - second.mean()
            norm = float(np.linalg.norm(first) * np.linalg.norm(second))
            of_channels.append(float(first @ second) / norm if norm > 1e-6 else 0.0)
        return float(np.mean(of_channels))


@dataclass
class Place:
    """Earlier scene, which the stream has left."""

    gaussians: Gaussians
    """Last state of the Gaussians, without a deformation field, in host memory after `Places.to_host`."""
    camera: Camera
    """Camera that last observed this scene."""
    left_s: float
    """Time in seconds when the stream left this scene."""
    _seen: dict[Camera, Structure] = field(default_factory=dict, repr=False)

    def structure(self, camera: Camera) -> Structure:
        """Render the earlier scene from a camera and return the band-pass filtered picture.

        The result for the last camera is cached.
        """
        if camera not in self._seen:
            with torch.no_grad():
                output = render(self.gaussians.to("cpu"), camera.scaled(RENDERED_PX / camera.width_px), depth=False)
            size = compared_size(camera.width_px, camera.height_px)
            pictures = (output.image.numpy(), output.alpha.numpy())
            image, alpha = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures)
            self._seen = {camera: Structure.of(np.asarray(image, np.float32), alpha > 0.5)}
        return self._seen[camera]


class Places:
    """Store of the scenes that the stream left most recently."""

    def __init__(self) -> None:
        self._left: list[Place] = []

    def __len__(self) -> int:
        return len(self._left)

    def leave(self, gaussians: Gaussians, camera: Camera, time_s: float, seen: Structure | None = None) -> None:
        """Keep a copy of a scene. It stays on its device until the next call of `to_host` or this method.

        Args:
            gaussians: last state of the scene.
            camera: camera that last observed the scene.
            time_s: time in seconds at which the stream left the scene.
            seen: structure of a picture of the scene from that camera; None to render it when it is needed.
        """
        self.to_host()
        kept = gaussians.map(lambda tensor: tensor.detach().to(torch.float32, copy=True))
        place = Place(kept, camera, time_s, {} if seen is None else {camera: seen})
        self._left = [*self._left, place][-MOST_PLACES:]

    def to_host(self) -> None:
        """Move all scenes to host memory. The first picture of the next scene need not wait for that."""
        for place in self._left:
            place.gaussians = place.gaussians.to("cpu")

    def take(self, frame: Frame) -> Place | None:
        """Remove and return the earlier scene that a frame shows, or None if it shows none.

        Each earlier scene is seen from the frame's pose or, without a pose, from its last camera. The comparison
        ignores the frame's exposure and white balance.
        """
        if not self._left:
            return None
        shown = _shown(frame)
        likeness = [place.structure(_seen_by(place, frame)).likeness(shown) for place in self._left]
        best = int(np.argmax(likeness))
        return self._left.pop(best) if likeness[best] >= SAME_PLACE else None


def _seen_by(place: Place, frame: Frame) -> Camera:
    """Return the camera from which an earlier scene is rendered for the comparison with a frame."""
    camera = place.camera.resized(frame.width_px, frame.height_px)
    return camera if frame.pose is None else camera.with_pose(frame.pose)


def structure_of(frame: Frame) -> Structure | None:
    """Return the structure of the tissue in a frame; None if it shows too little tissue to be compared."""
    shown = _shown(frame)
    return shown if np.count_nonzero(shown.known) >= LEAST_SHARE * shown.known.size else None


def _shown(frame: Frame) -> Structure:
    size = compared_size(frame.width_px, frame.height_px)
    samples = SAMPLES * size[0], SAMPLES * size[1]
    known = np.ones((size[1], size[0]), bool)
    for mask in (frame.mask, frame.loss_mask):
        if mask is not None:
            some = cv2.resize(mask, samples, interpolation=cv2.INTER_NEAREST) > 0
            known &= (
                averaged(some.view(np.uint8) * np.uint8(255), size, SAMPLES) >= 128
            )  # set in half of the samples or more
    return Structure.of(averaged(frame.image, size, SAMPLES).astype(np.float32) / np.float32(255), known)


class LeftScenes:
    """Scenes that a stream has left: their last states, and the memory of the newest one.

    A scene of the same picture size reuses that memory, so that captured graphs stay valid.
    """

    def __init__(self) -> None:
        self.places = Places()
        self._recognised: tuple[int, Place] | None = None
        """Number of the frame that starts the next scene, and the earlier scene that this frame shows; None if it shows
        none.
        """
        self._kept: TrainingStep | None = None
        self._kept_size: tuple[int, int] | None = None
        """Picture size (width, height) of the scene that was started last, whose memory the next scene may reuse."""

    def forget(self) -> None:
        """Discard all earlier scenes."""
        self.places, self._recognised = Places(), None

    def leave(self, step: TrainingStep, camera: Camera, time_s: float, frame: Frame | None) -> None:
        """Keep the last state of a scene to recognise it later.

        Args:
            step: training of the scene.
            camera: camera that last observed the scene.
            time_s: time of the last observation in seconds.
            frame: frame of that observation, whose picture is compared with later frames in place of a rendering of the scene.
                None to render the scene for the first comparison, which delays the picture of the later frame by more than
                half a frame interval.
        """
        self.places.leave(step.at(time_s), camera, time_s, None if frame is None else structure_of(frame))

    def recognise(self, frame: Frame) -> bool:
        """Return True if the frame, which starts the next scene, shows a scene that the stream left before."""
        place = self.places.take(frame)
        self._recognised = None if place is None else (frame.seq, place)
        return place is not None

    def recognised(self, seq: int) -> Gaussians | None:
        """Return the Gaussians of the earlier scene that frame `seq` was found to show; None if it shows no earlier one."""
        return self._recognised[1].gaussians if self._recognised and self._recognised[0] == seq else None

    def keep_memory(self, step: TrainingStep | None) -> None:
        """Keep the tensors of a scene, to be reused by the next scene. None leaves the scene kept before unchanged."""
        self._kept = step or self._kept

    def restarted(self, gaussians: Gaussians, observation: Observation) -> TrainingStep | None:
        """Start a scene of these Gaussians from its first observation in the memory of the previous
        scene. Return None if there is no such memory or the scene does not fit into it.
        """
        kept, self._kept = self._kept, None
        size = observation.camera.width_px, observation.camera.height_px
        same_size, self._kept_size = size == self._kept_size, size
        if kept is None or not same_size:
            return None
        return kept if kept.restart(gaussians, observation.time_s, observation.camera) else None


def compared_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Return width and height in pixels to which pictures of this aspect ratio are reduced, to compare them with an earlier
    scene.
    """
    return COMPARED_PX, max(1, round(COMPARED_PX * height_px / width_px))


def _blurred(plane: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma_px), np.float32)
