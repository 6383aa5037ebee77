"""Arguments of `rasterization`: tensors, options, and unsupported options of gsplat."""

from __future__ import annotations

import math
import operator
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor
from torch.nn import Parameter

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import MAX_SH_DEGREE

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed"]
RasterizeMode = Literal["classic", "antialiased"]
SparseGradients = bool | Literal["all"]
"""True for sparse gradients of means, quaternions and scales; "all" for those of opacities and colours, too."""
GsplatVersion = Literal["1.6", "1.5.3"]
_RENDER_MODES, _RASTERIZE_MODES = get_args(RenderMode), get_args(RasterizeMode)

NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Default range of rendered z in the scene's unit."""
EPS2D = 0.3
"""Default blur, pixels² added to the diagonal of a splat's covariance."""
MOST_SIDE_PX = 1 << 16
TILE_SIZE = 16
"""Side in pixels of the tiles of compiled ops that blend one image, and default of those that take a tile size."""


class Constants(NamedTuple):
    """Rendering constants of one version of gsplat, in which versions 1.5.3 and 1.6 differ."""

    max_alpha: float
    """Upper limit of a splat's alpha at a pixel."""
    compensation_floor: float
    """Lower limit of the antialiasing compensation, without gradient where active.

    gsplat 1.5.3 has a gradient at 0, but culls Gaussians with an opacity below 1/255 before it applies the
    compensation.
    """


CONSTANTS: dict[GsplatVersion, Constants] = {"1.6": Constants(0.99, 0.005), "1.5.3": Constants(0.999, 0.0)}


class Arguments(NamedTuple):
    """Unchecked tensors passed to `rasterization`."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    """Colours or SH coefficients of `rasterization`; None if `render_mode` has no colours."""
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None
    covars: Tensor | None
    extra_signals: Tensor | None = None


_SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "means": ("[..., N, 3]", (3,)),
    "quats": ("[..., N, 4]", (4,)),
    "scales": ("[..., N, 3]", (3,)),
    "opacities": ("[..., N]", ()),
    "colors": ("[..., N, D], or harmonics [..., N, K, 3]", ()),
    "viewmats": ("[..., C, 4, 4]", (4, 4)),
    "Ks": ("[..., C, 3, 3]", (3, 3)),
    "backgrounds": ("[..., C, D]", ()),
    "covars": ("[..., N, 3, 3]", (3, 3)),
    "extra_signals": ("[..., N, E], or harmonics [..., N, K, E]", ()),
}
"""Expected shape of each tensor, for error messages, and its trailing dimensions."""


@dataclass(frozen=True)
class RenderSettings:
    """Non-tensor options of `rasterization`, validated on construction."""

    width: int
    height: int
    near_plane: float = NEAR_PLANE
    far_plane: float = FAR_PLANE
    radius_clip: float = 0.0
    eps2d: float = EPS2D
    sh_degree: int | None = None
    packed: bool = False
    tile_size: int = TILE_SIZE
    render_mode: RenderMode = "RGB"
    absgrad: bool = False
    rasterize_mode: RasterizeMode = "classic"
    camera_model: str = "pinhole"
    constants: GsplatVersion = "1.6"
    global_z_order: bool = True
    """False sorts splats by the distance of their centre from the camera instead of by z."""
    extra_degree: int | None = None
    """Degree of the spherical harmonics of `extra_signals`; None for plain values."""
    normals: bool = False
    sparse_grad: SparseGradients = False
    distributed: bool = False
    """True if the Gaussians are shared out over processes."""

    def __post_init__(self) -> None:
        # Python's own numbers replace those of NumPy and tensors of one element, which gsplat takes, too.
        for name in ("width", "height", "tile_size"):
            side = _whole(name, getattr(self, name), "a whole number of pixels")
            if not 1 <= side <= MOST_SIDE_PX:
                raise InvalidInput(f"{name} must be from 1 to {MOST_SIDE_PX} px, got {side}")
            object.__setattr__(self, name, side)
        for name in ("near_plane", "far_plane", "radius_clip", "eps2d"):
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        for field_name, name in (("sh_degree", "sh_degree"), ("extra_degree", "extra_signals_sh_degree")):
            if getattr(self, field_name) is None:
                continue
            degree = _whole(name, getattr(self, field_name), f"None or 0 to {MAX_SH_DEGREE}")
            if not 0 <= degree <= MAX_SH_DEGREE:
                raise InvalidInput(f"{name} must be None or 0 to {MAX_SH_DEGREE}, got {degree}")
            object.__setattr__(self, field_name, degree)
        for name, value, known in (
            ("render_mode", self.render_mode, _RENDER_MODES),
            ("rasterize_mode", self.rasterize_mode, _RASTERIZE_MODES),
        ):
            if not isinstance(value, str) or value not in known:
                raise InvalidInput(f"unknown {name} {value!r}; the modes are {', '.join(known)}")
        if self.sparse_grad not in (False, True, "all"):
            raise InvalidInput(f"sparse_grad must be False, True or 'all', got {_shown(self.sparse_grad)}")
        if self.sparse_grad and not self.packed:
            raise InvalidInput("sparse_grad needs packed=True; give packed=True, or leave sparse_grad out")
        if self.constants not in tuple(CONSTANTS):
            raise InvalidInput(f"unknown constants {self.constants!r}; the versions are {', '.join(CONSTANTS)}")

    @property
    def has_colors(self) -> bool:
        """True if colours are among the output channels."""
        return self.render_mode.startswith("RGB")

    def shows(self, colors: Tensor | None) -> bool:
        """Return True if the output has channels of `colors`, which may have none if the output has depth."""
        return self.has_colors and colors is not None and (self.sh_degree is not None or colors.shape[-1] > 0)

    @property
    def least_colors(self) -> int:
        """Smallest number of channels of plain colours: 0 if the output has a channel of depth or distance besides."""
        return 0 if self.has_depth or self.has_distance else 1

    @property
    def tile_grid(self) -> tuple[int, int]:
        """Number of tiles per row and per column."""
        return -(-self.width // self.tile_size), -(-self.height // self.tile_size)

    @property
    def has_depth(self) -> bool:
        """True if z of the splats' centres is the last output channel."""
        return self.render_mode.endswith("D")

    @property
    def has_distance(self) -> bool:
        """True if distance along the rays is the last output channel."""
        return self.render_mode.endswith("d")

    @property
    def divides_depth(self) -> bool:
        """True if depth or distance is divided by alpha."""
        return self.render_mode.endswith(("ED", "Ed"))


