"""Parameters that are determined only jointly: their determined linear combinations, with value and standard error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import torch

from fdi_torch.amounts import parameter_words, with_error
from fdi_torch.estimate.information import Certainty, determined_combinations
from fdi_torch.names import listed
from fdi_torch.parameters import ParameterSpace
from fdi_torch.quantities import display_unit

# A parameter whose coefficient is below this fraction of the largest one does not belong to the combination.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Combination:
    """Linear combination sum c_i theta_i that the readings determine although they do not determine each theta_i.

    parameters: names of the theta_i. units, coefficients: theirs, SI; the first coefficient is 1, so that the
    combination has the unit of its first parameter. value, std: estimate with its standard error. nominal: value for
    nominal parameters.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    coefficients: tuple[float, ...]
    value: float
    std: float
    nominal: float

    @property
    def unit(self) -> str:
        return self.units[0]

    @property
    def formula(self) -> str:
        """The combination as text, such as 'a + 0.8 b - 2 cm/% c', with coefficients in the units for display."""
        own_unit, own_scale = display_unit(self.unit, self.parameters[0])
        text = ""
        for name, si_unit, c in zip(self.parameters, self.units, self.coefficients, strict=True):
            unit, scale = display_unit(si_unit, name)
            sign = ("- " if c < 0 else "+ ") if text else ("-" if c < 0 else "")
            factor = f"{abs(c) * own_scale / scale:.3g}"
            if unit != own_unit:
                factor = f"{factor} {own_unit or '1'}{f'/({unit})' if '/' in unit else f'/{unit}' if unit else ''}"
            text += f"{' ' if text else ''}{sign}{'' if factor == '1' else f'{factor} '}{name}"
        return text

    @property
    def words(self) -> str:
        """'a + 0.8 b = 0.0994 ± 0.0023', in the units for display."""
        unit, scale = display_unit(self.unit, self.parameters[0])
        return f"{self.formula} = {with_error(scale * self.value, scale * self.std)} {unit}".rstrip()

    @property
    def rivals(self) -> str:
        """'leak at T2 or plugging at OUT2'."""
        return listed([parameter_words(name) for name in self.parameters], "or")

    @property
    def sized_rivals(self) -> str:
        """The rivals with what is known of their sizes."""
        return f"{self.rivals} ({self.words})"

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Confidence interval, from the normal distribution."""
        half_width = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * self.std
        return self.value - half_width, self.value + half_width

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Combination:
        """The combination of `to_dict`. Raises KeyError, TypeError or ValueError for anything else."""
        names, units = (tuple(map(str, plain[key])) for key in ("parameters", "units"))
        coefficients = tuple(map(float, plain["coefficients"]))
        if not names or not len(names) == len(units) == len(coefficients):
            raise ValueError(f"expected a unit and a coefficient for each of the parameters, got {len(names)} of them")
        return cls(names, units, coefficients, *(float(plain[key]) for key in ("value", "std", "nominal")))


@dataclass(frozen=True)
class UndeterminedGroup:
    """Parameters that share an undetermined direction, with their determined combinations, which may be none."""

    parameters: tuple[str, ...]
    combinations: tuple[Combination, ...]

    @property
    def sentence(self) -> str:
        formulas = [combination.formula for combination in self.combinations]
        if formulas:
            return f"of {listed(self.parameters)}, only {listed(formulas)} {_verb(formulas)} determined"
        verb = _verb(self.parameters)
        pronoun = "it" if verb == "is" else "them"
        return f"{listed(self.parameters)} {verb} not determined: the readings do not depend on {pronoun}"


def undetermined_groups(space: ParameterSpace, theta: torch.Tensor, sure: Certainty) -> tuple[UndeterminedGroup, ...]:
    """All groups of jointly undetermined parameters; `sure` is the certainty at theta (P,).

    A combination's variance is c' C c, with C the covariance in the determined subspace.
    """
    nominal = space.nominal(theta)
    groups = []
    for members, rows in determined_combinations(sure.null, sure.scale):
        covariance = sure.determined[members][:, members]
        combinations = []
        for row in rows:
            kept = [k for k in range(len(members)) if abs(row[k]) > _ROUNDING * row.abs().max()]
            parameters = [space.parameters[members[k]] for k in kept]
            combinations.append(
                Combination(
                    parameters=tuple(p.name for p in parameters),
                    units=tuple(p.unit for p in parameters),
                    coefficients=tuple(float(row[k]) for k in kept),
                    value=float(row @ theta[members]),
                    std=math.sqrt(max(float(row @ covariance @ row), 0.0)),
                    nominal=float(row @ nominal[members]),
                )
            )
        groups.append(UndeterminedGroup(tuple(space.names[i] for i in members), tuple(combinations)))
    return tuple(groups)


def _verb(subjects: Sequence[str]) -> str:
    return "is" if len(subjects) == 1 else "are"
