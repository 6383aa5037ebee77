"""Loss terms of training: their interface, selection by name and weighted sum, and the terms of colours, depth, rays,
classes and sparsity.

The rays of a step are rendered once for all losses along rays. Normals are compared with those of the rendered depth
(Huang et al. 2024, "2D Gaussian Splatting"). Losses that need further measurements are in `measured_losses`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsplat_core.choices import LOSSES
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.ops.arguments import View
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.ops.ray_losses import ray_depth_loss, ray_normal_loss
from gsplat_core.rendering.rasterization import render
from gsplat_core.rendering.surface import COVERED, SEMANTICS, blend_view_rays, view_of
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.observations import Observation, depth_of

EVERY = 8
"""Interval in steps at which losses along rays are evaluated. 4 and 8 have equal accuracy on synthetic stereo recordings
(benchmarks/results/methods.md)."""


@dataclass(frozen=True)
class LossContext:
    """Other frames, and the scene at other times, which a loss may use besides the compared observation."""

    frames: Sequence[Observation]
    """Observations available for training in temporal order, including the current one."""
    at: Callable[[float], Gaussians]
    """Function that returns the scene at another time in seconds, without gradients."""


class Loss(Protocol):
    """Loss term, created once per scene. It may keep values that it computed from observations."""

    name: ClassVar[str]
    """Name in `LOSSES`."""
    default_weight: ClassVar[float]
    """Factor of the term if the user gives none."""

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Compare the scene with an observation.

        Args:
            scene: Gaussians at the observation's time in the colours of its eye; their tensors require gradients.
            observation: target.
            context: further observations, and the scene at other times.

        Returns:
            Scalar on the scene's device, differentiable in the scene's tensors. None if the observation has nothing
            to compare.
        """


@runtime_checkable
class RayLoss(Protocol):
    """Loss term of the rendered surface, without state. A CUDA graph captures the training step with its other parts.

    The rays are rendered once for all such losses, in one of `EVERY` steps. The weighted loss of that step is
    multiplied by `EVERY`.
    """

    name: ClassVar[str]
    """Name in `LOSSES`."""
    default_weight: ClassVar[float]
    """Factor of the term if the user gives none."""
    needs_depth: ClassVar[bool]
    """True if only observations with depth are compared."""

    def compare(self, rays: RenderedRays) -> Tensor:
        """Compare the rays of one observation by operations on the device.

        Args:
            rays: rendered rays, differentiable in the scene, and values of the observation. Unknown depth is 0.

        Returns:
            Differentiable scalar on the scene's device, 0 if there is nothing to compare. The host may not read a value
            of the device or copy one to it.
        """


@runtime_checkable
class ExtendingLoss(Protocol):
    """Loss that needs further trained tensors of the Gaussians, such as class logits, in `Gaussians.extra`."""

    rates: ClassVar[Mapping[str, float]]
    """Learning rates of the loss's tensors by name."""

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the loss's tensors in `extra`. Tensors that are already there stay unchanged."""


class LossKind(Protocol):
    """Registry entry of a loss, usually its class."""

    name: ClassVar[str]
    default_weight: ClassVar[float]

    def __call__(self) -> Loss | RayLoss:
        """Create the loss for a new scene."""


ALWAYS_COMPARED = {"photometric": "ssim_weight and squared_error", "depth": "depth_weight"}
"""Losses that every step computes by the fused path, with the settings that weigh them."""


