"""The tool network: a small convolutional encoder and decoder."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

CHANNELS = (16, 24, 48, 96)
STRIDE = 16
"""Height and width of the network's input must be multiples of this."""


DARK = 0.06
"""Offset of the logarithms of ratios, which are noise where it is dark."""


def features(pictures: Tensor) -> Tensor:
    """Return red, green and blue in -1..1 and the logarithms of red over green and of green over blue, [N, 5, h, w].

    Args:
        pictures: RGB [N, 3, h, w] in 0..1.
    """
    logs = torch.log(pictures + DARK)
    return torch.cat([pictures * 2 - 1, logs[:, :1] - logs[:, 1:2], logs[:, 1:2] - logs[:, 2:3]], dim=1)


class Block(nn.Sequential):
    """3x3 convolution, normalisation and rectifier."""

    def __init__(self, channels_in: int, channels: int, stride: int = 1, dilation: int = 1, size: int = 3) -> None:
        super().__init__(
            nn.Conv2d(channels_in, channels, size, stride, dilation * (size // 2), dilation, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Block that is added to its input."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.block = Block(channels, channels, dilation=dilation)

    def forward(self, features: Tensor) -> Tensor:
        return features + self.block(features)


class Separable(nn.Sequential):
    """3x3 convolution of each channel by itself, then a mix of channels."""

    def __init__(self, channels: int) -> None:
        super().__init__(
            nn.Conv2d(channels, channels, 3, 1, 1, groups=channels, bias=False),
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(inplace=True),
        )


class Context(nn.Module):
    """Adds a function of the mean over the picture to every position, for example of the tissue's colour."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Linear(channels, channels // 2)
        self.outer = nn.Linear(channels // 2, channels)

    def forward(self, features: Tensor) -> Tensor:
        mean = features.mean((2, 3))
        return features + self.outer(torch.relu(self.inner(mean)))[:, :, None, None]


class ToolNetwork(nn.Module):
    """Encoder and decoder with skip connections.

    Args of a call:
        picture: `features` of a picture, [N, 5, h, w], h and w multiples of `STRIDE`.

    Returns:
        Logits of tool [N, 1, h / 2, w / 2].
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = CHANNELS
        self.stem = Block(5, a, stride=2)
        self.second = nn.Sequential(Block(a, b, stride=2), Residual(b))
        self.third = nn.Sequential(Block(b, c, stride=2), Residual(c))
        self.fourth = nn.Sequential(
            Block(c, d, stride=2), Context(d), Residual(d), Residual(d, dilation=2), Context(d), Residual(d)
        )
        self.to_third = nn.Conv2d(d, c, 1)
        self.at_third = Residual(c)
        self.to_second = nn.Conv2d(c, b, 1)
        self.at_second = Residual(b)
        self.to_first = nn.Conv2d(b, a, 1)
        self.at_first = Separable(a)
        self.out = nn.Conv2d(a, 1, 1)

    def forward(self, picture: Tensor) -> Tensor:
        first = self.stem(picture)
        second = self.second(first)
        third = self.third(second)
        fourth = self.fourth(third)
        x = self.at_third(third + twice(self.to_third(fourth)))
        x = self.at_second(second + twice(self.to_second(x)))
        x = self.at_first(first + twice(self.to_first(x)))
        return self.out(x)


def twice(features: Tensor) -> Tensor:
    """Double height and width."""
    return nn.functional.interpolate(features, scale_factor=2.0, mode="nearest")


def fused(network: nn.Module) -> nn.Module:
    """Return a copy for inference whose normalisations are part of the convolutions."""
    copied = copy.deepcopy(network).cpu().to(memory_format=torch.contiguous_format).eval()
    for part in copied.modules():
        if isinstance(part, Block | Separable):
            for index in range(len(part) - 1):
                before, after = part[index], part[index + 1]
                if isinstance(before, nn.Conv2d) and isinstance(after, nn.BatchNorm2d):
                    part[index], part[index + 1] = fuse_conv_bn_eval(before, after), nn.Identity()
    return copied
