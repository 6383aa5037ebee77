"""Registries of the implementations that a user selects by name, and checks of combinations of the names.

Importing this module imports no implementation, and neither torch nor NumPy. The command line and the service read the
names from these registries. A new implementation is a module and one line in this file.

The tables of combinations (renderer, options, outputs and losses) repeat what the renderers' `Capabilities` state, so that a
process without torch, such as the service's, refuses a bad combination before work is queued. A renderer of another package is
not in the tables. It is checked when it is created.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal

from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry

if TYPE_CHECKING:
    from gsplat_core.deformation.kinds import FieldKind
    from gsplat_core.depth.maps import Estimator
    from gsplat_core.rendering.renderer import OutputKind, RendererKind
    from gsplat_core.scene.range_sensors import RangeSensor
    from gsplat_core.training.losses import LossKind
    from gsplat_core.training.strategies.strategy import StrategyKind

StereoLayout = Literal["side_by_side", "top_bottom"]
"""Places of the left and right eye in a picture that holds both: left and right half, or upper and lower half."""

FIELDS: Registry[FieldKind[Any]] = Registry(
    "deformation field",
    {
        # `auto` stands for the deformation field with the better results in benchmarks/results/replay.md
        "auto": "gsplat_core.deformation.basis:KIND",
        "basis": "gsplat_core.deformation.basis:KIND",
        "hexplane": "gsplat_core.deformation.hexplane:KIND",
    },
)
"""Kinds of deformation fields by the names that a user can choose; `auto` is an alias."""

RENDERERS: Registry[RendererKind] = Registry(
    "renderer",
    {
        "alpha": "gsplat_core.rendering.alpha:AlphaRenderer",
        "stochastic": "gsplat_core.rendering.stochastic:StochasticRenderer",
        "points": "gsplat_core.rendering.stochastic:PointRenderer",
        "weighted_sum": "gsplat_core.rendering.weighted_sum:WeightedSumRenderer",
    },
)
"""Renderers by name; "alpha" is alpha blending (Kerbl et al. 2023).

CONTRIBUTING.md, "A renderer", describes how to add one.
"""

OUTPUTS: Registry[OutputKind] = Registry(
    "output",
    {
        "ray_depth": "gsplat_core.rendering.renderer:RAY_DEPTH",
        "median_depth": "gsplat_core.rendering.renderer:MEDIAN_DEPTH",
        "normals": "gsplat_core.rendering.renderer:NORMALS",
        "depth_normals": "gsplat_core.rendering.renderer:DEPTH_NORMALS",
        "spread": "gsplat_core.rendering.renderer:SPREAD",
        "confidence": "gsplat_core.rendering.renderer:CONFIDENCE",
        "semantics": "gsplat_core.rendering.renderer:SEMANTICS",
        "flow": "gsplat_core.rendering.renderer:FLOW",
        "occlusion": "gsplat_core.rendering.renderer:OCCLUSION",
    },
)
"""Planes that a renderer can return in addition to picture, opacity and depth, by name. `Capabilities.outputs` states those of a
renderer.
"""

DEPTHS: Registry[type[Estimator]] = Registry(
    "depth",
    {
        "recorded": "gsplat_core.depth.maps:RecordedDepth",
        "stereo": "gsplat_core.depth.stereo:StereoDepth",
        "light": "gsplat_core.experimental.light:LightDepth",
        "parallax": "gsplat_core.depth.multiview:ParallaxDepth",
        "onnx": "gsplat_core.depth.learned:LearnedDepth",
        "breathing": "gsplat_core.experimental.breathing_depth:BreathingDepth",
        "none": "gsplat_core.depth.maps:NoDepth",
    },
)
"""Depth estimators by name. The constructor takes an address if the name is in `DEPTHS_WITH_ADDRESS`."""
DEPTHS_WITH_ADDRESS = {"onnx": "onnx:FILE"}
"""Names of the depth estimators that need an address, such as a file, each with the syntax of the user's setting."""

MOTION_PRIORS: Registry[Callable[[Any], Any]] = Registry(
    "motion prior",
    {
        "bumps": "gsplat_core.training.motion_prior:no_prior",
        "flow": "gsplat_core.training.motion_prior:FlowPrior",
        "learned": "gsplat_core.experimental.learned_prior:LearnedPrior",
    },
)
"""Factories of motion priors by name; each takes a `ReconstructorConfig`. `bumps` adds no prior: the deformation field alone
extrapolates motion.
"""

LOSSES: Registry[LossKind] = Registry(
    "loss",
    {
        "photometric": "gsplat_core.training.losses:Photometric",
        "depth": "gsplat_core.training.losses:Depth",
        "ray_depth": "gsplat_core.training.losses:RayDepth",
        "normal_consistency": "gsplat_core.training.losses:NormalConsistency",
        "semantics": "gsplat_core.training.losses:Semantics",
        "flow": "gsplat_core.training.measured_losses:FlowLoss",
        "triangulation": "gsplat_core.training.measured_losses:TriangulationLoss",
        "range": "gsplat_core.training.measured_losses:RangeLoss",
        "opacity": "gsplat_core.training.losses:MeanOpacity",
        "scale": "gsplat_core.training.losses:MeanScale",
    },
)
"""Losses of training by name. Every step computes `photometric` and `depth`; others are added when a user names them."""

STRATEGIES: Registry[StrategyKind] = Registry(
    "strategy",
    {
        "streaming": "gsplat_core.training.strategies.streaming:KIND",
        "birth_death": "gsplat_core.training.strategies.mcmc:BIRTH_DEATH",
        "adc": "gsplat_core.training.strategies.adc:KIND",
        "mcmc": "gsplat_core.training.strategies.mcmc:KIND",
    },
)
"""Strategies that add, move and remove Gaussians during offline training, by name. `StrategyKind.library` is the strategy class for
a training loop of a library user.
"""