def loss_weights(chosen: Sequence[str]) -> dict[str, float]:
    """Return the weights of the losses that are added to the fused path, by name.

    Args:
        chosen: losses as `name` or `name:weight`, for example `normal_consistency:0.05`.

    Raises:
        InvalidSetting: for an unknown loss, a repeated loss, a weight that is not a positive number, or a weight for a
            loss of the fused path, or a string in place of a list.
    """
    if isinstance(chosen, str):
        raise InvalidSetting(f"losses is {chosen!r}; give a list of names, such as [{chosen!r}]")
    weights: dict[str, float] = {}
    for each in chosen:
        name, colon, given = each.partition(":")
        LOSSES.check(name)
        if name in ALWAYS_COMPARED:
            if colon:
                raise InvalidSetting(
                    f"losses has {each!r}; {name} is always compared and weighed by {ALWAYS_COMPARED[name]}, so write"
                    f" {name!r} or leave it out"
                )
            continue
        if name in weights:
            raise InvalidSetting(
                f"losses names {name!r} twice; name it once, as {name}:{LOSSES[name].default_weight:g}"
            )
        weights[name] = _weight(each, given) if colon else LOSSES[name].default_weight
    return weights


def _weight(loss: str, given: str) -> float:
    try:
        weight = float(given)
    except ValueError:
        weight = math.nan
    if not 0 < weight < math.inf:
        raise InvalidSetting(
            f"losses has {loss!r}; the weight after the colon must be a positive number, as in name:0.1"
        )
    return weight


class WeightedLosses:
    """Weighted sum of the chosen losses for one scene."""

    def __init__(self, weights: dict[str, float]) -> None:
        """Create the losses named in `weights` (result of `loss_weights`), each with its weight."""
        made = [(LOSSES[name](), weight) for name, weight in weights.items()]
        self._of_rays = [(loss, weight) for loss, weight in made if isinstance(loss, RayLoss)]
        self._terms: list[tuple[Loss, float]] = [
            (loss, weight) for loss, weight in made if not isinstance(loss, RayLoss)
        ]
        self._steps = 0

    def __bool__(self) -> bool:
        return bool(self._terms or self._of_rays)

    @property
    def can_be_captured(self) -> bool:
        """True if a CUDA graph can capture all losses, by `compare`."""
        return not self._terms

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the tensors that the losses train."""
        for loss, _ in self._terms:
            if isinstance(loss, ExtendingLoss):
                gaussians = loss.extended(gaussians)
        return gaussians

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the tensors that the losses train, by name in `Gaussians.extra`."""
        extending = [loss for loss, _ in self._terms if isinstance(loss, ExtendingLoss)]
        return {name: rate for loss in extending for name, rate in loss.rates.items()}

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the weighted sum, see `Loss.__call__`; None if no loss has anything to compare.

        Raises:
            InvalidInput: for a loss that returns something else than one value.
        """
        total = self.compare(rays_of(scene, observation)) if self.are_rays_due(observation) else None
        for loss, weight in self._terms:
            value = loss(scene, observation, context)
            if value is not None:
                if not isinstance(value, Tensor) or value.dim():
                    found = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
                    raise InvalidInput(
                        f"the loss {loss.name!r} returned {found}; it must return a tensor of one value, or None"
                    )
                total = weight * value if total is None else total + weight * value
        return total

    def are_rays_due(self, observation: Observation) -> bool:
        """Return True if this step compares the rays of the observation. Called once per step."""
        self._steps += 1
        has_depth = observation.depth is not None
        compared = any(has_depth or not loss.needs_depth for loss, _ in self._of_rays)
        return compared and (self._steps - 1) % EVERY == 0

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the weighted sum of the losses along rays for a step that compares them.

        Args:
            rays: rays for which `are_rays_due` returned True.
        """
        has_depth = rays.known_depth is not None
        terms = [
            (EVERY * weight) * loss.compare(rays) for loss, weight in self._of_rays if has_depth or not loss.needs_depth
        ]
        return sum(terms[1:], start=terms[0])


class MeanOpacity:
    """Mean opacity of all Gaussians."""

    name: ClassVar[str] = "opacity"
    default_weight: ClassVar[float] = 0.01

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean opacity of the scene's Gaussians, None without Gaussians; the observation is not read."""
        return scene.opacities.mean() if scene.count else None


