"""Learned corrections of camera poses, with priors, for one's own training loop."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.poses.se3 import exp


class CameraCorrections(torch.nn.Module):
    """One rigid correction for each camera, applied in camera coordinates: exp(twist) @ viewmat.

    Poses and scene can move together without a change of the pictures. Fixed cameras and the prior prevent this.

    ```python
    corrections = CameraCorrections(len(viewmats), translation_sigma=0.5, rotation_sigma=0.01)
    optimiser = torch.optim.Adam(corrections.parameters(), lr=1e-3)
    image, _, _ = rasterization(..., viewmats=corrections(viewmats[ids], ids), ...)
    loss = (image - target).abs().mean() + 1e-3 * corrections.prior(ids)
    ```

    Args:
        count: number of cameras.
        translation_sigma: expected error of the positions in the scene's unit.
        rotation_sigma: expected error of the directions in radians.
        fixed: indices of cameras without correction; the first one by default.

    Raises:
        InvalidInput: for a sigma that is not positive, or a fixed camera that does not exist.
    """

    sigmas: Tensor
    """Expected errors [6] of a twist: of the translation in the scene's unit, of the rotation in radians."""
    free: Tensor
    """Factors [count, 1]: 0 for fixed cameras, else 1."""

    def __init__(
        self, count: int, *, translation_sigma: float, rotation_sigma: float, fixed: Sequence[int] = (0,)
    ) -> None:
        super().__init__()
        if not (0 < translation_sigma < float("inf") and 0 < rotation_sigma < float("inf")):
            raise InvalidInput(
                f"translation_sigma and rotation_sigma must be positive, got {translation_sigma} and {rotation_sigma}"
            )
        wrong = [index for index in fixed if not 0 <= index < count]
        if wrong:
            raise InvalidInput(f"fixed: there is no camera {wrong[0]}; the {count} cameras count from 0")
        self.normalised = torch.nn.Parameter(torch.zeros(count, 6))
        """Twists [count, 6] divided by their expected errors, so that one learning rate fits both parts."""
        sigmas = torch.tensor([translation_sigma] * 3 + [rotation_sigma] * 3)
        free = torch.ones(count, 1)
        free[list(fixed)] = 0
        self.register_buffer("sigmas", sigmas)
        self.register_buffer("free", free)

    def twists(self, ids: Tensor | None = None) -> Tensor:
        """Return the twists [..., 6] (translation, rotation vector) of cameras `ids` [...]; all by default."""
        chosen = self.normalised * self.free
        return (chosen if ids is None else chosen[ids]) * self.sigmas

    def forward(self, viewmats: Tensor, ids: Tensor | None = None) -> Tensor:
        """Return the corrected world-to-camera matrices.

        Args:
            viewmats: matrices [..., 4, 4] of the cameras `ids`.
            ids: integers [...]; None if `viewmats` are those of all cameras.

        Raises:
            InvalidInput: if the shapes do not match.
        """
        twists = self.twists(ids)
        if viewmats.shape != (*twists.shape[:-1], 4, 4):
            raise InvalidInput(
                f"viewmats must be {[*twists.shape[:-1], 4, 4]}, one for each camera of ids, got {list(viewmats.shape)}"
            )
        return exp(twists.to(viewmats.dtype)) @ viewmats

    def prior(self, ids: Tensor | None = None) -> Tensor:
        """Return the mean negative logarithm of the corrections' normal distribution, without its constant."""
        chosen = self.normalised * self.free
        return 0.5 * (chosen if ids is None else chosen[ids]).square().sum(-1).mean()

    def smoothness(self, step_sigma: float = 1.0) -> Tensor:
        """Return the mean negative logarithm of the normal distribution of differences between corrections of
        consecutive cameras of a video.

        Args:
            step_sigma: expected difference as a share of the expected errors.
        """
        if len(self.normalised) < 2:
            return self.normalised.sum() * 0
        return 0.5 * ((self.normalised * self.free).diff(dim=0) / step_sigma).square().sum(-1).mean()
