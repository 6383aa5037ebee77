"""HexPlane with an MLP: six feature planes over space and time, and a small network that turns features into motion.

Planes after HexPlane (Cao and Johnson 2023, eq. 3), used for Gaussians as in 4D Gaussian Splatting (Wu et al. 2024,
section 4.2) and in G-SHARP: product over the six planes, concatenation over the levels, a trunk, and heads for position,
log-scale, rotation and opacity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from types import ModuleType
from typing import Any, cast

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, checked_window, ops_for
from gsplat_core.deformation.field_slots import WholeFieldSlot
from gsplat_core.deformation.smoothing import towards_neighbours_
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane import hexplane as compiled
from gsplat_core.ops.hexplane import plain_torch
from gsplat_core.ops.hexplane.plain_torch import PLANE_AXES
from gsplat_core.ops.hexplane_deltas.hexplane_deltas import hexplane_deltas, takes_layers
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import HEAD_COLUMNS, HEAD_GROUPS, width_of

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
SPACE_PLANES, TIME_PLANES = PLANE_NAMES[:3], PLANE_NAMES[3:]
BOX_MARGIN = 0.05
"""Share of the box's longest side added on every side, so that Gaussians can move a little and stay inside."""


def box_around(means: Tensor) -> Tensor:
    """[2, 3]: corners of the finite positions with a margin; the unit box around the origin when there are none."""
    box = torch.tensor([[-1.0] * 3, [1.0] * 3], device="cpu" if means.is_meta else means.device)
    if means.is_meta:  # only the shape is wanted
        return box
    finite = means.detach().to(torch.float32)
    finite = finite[finite.isfinite().all(dim=1)]
    if finite.shape[0] == 0:
        return box
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    margin = max(float((high - low).max()) * BOX_MARGIN, 1e-3)
    return torch.stack([low - margin, high + margin])


def _along_a_curve(coordinates: Tensor) -> Tensor:
    """int32 [N]: the points in the order of a Morton curve, so that those side by side read the same memory."""
    code = torch.zeros(coordinates.shape[0], dtype=torch.int64, device=coordinates.device)
    cells = ((coordinates[:, :3].nan_to_num() + 1) * 511.5).clamp(0, 1023).long()
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort(stable=True).int()


class HexPlaneField(DeformationField):
    """Six planes per level, `channels` features each; a trunk of `depth` layers of `width`; one linear head of 11 channels.

    `resolution` is the grid of (x, y, z, t) at level 1; a level m multiplies x, y and z by m, as in 4D Gaussian Splatting.
    Planes are stored channels-last [V, U, C]. Space planes start uniform in 0.1..0.5, time planes at 1, and the head at
    zero, so an untrained field is the identity. `box` [2, 3] is the corner-to-corner range of the canonical positions; it is
    set from the Gaussians when the field is made. Positions outside it are clamped to its surface.
    """

    kind = "hexplane"
    slot_type = WholeFieldSlot

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

    def coordinates(self, means: Tensor, time_s: float) -> Tensor:
        """[N, 4] in [-1, 1]: the one place where space and time are normalised. Outside the box or window: clamped."""
        low, high = self.box.to(means.dtype)
        space = (2 * (means - low) / (high - low) - 1).clamp(-1, 1)
        return torch.cat([space, torch.full_like(space[:, :1], self.frame_time(time_s))], dim=1)

    @property
    def has_frame_deltas(self) -> bool:
        """Whether the kernel takes the network's sizes; plain torch, which others fall back to, cannot be captured."""
        return takes_layers(self.channels, len(self.levels), self.width, self.depth)

    def frame_time(self, time_s: float) -> float:
        """What `frame_deltas` takes for a time: it, clamped to the window, in [-1, 1]."""
        start, end = self.time_window_s
        return 2 * (self.clamp_time(time_s) - start) / (end - start) - 1 if end > start else 0.0

    def features(self, means: Tensor, time_s: float) -> Tensor:
        """[N, levels * channels]: product over the planes, levels side by side."""
        return torch.cat(self._features(self.coordinates(means, time_s)), dim=1)

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`; outside the window the state of its nearest end."""
        coordinates = self.coordinates(gaussians.means, time_s)
        # With a graph, torch's own layers: they keep what their gradients need.
        ops = plain_torch if torch.is_grad_enabled() else self._ops
        return self._displaced(
            gaussians, ops.hexplane_decode(self._features(coordinates), coordinates, [], *self._network())
        )

    def cached(self, gaussians: Gaussians) -> Callable[[float], Gaussians]:
        """Factorised inference: the product of the space planes is kept per Gaussian, and at a new time the time planes
        are interpolated into lines once, then sampled and multiplied. Exact up to rounding."""
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
        """From a float32 [1] on the field's device, a time of `frame_time`, to what the field adds then: [N, 16], the frame path's layout.

        No autograd graph. What does not depend on time is computed now, for the planes as they are; the function follows later changes of
        time planes and network only. On CUDA nothing waits for the host, so that a CUDA graph can hold the call.

        Args:
            dtype: torch.float16 keeps the space features in half the memory and runs the network in half precision, which on CUDA is
                twice as fast and adds an error of about 1e-3 of the deltas. Elsewhere, and for sizes that the kernels do not take, float32.
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
        """Cover another window with the same number of time rows: what was learned keeps its place in time.

        The rows are interpolated linearly, so a longer window has coarser rows; beyond the old window they hold the nearest
        end. Parameters are changed in place, so that an optimiser can go on with them.
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
        """See `DeformationField.smooth_in_time`: the rows of the time planes."""
        for plane in self._named(TIME_PLANES):
            towards_neighbours_(plane.data.transpose(0, 1), amount)

    def plane_tensors(self) -> list[Tensor]:
        """The planes' memory, outside of autograd: xy, xz, yz, xt, yt, zt of every level."""
        return [plane.data for plane in self._named(PLANE_NAMES)]

    def network_tensors(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases of the trunk and the head, layer by layer, outside of autograd."""
        weights, biases = self._network()
        return [weight.data for weight in weights], [bias.data for bias in biases]

    def config(self) -> dict[str, Any]:
        """Kind, window and architecture; the box is stored with the tensors."""
        return {
            "kind": self.kind,
            "time_window_s": list(self.time_window_s),
            "channels": self.channels,
            "resolution": list(self.resolution),
            "levels": list(self.levels),
            "width": self.width,
            "depth": self.depth,
        }

    def check_state(self) -> None:
        """InvalidInput when the box is not one: its lower corner must be below its upper one."""
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
        """The planes of these names, level by level."""
        return [[cast(torch.nn.ParameterDict, planes)[name] for name in names] for planes in self.planes]

    def _lines(self, planes: Sequence[Tensor], time_s: float) -> list[Tensor]:
        """The time planes of one level interpolated at `time_s`: three lines [U, C]."""
        rows = self.resolution[3]
        t = torch.tensor(
            self.frame_time(time_s), dtype=self.box.dtype
        )  # on the CPU: reading it back from a GPU would wait
        at = float((t + 1) / 2 * (rows - 1))
        row = min(int(at), rows - 2)
        return [torch.lerp(plane[row], plane[row + 1], at - row) for plane in planes]

    def _features(self, coordinates: Tensor) -> list[Tensor]:
        return [self._ops.hexplane_features(coordinates, *level) for level in self._levels(PLANE_NAMES)]

    def _network(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases of the trunk and the head, layer by layer."""
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
        )
