"""Parameters of the unscented transform, with gsplat's names and defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsplat_core.errors import InvalidInput


@dataclass
class UnscentedTransformParameters:
    """Sigma points and validity of the unscented transform (Wan and van der Merwe 2000).

    Raises:
        InvalidInput: for an alpha or a spread that is not positive, or a negative margin.
    """

    alpha: float = 0.1
    """Spread of the sigma points around the mean."""
    beta: float = 2.0
    """Prior knowledge of the distribution; 2 is optimal for Gaussians."""
    kappa: float = 0.0
    """Secondary scaling of the sigma points."""
    in_image_margin_factor: float = 0.1
    """Margin around the picture in which sigma points are valid, as a share of its size."""
    require_all_sigma_points_valid: bool = True
    """Cull Gaussians with any sigma point outside the picture and its margin. False culls only those with all of them outside.

    A sigma point behind the camera or in a part of the lens that folds over culls the Gaussian in both cases.
    """

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and 3 + self.kappa > 0 and math.isfinite(self.alpha * (3 + self.kappa) + self.beta)):
            raise InvalidInput(
                f"ut_params: alpha must be positive and kappa above -3, got alpha={self.alpha}, kappa={self.kappa}"
            )
        if not self.in_image_margin_factor >= 0:
            raise InvalidInput(
                f"ut_params: in_image_margin_factor must not be negative, got {self.in_image_margin_factor}"
            )

    @property
    def spread(self) -> float:
        """Distance of a sigma point from the mean in standard deviations along its axis."""
        return self.alpha * math.sqrt(3 + self.kappa)

    @property
    def weight(self) -> float:
        """Weight of each outer sigma point in mean and covariance."""
        return 0.5 / self.spread**2

    @property
    def center_weight(self) -> float:
        """Weight of the central sigma point in the covariance; its weight in the mean is 1 less the other six."""
        return 1 - 6 * self.weight + 1 - self.alpha**2 + self.beta
