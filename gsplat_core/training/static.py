"""Trainer of a static scene: 3DGS's optimisation (Kerbl et al. 2023) with the defaults of gsplat's example trainer.

Learning rates and densification thresholds of 3DGS assume cameras at a distance of about 1 from what they see. Scenes of
COLMAP have an arbitrary unit, so training uses centred and scaled coordinates, and the result is converted back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidSetting, RecordingInvalid
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.io.recordings.colmap import ColmapScene, PosedImage
from gsplat_core.ops.adam import adam_step_queued
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.strategies.adc import DefaultStrategy
from gsplat_core.training.strategies.mcmc import MCMCStrategy

LEAST_POINTS = 4
"""Minimum number of points, so that each has three neighbours, from whose distance its scale follows."""
MOST_LOCATED = 10_000
"""Largest number of points that are projected to check that some image shows a point. Of a larger set, only every k-th point
is projected.
"""
SCENE_MARGIN = 1.1
"""Ratio of a scene's extent (gsplat's `scene_scale`) to the largest distance of a camera from the cameras' mean position."""


@dataclass(frozen=True)
class TrainingPicture:
    """Picture with its camera."""

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    """RGB [H, W, 3], of the camera's size."""


@dataclass(frozen=True)
class Points:
    """Points from structure from motion, from which the Gaussians are initialised."""

    positions: NDArray[np.float64]
    """Positions of the points in the world, [N, 3]."""
    colours: NDArray[np.uint8]
    """Colours of the points, RGB [N, 3]."""