class MeanScale:
    """Mean standard deviation of all Gaussians, relative to the scene's distance from the camera of the first
    observation.
    """

    name: ClassVar[str] = "scale"
    default_weight: ClassVar[float] = 0.01

    def __init__(self) -> None:
        self._distance: Tensor | None = None

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean standard deviation of the scene's Gaussians, relative to the scene's median distance at the
        first call; None without Gaussians.
        """
        if not scene.count:
            return None
        if self._distance is None:
            self._distance = depth_of(scene.means.detach(), observation.camera).abs().median()
        return scene.scales.mean() / self._distance


class Photometric:
    """L1 difference of the colours over tissue.

    Every step computes this term by the fused path of `image_loss`, with the settings `ssim_weight` and
    `squared_error`. This class evaluates it alone.
    """

    name: ClassVar[str] = "photometric"
    default_weight: ClassVar[float] = 1.0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean absolute colour difference between the rendered picture and the observation over tissue."""
        output = render(scene, observation.camera, depth=False)
        return image_loss(output.image, observation.image, observation.mask).loss


class Depth:
    """Mean absolute difference of inverse depths over tissue of known depth, in 1/mm.

    Every step computes this term by the fused path of `image_loss`, with the setting `depth_weight`. This class
    evaluates it alone.
    """

    name: ClassVar[str] = "depth"
    default_weight: ClassVar[float] = 1.0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean absolute difference of inverse depths; None for an observation without depth."""
        if observation.depth is None:
            return None
        output = render(scene, observation.camera)
        image = output.image.detach()
        result = image_loss(image, observation.image, observation.mask, output.depth, observation.depth, 0.0, 1.0)
        return result.loss - image_loss(image, observation.image, observation.mask).loss


class RayDepth:
    """Mean absolute difference of inverse depths over tissue of known depth, times the observation's mean depth.

    `depth` compares the depths of the Gaussians' centres. On tilted tissue the centres in front hide those behind, so
    they are biased towards the camera, and the fit compensates. The depth along the ray has no such bias and moves the
    rotations and scales, too.
    """

    name: ClassVar[str] = "ray_depth"
    default_weight: ClassVar[float] = 0.2
    needs_depth: ClassVar[bool] = True

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean absolute difference of inverse ray depths over tissue, relative to the observation's mean inverse
        depth.
        """
        assert rays.known_depth is not None
        return ray_depth_loss(rays.depths, rays.known_depth, rays.tissue)


class NormalConsistency:
    """Mean of 1 - (splat normal · depth normal), weighted by the blending weights, over tissue.

    It needs no depth of the observation. It flattens bumps and turns Gaussians into the surface.
    """

    name: ClassVar[str] = "normal_consistency"
    default_weight: ClassVar[float] = 0.1
    needs_depth: ClassVar[bool] = False

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean difference between blended splat normals and depth normals over the observation's tissue."""
        view = rays.view
        return ray_normal_loss(rays.depths, rays.alphas, rays.normals, rays.tissue, view.K, view.camera_model)


CLASSES = 4
"""Number of classes of a scene; labels are 0 to 3."""


class Semantics:
    """Mean cross-entropy of the rendered classes over labelled pixels. Only frames with `Frame.labels` are compared.

    A scene that is trained with this loss has the logits `Gaussians.extra["semantics"]` [N, 4]. They move with the
    Gaussians, so labels on a few frames classify all frames. Colours and geometry receive no gradient. Pixels of tools are
    compared, too, where they have a label.
    """

    name: ClassVar[str] = SEMANTICS
    default_weight: ClassVar[float] = 1.0
    rates: ClassVar[Mapping[str, float]] = {SEMANTICS: 0.05}

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with class logits in `extra`. Logits that are already there stay unchanged, new ones are 0."""
        if SEMANTICS in gaussians.extra:
            return gaussians
        logits = gaussians.means.new_zeros(gaussians.count, CLASSES)
        return replace(gaussians, extra={**gaussians.extra, SEMANTICS: logits})

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean cross-entropy over the observation's labelled pixels; None without labels."""
        if observation.labels is None:
            return None
        geometry = replace(scene.detach(), extra={})
        rays = rays_of(geometry, observation, scene.extra[SEMANTICS])
        labels = rays.sampled(observation.labels).long()
        known = labels < CLASSES
        target = torch.where(known, labels, 0)
        off = torch.nn.functional.cross_entropy(rays.values.permute(2, 0, 1)[None], target[None], reduction="none")[0]
        return torch.where(known, off, 0).sum() / known.sum().clamp(min=1)


