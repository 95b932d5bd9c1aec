"""Parameter estimate with its uncertainty: standard errors, undetermined combinations, goodness of fit and status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float

from fdi_torch.estimate.combinations import Combination, undetermined_groups
from fdi_torch.estimate.information import certainty
from fdi_torch.names import counted
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.quantities import quantity_text
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units, needed

if TYPE_CHECKING:
    from fdi_torch.estimate.posterior_draws import Draws

# Distances from an end of a parameter's range, as a share of it: within the first, an estimate lies at the bound by
# rounding; within the second, the range and not the data determined it.
_AT_BOUND, AT_END = 1e-9, 1e-3


@dataclass(frozen=True, repr=False)
class Estimate(Shown):
    """Estimate of one set of parameters, SI units.

    std (P,): standard errors, which include the tolerances of plant constants through their priors; infinite for
    undetermined parameters. covariance (P, P): computed without regard to bounds; infinite or NaN in the rows and
    columns of undetermined parameters. ranges: lowest and highest value by name. at_bounds: 'low' or 'high' by name.
    undetermined: one sentence per group. combinations: what is determined of the undetermined parameters.
    noise_std (C,): noise level of each channel over all recordings, known or estimated, in its unit. reached: how the
    estimate was computed, as plain values. draws: from the posterior, if some were asked for.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: torch.Tensor
    std: torch.Tensor
    covariance: torch.Tensor
    status: str = ""
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    at_bounds: Mapping[str, str] = field(default_factory=dict)
    undetermined: tuple[str, ...] = ()
    combinations: tuple[Combination, ...] = ()
    noise_std: torch.Tensor | None = None
    reached: Mapping[str, Any] = field(default_factory=dict)
    draws: Draws | None = field(default=None, repr=False)

    @property
    def headline(self) -> str:
        """Whether the estimate has converged."""
        return self.warning or self.status.replace("_", " ")

    @property
    def heading(self) -> str:
        return f"Estimate of {counted(len(self.names), 'parameter')}: {self.headline}"

    @in_its_units
    def table(self) -> Table:
        """One row per parameter, in its unit for display."""
        columns = [c.tolist() for c in (self.value, self.std, *self.interval())]
        by_parameter = zip(self.names, self.units, *columns, strict=True)
        rows = [(name, *in_display_unit(name, unit, *numbers)) for name, unit, *numbers in by_parameter]
        return Table(["parameter", "unit", "estimate", "std error", "95 % low", "95 % high"], rows)

    @property
    def warning(self) -> str:
        """The warning of an estimate that has not converged; empty for one that has."""
        return convergence_warning(self.status)

    @property
    def limits(self) -> dict[str, Mapping[str, Any]]:
        """The ranges of the parameters, and the ends at which estimates lie, as `report.numbers.estimate_table` takes
        them."""
        return {"ends": self.at_bounds, "ranges": self.ranges}

    @property
    def correlation(self) -> torch.Tensor:
        """Correlation matrix (P, P); NaN in rows and columns of undetermined parameters."""
        return self.covariance / (self.std[:, None] * self.std[None, :])

    def interval(self, confidence: float = 0.95) -> tuple[torch.Tensor, torch.Tensor]:
        """Lower and upper limits (P,) of each parameter's confidence interval, from the normal distribution.

        They lie within the parameter's range; an estimate at an end of it is that limit of its interval.
        """
        half_width = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * self.std
        ends = [self.at_bounds.get(name) for name in self.names]
        low, high = (torch.tensor([end == side for end in ends], device=self.std.device) for side in ("low", "high"))
        ranges = [self.ranges.get(name, (-math.inf, math.inf)) for name in self.names]
        least, most = self.value.new_tensor(ranges).reshape(-1, 2).unbind(-1)
        lower, upper = self.value - half_width.where(~low, 0.0), self.value + half_width.where(~high, 0.0)
        return lower.clamp(min=least), upper.clamp(max=most)

    def to_arviz(self) -> Any:
        """The draws as an xarray.DataTree by ArviZ (extra `draws`), see `Draws.to_arviz`.

        Raises ValueError for an estimate without draws.
        """
        if self.draws is None:
            raise ValueError(
                "expected an estimate with draws, got none; set estimate.draws, or call TrainResult.sample()"
            )
        return self.draws.to_arviz()

    def to_xarray(self) -> Any:
        """An xarray.Dataset (extra `xarray`) over `parameter` in SI: value, std, low and high of the 95 % interval, and
        covariance over `parameter` and `other`.
        """
        columns = dict(zip(("value", "std", "low", "high"), (self.value, self.std, *self.interval()), strict=True))
        variables: dict[str, Any] = {name: ("parameter", column.cpu().numpy()) for name, column in columns.items()}
        variables["covariance"] = (("parameter", "other"), self.covariance.cpu().numpy())
        names = list(self.names)
        coordinates = {"parameter": names, "other": names, "unit": ("parameter", list(self.units))}
        return needed("xarray").Dataset(variables, coordinates, {"status": self.status})

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON. A number that is not finite becomes None; in `std` this means "not determined".

        The covariance is flattened row by row; `covariance_shape` holds its shape.
        """
        separate = ("covariance", "draws", "combinations")
        names = [f.name for f in fields(self) if f.name not in separate]
        plain = {name: plain_value(getattr(self, name), name) for name in names}
        flat = plain_value(self.covariance.flatten(), "covariance")
        shape = list(self.covariance.shape)
        combinations = [combination.to_dict() for combination in self.combinations]
        more = {"covariance_shape": shape, "combinations": combinations}
        return plain | {"covariance": flat} | more


def make_estimate(
    space: ParameterSpace,
    theta: Float[torch.Tensor, " P"],
    information: Float[torch.Tensor, "P P"],
    *,
    status: str = "",
    noise_std: torch.Tensor | None = None,
    reached: Mapping[str, Any] | None = None,
) -> Estimate:
    """Make the estimate theta (P,) with uncertainties from the Fisher information (P, P) there, priors included.

    Raises ValueError for mismatched shapes.
    """
    parameters = len(space)
    if theta.shape != (parameters,) or information.shape != (parameters, parameters):
        raise ValueError(
            f"expected theta ({parameters},) and information ({parameters}, {parameters}), got {tuple(theta.shape)} "
            f"and {tuple(information.shape)}; make one estimate for each member of a batch"
        )
    uncertainty = certainty(information)
    groups = undetermined_groups(space, theta, uncertainty)
    return Estimate(
        names=space.names,
        units=tuple(p.unit for p in space),
        value=theta,
        std=uncertainty.std,
        covariance=uncertainty.covariance,
        status=status,
        ranges={p.name: (p.low, p.high) for p in space},
        at_bounds=parameters_at_bounds(space, theta),
        undetermined=(*(group.sentence for group in groups), *wider_than_range(space, uncertainty.std)),
        combinations=tuple(combination for group in groups for combination in group.combinations),
        noise_std=noise_std,
        reached=dict(reached or {}),
    )


def parameters_at_bounds(space: ParameterSpace, theta: torch.Tensor) -> dict[str, str]:
    """'low' or 'high' by name, for each parameter whose value in theta (P,) is at a bound."""
    pairs = zip(space, theta.tolist(), strict=True)
    return {
        p.name: "low" if end == p.low else "high"
        for p, value in pairs
        if (end := _end(p, value, _AT_BOUND)) is not None
    }


def end_reached(p: Parameter, value: float) -> float | None:
    """The end of a parameter's range that a value has reached or passed; None inside the range.

    The nominal value and physical limits are no ends in this sense: they are valid estimates.
    """
    end = _end(p, value, AT_END)
    return None if end in (p.nominal, *p.extremes) else end


def _end(p: Parameter, value: float, share: float) -> float | None:
    """The finite end of the range that the value lies within this share of it from, or beyond; None inside."""
    width = p.high - p.low
    for end, beyond in ((p.low, p.low - value), (p.high, value - p.high)):
        margin = share * (width if math.isfinite(width) else abs(end))
        if math.isfinite(end) and beyond >= -margin:
            return end
    return None


def wider_than_range(space: ParameterSpace, std: Float[torch.Tensor, " P"]) -> tuple[str, ...]:
    """One sentence for each parameter whose standard error (P,) is finite but larger than its range."""
    return tuple(
        f"{p.name} is hardly determined: standard error {quantity_text(error, p.unit, 3)}, more than its range from "
        f"{quantity_text(p.low, p.unit)} to {quantity_text(p.high, p.unit)}"
        for p, error in zip(space, std.tolist(), strict=True)
        if p.high - p.low < error < math.inf
    )


def chi_square_quantile(confidence: float) -> float:
    """Quantile of chi-square with one degree of freedom."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence) ** 2


def convergence_warning(status: str) -> str:
    """The warning of a refinement that ended with a status other than 'converged'; empty for that."""
    if status in ("converged", ""):
        return ""
    return f"Not converged ({status.replace('_', ' ')}): sizes may be off by more than their standard errors"


def plain_value(value: Any, name: str) -> Any:
    """Convert to numbers, text, lists and dicts; a number that is not finite becomes None.

    Raises ValueError for any other type; `name` is the path of the value for the message.
    """
    if isinstance(value, torch.Tensor):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain_value(item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(value, Sequence):
        return [plain_value(item, name) for item in value]
    raise ValueError(f"{name}: expected numbers, text, tensors, lists or dicts, got {type(value).__name__}; convert it")