@dataclass(frozen=True)
class TrainingCoordinates:
    """Similarity transform from the world to training coordinates: x ↦ (x - centre) · factor."""

    centre: NDArray[np.float64]
    """Point [3] nearest to the optical axes, in world units."""
    factor: float
    """Training units per world unit: inverse of the cameras' median distance from the centre in world units."""

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> TrainingCoordinates:
        """Return coordinates in which the centre of attention is 0 and the cameras' median distance is 1.

        Cameras with one optical axis, or at one place, see no centre. Their mean position is used instead.
        """
        positions = np.stack([camera.position for camera in cameras])
        centre = _nearest_to_axes(positions, np.stack([camera.world_to_camera[2, :3] for camera in cameras]))
        distance = float(np.median(np.linalg.norm(positions - centre, axis=1)))
        return cls(centre, 1 / distance if distance > 0 else 1.0)

    def camera(self, camera: Camera) -> Camera:
        """Return a camera with its pose in training coordinates."""
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ self.centre) * self.factor
        return camera.with_pose(pose)

    def positions(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions [N, 3] to training coordinates."""
        return (positions - self.centre) * self.factor

    def to_world(self, gaussians: Gaussians) -> Gaussians:
        """Convert Gaussians in training coordinates to world coordinates."""
        centre = torch.tensor(self.centre, dtype=gaussians.dtype, device=gaussians.device)
        return replace(
            gaussians,
            means=gaussians.means / self.factor + centre,
            log_scales=gaussians.log_scales - float(np.log(self.factor)),
        )


def _nearest_to_axes(positions: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point [3] nearest to the optical axes (least squares); the mean position if they are almost parallel."""
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(0)
    if np.linalg.cond(system) > 1e4:
        return np.asarray(positions.mean(0))
    return np.asarray(np.linalg.solve(system, (across @ positions[:, :, None]).sum(0))[:, 0])


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Return the extent of a scene by its cameras, gsplat's `scene_scale`; 1 if all cameras are at one place."""
    positions = np.stack([camera.position for camera in cameras])
    return float(SCENE_MARGIN * np.linalg.norm(positions - positions.mean(0), axis=1).max()) or 1.0


def read_pictures(
    scene: ColmapScene,
    posed: Sequence[PosedImage],
    images: str = "images",
    scale: float = 1.0,
    read: Callable[[int], None] | None = None,
) -> tuple[TrainingPicture, ...]:
    """Read pictures of a scene into memory.

    Args:
        scene: scene of the pictures.
        posed: pictures to read.
        images: folder of the image files inside the scene.
        scale: factor on their size.
        read: called with the number of pictures read so far.

    Raises:
        RecordingInvalid: if a file is missing or damaged, or its shape differs from that of its camera.
        InvalidSetting: if nothing is left of a picture at `scale`.
    """
    pictures = []
    for number, each in enumerate(posed, 1):
        pictures.append(TrainingPicture(each.name, *scene.read(each, images, scale)))
        if read is not None:
            read(number)
    return tuple(pictures)


def read_points(scene: ColmapScene) -> Points:
    """Read the points of a scene.

    Raises:
        RecordingError: if there are fewer than `LEAST_POINTS` points, no image shows one, or their file is missing or
            malformed.
    """
    positions, colours = scene.points()
    if len(positions) < LEAST_POINTS:
        raise RecordingInvalid(
            f"{scene.sparse} has {len(positions)} points, and training begins with at least {LEAST_POINTS}; export the scene with its points3D"
        )
    some = positions[:: -(-len(positions) // MOST_LOCATED)]
    if not any(_shows_a_point(each.camera, some) for each in scene.images):
        raise RecordingInvalid(
            f"none of the {len(positions)} points in {scene.sparse} is inside a picture; poses and points do not belong"
            " together, so export the scene again"
        )
    return Points(positions, colours)


def _shows_a_point(camera: Camera, positions: NDArray[np.float64]) -> bool:
    seen = positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    seen = seen[seen[:, 2] > 0] @ camera.K.T
    inside = (seen[:, :2] >= 0) & (seen[:, :2] <= seen[:, 2:] * [camera.width_px, camera.height_px])
    return bool(inside.all(1).any())


class CompiledAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) over dense float32 tensors.

    Its state has the names of `torch.optim.Adam` (`step`, `exp_avg`, `exp_avg_sq`), which strategies edit row by row. A
    row with a non-finite gradient keeps its values.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        """Create the optimiser; arguments are those of `torch.optim.Adam`."""
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update every tensor that has a gradient, without waiting for the device. Returns the loss of `closure`, which
        is called first, None without one.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and parameter.numel():
                    self._update(parameter, parameter.grad.contiguous(), group)
        return loss

    def _update(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)  # on the host, as `torch.optim.Adam` keeps it without `capturable`
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
        state["step"] += 1
        adam_step_queued(
            parameter, gradient, state["exp_avg"], state["exp_avg_sq"], int(state["step"]), group["lr"],
            group["betas"], group["eps"], row_size=max(1, parameter.numel() // max(1, parameter.shape[0])),
        )  # fmt: skip


FULL_STEPS = 30_000
"""Number of steps of a full training, for which all schedules are given; shorter trainings shorten them in proportion."""
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
"""Learning rates of Adam. That of the means is multiplied by the extent of the scene."""
MEANS_DECAY = 0.01
"""Factor by which the rate of the means falls exponentially over a training."""
SH_EVERY = 1000
"""Number of steps, of a training with `FULL_STEPS`, after which another degree of the spherical harmonics is used."""
EPSILON = 1e-15
NEIGHBOURS = 3
"""Number of neighbours whose root mean squared distance, times `Start.scale`, is the initial scale of a Gaussian."""
LEAST_SCALE = 1e-7
"""Minimum initial scale of a Gaussian in training coordinates, for points that coincide."""
NEAR_PLANE = 0.01


@dataclass(frozen=True)
class Start:
    """Initial scale and opacity of the Gaussians, and weights of the regularisers, that suit a densification strategy."""

    opacity: float = 0.1
    scale: float = 1.0
    """Factor on the initial scales."""
    opacity_weight: float = 0.0
    """Weight of the mean opacity in the loss."""
    scale_weight: float = 0.0
    """Weight of the mean scale in the loss."""


STARTS = {"adc": Start(), "mcmc": Start(0.5, 0.1, 0.01, 0.01), "none": Start()}
"""Initial values and regularisation for each strategy: adaptive density control, MCMC, and a fixed number of Gaussians."""
ABSGRAD_THRESHOLD = 0.0008
"""Mean gradient above which a Gaussian is duplicated or split, with the option `absgrad` (Ye et al. 2024)."""
REFINE_EVERY = 100
RESETS_AT_LEAST = 10
"""Smallest interval between resets of the opacities, in refinements; keeps short trainings from resetting too often."""


@dataclass(frozen=True)
class StaticConfig:
    """Options of the training of a static scene.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    steps: int = FULL_STEPS
    strategy: str = "adc"
    """Name of the densification strategy, in `STARTS`."""
    max_gaussians: int = 1_000_000
    """Number of Gaussians at which `mcmc` stops to add, and after which `adc` multiplies none."""
    absgrad: bool = False
    """Let `adc` use sums of absolute gradients."""
    sh_degree: int = 3
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM; that of L1 is the rest."""

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InvalidSetting(f"steps is {self.steps}; it must be at least 1")
        if self.strategy not in STARTS:
            raise InvalidSetting(f"unknown strategy {self.strategy!r:.60}; static scenes have {', '.join(STARTS)}")
        if self.max_gaussians < 1:
            raise InvalidSetting(f"max_gaussians is {self.max_gaussians}; it must be at least 1")
        if self.absgrad and self.strategy != "adc":
            raise InvalidSetting(f"absgrad belongs to strategy adc, and the strategy is {self.strategy}; leave it out")
        if not 0 <= self.sh_degree <= 4:
            raise InvalidSetting(f"sh_degree is {self.sh_degree}; it must be 0 to 4")

    @property
    def start(self) -> Start:
        """Initial values of the strategy."""
        return STARTS[self.strategy]

    def shortened(self, steps: int) -> int:
        """Return a number of steps of a full schedule in proportion to the length of this training, at least 1."""
        return max(1, round(steps * min(1.0, self.steps / FULL_STEPS)))

    def new_strategy(self, pictures: int, generator: torch.Generator) -> DefaultStrategy | MCMCStrategy | None:
        """Return the strategy with its schedule for this length; None for a fixed number of Gaussians.

        Between two refinements, every picture is trained on at least once, but no refinement waits longer than in a full
        training.
        """
        every = max(min(REFINE_EVERY, pictures), self.shortened(REFINE_EVERY))
        schedule: dict[str, Any] = {"refine_start_iter": self.shortened(500), "refine_every": every}
        if self.strategy == "adc":
            stop, reset = self.shortened(15_000), max(self.shortened(3000), RESETS_AT_LEAST * every)
            if 2 * reset > stop:
                reset = self.steps  # no reset within the training, which is too short to recover from one
            if self.absgrad:
                schedule["grow_grad2d"] = ABSGRAD_THRESHOLD
            return DefaultStrategy(
                **schedule, refine_stop_iter=stop, reset_every=reset, absgrad=self.absgrad, generator=generator,
            )  # fmt: skip
        if self.strategy == "mcmc":
            return MCMCStrategy(
                self.max_gaussians, **schedule, refine_stop_iter=self.shortened(25_000), generator=generator
            )
        return None


@dataclass(frozen=True)
class StaticStep:
    """Result of one training step."""

    step: int
    """Number of the step, from 0."""
    loss: Tensor
    """Loss of the step, a scalar on the device."""
    picture: int
    """Index of the picture trained on."""


class StaticTrainer:
    """Gaussians of a static scene with their optimisers.

    `params` and `optimizers` are dictionaries with the keys `means`, `scales` (logarithms), `quats`, `opacities` (logits),
    `sh0` and `shN`, which strategies of gsplat's interface edit. Values are in training coordinates.
    """

    def __init__(
        self,
        pictures: Sequence[TrainingPicture],
        points: Points,
        config: StaticConfig | None = None,
        *,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """Initialise a Gaussian at each point.

        Args:
            pictures: pictures to train on, at least one.
            points: initial positions and colours.
            config: options.
            seed: seed of the order of pictures and of the initial rotations.
            device: device that trains.
        """
        if not pictures:
            raise InvalidSetting("there is no picture to train on; hold out fewer images")
        self.config = config or StaticConfig()
        self.device = torch.device(device)
        self.first_camera = pictures[0].camera
        self.coordinates = TrainingCoordinates.of([picture.camera for picture in pictures])
        self._cameras = [self.coordinates.camera(picture.camera) for picture in pictures]
        self.extent = scene_extent(self._cameras)
        self._matrices = [camera.matrices(self.device) for camera in self._cameras]
        self._images = [torch.from_numpy(np.ascontiguousarray(each.image)).to(self.device) for each in pictures]
        self._order = torch.Generator().manual_seed(seed)
        self._left: list[int] = []
        self.params = self._initial(points, seed)
        self.optimizers = {
            name: CompiledAdam([{"params": parameter, "lr": self._rate(name), "name": name}], eps=EPSILON)
            for name, parameter in self.params.items()
        }
        self.steps_done = 0
        generator = torch.Generator(self.device).manual_seed(seed)
        self.strategy = self.config.new_strategy(len(pictures), generator)
        self._state: dict[str, Any] = {}
        if self.strategy is not None:
            self.strategy.check_sanity(self.params, self.optimizers)
            scale = {"scene_scale": self.extent} if isinstance(self.strategy, DefaultStrategy) else {}
            self._state = self.strategy.initialize_state(**scale)

    def _initial(self, points: Points, seed: int) -> torch.nn.ParameterDict:
        config, generator = self.config, torch.Generator().manual_seed(seed)
        means = torch.from_numpy(self.coordinates.positions(points.positions)).float()
        others = nearest_others(means, NEIGHBOURS)
        distances = (means[others] - means[:, None]).square().sum(-1).mean(-1).sqrt()
        scales = (distances * config.start.scale).clamp_min(LEAST_SCALE).log()[:, None].repeat(1, 3)
        sh = torch.zeros(len(means), (config.sh_degree + 1) ** 2, 3)
        sh[:, 0] = (torch.from_numpy(points.colours).float() / 255 - 0.5) / SH_C0
        values = {
            "means": means,
            "scales": scales,
            "quats": torch.rand(len(means), 4, generator=generator),
            "opacities": torch.full((len(means),), config.start.opacity).logit(),
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
        }
        return torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value.contiguous().to(self.device)) for name, value in values.items()}
        )

    def _rate(self, name: str, step: int = 0) -> float:
        if name != "means":
            return RATES[name]
        return RATES[name] * self.extent * MEANS_DECAY ** (step / self.config.steps)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.params["means"].shape[0])

    def gaussians(self) -> Gaussians:
        """Return a copy of the Gaussians in world coordinates."""
        params = {name: parameter.detach() for name, parameter in self.params.items()}
        return self.coordinates.to_world(
            Gaussians(
                params["means"].clone(),
                torch.nn.functional.normalize(params["quats"], dim=-1),
                params["scales"].clone(),
                params["opacities"].clone(),
                torch.cat([params["sh0"], params["shN"]], 1),
            )
        )

    def step(self) -> StaticStep:
        """Train on the next picture; pictures come in random order, each once before any comes again."""
        step, config = self.steps_done, self.config
        self.optimizers["means"].param_groups[0]["lr"] = self._rate("means", step)
        picture = self._next_picture()
        degree = min(step // config.shortened(SH_EVERY), config.sh_degree)
        scales, opacities = self.params["scales"].exp(), self.params["opacities"].sigmoid()
        image, info = self._render(picture, scales, opacities, degree)
        loss = image_loss(image, self._images[picture], ssim_weight=config.ssim_weight).loss
        if config.start.opacity_weight:
            loss = loss + config.start.opacity_weight * opacities.mean()
        if config.start.scale_weight:
            loss = loss + config.start.scale_weight * scales.mean()
        if self.strategy is not None:
            self.strategy.step_pre_backward(self.params, self.optimizers, self._state, step, info)
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self._refine(step, info)
        self.steps_done += 1
        return StaticStep(step, loss.detach(), picture)

    def _refine(self, step: int, info: dict[str, Any]) -> None:
        """Let the strategy change the Gaussians."""
        own = self.params, self.optimizers, self._state, step, info
        if isinstance(self.strategy, MCMCStrategy):
            self.strategy.step_post_backward(*own, lr=self._rate("means", step))
        elif self.strategy is not None:
            if self.count >= self.config.max_gaussians:
                self.strategy.grow_grad2d = math.inf
            self.strategy.step_post_backward(*own)

    def _next_picture(self) -> int:
        if not self._left:
            self._left = torch.randperm(len(self._images), generator=self._order).tolist()
        return self._left.pop()

    def _render(self, picture: int, scales: Tensor, opacities: Tensor, degree: int) -> tuple[Tensor, dict[str, Any]]:
        """Return the rendered picture [H, W, 3] and the intermediate results of `rasterization`."""
        camera, params = self._cameras[picture], self.params
        viewmat, K = self._matrices[picture]
        colors, _, info = rasterization(
            params["means"], params["quats"], scales, opacities, torch.cat([params["sh0"], params["shN"]], 1), viewmat[None],
            K[None], camera.width_px, camera.height_px, near_plane=NEAR_PLANE, sh_degree=degree, packed=False,
            absgrad=self.config.absgrad,
        )  # fmt: skip
        return colors[0], info

    def psnr_db(self, picture: int) -> float:
        """Return the PSNR of a training picture in dB; waits for the device."""
        with torch.no_grad():
            scales, opacities = self.params["scales"].exp(), self.params["opacities"].sigmoid()
            image, _ = self._render(picture, scales, opacities, self.config.sh_degree)
            error = float((image.clamp(0, 1) - self._images[picture] / 255).square().mean())
        return -10 * math.log10(max(error, 1e-10))
