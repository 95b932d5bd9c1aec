"""Hypotheses about a change of parameters, their fits, and the posterior over all fitted hypotheses."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from fdi_torch.estimate.evidence import posterior
from fdi_torch.parameters import ParameterName

SHAPE = ("period", "phase")  # fields that describe how an oscillation looks, not how large it is


@dataclass(frozen=True)
class Fault:
    """One fault of the list. size: column of its size. shape: columns of period and phase of an oscillation."""

    size: int
    shape: tuple[int, ...] = ()

    @property
    def columns(self) -> tuple[int, ...]:
        return (self.size, *self.shape)


def faults_of(names: Sequence[str]) -> list[Fault]:
    """Group parameters into faults: period and phase of an oscillation belong to its amplitude."""
    faults = []
    for column, name in enumerate(map(ParameterName.parse, names)):
        if name.field not in SHAPE:
            siblings = (str(name.sibling(field)) for field in SHAPE)
            faults.append(Fault(column, tuple(names.index(s) for s in siblings if s in names)))
    return faults


@dataclass(frozen=True)
class Hypothesis:
    """A set of parameters that change together at one onset.

    columns: of the parameter space. incipient: whether they grow linearly from the onset instead of changing at once.
    shape: those of the columns that are period or phase. recovered: those that return to nominal, so that only the
    onset is estimated. unlisted: any cause that is not on the list of faults; it changes none of the parameters.
    """

    columns: tuple[int, ...]
    incipient: bool = False
    shape: tuple[int, ...] = ()
    recovered: tuple[int, ...] = ()
    unlisted: bool = False

    @property
    def free(self) -> list[int]:
        """The columns whose values are estimated."""
        return [c for c in self.columns if c not in self.recovered]

    @property
    def sizes(self) -> tuple[int, ...]:
        """The columns that are sizes of faults."""
        return tuple(c for c in self.columns if c not in self.shape)

    @property
    def new(self) -> list[int]:
        """The sizes of faults that do not recover."""
        return [c for c in self.sizes if c not in self.recovered]

    @property
    def count(self) -> int:
        """Number of faults that change, where simultaneous recoveries count as one."""
        return len(self.new) + bool(self.recovered)

    def with_fault(self, fault: Fault) -> Hypothesis:
        """The hypothesis with a further fault at the same onset."""
        columns, shape = {*self.columns, *fault.columns}, {*self.shape, *fault.shape}
        return Hypothesis(tuple(sorted(columns)), self.incipient, tuple(sorted(shape)), self.recovered)


@dataclass(frozen=True)
class HypothesisFit:
    """A fitted hypothesis.

    value, std (P,): all parameters after the change, and standard deviations of the hypothesis' own (0 elsewhere).
    onset, onset_std: s. evidence: log of evidence times prior odds, relative to "no change", nats. misfit: half the sum
    of squares of the white innovations. noise_level: twice the misfit that noise alone gives on average; noise_limit:
    its upper limit, four standard deviations above. at_bound: columns whose estimate stopped at an end of its range.
    probability: of the posterior over all hypotheses fitted together.
    """

    hypothesis: Hypothesis
    value: Tensor
    std: Tensor
    onset: float
    onset_std: float
    evidence: float
    misfit: float
    noise_level: float
    noise_limit: float
    at_bound: tuple[int, ...] = ()
    probability: float = 1.0

    @property
    def fits(self) -> bool:
        """Whether the innovations are no larger than noise."""
        return 2.0 * self.misfit <= self.noise_limit

    @property
    def misfit_ratio(self) -> float:
        """Misfit relative to the expected misfit of pure noise; 1 if noise alone can explain the residuals."""
        return 1.0 if self.fits else max(2.0 * self.misfit / self.noise_level, 1.0)


NO_CHANGE, UNLISTED = Hypothesis(()), Hypothesis((), unlisted=True)


def with_posterior(fits: Sequence[HypothesisFit], over_excess: Sequence[float] = ()) -> list[HypothesisFit]:
    """The fits with their posterior probabilities, likeliest first.

    If even the closest fit leaves more than noise, the model is inexact. Then misfits are divided by the excess, and
    standard deviations are widened by its square root: a quasi-likelihood (McCullagh and Nelder, 1989, "Generalized
    linear models", chapter 9). over_excess: the misfits so divided; by default all by the excess ratio of the closest.
    """
    closest = min(fits, key=lambda fit: fit.misfit)
    excess, widening = closest.misfit_ratio, closest.misfit_ratio**0.5
    if excess > 1.0:
        over_excess = over_excess or [f.misfit / excess for f in fits]
        fits = [
            replace(
                f,
                std=f.std * widening,
                onset_std=f.onset_std * widening,
                evidence=f.evidence + f.misfit - misfit,
            )
            for f, misfit in zip(fits, over_excess, strict=True)
        ]
    probabilities = posterior([f.evidence for f in fits])
    weighted = [replace(f, probability=p) for f, p in zip(fits, probabilities, strict=True)]
    return sorted(weighted, key=lambda fit: -fit.probability)


def merged(fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
    """One fit for each set of changed parameters, likeliest first.

    Sudden and incipient changes of the same parameters count as one explanation, with the sum of their probabilities.
    """
    each: dict[Hypothesis, HypothesisFit] = {}
    for f in sorted(fits, key=lambda fit: -fit.probability):
        key = replace(f.hypothesis, incipient=False)
        each[key] = replace(each[key], probability=each[key].probability + f.probability) if key in each else f
    return sorted(each.values(), key=lambda fit: -fit.probability)


def with_unlisted_as_one(fits: Sequence[HypothesisFit], unlisted: Container[int]) -> list[HypothesisFit]:
    """The fits, with those of faults that are not on the list as one explanation; the likeliest explanation first.

    unlisted: columns of these faults. One that no reading can distinguish from a fault of the list counts as that one.
    """
    outside = [f for f in fits if any(c in unlisted for c in f.hypothesis.columns)]
    inside = [f for f in fits if not any(c in unlisted for c in f.hypothesis.columns)]
    outside = [f for f in outside if not any(_indistinguishable(f, other) for other in inside)]
    if not outside:
        total = sum(f.probability for f in inside)
        return [replace(f, probability=f.probability / total) for f in inside]
    best, together = outside[0], sum(f.probability for f in outside)
    cause = replace(best, hypothesis=UNLISTED, at_bound=(), probability=together)
    total = together + sum(f.probability for f in inside)
    listed = merged(inside)[0].probability
    order = [cause, *inside] if together > listed else [inside[0], cause, *inside[1:]]
    return [replace(f, probability=f.probability / total) for f in order]


def credible_set(fits: Sequence[HypothesisFit], level: float = 0.95) -> list[HypothesisFit]:
    """The first of the merged fits, as many as together have `level` of the probability.

    Fits that no reading can distinguish from one of these are included as well.
    """
    chosen: list[HypothesisFit] = []
    for f in fits:
        if sum(c.probability for c in chosen) >= level and not any(_indistinguishable(f, c) for c in chosen):
            continue
        chosen.append(f)
    return chosen


def _indistinguishable(a: HypothesisFit, b: HypothesisFit) -> bool:
    """Same number of faults and same misfit, up to 0.01 nat of incomplete convergence."""
    return len(a.hypothesis.sizes) == len(b.hypothesis.sizes) > 0 and abs(a.misfit - b.misfit) < 0.01
