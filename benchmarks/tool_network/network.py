"""The tool network: a small convolutional encoder and decoder."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

CHANNELS = (16, 24, 48, 96, 144)
INPUTS = 8
"""Number of planes of the input."""
STRIDE = 32
"""Height and width of the network's input must be multiples of this."""


DARK = 0.06
"""Offset of the logarithms of ratios, which are noise where it is dark."""


SURROUND = 16 / 255
"""Largest channel below which a pixel counts as surround of the field of view, not as part of a picture's mean."""


def features(pictures: Tensor) -> Tensor:
    """Return the network's input, [N, 8, h, w].

    The planes are red, green and blue in -1..1, the logarithms of red over green and of green over blue, and those and the logarithm of green
    relative to their means over the picture. So a colour is known both by itself and compared with the tissue of the same picture.

    Args:
        pictures: RGB [N, 3, h, w] in 0..1.
    """
    logs = torch.log(pictures + DARK)
    ratios = torch.cat([logs[:, :1] - logs[:, 1:2], logs[:, 1:2] - logs[:, 2:3], logs[:, 1:2]], dim=1)
    inside = (pictures.amax(1, keepdim=True) >= SURROUND).float()
    mean = (ratios * inside).sum((2, 3), keepdim=True) / inside.sum((2, 3), keepdim=True).clamp(min=1)
    return torch.cat([pictures * 2 - 1, ratios[:, :2], ratios - mean], dim=1)


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


class MixedStyle(nn.Module):
    """In training, gives a share of pictures means and deviations of channels between their own and another picture's.

    Zhou et al., "Domain generalization with MixStyle", 2021. The network relies less on colours and textures that are usual in drawn pictures.
    """

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, features: Tensor) -> Tensor:
        if not self.training:
            return features
        count = len(features)
        mean = features.mean((2, 3), keepdim=True)
        deviation = (features.var((2, 3), keepdim=True) + 1e-5).sqrt()
        mean, deviation = mean.detach(), deviation.detach()
        chance = torch.rand((2, count, 1, 1, 1), device=features.device)
        # Of a beta distribution with both parameters 0.5.
        own = torch.where(chance[0] < self.share, torch.sin(torch.pi / 2 * chance[1]) ** 2, 1.0)
        other = torch.randperm(count, device=features.device)
        mixed_mean = own * mean + (1 - own) * mean[other]
        mixed_deviation = own * deviation + (1 - own) * deviation[other]
        return (features - mean) / deviation * mixed_deviation + mixed_mean


class ToolNetwork(nn.Module):
    """Encoder and decoder with skip connections.

    Args of a call:
        picture: `features` of a picture, [N, 8, h, w], h and w multiples of `STRIDE`.

    Returns:
        Logits of tool [N, 1, h / 2, w / 2]; in training also coarse ones [N, 1, h / 16, w / 16].
    """

    def __init__(self, mixed: float = 0.0) -> None:
        """Create an untrained network. `mixed` is the share of pictures with a mixed style in training."""
        super().__init__()
        a, b, c, d, e = CHANNELS
        self.stem = Block(INPUTS, a, stride=2)
        self.second = nn.Sequential(Block(a, b, stride=2), Residual(b))
        self.third = nn.Sequential(Block(b, c, stride=2), Residual(c))
        self.fourth = nn.Sequential(Block(c, d, stride=2), Context(d), Residual(d))
        self.fifth = nn.Sequential(Block(d, e, stride=2), Context(e), Residual(e), Residual(e), nn.Dropout2d(0.1))
        self.to_fourth = nn.Conv2d(e, d, 1)
        self.at_fourth = Residual(d)
        self.coarse = nn.Conv2d(d, 1, 1)
        self.mixed = MixedStyle(mixed)
        self.to_third = nn.Conv2d(d, c, 1)
        self.at_third = Residual(c)
        self.to_second = nn.Conv2d(c, b, 1)
        self.at_second = Residual(b)
        self.to_first = nn.Conv2d(b, a, 1)
        self.at_first = Separable(a)
        self.out = nn.Conv2d(a, 1, 1)

    def forward(self, picture: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        first = self.mixed(self.stem(picture))
        second = self.mixed(self.second(first))
        third = self.third(second)
        fourth = self.fourth(third)
        fourth = self.at_fourth(fourth + twice(self.to_fourth(self.fifth(fourth))))
        x = self.at_third(third + twice(self.to_third(fourth)))
        x = self.at_second(second + twice(self.to_second(x)))
        x = self.at_first(first + twice(self.to_first(x)))
        return (self.out(x), self.coarse(fourth)) if self.training else self.out(x)


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
