"""HexPlane deformation field: six feature planes over space and time, decoded by an MLP.

Planes follow HexPlane (Cao and Johnson 2023, eq. 3), used for Gaussians as in 4D Gaussian Splatting
(Wu et al. 2024, section 4.2) and in G-SHARP. Features are the product over the six planes,
concatenated over the levels. A trunk and heads predict position, log-scale, rotation and opacity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any, cast

import torch
from torch import Tensor

from gsplat_core.deformation.field import (
    Capabilities,
    DeformationField,
    WholeFieldSlot,
    checked_window,
    ops_for,
    towards_neighbours_,
)
from gsplat_core.deformation.kinds import FieldKind, NewField, OneRate
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import hexplane as compiled
from gsplat_core.ops import plain_torch
from gsplat_core.ops.hexplane_deltas import hexplane_deltas, takes_layers
from gsplat_core.ops.hexplane_training import (
    AdamOnDevice,
    FieldGradient,
    TrainingState,
    hexplane_planes_adam_,
    hexplane_train,
    hexplane_train_backward,
    network_adam_,
)
from gsplat_core.ops.plain_torch import HEAD_COLUMNS, HEAD_GROUPS, PLANE_AXES
from gsplat_core.scene.gaussians import Gaussians, width_of
from gsplat_core.value_ranges import IntegerIn, ListOf

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
SPACE_PLANES, TIME_PLANES = PLANE_NAMES[:3], PLANE_NAMES[3:]
BOX_MARGIN = 0.05
"""Margin on every side as a share of the box's longest side, so that Gaussians can move inside."""


def box_around(means: Tensor) -> Tensor:
    """Return the corners [2, 3] of the bounding box of all finite positions, with a margin.

    Without finite positions, the box is [-1, 1]³.
    """
    box = torch.tensor([[-1.0] * 3, [1.0] * 3], device="cpu" if means.is_meta else means.device)
    if means.is_meta:  # a meta tensor has a shape but no values
        return box
    finite = means.detach().to(torch.float32)
    finite = finite[finite.isfinite().all(dim=1)]
    if finite.shape[0] == 0:
        return box
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    margin = max(float((high - low).max()) * BOX_MARGIN, 1e-3)
    return torch.stack([low - margin, high + margin])


def _along_a_curve(coordinates: Tensor) -> Tensor:
    """Return the order of points along a Morton curve, int32 [N], for coherent memory access."""
    code = torch.zeros(coordinates.shape[0], dtype=torch.int64, device=coordinates.device)
    cells = ((coordinates[:, :3].nan_to_num() + 1) * 511.5).clamp(0, 1023).long()
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort(stable=True).int()


