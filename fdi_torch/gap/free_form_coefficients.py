"""Free forms to first order: what they take up of what a fit leaves open, its constants staying as they are.

About the trajectory of an explanation, which follows the readings, one regression does what another fit would do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter, covariance
from fdi_torch.gap.free_form import UNIT
from fdi_torch.gap.screening import Option, effect_columns, options_of
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import OperatingRange

AMPLITUDES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True)
class Coefficients:
    """Of free forms: names, values (M,) and their covariance (M, M)."""

    names: tuple[str, ...]
    values: Tensor
    covariance: Tensor

    def by_name(self) -> dict[str, float]:
        return dict(zip(self.names, self.values.tolist(), strict=True))


def coefficients_of(
    fitter: Fitter,
    fit: Fit,
    free: Sequence[Placement],
    reach: OperatingRange,
    returned: Sequence[Placement] = (),
) -> Coefficients:
    """What free forms take up of what a fit leaves, and of what its causes `returned` do.

    The amplitude of the coefficients' normal prior is the one of most evidence.
    """
    options = options_of(free, fitter, reach)
    names = tuple(next(n for n, v in o.start.items() if v != 0.0) for o in options)
    columns = effect_columns(fitter, fit, options) / UNIT
    residual = fitter.white(fit.linearised)[0][0]
    if returned:
        residual = residual + effect_columns(fitter, fit, [_as_fitted(fitter, fit, p) for p in returned]).sum(-1)
    columns, residual = _beside_starts(fitter, fit, columns, residual)
    prior = torch.tensor([o.parameters[0].std for o in options], dtype=columns.dtype)
    spectrum, basis = torch.linalg.eigh((columns * prior).T @ (columns * prior))
    spectrum, score = spectrum.clamp(min=0.0), basis.T @ (prior * (columns.T @ residual))
    amplitude = max(AMPLITUDES, key=lambda a: _evidence(spectrum, score, a))
    weight = 1.0 / (spectrum + 1.0 / amplitude**2)
    shaped = prior.unsqueeze(1) * basis
    return Coefficients(names, shaped @ (weight * score), (shaped * weight) @ shaped.T)


def without_time_course(free: Sequence[Placement]) -> tuple[Placement, ...]:
    """Free forms without their course in time, which belongs to one recording's clock alone."""
    kept = []
    for p in free:
        effect: Any = p.effect
        nodes = {variable: grid for variable, grid in effect.nodes.items() if variable != "time"}
        kept += [Placement(type(effect)(nodes, effect.scale), p.location)] if nodes else []
    return tuple(kept)


def _evidence(spectrum: Tensor, score: Tensor, amplitude: float) -> float:
    v = amplitude**2
    return 0.5 * float((score**2 / (spectrum + 1.0 / v)).sum()) - 0.5 * float(torch.log1p(v * spectrum).sum())


def _beside_starts(fitter: Fitter, fit: Fit, columns: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (N, M) and residual (N,) less what the start levels can take. All else stays as it was fitted: a free
    function of a pipe's head would share its coefficient's part with the constant, and could be compared with nothing.
    """
    kept = [i for i, n in enumerate(fit.space.names) if ".start_level" in n]
    j = fitter.white(fit.linearised)[1][0][..., kept].flatten(0, 1)
    q, _ = torch.linalg.qr(j / j.norm(dim=0).clamp(min=1e-300))
    c, r = columns.flatten(0, 1), residual.flatten()
    return c - q @ (q.T @ c), r - q @ (q.T @ r)


def fitted_coefficients(fitter: Fitter, fit: Fit, free: Sequence[Placement]) -> Coefficients:
    """The coefficients of a fit that holds the free form itself."""
    prefixes = {p.prefix for p in free}
    kept = [i for i, n in enumerate(fit.space.names) if n.rpartition(".")[0] in prefixes]
    spread = covariance(fitter, fit)[kept][:, kept]
    return Coefficients(tuple(fit.space.names[i] for i in kept), fit.theta[kept], spread)


def _as_fitted(fitter: Fitter, fit: Fit, placement: Placement) -> Option:
    """The placement with its parameters as the fit has them."""
    values = {n: v for n, v in fit.effect_values.items() if n.rpartition(".")[0] == placement.prefix}
    return Option(placement, values, placement.effect.parameters(placement.location, fitter.data.plant))