def check_tensors(arguments: Arguments, has_colors: bool = True) -> None:
    """Raise InvalidInput for a missing, non-floating or wrongly shaped argument of `rasterization`."""
    by_covars = arguments.covars is not None
    for name, value in arguments._asdict().items():
        if value is None:
            if name in ("backgrounds", "covars", "extra_signals") or (by_covars and name in ("quats", "scales")):
                continue
            if name == "colors" and not has_colors:
                continue
            also = ", or covars in place of quats and scales" if name in ("quats", "scales") else ""
            raise InvalidInput(f"{name} is None; it must be a tensor {_SHAPES[name][0]}{also}")
        if not isinstance(value, Tensor):
            raise InvalidInput(f"{name} must be a tensor {_SHAPES[name][0]}, got {_shown(value)}")
        if not value.is_floating_point() or value.is_meta or value.layout != torch.strided:
            raise InvalidInput(
                f"{name} must be a dense floating-point tensor, got {value.dtype} on {value.device}, {value.layout}"
            )
        shape, trailing = _SHAPES[name]
        if value.dim() < max(1, len(trailing)) or tuple(value.shape[value.dim() - len(trailing) :]) != trailing:
            raise InvalidInput(f"{name} must be {shape}, got {list(value.shape)}")
    devices = {name: value.device for name, value in arguments._asdict().items() if value is not None}
    if len(set(devices.values())) > 1:
        found = ", ".join(f"{name}: {device}" for name, device in devices.items())
        raise InvalidInput(f"all tensors must be on one device, got {found}")


_PLAIN_OPTIONS = {int, float, bool, str, type(None)}
PLAIN_TENSORS = {Tensor, Parameter, type(None)}
"""Types of tensor arguments that may be checked once for many calls; subclasses may behave in any way."""


def signature_of(arguments: Arguments, options: tuple[Any, ...]) -> Hashable | None:
    """Return a key of everything in a call that the checks of arguments depend on, or None for an unusual call.

    Calls with equal keys pass or fail the same checks, because no check reads the values of a tensor. The key holds no
    tensor. A call is unusual if an argument has another type than the usual ones, or inside a transform of torch.

    Args:
        arguments: tensors of the call, not yet checked.
        options: all other arguments.
    """
    if is_transformed():  # tested first, because torch.compile cannot trace the tests below
        return None
    types = tuple(map(type, options))
    if not _PLAIN_OPTIONS.issuperset(types) or not PLAIN_TENSORS.issuperset(map(type, arguments)):
        return None
    kinds = [None if t is None else (t.shape, t.dtype, t.device, t.layout, t.requires_grad) for t in arguments]
    # The key includes the types of the options, because True, 1 and 1.0 are equal.
    return options, types, tuple(kinds), torch.is_grad_enabled()


def is_transformed() -> bool:
    """Return True inside a compiler, a functorch transform or a dispatch mode of torch."""
    if torch.compiler.is_compiling():
        return True
    return torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack() > 0


def _whole(name: str, value: Any, expected: str) -> int:
    """Return a whole number as an int; `expected` completes the error about other values.

    A floating-point tensor of one element is truncated, as gsplat does: programs give `width=K[0, 2] * 2`.
    """
    try:
        if isinstance(value, Tensor) and value.is_floating_point():
            return int(value)
        if not isinstance(value, bool):
            return operator.index(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pass
    raise InvalidInput(f"{name} must be {expected}, got {_shown(value)}")


def _number(name: str, value: Any) -> float:
    """Return a number, also an infinite one, as a float."""
    try:
        number = math.nan if isinstance(value, bool | str | bytes) else float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        number = math.nan
    if math.isnan(number):
        raise InvalidInput(f"{name} must be a number, got {_shown(value)}")
    return number


def _shown(value: object) -> str:
    return f"{value!r:.80} ({type(value).__name__})"


REFUSED: dict[str, str] = {
    "rays": "give viewmats and Ks, which define the rays",
    "lidar_coeffs": (
        "use the camera models pinhole, ortho and fisheye, or gsplat_core.training.measured_losses.render_ranges for a"
        " range sensor"
    ),
    "external_distortion_coeffs": (
        "distortion by a windshield is not modelled; undistort the pictures and use the camera models pinhole, ortho and"
        " fisheye"
    ),
}
"""Advice that ends the error message about an unsupported argument of gsplat, by argument; "leave it out" for others."""


def refuse_unsupported(**arguments: Any) -> None:
    """Raise NotImplementedError for the first argument that is neither None nor False.

    A rolling shutter named GLOBAL means none in gsplat.
    """
    for name, value in arguments.items():
        if value is None or value is False or getattr(value, "name", None) == "GLOBAL":
            continue
        shown = f"a tensor {list(value.shape)}" if hasattr(value, "shape") else f"{value!r:.80}"
        raise NotImplementedError(f"{name} is not supported, got {shown}; {REFUSED.get(name, 'leave it out')}")
