"""Summary of the trials of a setting for each estimator, with the Monte Carlo error of every number; and the
isolation of fault modes: stated against true sets of faults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.proportion import wilson
from fdi_torch.parameters import ParameterSpace
from fdi_torch.study.estimators import ESTIMATORS
from fdi_torch.study.monte_carlo import Trial, is_converged
from fdi_torch.study.study_plan import Plan, Setting

# Quantile of 95 % intervals.
_REACH = NormalDist().inv_cdf(0.975)
# An error of more Cramer-Rao bounds than this is not noise: the fit stopped elsewhere.
STUCK = 6.0


@dataclass(frozen=True)
class Ratio:
    """A number with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """Performance of one estimator for one parameter. bias, bias_error, rmse in the parameter's SI unit.

    over_bound: RMSE over the Cramer-Rao bound; over_linearised: over the RMSE of the linearised efficient estimator on
    the same draws; coverage: of the stated 95 % intervals. None if not available.
    """

    estimator: str
    parameter: str
    unit: str
    bias: float
    bias_error: float
    rmse: float
    over_bound: Ratio | None
    over_linearised: Ratio | None
    coverage: Ratio | None


@dataclass(frozen=True)
class Summary:
    """failures: trials of each estimator that ended far from the truth; worst: largest error, as a share of the range.

    undetermined: trials in which, by the Fisher information at the truth, a parameter is not determined. noise: of each
    output, its standard deviation, mean over the trials, with its SI unit. truth: parameters, SI, that are the same in
    all trials.
    """

    setting: str
    trials: int
    scores: tuple[Score, ...]
    failures: Mapping[str, int]
    worst: Mapping[str, float]
    converged: int
    undetermined: int
    rho: Ratio
    noise: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    truth: Mapping[str, float] = field(default_factory=dict)

    def numbers(self) -> dict[str, float]:
        """The summary as one flat mapping from dotted names, such as `lm.T1.leak.size.bias`, to numbers."""
        flat: dict[str, float] = {"converged": self.converged, "undetermined": self.undetermined}
        flat |= _ends("rho", self.rho)
        flat |= {f"noise.{sensor}": std for sensor, (std, _) in self.noise.items()}
        flat |= {f"truth.{name}": value for name, value in self.truth.items()}
        flat |= {f"{name}.failures": count for name, count in self.failures.items()}
        flat |= {f"{name}.worst": error for name, error in self.worst.items()}
        for score in self.scores:
            name = f"{score.estimator}.{score.parameter}"
            flat |= {f"{name}.{key}": getattr(score, key) for key in ("bias", "bias_error", "rmse")}
            for key in ("over_bound", "over_linearised", "coverage"):
                flat |= _ends(f"{name}.{key}", getattr(score, key))
        return flat


def summarise(plan: Plan, setting: Setting, trials: Sequence[Trial], tolerance: float = 1e-5) -> Summary:
    """Statistics of the estimates in all trials of one setting.

    tolerance: in trials without noise, an estimate that misses the truth by more than this share of the parameter's
    range counts as a failure.
    """
    space = plan.fitting.space
    names: list[str] = [name for name in ESTIMATORS if name in trials[0].numbers]
    truth = column(trials, "truth")
    errors = {name: column(trials, name) - truth for name in names}
    width = space.high() - space.low()
    return Summary(
        setting=setting.name,
        trials=len(trials),
        scores=tuple(s for name in names for s in _scores(name, errors, trials, space, setting.snr_db is not None)),
        failures={name: _failures(name, errors[name], trials, setting, tolerance * width) for name in names},
        worst={name: float((errors[name].abs() / width).max()) for name in names},
        converged=sum(is_converged(trial.status) for trial in trials),
        undetermined=int((column(trials, "bound") > width).any(-1).sum()),
        rho=mean_with_error(column(trials, "rho").sum(-1)),
        noise=_noise(plan, setting, trials),
        truth={p.name: float(truth[0, i]) for i, p in enumerate(space) if bool((truth[:, i] == truth[0, i]).all())},
    )


def _noise(plan: Plan, setting: Setting, trials: Sequence[Trial]) -> dict[str, tuple[float, str]]:
    """Noise of each sensor; none of a setting without noise, or from a log of trials that do not state it."""
    if setting.snr_db is None or not all("noise" in trial.numbers for trial in trials):
        return {}
    stds = column(trials, "noise").mean(0).tolist()
    sensors = plan.fitting.networks[0].description.sensors
    return {sensor.column: (std, sensor.unit) for sensor, std in zip(sensors, stds, strict=True)}


def column(trials: Sequence[Trial], name: str) -> Float[Tensor, "trials ..."]:
    """One array of all trials, stacked."""
    return torch.tensor([trial.numbers[name] for trial in trials], dtype=torch.float64)


