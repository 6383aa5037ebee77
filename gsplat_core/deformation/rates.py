"""Learning rates of deformation fields."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting


@dataclass(frozen=True)
class FieldRates:
    """Adam's learning rates of one kind of field: a frozen dataclass of numbers that derives from this one.

    A rate whose name ends in `_px` moves positions and is in pixels of the training image; the others are in the units of what they train.
    Raises InvalidSetting when a rate is not in 0..10.
    """

    def __post_init__(self) -> None:
        check_rates(vars(self))

    def scaled(self, mm_per_px: float, scale: float = 1.0) -> dict[str, float]:
        """Every rate by name, times `scale`; those in pixels become rates in the scene's unit of length."""
        return {name: (rate * mm_per_px if name.endswith("_px") else rate) * scale for name, rate in vars(self).items()}

    def rate_of(self, parameter: str) -> str:
        """The name of the rate with which autograd training updates this parameter, one of `Module.named_parameters()`."""
        raise NotImplementedError(f"{type(self).__name__} does not say which rate {parameter} has")


@dataclass(frozen=True)
class OneRate(FieldRates):
    """The same rate for every parameter of a field."""

    parameters: float = 5e-3

    def rate_of(self, parameter: str) -> str:
        return "parameters"


def check_rates(rates: dict[str, float]) -> None:
    """Raise InvalidSetting unless every rate is in 0..10."""
    for name, rate in rates.items():
        if not 0 <= rate < 10:
            raise InvalidSetting(f"learning rate {name} is {rate}; it must be between 0 and 10")
