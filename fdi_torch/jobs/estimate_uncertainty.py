"""Profile likelihoods of an estimate, and draws from its posterior, beyond its standard errors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.config.problems import ConfigError
from fdi_torch.config.run_file import Run
from fdi_torch.device import on_its_device
from fdi_torch.effects import full_name
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.hybrid import HybridResult
from fdi_torch.estimate.objectives import Problem
from fdi_torch.estimate.posterior_draws import MOST_POINTWISE, draw_posterior
from fdi_torch.estimate.profile import Profile, profile_likelihood
from fdi_torch.estimate.ridges import ridge_coordinates
from fdi_torch.names import unknown
from fdi_torch.parameters import ParameterSpace
from fdi_torch.progress import Tell, silent


def profiled_names(run: Run, space: ParameterSpace) -> list[str]:
    """Names in `estimate.profile`, in full. Raises ConfigError for one that is not estimated."""
    names = []
    for name in run.config.estimate.profile:
        full = name if name in space else full_name(name, run.plant)
        if full not in space:
            raise ConfigError([f"estimate.profile: {unknown('an estimated parameter', name, space.names)}"])
        names.append(full)
    return names


@on_its_device
def profiles_of(
    fitting: Fitting, result: HybridResult, names: Iterable[str], confidence: float = 0.95
) -> tuple[Profile, ...]:
    """Profiles of the named parameters, with the noise levels of the standard errors."""
    return profile_likelihood(result.likelihood.linearise, fitting.space, result.estimate, names, confidence)


@on_its_device
def with_draws(
    fitting: Fitting, result: HybridResult, draws: int, seed: int, most_steps: int = 16_000, tell: Tell = silent
) -> HybridResult:
    """The result whose estimate holds draws from the posterior, with the noise levels of the standard errors."""
    theta, likelihood = result.estimate.value, result.likelihood
    lane = torch.zeros(1, dtype=torch.int64, device=theta.device)
    information = likelihood.linearise(theta[None], lane).curvature[0]
    drawn = draw_posterior(
        likelihood.cost,
        fitting.space,
        theta,
        information,
        coordinates=ridge_coordinates(likelihood.linearise, fitting.space, theta, information),
        draws=draws,
        seed=seed,
        most_steps=most_steps,
        tell=tell,
    )
    observed, log_likelihood = readings_and_their_likelihood(fitting, likelihood, drawn.values.to(theta))
    drawn = replace(drawn, observed=observed, log_likelihood=log_likelihood)
    return replace(result, estimate=replace(result.estimate, draws=drawn))


def readings_and_their_likelihood(
    fitting: Fitting, likelihood: Problem, values: Tensor
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Readings (S,) by sensor, NaN where masked, and the log-likelihood (M, D, S) of each at the draws (M, D, P).

    Sensors of recording k > 0 have the suffix '@k'. The log-likelihoods are left out where they would be too many.
    """
    observed: dict[str, Tensor] = {}
    pointwise: dict[str, Tensor] = {}
    flat = values.flatten(0, 1)
    few = len(flat) * sum(int(term.data.values.numel()) for term in likelihood.terms) <= MOST_POINTWISE
    for k, term in enumerate(likelihood.terms):
        assert term.noise_std is not None
        known = torch.where(term.data.weight > 0, term.data.known, torch.nan)
        names = [s.column if k == 0 else f"{s.column}@{k}" for s in fitting.plant.sensors]
        observed |= {name: known[:, i].cpu() for i, name in enumerate(names)}
        if few:
            z = (term.engine.readings(term.theta(flat)) - known) / term.noise_std
            each = -0.5 * z**2 - torch.log(term.noise_std) - 0.5 * torch.log(torch.tensor(2.0 * torch.pi))
            shaped = each.unflatten(0, values.shape[:2]).cpu()
            pointwise |= {name: shaped[..., i] for i, name in enumerate(names)}
    return observed, pointwise