KERNELS: Registry[type[Any]] = Registry(
    "kernel",
    {
        "gaussian": "gsplat_core.experimental.cut_gaussians:GaussianKernel",
        "cut": "gsplat_core.experimental.cut_gaussians:CutKernel",
    },
)
"""Functions by which a splat's opacity falls off from its centre, by name. Renderers use `gaussian`; `cut` is experimental
(`render_kernel`).
"""

SENSORS: Registry[type[RangeSensor]] = Registry(
    "range sensor",
    {
        "time_of_flight": "gsplat_core.scene.range_sensors:TimeOfFlight",
        "structured_light": "gsplat_core.scene.range_sensors:StructuredLight",
        "oct_line": "gsplat_core.scene.range_sensors:OctLine",
    },
)
"""Range sensors by name. The loss `range` compares their recorded scans with the scene."""

Eyes = Literal["left", "both"]
"""Eyes of a stereo scope whose pictures are used for training: the left one alone, or both."""


STANDARD = ("image", "alpha", "depth")
"""Names of the outputs that every renderer returns: the picture, its opacity and its depth."""
_SAMPLED = ("samples", "supersampling", "seed", "progressive", "storage")
OPTIONS: Mapping[str, tuple[str, ...]] = {
    "alpha": (),
    "stochastic": (*_SAMPLED, "order"),
    "points": _SAMPLED,
    "weighted_sum": (),
}
"""Names of the fields of `RendererOptions` that apply to a renderer, by the renderer's name."""
OUTPUTS_OF: Mapping[str, tuple[str, ...]] = {
    "alpha": (*STANDARD, *OUTPUTS),
    "stochastic": STANDARD,
    "points": STANDARD,
    "weighted_sum": STANDARD,
}
"""Names of the outputs (image, alpha, depth and those in `OUTPUTS`) that a renderer can return, by the renderer's name."""
OWN_OPACITIES = ("weighted_sum",)
"""Renderers whose opacities differ in meaning from those of alpha blending. They exclude the losses and strategies that rely on
alpha blending.
"""
WITH_OPACITIES_OF_ALPHA = ("adc", "mcmc")
"""Strategies that rely on the opacities of alpha blending; refused for the renderers in `OWN_OPACITIES`."""
OF_EVERY_STEP = ("photometric", "depth")
"""Losses that every training step computes, from the picture of the renderer that trains the scene."""


NEEDED_BY: Mapping[str, tuple[str, str]] = {"semantics": ("labels", "labels/"), "range": ("ranges", "scans/")}
"""Field of `Frame` that a loss needs, and the folder of a recording that contains its data, by the loss's name."""


def check_renderer_options(renderer: str, given: Iterable[str]) -> None:
    """Check that a renderer has the options with the names `given`.

    Raises:
        InvalidSetting: otherwise.
    """
    for option in given:
        if option not in OPTIONS.get(renderer, (option,)):
            having = [name for name, options in OPTIONS.items() if option in options]
            raise InvalidSetting(
                f"renderer {renderer!r} has no option {option}; choose renderer {' or '.join(having)}, or leave {option} out"
            )


def check_outputs(renderer: str, outputs: Iterable[str]) -> None:
    """Check that a renderer can return the outputs with the names `outputs`.

    Raises:
        InvalidSetting: otherwise.
    """
    for output in outputs:
        known = OUTPUTS_OF.get(renderer, (output,))
        if output not in known:
            having = [name for name, all_outputs in OUTPUTS_OF.items() if output in all_outputs]
            other = f"choose renderer {' or '.join(having)}, or " if having else ""
            raise InvalidSetting(
                f"renderer {renderer!r} has no output {output!r}; {other}take the outputs {', '.join(known)}"
            )


def check_compared(losses: Iterable[str], fields: Iterable[str], source: str) -> None:
    """Check that frames have the fields that the losses need (`NEEDED_BY`).

    Args:
        losses: losses, each a name or `name:weight`.
        fields: optional fields of the frames.
        source: name of the frames' source for the message.

    Raises:
        InvalidSetting: if a loss would never compare anything.
    """
    known = {*fields}
    for name in (each.partition(":")[0] for each in losses):
        field, folder = NEEDED_BY.get(name, ("", ""))
        if field and field not in known:
            raise InvalidSetting(
                f"loss {name!r} compares {field}, and {source} has none; add {folder} to the recording, or leave {name} out"
            )


def check_losses(renderer: str, losses: Iterable[str]) -> None:
    """Check that `renderer` can train a scene with the losses, each a name or `name:weight`.

    Raises:
        InvalidSetting: otherwise.
    """
    names = [each.partition(":")[0] for each in losses]
    further = [name for name in names if name not in OF_EVERY_STEP]
    if further and renderer in OWN_OPACITIES:
        raise InvalidSetting(
            f"loss {further[0]!r} uses the opacities of alpha blending, and renderer {renderer!r} trains others; choose"
            f" renderer alpha, or leave the losses {', '.join(further)} out"
        )


def check_strategy(renderer: str, strategy: str) -> None:
    """Check that a strategy can add and remove Gaussians of a scene that `renderer` trains.

    Raises:
        InvalidSetting: otherwise.
    """
    if strategy in WITH_OPACITIES_OF_ALPHA and renderer in OWN_OPACITIES:
        raise InvalidSetting(
            f"strategy {strategy!r} uses the opacities of alpha blending, and renderer {renderer!r} trains others; choose"
            f" renderer alpha, or strategy streaming"
        )
