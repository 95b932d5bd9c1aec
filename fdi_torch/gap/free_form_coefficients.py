"""First-order coefficients of a free discrepancy: regression on the residual of a fit, with all constants fixed.

The regression is made about the trajectory of an explanation, which follows the readings, so that no further fit is
needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter, covariance
from fdi_torch.gap.free_form import TRIAL_SIZE
from fdi_torch.gap.screening import Option, effect_columns, options_of
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import OperatingRange

# Factors of the coefficients' prior standard deviation, of which the likeliest is taken.
AMPLITUDES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True)
class Coefficients:
    """Names, values (M,) and covariance (M, M) of coefficients."""

    names: tuple[str, ...]
    values: Tensor
    covariance: Tensor

    def by_name(self) -> dict[str, float]:
        return dict(zip(self.names, self.values.tolist(), strict=True))


def coefficients_of(
    fitter: Fitter,
    fit: Fit,
    free: Sequence[Placement],
    operating_range: OperatingRange,
    returned: Sequence[Placement] = (),
) -> Coefficients:
    """Coefficients of free forms, fitted to the residual of a fit.

    returned: causes of the fit whose influence the free forms shall describe instead; it is added to the residual. The
    amplitude of the coefficients' normal prior maximises the evidence.
    """
    options = options_of(free, fitter, operating_range)
    names = tuple(next(n for n, v in o.start.items() if v != 0.0) for o in options)
    columns = fitter.whiten(effect_columns(fitter, fit, options)) / TRIAL_SIZE
    residual = fitter.residual(fit.linearised.readings)[0]
    if returned:
        fitted = [Option(p, fit.values_of([p]), p.effect.parameters(p.location, fitter.data.plant)) for p in returned]
        changes = effect_columns(fitter, fit, fitted)
        residual = residual + fitter.whiten(changes).sum(-1)
    columns, residual = _without_initial_levels(fitter, fit, columns, residual)
    prior = torch.tensor([o.parameters[0].std for o in options], dtype=columns.dtype)
    spectrum, basis = torch.linalg.eigh((columns * prior).T @ (columns * prior))
    spectrum, score = spectrum.clamp(min=0.0), basis.T @ (prior * (columns.T @ residual))
    amplitude = max(AMPLITUDES, key=lambda a: _evidence(spectrum, score, a))
    weight = 1.0 / (spectrum + 1.0 / amplitude**2)
    shaped = prior.unsqueeze(1) * basis
    return Coefficients(names, shaped @ (weight * score), (shaped * weight) @ shaped.T)


def without_time_course(free: Sequence[Placement]) -> tuple[Placement, ...]:
    """The free forms without their functions of time, which would not repeat in another recording."""
    placements = []
    for p in free:
        effect: Any = p.effect
        nodes = {variable: grid for variable, grid in effect.nodes.items() if variable != "time"}
        placements += [Placement(type(effect)(nodes, effect.scale), p.location)] if nodes else []
    return tuple(placements)


def _evidence(spectrum: Tensor, score: Tensor, amplitude: float) -> float:
    v = amplitude**2
    return 0.5 * float((score**2 / (spectrum + 1.0 / v)).sum()) - 0.5 * float(torch.log1p(v * spectrum).sum())


def _without_initial_levels(fitter: Fitter, fit: Fit, columns: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (N, M) and residual (N,) with the initial levels projected out.

    All other parameters stay as fitted: a function of a pipe's head would otherwise share its flow with the pipe's
    constant.
    """
    initial_levels = [i for i, n in enumerate(fit.space.names) if ParameterName.parse(n).field == "start_level"]
    j = fitter.whiten(fit.linearised.jacobian[..., initial_levels])[0].flatten(0, 1)
    q, _ = torch.linalg.qr(j / j.norm(dim=0).clamp(min=1e-300))
    c, r = columns.flatten(0, 1), residual.flatten()
    return c - q @ (q.T @ c), r - q @ (q.T @ r)


def fitted_coefficients(fitter: Fitter, fit: Fit, free: Sequence[Placement]) -> Coefficients:
    """Coefficients of a free form, with their covariance, from a fit that contains it."""
    indices = [fit.space.index(n) for n in fit.values_of(free)]
    selected = covariance(fitter, fit)[indices][:, indices]
    return Coefficients(tuple(fit.space.names[i] for i in indices), fit.theta[indices], selected)
