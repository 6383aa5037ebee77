"""Regression of functions of 1 to 4 variables by Gaussian splats, with Wasserstein-Fisher-Rao descent.

from gsplat_core.regression import fit

fitted = fit(points, values, count=64)
fitted.splats(other_points)
"""

from gsplat_core.regression.birth_death import BirthDeath, births_and_deaths
from gsplat_core.regression.fit import Fit, FitOptions, fit
from gsplat_core.regression.splats import Splats, loss_and_gradients, wasserstein_distance

__all__ = [
    "BirthDeath",
    "Fit",
    "FitOptions",
    "Splats",
    "births_and_deaths",
    "fit",
    "loss_and_gradients",
    "wasserstein_distance",
]
