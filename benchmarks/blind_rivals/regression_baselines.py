"""Baselines that regress the equation errors of a recording: split-sample F tests, sparse regression, Gaussian
processes.

None simulates; each gives an answer in the format of a diagnosis.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.blind_rivals.equation_errors import EquationErrors, equation_errors
from fdi_torch.blind.deviation import Array
from fdi_torch.blind.places import Cause
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

LEVEL = 0.01
"""Level of the F test, divided among all candidates (Bonferroni)."""
MOST_CAUSES = 3
SEGMENT = 20  # blocks of one half of the data in turn
RIDGE, TRIALS = 1e-2, 50
THRESHOLDS = tuple(0.05 * 2.0**k for k in range(10))
LENGTH = 0.3  # of the Gaussian processes, as a share of what a place sees
AMPLITUDES = (0.3, 1.0, 3.0, 10.0)
_TOLERANCE = 0.03


class Regression:
    """y (n,) and its columns, whitened tank by tank; discharge coefficients have their tolerances as priors."""

    def __init__(self, errors: EquationErrors, leave_out: Collection[str]) -> None:
        self.causes = [cause for cause in errors.columns if cause[0] not in leave_out]
        balanced = np.isfinite(errors.y).all(axis=0)
        y, nuisance = errors.y[:, balanced], np.stack([c[:, balanced] for c in errors.nuisance], axis=-1)
        spread = noise_of(y)
        self.half = np.repeat(np.arange(len(y)) // SEGMENT % 2, y.shape[1]).astype(bool)
        self.y = (y / spread).reshape(-1)
        self.nuisance = (nuisance / spread[:, None]).reshape(len(self.y), -1)
        columns = [(errors.columns[c][:, balanced] / spread).reshape(-1) for c in self.causes]
        self.columns = np.stack(columns, axis=1)
        self.columns /= np.maximum(np.sqrt(np.mean(self.columns**2, axis=0)), 1e-300)

    def residual(self, chosen: Sequence[int], rows: Array) -> tuple[float, Array]:
        """Residual sum of squares of these rows, and the coefficients of chosen and nuisance columns."""
        x = np.concatenate([self.columns[rows][:, list(chosen)], self.nuisance[rows]], axis=1)
        prior = np.zeros((self.nuisance.shape[1], x.shape[1]))
        prior[:, len(chosen) :] = np.eye(self.nuisance.shape[1]) / _TOLERANCE
        stacked, target = np.concatenate([x, prior]), np.concatenate([self.y[rows], np.zeros(len(prior))])
        solved = np.linalg.lstsq(stacked, target, rcond=1e-10)[0]
        return float(np.sum((target - stacked @ solved) ** 2)), solved


def noise_of(y: Array) -> Array:
    """(N,): standard deviation of equation errors (K, N) from second differences, assuming e_k - e_(k-1)
    with white e.
    """
    spread: Array = np.sqrt(np.mean(np.diff(y, 2, axis=0) ** 2, axis=0) / 10) + 1e-15
    return spread


def split_f_test(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    """Chooses effects one by one on one half of the data, and keeps them as long as the F test on the other half says
    that they are needed ("Where is my physics wrong?", arXiv 2606.23215, in its simplest form).
    """
    regression = Regression(equation_errors(plant, recording), leave_out)
    chosen: list[int] = []
    left, samples = regression.residual(chosen, ~regression.half)[0], int((~regression.half).sum())
    while len(chosen) < MOST_CAUSES:
        free = [k for k in range(len(regression.causes)) if k not in chosen]
        best = min(free, key=lambda k: regression.residual([*chosen, k], regression.half)[0])
        after = regression.residual([*chosen, best], ~regression.half)[0]
        p = f_test(left - after, after, 1, samples - len(chosen) - regression.nuisance.shape[1])
        if p > LEVEL / len(regression.causes):
            break
        chosen, left = [*chosen, best], after
    return _answer([regression.causes[k] for k in chosen])


def sparse_regression(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    """Sequentially thresholded least squares over all columns (Brunton, Proctor and Kutz, 2016, SINDy); the threshold
    comes from the Bayesian information criterion.
    """
    regression = Regression(equation_errors(plant, recording), leave_out)
    rows, n = np.ones(len(regression.y), dtype=bool), len(regression.y)
    candidates: list[list[int]] = [[]]
    for threshold in THRESHOLDS:
        kept = list(range(len(regression.causes)))
        for _ in range(TRIALS):
            x = np.concatenate([regression.columns[:, kept], regression.nuisance], axis=1)
            ridge = np.concatenate(
                [np.full(len(kept), n * RIDGE), np.full(regression.nuisance.shape[1], _TOLERANCE**-2)]
            )
            size = np.abs(np.linalg.solve(x.T @ x + np.diag(ridge), x.T @ regression.y))[: len(kept)]
            large = [k for k, s in zip(kept, size, strict=True) if s > threshold]
            if large == kept:
                break
            kept = large
        candidates.append(kept)
    best = min(candidates, key=lambda own: n * np.log(regression.residual(own, rows)[0] / n) + len(own) * np.log(n))
    return _answer([regression.causes[k] for k in best])


def gaussian_process(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    """A smooth flow of what a place sees and of time, at each place in turn (Kennedy and O'Hagan, 2001): the place with
    the highest marginal likelihood, and never a cause.
    """
    errors = equation_errors(plant, recording)
    regression = Regression(errors, leave_out)
    rows = np.ones(len(regression.y), dtype=bool)
    y, noise = np.full_like(errors.y, np.nan), noise_of(errors.y)
    calibrated = regression.y - regression.nuisance @ regression.residual([], rows)[1]
    y[:, np.isfinite(errors.y).all(axis=0)] = calibrated.reshape(len(y), -1)
    gains = {place: _gain(y, seen, balance / noise) for place, (seen, balance) in errors.local.items()}
    ranked = sorted(gains, key=lambda place: gains[place], reverse=True)
    odds = np.exp(np.array([gains[place] for place in ranked]) - max(gains.values()))
    where = [{"location": p, "share": float(o / odds.sum())} for p, o in zip(ranked, odds, strict=True)]
    gap = max(gains.values()) > np.log(len(ranked) / LEVEL)
    return _answer([]) | ({"verdict": "unknown", "where": where} if gap else {})


def _gain(y: Array, seen: Array, balance: Array) -> float:
    """Log marginal likelihood ratio for a flow at this location, over the balances that the flow enters."""
    tanks = np.flatnonzero((balance != 0) & np.isfinite(y).all(axis=0))
    if not len(tanks):
        return -np.inf
    axes = [(seen - seen.min()) / max(float(np.ptp(seen)), 1e-12), np.linspace(0.0, 1.0, len(seen))]
    distance = sum((a[:, None] - a[None, :]) ** 2 for a in axes)
    enters = balance[tanks] / np.abs(balance[tanks]).max()
    target, kernel = y[:, tanks].T.reshape(-1), np.kron(np.outer(enters, enters), np.exp(-0.5 * distance / LENGTH**2))
    free, axis = np.linalg.eigh(kernel)
    power = (axis.T @ target) ** 2
    variances = [1.0 + a * a * np.maximum(free, 0.0) for a in AMPLITUDES]
    return max(0.5 * float(np.sum(power * (1 - 1 / v)) - np.sum(np.log(v))) for v in variances)


def _answer(causes: Sequence[Cause]) -> dict[str, Any]:
    listed = [{"effect": effect, "location": place} for effect, place in causes]
    return {
        "verdict": "named" if causes else "no_gap",
        "where": [{"location": place, "share": 1.0 / len(causes)} for _, place in causes],
        "causes": listed,
        "ambiguity_set": [listed] if causes else [],
        "posterior": [],
    }


def f_test(explained: float, residual: float, parameters: int, samples: float) -> float:
    """p-value of `parameters` columns that reduce the sum of squares by `explained` to `residual`."""
    freedom = samples - parameters
    if freedom <= 0 or residual <= 0:
        return 1.0
    return float(stats.f.sf(explained / parameters / (residual / freedom), parameters, freedom))
