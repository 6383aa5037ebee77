"""Features of the renderers that are registered here, and checks of combinations of renderer, options, outputs and losses.

The tables repeat what the renderers' `Capabilities` state, so that a process without torch, such as the service's, refuses a
bad combination before work is queued. A renderer of another package is not in the tables. It is checked when it is created.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gsplat_core.choices import OUTPUTS
from gsplat_core.errors import InvalidSetting

STANDARD = ("image", "alpha", "depth")
"""Outputs of every renderer."""
_SAMPLED = ("samples", "supersampling", "seed", "progressive", "storage")
OPTIONS: Mapping[str, tuple[str, ...]] = {
    "alpha": (),
    "stochastic": (*_SAMPLED, "order"),
    "points": _SAMPLED,
    "weighted_sum": (),
}
"""Options of `RendererOptions` that a renderer has, by renderer."""
OUTPUTS_OF: Mapping[str, tuple[str, ...]] = {
    "alpha": (*STANDARD, *OUTPUTS),
    "stochastic": STANDARD,
    "points": STANDARD,
    "weighted_sum": STANDARD,
}
"""Outputs by renderer."""
OWN_OPACITIES = ("weighted_sum",)
"""Renderers that train opacities of their own. Losses other than those of every step blend by the opacities of `alpha`."""
WITH_OPACITIES_OF_ALPHA = ("adc", "mcmc")
"""Strategies that rely on alpha blending as the renderer that trains the scene."""
OF_EVERY_STEP = ("photometric", "depth")
"""Losses that every training step computes, by the picture of the renderer that trains the scene."""


NEEDED_BY: Mapping[str, tuple[str, str]] = {"semantics": ("labels", "labels/"), "range": ("ranges", "scans/")}
"""Field of frames that a loss compares with, and the folder of a recording that has it, by loss."""


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
    """Check that a renderer has the outputs.

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
    """Check that frames have the fields with which losses compare the scene.

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
    """Check that a scene that `renderer` trains can be trained by further losses, each a name or `name:weight`.

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
    """Check that a strategy can change the Gaussians of a scene that `renderer` trains.

    Raises:
        InvalidSetting: otherwise.
    """
    if strategy in WITH_OPACITIES_OF_ALPHA and renderer in OWN_OPACITIES:
        raise InvalidSetting(
            f"strategy {strategy!r} uses the opacities of alpha blending, and renderer {renderer!r} trains others; choose"
            f" renderer alpha, or strategy streaming"
        )
