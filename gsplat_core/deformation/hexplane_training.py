"""The HexPlane field's part in a training step that runs on the GPU alone, without autograd and without a wait of the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.hexplane_deltas.hexplane_deltas import takes_layers
from gsplat_core.ops.hexplane_training.hexplane_training import (
    AdamOnDevice,
    FieldGradient,
    TrainingState,
    hexplane_planes_adam_,
    hexplane_train,
    hexplane_train_backward,
    network_adam_,
)
from gsplat_core.scene.gaussians import Gaussians


class HexPlaneTraining:
    """Deltas, gradients and Adam of one field: `deltas`, then `update` with their gradient, and again.

    Both only queue work on the current stream and read time, rates and step from device memory, so a CUDA graph can hold a step and be
    replayed with others. Parameters and moments change in place. The same inputs give the same bits.

    Args:
        field: float32 on a CUDA device. Its tensors are taken now: where they are replaced by others, another `HexPlaneTraining` is due.

    Raises:
        InvalidInput: the field is elsewhere, or its sizes are not those that the kernels take; train it with autograd then.
    """

    rates = 2
    """Learning rates that `update` takes: of the planes, of the network."""
    reads_positions = True
    """The deltas depend on the Gaussians' positions, whose gradient `update` completes."""

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
        """Of the planes, of the network."""
        return [rates["planes"], rates["network"]]

    def tensors(self) -> Sequence[Tensor]:
        """Everything on the device that a step reads or changes."""
        return self._tensors

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor:
        """What the field adds to the Gaussians at `time` [1], one of `HexPlaneField.frame_time`: [N, 16], the frame path's layout."""
        means = gaussians.means.detach()
        self._state = hexplane_train(means, self._box, time, self._planes, self._weights, self._biases)
        return self._state.deltas

    def gradient(self, v_raw: Tensor) -> FieldGradient:
        """The field's gradient for dL/d(deltas) `v_raw` [N, 16] of the last `deltas`; adds the part of the positions to it in place."""
        if self._state is None:
            raise InvalidInput("there are no deltas to go back from; call deltas first")
        layers = self._weights, self._biases
        return hexplane_train_backward(v_raw, self._box, self._state, self._planes, *layers)

    def update(self, v_raw: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor | None = None) -> None:
        """One step of Adam for dL/d(deltas) `v_raw` [N, 16] of the last `deltas`; adds the positions' part to its first 3 columns.

        Args:
            time: as for `deltas`.
            rates: float32 [2], of the planes and of the network.
            step: int64 [1], counts from 1.
            status: int32 [4] of the frame; if its lists overflowed, nothing but `v_raw` is changed.
        """
        gradient = self.gradient(v_raw)
        of_planes, of_network = (
            AdamOnDevice(rate, step, status, self._betas, self._epsilon) for rate in (rates[:1], rates[1:])
        )
        hexplane_planes_adam_(self._planes, self._first, self._second, time, gradient, of_planes)
        network_adam_(self._network, gradient.network, self._network_first, self._network_second, of_network)
        self._state = None

    def add_colours(self, change: Tensor, time: Tensor) -> None:
        """A HexPlane takes no colours at one time: raises InvalidInput."""
        raise InvalidInput("the colours of a hexplane field cannot be set at one time; train them")