SMALL_PIXELS = 24_000
"""Number of pixels up to which losses along rays compare pictures at full size; larger pictures are compared at half size."""


class RenderedRays(NamedTuple):
    """Values rendered along the rays of an observation, and observed values, at the size [h, w] of the comparison."""

    view: View
    """Camera of the compared pixels."""
    stride: int
    """Distance of compared pixels in the observation's pixels: 1 for full size, 2 for half size."""
    alphas: Tensor
    depths: Tensor
    normals: Tensor
    """Normals of the splats, summed with their blending weights [h, w, 3]; the sum's length is at most the opacity."""
    values: Tensor
    """Further values of the splats, such as class logits, summed with their blending weights [h, w, K]."""
    tissue: Tensor
    """Mask bool [h, w] of compared pixels that show tissue and where a surface is rendered."""
    known_depth: Tensor | None
    """Depth [h, w] of the observation, 0 where unknown; None for an observation without depth."""

    def sampled(self, plane: Tensor) -> Tensor:
        """Return a plane [H, W] of the observation at the compared pixels."""
        return _sampled(plane, self.view, self.stride)


def rays_of(scene: Gaussians, observation: Observation, values: Tensor | None = None) -> RenderedRays:
    """Render the rays of an observation.

    Args:
        scene: Gaussians at the observation's time.
        observation: camera, mask and depth.
        values: further values [N, K] of the splats to blend.
    """
    view = view_of(observation.camera, scene.device)
    return compared_rays(scene, view, observation.mask, observation.depth, values)[0]


def compared_rays(
    scene: Gaussians,
    view: View,
    mask: Tensor,
    depth: Tensor | None,
    values: Tensor | None = None,
    capacity: int | None = None,
) -> tuple[RenderedRays, Tensor | None]:
    """Render the rays of a view. Pictures of more than `SMALL_PIXELS` pixels are rendered at half size.

    The centre of a compared pixel is then that of the observation's pixel with even row and column.

    Args:
        scene: Gaussians at the observation's time.
        view: camera of the observation.
        mask: mask [H, W] of the observation, not 0 for tissue.
        depth: depth [H, W] of the observation, 0 where unknown.
        values: further values [N, K] of the splats to blend.
        capacity: as in `blend_view_rays`.

    Returns:
        The rays, and the required capacity as in `blend_view_rays`.
    """
    stride = 1 if view.width * view.height <= SMALL_PIXELS else 2
    if stride > 1:
        K = view.K.clone()
        K[:2].div_(stride)
        K[:2, 2].add_(0.5 - 0.5 / stride)
        view = view._replace(K=K, width=view.width // stride, height=view.height // stride)
    rays, needed = blend_view_rays(scene, view, values, capacity)
    tissue = (rays.alphas >= COVERED) & (_sampled(mask, view, stride) != 0)
    known = None if depth is None else _sampled(depth, view, stride)
    normals = rays.values if values is None else rays.values[..., :3]
    further = rays.values[..., 3:]
    return RenderedRays(view, stride, rays.alphas, rays.depths, normals, further, tissue, known), needed


def _sampled(plane: Tensor, view: View, stride: int) -> Tensor:
    return plane[::stride, ::stride][: view.height, : view.width]