def _scores(
    name: str, errors: Mapping[str, Tensor], trials: Sequence[Trial], space: ParameterSpace, noisy: bool
) -> list[Score]:
    error, scores = errors[name], []
    bound = column(trials, "bound")
    std = column(trials, f"{name}_std") if f"{name}_std" in trials[0].numbers else None
    compared = noisy and "linearised" in errors and name != "linearised"
    for i, parameter in enumerate(space):
        errors_i = error[:, i]
        scores.append(
            Score(
                estimator=name,
                parameter=parameter.name,
                unit=parameter.unit,
                bias=float(errors_i.mean()),
                bias_error=float(errors_i.std() / math.sqrt(len(errors_i))) if len(errors_i) > 1 else math.nan,
                rmse=float(errors_i.square().mean().sqrt()),
                over_bound=rms_with_error(errors_i / bound[:, i]) if noisy else None,
                over_linearised=rms_ratio(errors_i, errors["linearised"][:, i]) if compared else None,
                coverage=None if std is None or not noisy else covered(errors_i, std[:, i]),
            )
        )
    return scores


def _failures(name: str, error: Tensor, trials: Sequence[Trial], setting: Setting, allowed: Tensor) -> int:
    if (
        setting.snr_db is not None
    ):  # the correlation is insensitive to gain and offset of a reading, and has its own bound
        allowed = STUCK * column(trials, "correlation_bound" if name == "correlation" else "bound")
    return int((~(error.abs() <= allowed)).any(-1).sum())


def mean_with_error(values: Float[Tensor, " N"]) -> Ratio:
    """Mean with its 95 % interval from the sample variance (Student's t)."""
    mean, reach = float(values.mean()), _reach(values)
    return Ratio(mean, mean - reach, mean + reach)


def rms_with_error(values: Float[Tensor, " N"]) -> Ratio:
    """Root mean square with its 95 % interval from the variance of the squares (delta method, of the logarithm)."""
    squares = values.square()
    mean = squares.mean()
    return _within(math.sqrt(float(mean)), squares / mean.clamp(min=torch.finfo(mean.dtype).tiny))


def rms_ratio(errors: Float[Tensor, " N"], others: Float[Tensor, " N"]) -> Ratio:
    """Ratio of the root mean squares of paired errors, with its 95 % interval (delta method)."""
    a, b = errors.square(), others.square()
    return _within(math.sqrt(float(a.mean() / b.mean())), a / a.mean() - b / b.mean())


def _within(root: float, squares: Float[Tensor, " N"]) -> Ratio:
    """A root with its 95 % interval from the relative deviations of the squares."""
    factor = math.exp(0.5 * _reach(squares))
    return Ratio(root, root / factor, root * factor)


def _reach(values: Float[Tensor, " N"]) -> float:
    """Half of the 95 % interval of a mean."""
    from scipy.special import stdtrit  # takes a while to load

    count = len(values)
    return float(stdtrit(count - 1, 0.975) * values.std()) / math.sqrt(count) if count > 1 else math.inf


def covered(error: Float[Tensor, " N"], std: Float[Tensor, " N"]) -> Ratio:
    """Share of 95 % intervals that contain the truth, with its interval (Wilson 1927)."""
    return share(int((error.abs() <= _REACH * std).sum()), len(error))


def share(count: int, trials: int) -> Ratio:
    """A share of trials with its 95 % interval (Wilson 1927)."""
    return Ratio(count / trials, *wilson(count, trials))


def _ends(name: str, ratio: Ratio | None) -> dict[str, float]:
    return {} if ratio is None else {name: ratio.value, f"{name}.low": ratio.low, f"{name}.high": ratio.high}


@dataclass(frozen=True)
class Isolation:
    """Counts of stated modes.

    labels (M,): 'none', 'theta_1', 'theta_1 + theta_3' ... confusion (M, M): trials by true mode (row) and stated mode
    (column). missed, false: parameters wrongly stated as fault-free, or as faulty. right: correctly stated modes.
    """

    labels: tuple[str, ...]
    confusion: tuple[tuple[int, ...], ...]
    trials: int
    right: int
    missed: int
    false: int


def count_modes(space: ParameterSpace, trials: Sequence[Trial], confidence: float = 0.95) -> Isolation:
    """State a parameter as faulty if it differs from nominal significantly, and count the modes.

    The confidence is divided among the parameters (Bonferroni).
    """
    truth, value, std = (column(trials, name) for name in ("truth", "free", "free_std"))
    reach = NormalDist().inv_cdf(1.0 - (1.0 - confidence) / (2 * len(space)))
    names = [name.removesuffix(".size") for name in space.names]
    faulty = truth != space.nominal()
    stated = (value - space.nominal()).abs() > reach * std
    places = {
        code: k
        for k, code in enumerate(sorted({*_codes(faulty), *_codes(stated)}, key=lambda code: (code.bit_count(), code)))
    }
    confusion = [[0] * len(places) for _ in places]
    for row, col in zip(_codes(faulty), _codes(stated), strict=True):
        confusion[places[row]][places[col]] += 1
    return Isolation(
        labels=tuple(" + ".join(names[i] for i in range(len(names)) if code >> i & 1) or "none" for code in places),
        confusion=tuple(tuple(row) for row in confusion),
        trials=len(trials),
        right=int((faulty == stated).all(-1).sum()),
        missed=int((faulty & ~stated).sum()),
        false=int((stated & ~faulty).sum()),
    )


def _codes(faulty: Tensor) -> list[int]:
    """(trials, P) bool as one integer per trial, one bit per parameter."""
    return (faulty.to(torch.int64) << torch.arange(faulty.shape[-1])).sum(-1).tolist()