class HexPlaneField(DeformationField):
    """HexPlane field with six planes per level, a trunk MLP and one linear head of 11 channels.

    `resolution` is the grid of (x, y, z, t) at level 1. Level m multiplies x, y and z by m, as in 4D Gaussian
    Splatting. Each plane has `channels` features, stored channels-last [V, U, C]. The trunk has `depth` layers of
    `width`. Space planes start uniformly in 0.1..0.5, time planes at 1, and the head at zero, so an untrained field is
    the identity. `box` [2, 3] bounds the canonical positions. It is computed from the Gaussians when the field is
    created. Positions outside are clamped to it.
    """

    kind = "hexplane"

    def __init__(
        self,
        gaussians: Gaussians,
        time_window_s: tuple[float, float],
        *,
        channels: int = 32,
        resolution: Sequence[int] = (64, 64, 64, 25),
        levels: Sequence[int] = (1, 2),
        width: int = 64,
        depth: int = 3,
    ) -> None:
        super().__init__(time_window_s)
        if len(resolution) != 4 or min(resolution) < 2:
            raise InvalidInput(f"resolution must be four sizes (x, y, z, t) of at least 2, got {list(resolution)}")
        if not levels or min(levels) < 1 or channels < 1 or width < 1 or depth < 1:
            raise InvalidInput(
                f"levels, channels, width and depth must be at least 1, got {list(levels)}, {channels}, {width}, {depth}"
            )
        self.channels, self.resolution, self.levels = channels, tuple(resolution), tuple(levels)
        self.width, self.depth = width, depth
        self.box: Tensor
        self.register_buffer("box", box_around(gaussians.means))
        self.planes = torch.nn.ModuleList(self._new_planes(level) for level in self.levels)
        sizes = [channels * len(self.levels)] + [width] * depth
        self.trunk = torch.nn.ModuleList(torch.nn.Linear(a, b) for a, b in pairwise(sizes))
        self.head = torch.nn.Linear(width, len(HEAD_COLUMNS))
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)
        if not gaussians.means.is_meta:
            self.to(self.box.device)

    @classmethod
    def for_gaussians(
        cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any
    ) -> HexPlaneField:
        return cls(gaussians, time_window_s, **architecture)

    @property
    def capabilities(self) -> Capabilities:
        # The torch fallback for other sizes cannot be captured in a CUDA graph.
        has_kernel = takes_layers(self.channels, len(self.levels), self.width, self.depth)
        return Capabilities(
            frame_deltas=self if has_kernel else None,
            slot=lambda rows: WholeFieldSlot(self),
            smooth_in_time=self.smooth_in_time,
        )

    def coordinates(self, means: Tensor, time_s: float) -> Tensor:
        """Normalise positions and time to [N, 4] in [-1, 1], clamped to the box and window."""
        low, high = self.box.to(means.dtype)
        space = (2 * (means - low) / (high - low) - 1).clamp(-1, 1)
        return torch.cat([space, torch.full_like(space[:, :1], self.frame_time(time_s))], dim=1)

    def frame_time(self, time_s: float) -> float:
        """Map `time_s`, clamped to the time window, to the argument of `frame_deltas` in [-1, 1]."""
        start, end = self.time_window_s
        return 2 * (self.clamp_time(time_s) - start) / (end - start) - 1 if end > start else 0.0

    def features(self, coordinates: Tensor) -> list[Tensor]:
        """Return the features [N, channels] of each level: the product of its six planes, sampled at `coordinates` [N, 4]."""
        return [self._ops.hexplane_features(coordinates, *level) for level in self._levels(PLANE_NAMES)]

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Deform Gaussians to `time_s`, clamped to the window."""
        coordinates = self.coordinates(gaussians.means, time_s)
        # The torch implementation keeps the intermediates that autograd needs.
        ops = plain_torch if torch.is_grad_enabled() else self._ops
        return self._displaced(
            gaussians, ops.hexplane_decode(self.features(coordinates), coordinates, [], *self._network())
        )

    def cached(self, gaussians: Gaussians) -> Callable[[float], Gaussians]:
        """Return a factorised inference function; exact up to rounding.

        The product of the space planes is kept per Gaussian. For each new time, the time planes are
        interpolated to lines, sampled and multiplied.
        """
        gaussians = gaussians.detach()
        if self.box.device.type == "cuda" and self._ops is compiled:
            deltas = self.frame_deltas(gaussians)

            def displaced_at(time_s: float) -> Gaussians:
                time = torch.full((1,), self.frame_time(time_s), device=self.box.device)
                return self._displaced(gaussians, deltas(time)[:, list(HEAD_COLUMNS)])

            return displaced_at
        with torch.no_grad():
            coordinates = self.coordinates(gaussians.means, self.time_window_s[0])
            spaces = [self._ops.hexplane_space(coordinates, *level) for level in self._levels(SPACE_PLANES)]

        def at(time_s: float) -> Gaussians:
            with torch.no_grad():
                lines = [line for level in self._levels(TIME_PLANES) for line in self._lines(level, time_s)]
                deltas = self._ops.hexplane_decode(spaces, coordinates, lines, *self._network())
                return self._displaced(gaussians, deltas)

        return at

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """Return a function from a normalised time to the field's deltas, without autograd.

        Features of the space planes are computed now. The returned function reflects later changes of the time planes
        and the network only. On CUDA it does not synchronise with the host, so a CUDA graph can capture the call.

        Args:
            gaussians: canonical Gaussians.
            dtype: torch.float16 halves the memory of the space features and runs the network in half precision. On CUDA
                this is twice as fast and adds an error of about 1e-3 of the deltas. On other devices, and for sizes
                that the kernels do not support, float32 is used.

        Returns:
            Function from a float32 tensor [1] on the field's device, as computed by `frame_time`, to deltas [N, 16] in
            the layout of `scene.gaussians`.
        """
        is_cuda = self.box.device.type == "cuda" and self._ops is compiled
        with torch.no_grad():
            coordinates = self.coordinates(gaussians.means.detach(), self.time_window_s[0])
            order = _along_a_curve(coordinates) if is_cuda else None
            if order is not None:
                coordinates = coordinates[order.long()].contiguous()
            spaces = [self._ops.hexplane_space(coordinates, *level) for level in self._levels(SPACE_PLANES)]
        sizes = (self.channels, len(self.levels), self.width, self.depth)
        if is_cuda and dtype == torch.float16 and takes_layers(*sizes, item=2):
            spaces = [space.half() for space in spaces]
        fits = is_cuda and takes_layers(*sizes, item=spaces[0].element_size())

        def at(time: Tensor) -> Tensor:
            with torch.no_grad():
                planes = [plane.data for plane in self._named(TIME_PLANES)]
                weights, biases = self.network_tensors()
                if fits:
                    return hexplane_deltas(spaces, coordinates, time, planes, weights, biases, order)
                return plain_torch.hexplane_deltas(
                    spaces, coordinates, time, planes, weights, biases, order, self._ops.hexplane_decode
                )

        return at

    def extend(self, time_window_s: tuple[float, float]) -> None:
        """Change the time window while preserving the learned motion at each time.

        The number of time rows is constant. Rows are interpolated linearly, so a longer window has
        coarser rows. Times outside the old window take the value at its nearest end. Parameters are
        changed in place, so optimiser state stays attached.
        """
        start, end = checked_window(time_window_s)
        old_start, old_end = self.time_window_s
        rows = self.resolution[3]
        times = torch.linspace(start, end, rows, dtype=torch.float64)
        at = ((times - old_start) / ((old_end - old_start) or 1.0)).clamp(0, 1) * (rows - 1)
        row = at.long().clamp(max=rows - 2)
        share = (at - row).to(torch.float32)[:, None, None].to(self.box.device)
        row = row.to(self.box.device)
        for plane in self._named(TIME_PLANES):
            plane.data.copy_(torch.lerp(plane.data[row], plane.data[row + 1], share))
        self._time_window_s = (start, end)

    def smooth_in_time(self, amount: float) -> None:
        """Smooth the rows of the time planes; see `Capabilities.smooth_in_time`."""
        for plane in self._named(TIME_PLANES):
            towards_neighbours_(plane.data.transpose(0, 1), amount)

    def plane_tensors(self) -> list[Tensor]:
        """Return the planes without autograd: xy, xz, yz, xt, yt, zt of every level."""
        return [plane.data for plane in self._named(PLANE_NAMES)]

    def network_tensors(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return weights and biases of trunk and head layer by layer, without autograd."""
        weights, biases = self._network()
        return [weight.data for weight in weights], [bias.data for bias in biases]

    def config(self) -> dict[str, Any]:
        """Return kind, window and architecture; the box is stored with the tensors."""
        return {
            **super().config(),
            "channels": self.channels,
            "resolution": list(self.resolution),
            "levels": list(self.levels),
            "width": self.width,
            "depth": self.depth,
        }

    def check_state(self) -> None:
        """Raise InvalidInput unless the lower corner of the box is below the upper one."""
        if not bool((self.box[1] > self.box[0]).all()):
            raise InvalidInput(
                f"the field's box must have its lower corner before its upper one, got {self.box.tolist()}"
            )

    def _new_planes(self, level: int) -> torch.nn.ParameterDict:
        sizes = [size * level for size in self.resolution[:3]] + [self.resolution[3]]
        planes = torch.nn.ParameterDict()
        for name, (u, v) in zip(PLANE_NAMES, PLANE_AXES, strict=True):
            plane = torch.ones(sizes[v], sizes[u], self.channels)
            planes[name] = torch.nn.Parameter(plane if name in TIME_PLANES else plane.uniform_(0.1, 0.5))
        return planes

    @property
    def _ops(self) -> ModuleType:
        return ops_for(self.box, compiled, plain_torch)

    def _named(self, names: Sequence[str]) -> list[Tensor]:
        return [plane for level in self._levels(names) for plane in level]

    def _levels(self, names: Sequence[str]) -> list[list[Tensor]]:
        """Return the feature planes with these names, such as `xy` and `xt`, as one list per resolution level."""
        return [[cast(torch.nn.ParameterDict, planes)[name] for name in names] for planes in self.planes]

    def _lines(self, planes: Sequence[Tensor], time_s: float) -> list[Tensor]:
        """Interpolate the time planes of one level at `time_s` to three lines [U, C]."""
        rows = self.resolution[3]
        t = torch.tensor(
            self.frame_time(time_s), dtype=self.box.dtype
        )  # kept on the CPU, because reading it from a GPU would synchronise
        at = float((t + 1) / 2 * (rows - 1))
        row = min(int(at), rows - 2)
        return [torch.lerp(plane[row], plane[row + 1], at - row) for plane in planes]

    def _network(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases of trunk and head, layer by layer."""
        layers = [cast(torch.nn.Linear, layer) for layer in (*self.trunk, self.head)]
        return [layer.weight for layer in layers], [layer.bias for layer in layers]

    def _displaced(self, gaussians: Gaussians, deltas: Tensor) -> Gaussians:
        position, log_scale, rotation, opacity = torch.split(deltas, [width_of(group) for group in HEAD_GROUPS], dim=1)
        return Gaussians(
            means=gaussians.means + position,
            quats=gaussians.quats + rotation,
            log_scales=gaussians.log_scales + log_scale,
            logit_opacities=gaussians.logit_opacities + opacity[:, 0],
            sh=gaussians.sh,
            right_sh=gaussians.right_sh,
            extra=gaussians.extra,
        )


class HexPlaneTraining:
    """Trainer of a HexPlane field with fused gradients and Adam.

    Each step calls `deltas`, then `update` with their gradient. Both enqueue work on the current stream and read time,
    rates and step from device memory, so a CUDA graph can capture a step and replay it with other values. Parameters
    and moments change in place. Equal inputs give bit-identical results.

    Args:
        field: float32 field on a CUDA device. Its tensors are captured here; if they are replaced, create a new
            trainer.

    Raises:
        InvalidInput: if the field is on another device or the kernels do not support its sizes. Train with autograd
            then.
    """

    rates = 2
    """Number of learning rates of `update`: planes and network."""
    reads_positions = True
    """The deltas depend on the Gaussians' positions; `update` adds that part of their gradient."""
    add_colours = None
    """No function that changes colours over time, because the field does not deform colours."""

    def __init__(
        self,
        field: HexPlaneField,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
    ) -> None:
        sizes = (field.channels, len(field.levels), field.width, field.depth)
        if field.box.device.type != "cuda" or field.box.dtype != torch.float32 or not takes_layers(*sizes):
            raise InvalidInput(
                f"training without autograd takes a float32 field on CUDA with a multiple of 16 channels and layers up to 128 wide, got"
                f" {field.box.dtype} on {field.box.device}, {field.channels} channels, {field.depth} layers of {field.width}"
            )
        self._box = field.box
        self._planes = field.plane_tensors()
        self._weights, self._biases = field.network_tensors()
        self._network = [t for pair in zip(self._weights, self._biases, strict=True) for t in pair]
        self._betas = betas
        self._epsilon = epsilon
        self._first, self._second = ([torch.zeros_like(p) for p in self._planes] for _ in range(2))
        size = sum(t.numel() for t in self._network)
        self._network_first, self._network_second = (torch.zeros(size, device=self._box.device) for _ in range(2))
        moments = (*self._first, *self._second, self._network_first, self._network_second)
        self._tensors = (*self._planes, *self._network, *moments, self._box)
        self._state: TrainingState | None = None

    def rate_values(self, rates: Mapping[str, float]) -> Sequence[float]:
        """Return the learning rates in the order planes, network."""
        return [rates["planes"], rates["network"]]

    def tensors(self) -> Sequence[Tensor]:
        """Tensors on the device that a training step reads or changes."""
        return self._tensors

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor:
        """Return the deltas [N, 16] at a normalised time.

        Args:
            gaussians: canonical Gaussians.
            time: float32 [1] as computed by `HexPlaneField.frame_time`.
        """
        means = gaussians.means.detach()
        self._state = hexplane_train(means, self._box, time, self._planes, self._weights, self._biases)
        return self._state.deltas

    def gradient(self, v_raw: Tensor) -> FieldGradient:
        """Return the field's gradient for dL/d(deltas) `v_raw` [N, 16] of the last `deltas` call.

        The gradient through the positions is added to `v_raw` in place.
        """
        if self._state is None:
            raise InvalidInput("there are no deltas to go back from; call deltas first")
        layers = self._weights, self._biases
        return hexplane_train_backward(v_raw, self._box, self._state, self._planes, *layers)

    def update(self, v_raw: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor | None = None) -> None:
        """Take one Adam step for the gradient of the deltas last returned by `deltas`.

        Args:
            v_raw: dL/d(deltas) [N, 16]; the gradient through the positions is added to columns 0 to 2.
            time: argument of the last `deltas` call.
            rates: float32 [2], learning rates of the planes and the network.
            step: int64 [1], step number from 1.
            status: int32 [4] of the frame; if its lists overflowed, only `v_raw` is changed.
        """
        gradient = self.gradient(v_raw)
        of_planes, of_network = (
            AdamOnDevice(rate, step, status, self._betas, self._epsilon) for rate in (rates[:1], rates[1:])
        )
        hexplane_planes_adam_(self._planes, self._first, self._second, time, gradient, of_planes)
        network_adam_(self._network, gradient.network, self._network_first, self._network_second, of_network)
        self._state = None


PLANES_FACTOR = 4.0


@dataclass(frozen=True)
class HexPlaneLearningRates(OneRate):
    """Learning rate of the network; that of the feature planes is `PLANES_FACTOR` times as high."""

    def scaled(self, mm_per_px: float, scale: float = 1.0) -> dict[str, float]:
        """Return the rates `planes` and `network` times `scale`."""
        network = scale * self.parameters
        return {"planes": PLANES_FACTOR * network, "network": network}

    def rate_of(self, parameter: str) -> str:
        return "planes" if parameter.startswith("planes") else "network"


ROWS_PER_SPACING = 1
"""Time rows per `NewField.spacing_s` for recordings with a known end; interpolated linearly."""
MOST_ROWS = 1 << 10


def new_hexplane_field(wanted: NewField) -> HexPlaneField:
    """Create a HexPlane field (Cao & Johnson 2023).

    For a recording with a known end, the time resolution follows the wanted motion spacing and the
    space planes have three levels. Live, the field's default resolution is used.
    """
    if wanted.end_s is None:
        return HexPlaneField.for_gaussians(wanted.gaussians, wanted.time_window_s)
    rows = round(ROWS_PER_SPACING * (wanted.end_s - wanted.start_s) / wanted.spacing_s) + 1
    resolution = (64, 64, 64, min(max(rows, 2), MOST_ROWS))
    return HexPlaneField(wanted.gaussians, wanted.time_window_s, resolution=resolution, levels=(1, 2, 4))


KIND = FieldKind(
    field=HexPlaneField,
    new=new_hexplane_field,
    config={
        "channels": IntegerIn(1, 1 << 12),
        "resolution": ListOf(IntegerIn(2, 1 << 12), 4, 4),
        "levels": ListOf(IntegerIn(1, 64), 1, 16),
        "width": IntegerIn(1, 1 << 12),
        "depth": IntegerIn(1, 64),
    },
    rates=HexPlaneLearningRates(),
    captured_training=HexPlaneTraining,
    offline_spacing_s=1 / 15,  # finer spacings have not been measured
)
