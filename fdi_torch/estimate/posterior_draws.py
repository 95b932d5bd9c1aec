"""Draws from the posterior distribution by an ensemble sampler (the library emcee, extra `draws`).

The posterior is exp(-f) within the bounds, f being the negative log-likelihood with the Gaussian priors of the space;
within the bounds a parameter without standard deviation has a flat prior. All walkers of half the ensemble are
one batch of the likelihood. Moves: differential evolution and snooker (ter Braak and Vrugt 2008), in the proportion 4:1
that the documentation of emcee advises for distributions with several modes. They move along straight lines, hence in
the coordinates `RidgeCoordinates`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.ridge_coordinates import UNCHANGED, RidgeCoordinates
from fdi_torch.estimate.strategy import reflected
from fdi_torch.parameters import ParameterSpace
from fdi_torch.progress import Tell, silent
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units, needed

# Rank-normalised split R-hat and effective sample size from which draws count as converged (Vehtari et al. 2021,
# Bayesian Analysis 16:667, section 4).
LARGEST_R_HAT, SMALLEST_SIZE = 1.01, 400.0
# Steps before the first test of convergence; the number doubles until the test passes.
FIRST_STEPS = 500
# Steps between two reports of progress.
TOLD_EVERY = 100
# Largest number of values for which the log-likelihood of each reading is computed: 80 MB.
MOST_POINTWISE = 10_000_000

Cost = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, repr=False)
class Draws(Shown):
    """Draws from the posterior, SI units. M: walkers, each one chain; D: draws of each.

    values (M, D, P). log_posterior (M, D), up to a constant. r_hat, ess_bulk, ess_tail (P,): rank-normalised split
    R-hat and effective sample sizes (Vehtari et al. 2021). acceptance: share of accepted steps. steps: steps
    of each walker, of which the first half was discarded. observed: readings by name, (S,), NaN where masked.
    log_likelihood: of each reading, (M, D, S) by name; empty where it would take more than 80 MB.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Tensor
    log_posterior: Tensor
    r_hat: Tensor
    ess_bulk: Tensor
    ess_tail: Tensor
    acceptance: float
    steps: int
    observed: Mapping[str, Tensor] = field(default_factory=dict)
    log_likelihood: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def converged(self) -> bool:
        return bool((self.r_hat <= LARGEST_R_HAT).all() and (self._smallest_size >= SMALLEST_SIZE).all())

    @property
    def _smallest_size(self) -> Tensor:
        return torch.minimum(self.ess_bulk, self.ess_tail)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the draws are not usable; empty if they converged."""
        if self.converged:
            return ()
        worst = int(torch.nan_to_num(self.r_hat, math.inf).argmax())
        return (
            f"the draws have not converged after {self.steps} steps: R-hat {float(self.r_hat[worst]):.3f} of "
            f"{self.names[worst]} (expected at most {LARGEST_R_HAT:g}), effective sample size "
            f"{float(self._smallest_size.min()):.0f} (expected at least {SMALLEST_SIZE:g}); allow more steps, take the "
            "intervals of the profile likelihoods instead, or give the parameters that are not determined a narrower "
            "range or a prior",
        )

    @property
    def headline(self) -> str:
        text = f"{self.values.shape[0] * self.values.shape[1]} draws of {len(self.names)} parameters"
        size = f"effective sample size at least {float(self._smallest_size.min()):.0f}"
        return "; ".join([*self.warnings, f"{text}, {size}, R-hat at most {float(self.r_hat.max()):.3f}"])

    def median(self) -> Tensor:
        """Median of each parameter, (P,)."""
        return self.values.flatten(0, 1).median(0).values

    def interval(self, confidence: float = 0.95) -> tuple[Tensor, Tensor]:
        """Lower and upper limits (P,) of the equal-tailed credible intervals."""
        flat = self.values.flatten(0, 1)
        tail = 0.5 - 0.5 * confidence
        return flat.quantile(tail, 0), flat.quantile(1.0 - tail, 0)

    @in_its_units
    def table(self) -> Table:
        """One row per parameter, in its unit for display."""
        columns = self._summary()
        rows = [
            (name, *in_display_unit(name, unit, *numbers[:4]), *numbers[4:])
            for name, unit, *numbers in zip(*columns.values(), strict=True)
        ]
        return Table([*columns], rows)

    def _summary(self) -> dict[str, Any]:
        """Columns with one value per parameter, SI."""
        flat, (low, high) = self.values.flatten(0, 1), self.interval()
        columns: dict[str, Any] = {"parameter": self.names, "unit": self.units, "median": self.median().tolist()}
        columns |= {"std": flat.std(0).tolist(), "95 % low": low.tolist(), "95 % high": high.tolist()}
        columns |= {
            "R-hat": self.r_hat.tolist(),
            "ESS bulk": self.ess_bulk.tolist(),
            "ESS tail": self.ess_tail.tolist(),
        }
        return columns

    def to_dict(self) -> dict[str, Any]:
        """Summary as plain values for JSON."""
        return {name: list(column) for name, column in self._summary().items()} | {
            "steps": self.steps,
            "acceptance": self.acceptance,
            "converged": self.converged,
            "warnings": list(self.warnings),
        }

    def to_xarray(self) -> Any:
        """An xarray.Dataset (extra `xarray`): one variable per parameter in SI, and `log_posterior`, over `chain` and
        `draw`.
        """
        axes = ("chain", "draw")
        variables: dict[str, Any] = {
            name: (axes, self.values[..., i].cpu().numpy(), {"units": unit})
            for i, (name, unit) in enumerate(zip(self.names, self.units, strict=True))
        }
        variables["log_posterior"] = (axes, self.log_posterior.cpu().numpy())
        return needed("xarray").Dataset(variables)

    def to_arviz(self) -> Any:
        """An xarray.DataTree by ArviZ: posterior, sample_stats, observed_data and, where present, log_likelihood."""
        groups: dict[str, dict[str, Any]] = {
            "posterior": {name: self.values[..., i].numpy() for i, name in enumerate(self.names)},
            "sample_stats": {"lp": self.log_posterior.numpy()},
            "observed_data": {name: value.numpy() for name, value in self.observed.items()},
            "log_likelihood": {name: value.numpy() for name, value in self.log_likelihood.items()},
        }
        dims = {name: [f"{name}_sample"] for name in self.observed}
        # There may be more walkers than draws of each, which ArviZ takes for exchanged dimensions.
        present = {name: group for name, group in groups.items() if group}
        return needed("arviz_base", "draws").from_dict(present, dims=dims, check_conventions=False)


def draw_posterior(
    cost: Cost,
    space: ParameterSpace,
    start: Tensor,
    information: Tensor,
    *,
    coordinates: RidgeCoordinates = UNCHANGED,
    draws: int = 1000,
    seed: int = 0,
    most_steps: int = 16_000,
    tell: Tell = silent,
) -> Draws:
    """Draw from exp(-cost) within the bounds of the space until the draws have converged, or for `most_steps` steps.

    cost(candidates (L, N, P), lanes (L,)) -> (L, N): negative log-likelihood with priors, such as `Problem.cost`. start
    (P,), information (P, P): the estimate and the Fisher information there, from which the walkers start. coordinates:
    those of `ridges.ridge_coordinates` make draws from a narrow curved ridge many times faster. draws: number of draws
    that are kept, at least (the chains are thinned to it). tell(share, text): the share of `most_steps`. The result
    repeats for a seed. Raises ImportError without the extra `draws`, and ValueError for a parameter that is neither
    determined nor has a range.
    """
    if draws < 1 or most_steps < 4:
        raise ValueError(f"expected at least 1 draw and 4 steps, got {draws} and {most_steps}; ask for more")
    emcee = needed("emcee", "draws")
    low, high = space.low(start), space.high(start)
    lane = torch.zeros(1, dtype=torch.int64, device=start.device)

    def log_posterior(walkers: np.ndarray) -> np.ndarray:
        theta = coordinates.theta(torch.from_numpy(np.ascontiguousarray(walkers)).to(start))
        inside = ((theta >= low) & (theta <= high)).all(-1)
        values = theta.new_full((len(theta),), -math.inf)
        if bool(inside.any()):
            values[inside] = -cost(theta[inside][None], lane)[0]
        return torch.where(torch.isnan(values), -math.inf, values).cpu().numpy()

    random = np.random.RandomState(seed % 2**32)
    walkers = first_walkers(space, start, information, random, coordinates)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*walkers.shape, log_posterior, vectorize=True, moves=moves)
    state, steps, mixing = emcee.State(walkers, random_state=random.get_state()), 0, ""
    while True:
        more = max(min(max(FIRST_STEPS, steps), most_steps - steps), 1)
        for sampled in sampler.sample(state, iterations=more):
            state, steps = sampled, steps + 1
            if steps % TOLD_EVERY == 0:
                tell(steps / most_steps, f"draws: {steps} steps{mixing}")
        phi = torch.from_numpy(sampler.get_chain(discard=steps // 2))
        chains = coordinates.theta(phi.to(start)).cpu().transpose(0, 1).contiguous()
        statistics = convergence(chains)
        r_hat, *sizes = statistics
        largest = f"R-hat {float(r_hat.max()):.3f}"
        mixing = f", {largest} after {steps}"
        done = bool((r_hat <= LARGEST_R_HAT).all()) and all(bool((size >= SMALLEST_SIZE).all()) for size in sizes)
        if done or steps >= most_steps:
            break
    tell(1.0, f"draws: {'converged' if done else 'stopped'} after {steps} steps, {largest}")
    thin = max(chains.shape[0] * chains.shape[1] // draws, 1)
    log_p = torch.from_numpy(sampler.get_log_prob(discard=steps // 2)).T
    return Draws(
        names=space.names,
        units=tuple(p.unit for p in space),
        values=chains[:, ::thin].clone(),
        log_posterior=log_p[:, ::thin].clone(),
        r_hat=r_hat,
        ess_bulk=sizes[0],
        ess_tail=sizes[1],
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        steps=steps,
    )


def first_walkers(
    space: ParameterSpace,
    start: Tensor,
    information: Tensor,
    random: np.random.RandomState,
    coordinates: RidgeCoordinates,
) -> np.ndarray:
    """Walkers (M, P) about the estimate, overdispersed: normal with twice its standard errors, reflected at the bounds.

    A range adds the information of a uniform distribution over it, so that undetermined directions have a finite
    spread. The walkers are normal, and returned, in `coordinates`.
    """
    precision = coordinates.information(start, information) / 4.0 + torch.diag(range_information(space, start))
    unit = precision.diagonal().rsqrt()
    scaled = precision * unit[:, None] * unit[None, :]
    factor, failed = torch.linalg.cholesky_ex(0.5 * (scaled + scaled.mT))
    if int(failed) or not bool(torch.isfinite(factor).all()):
        raise ValueError(
            "expected parameters with a range or a prior, got an undetermined one; give low and high, or std"
        )
    count = max(32, 4 * len(space))
    normal = torch.from_numpy(random.standard_normal((len(space), count))).to(start)
    spread = torch.linalg.solve_triangular(factor.mT, normal, upper=True).T * unit
    theta = coordinates.theta(coordinates.phi(start) + spread)
    # A missing bound becomes one beyond all walkers, since reflection needs the width of the box.
    low = torch.where(torch.isfinite(space.low(start)), space.low(start), theta.amin(0))
    high = torch.where(torch.isfinite(space.high(start)), space.high(start), theta.amax(0))
    return coordinates.phi(reflected(theta, low, high)).cpu().numpy()


def range_information(space: ParameterSpace, start: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
    """Information of uniform distributions over the ranges, 12 / width^2; 0 for a parameter without range."""
    width = space.high(start) - space.low(start)
    return torch.where(torch.isfinite(width), 12.0 / width**2, 0.0)


def convergence(chains: Float[Tensor, "M D P"]) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
    """R-hat and effective sample sizes, bulk and tail, (P,) each, of chains (M, D, P), by ArviZ."""
    statistics = needed("arviz_stats.base", "draws").array_stats
    columns = [chains[..., i].numpy() for i in range(chains.shape[-1])]
    axes = {"chain_axis": 0, "draw_axis": 1}
    r_hat = [float(statistics.rhat(c, **axes)) for c in columns]
    bulk = [float(statistics.ess(c, **axes, method="bulk")) for c in columns]
    # The tails beyond which 5 % lie on each side (Vehtari et al. 2021, section 4.3).
    tail = [float(statistics.ess(c, **axes, method="tail", prob=(0.05, 0.95))) for c in columns]
    return chains.new_tensor(r_hat), chains.new_tensor(bulk), chains.new_tensor(tail)
