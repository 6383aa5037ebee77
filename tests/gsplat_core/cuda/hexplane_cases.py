"""A HexPlane field with Gaussians and a gradient of its deltas, and its exact gradients, for the tests of its training."""

import itertools

import torch

from gsplat_core import reference
from gsplat_core.ops.hexplane_training import hexplane_train, hexplane_train_backward
from gsplat_core.ops.plain_torch import HEAD_COLUMNS, PLANE_AXES
from gsplat_core.scene.gaussians import RAW_COLUMNS

BOX = torch.tensor([[-2.0, -1.0, 0.5], [2.0, 3.0, 1.5]])


def random(seed):
    return torch.Generator().manual_seed(seed)


class Case:
    """A field on the CPU in float32, Gaussians around its box, and a gradient of the deltas."""

    def __init__(
        self, n=700, channels=32, levels=2, width=32, depth=2, sizes=(9, 7, 8, 5), time=0.37, seed=0, spread=1.1
    ):
        generator = random(seed)
        self.means = BOX.mean(0) + spread * (BOX[1] - BOX[0]) * (torch.rand(n, 3, generator=generator) - 0.5)
        self.time = torch.tensor([time])
        self.planes = [
            0.6 + torch.rand(grid[v], grid[u], channels, generator=generator)
            for grid in ([s * (l + 1) for s in sizes[:3]] + [sizes[3]] for l in range(levels))
            for u, v in PLANE_AXES
        ]
        pairs = list(itertools.pairwise([channels * levels] + [width] * depth + [len(HEAD_COLUMNS)]))
        self.weights = [torch.randn(b, a, generator=generator) / a**0.5 for a, b in pairs]
        self.biases = [0.1 * torch.randn(b, generator=generator) for _, b in pairs]
        self.v_raw = torch.randn(n, RAW_COLUMNS, generator=generator)

    def exact(self):
        """Deltas, and gradients of the means, the planes and the network, in float64."""
        means, planes, weights, biases = (
            [t.double().requires_grad_() for t in group]
            for group in ([self.means], self.planes, self.weights, self.biases)
        )
        low, high = BOX.double()
        space = (2 * (means[0] - low) / (high - low) - 1).clamp(-1, 1)
        x = torch.cat([space, self.time.double().expand(space.shape[0], 1)], dim=1)
        levels = [reference.hexplane_features(x, *planes[i : i + 6]) for i in range(0, len(planes), 6)]
        outputs = reference.hexplane_decode(levels, x, [], weights, biases)
        deltas = outputs.new_zeros(outputs.shape[0], RAW_COLUMNS)
        deltas[:, HEAD_COLUMNS] = outputs
        deltas.backward(self.v_raw.double())
        network = torch.cat([t.grad.flatten() for pair in zip(weights, biases, strict=True) for t in pair])
        return deltas.detach(), means[0].grad, [p.grad for p in planes], network

    def on(self, device):
        names = ("means", "planes", "weights", "biases", "time", "v_raw")
        out = object.__new__(Case)
        for name in names:
            value = getattr(self, name)
            setattr(
                out, name, [t.to(device) for t in value] if isinstance(value, list) else value.to(device, copy=True)
            )
        out.box = BOX.to(device)
        return out

    def forward(self):
        return hexplane_train(self.means, self.box, self.time, self.planes, self.weights, self.biases)

    def backward(self, state, v_raw):
        return hexplane_train_backward(v_raw, self.box, state, self.planes, self.weights, self.biases)
