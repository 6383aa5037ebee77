"""Registries of the implementations that a user selects by name.

Importing this module imports no implementation, and neither torch nor NumPy. The command line and the service read the
names from these registries. A new implementation is a module and one line in this file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from gsplat_core.registry import Registry

if TYPE_CHECKING:
    from gsplat_core.deformation.kinds import FieldKind
    from gsplat_core.depth.maps import Estimator
    from gsplat_core.rendering.outputs import OutputKind
    from gsplat_core.rendering.renderer import RendererKind
    from gsplat_core.scene.range_sensors import RangeSensor
    from gsplat_core.training.losses.loss import LossKind
    from gsplat_core.training.strategies.strategy import StrategyKind

FIELDS: Registry[FieldKind[Any]] = Registry(
    "deformation field",
    {
        # `auto` names the field with the better results in benchmarks/results/replay.md
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
        "ray_depth": "gsplat_core.rendering.outputs:RAY_DEPTH",
        "median_depth": "gsplat_core.rendering.outputs:MEDIAN_DEPTH",
        "normals": "gsplat_core.rendering.outputs:NORMALS",
        "depth_normals": "gsplat_core.rendering.outputs:DEPTH_NORMALS",
        "spread": "gsplat_core.rendering.outputs:SPREAD",
        "confidence": "gsplat_core.rendering.outputs:CONFIDENCE",
        "semantics": "gsplat_core.rendering.outputs:SEMANTICS",
        "flow": "gsplat_core.rendering.outputs:FLOW",
        "occlusion": "gsplat_core.rendering.outputs:OCCLUSION",
    },
)
"""Outputs in addition to picture, opacity and depth, by name. `Capabilities.outputs` states those of a renderer."""

DEPTHS: Registry[type[Estimator]] = Registry(
    "depth",
    {
        "recorded": "gsplat_core.depth.registry:RecordedDepth",
        "stereo": "gsplat_core.depth.stereo:StereoDepth",
        "light": "gsplat_core.experimental.light:LightDepth",
        "parallax": "gsplat_core.depth.multiview:ParallaxDepth",
        "onnx": "gsplat_core.depth.learned:LearnedDepth",
        "breathing": "gsplat_core.experimental.breathing_depth:BreathingDepth",
        "none": "gsplat_core.depth.registry:NoDepth",
    },
)
"""Depth estimators by name. The constructor takes an address if the name is in `DEPTHS_WITH_ADDRESS`."""
DEPTHS_WITH_ADDRESS = {"onnx": "onnx:FILE"}
"""Names that are followed by a colon and an address, with an example of the syntax."""

MOTION_PRIORS: Registry[Callable[[Any], Any]] = Registry(
    "motion prior",
    {
        "bumps": "gsplat_core.training.motion.prior:no_prior",
        "flow": "gsplat_core.training.motion.prior:FlowPrior",
        "learned": "gsplat_core.experimental.learned_prior:LearnedPrior",
    },
)
"""Factories of motion priors by name; each takes a `ReconstructorConfig`. `bumps` uses the field's extrapolation alone."""

LOSSES: Registry[LossKind] = Registry(
    "loss",
    {
        "photometric": "gsplat_core.training.losses.pictures:Photometric",
        "depth": "gsplat_core.training.losses.pictures:Depth",
        "ray_depth": "gsplat_core.training.losses.rays:RayDepth",
        "normal_consistency": "gsplat_core.training.losses.rays:NormalConsistency",
        "semantics": "gsplat_core.training.losses.semantics:Semantics",
        "flow": "gsplat_core.training.losses.flow:FlowLoss",
        "triangulation": "gsplat_core.training.losses.triangulation:TriangulationLoss",
        "range": "gsplat_core.training.losses.ranges:RangeLoss",
        "opacity": "gsplat_core.training.losses.sparsity:MeanOpacity",
        "scale": "gsplat_core.training.losses.sparsity:MeanScale",
    },
)
"""Losses of training by name. Every step computes `photometric` and `depth`; others are added when a user names them."""

STRATEGIES: Registry[StrategyKind] = Registry(
    "strategy",
    {
        "streaming": "gsplat_core.training.strategies.streaming:KIND",
        "birth_death": "gsplat_core.training.strategies.birth_death:KIND",
        "adc": "gsplat_core.training.strategies.adc:KIND",
        "mcmc": "gsplat_core.training.strategies.mcmc:KIND",
    },
)
"""Changes of the Gaussians during offline training, by name. `StrategyKind.library` is the class for one's own loop."""

KERNELS: Registry[type[Any]] = Registry(
    "kernel",
    {
        "gaussian": "gsplat_core.experimental.cut_gaussians:GaussianKernel",
        "cut": "gsplat_core.experimental.cut_gaussians:CutKernel",
    },
)
"""Falloffs of a splat by name. Renderers use `gaussian`; `cut` is experimental (`render_kernel`)."""

SENSORS: Registry[type[RangeSensor]] = Registry(
    "range sensor",
    {
        "time_of_flight": "gsplat_core.scene.range_sensors:TimeOfFlight",
        "structured_light": "gsplat_core.scene.range_sensors:StructuredLight",
        "oct_line": "gsplat_core.scene.range_sensors:OctLine",
    },
)
"""Range sensors by name, whose scans the loss `range` compares."""

Eyes = Literal["left", "both"]
"""Eyes of a stereo scope whose pictures are trained on."""
