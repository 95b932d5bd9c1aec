"""The fit of hypotheses about a change: sizes and onset by Levenberg-Marquardt, and their evidence."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import ODDS, log_prior, log_volume
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearisation, held_back
from fdi_torch.estimate.uncertainty import end_reached
from fdi_torch.monitor.hypothesis import NO_CHANGE, Hypothesis, HypothesisFit
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.oscillation import (
    oscillation_columns,
    period_step,
    std_with_phases_at_zero,
    with_phases_at,
    with_wrapped_phases,
)
from fdi_torch.parameters import ParameterName, ParameterSpace

SIZE_STEP = 1e-4  # finite-difference step, as a share of a parameter's range
ITERATIONS = 12


@dataclass(frozen=True)
class Prior:
    """Prior odds of a hypothesis.

    names: of the parameter space. single_changes: number of possible single changes. growth_times: shortest and
    longest time in which a growing fault passes through its range, s. unlisted: columns of faults that are not on the
    list; unlisted_changes: number of possible changes of these.
    """

    names: tuple[str, ...]
    single_changes: int
    growth_times: tuple[float, float] | None = None
    unlisted: Container[int] = ()
    unlisted_changes: int = 0

    def __call__(self, hypothesis: Hypothesis) -> float:
        """Log of the odds against no change."""
        if any(c in self.unlisted for c in hypothesis.columns):
            return math.log(ODDS.unknown / self.unlisted_changes)
        places = len({ParameterName.parse(self.names[c]).place for c in hypothesis.new}) + bool(hypothesis.recovered)
        return log_prior(hypothesis.count, places, max(self.single_changes, 1))

    def growth(self, shares: Tensor, age: float) -> float:
        """Log density of the shares of their ranges that growing faults have reached at this age (s); 0 if uniform.

        share = age / T, and the time T in which a fault passes through its range is log-uniform. A smaller share, which
        means a T beyond the longest time, has the density at the longest time.
        """
        assert self.growth_times is not None, "expected times of growth for a growing fault"
        shortest, longest = self.growth_times
        return -float((shares.clamp(min=age / longest) * math.log(longest / shortest)).log().sum())


def no_change_fit(observer: ObserverBank, window: ObserverWindow, believed: Tensor, base: Tensor) -> HypothesisFit:
    """The fit of the hypothesis that the alarm is false. base (1, S, sensors): white innovations without a change."""
    limit, first = _noise_limit(observer, window), float(window.samples.time[0])
    level = float(window.readings)
    return HypothesisFit(NO_CHANGE, believed, torch.zeros_like(believed), first, 0.0, 0.0, misfit(base), level, limit)


def _noise_limit(observer: ObserverBank, window: ObserverWindow) -> float:
    """Upper limit of the innovations' sum of squares under noise alone, four standard deviations above its mean.

    The variance is that of the sum itself plus that of the noise variance, which was estimated from a finite recording.
    """
    count, channels = window.readings, len(observer.network.description.sensors)
    learnt = observer.whitening.samples * channels
    return count * (1.0 + 4.0 * math.sqrt(2.0 / max(count, 1) + 2.0 / learnt))


def point_of(fit: HypothesisFit) -> Tensor:
    """Values and onset of a fit, (P+1,)."""
    return torch.cat([fit.value, fit.value.new_tensor([fit.onset])])


def changes_of(fits: Sequence[HypothesisFit]) -> ChangeHypotheses:
    """Fits as the lanes of a bank of observers."""
    theta = torch.stack([f.value for f in fits])
    incipient = torch.tensor([f.hypothesis.incipient for f in fits])
    return ChangeHypotheses(theta, theta.new_tensor([f.onset for f in fits]), incipient)


def fit(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    hypotheses: Sequence[Hypothesis],
    starts: Tensor,
    base: float,
    prior: Prior,
    known_onset: bool = False,
    space: ParameterSpace | None = None,
) -> list[HypothesisFit]:
    """Sizes and onset of each hypothesis by Levenberg-Marquardt on the white innovations, all in parallel.

    believed (P,): parameters before the change; starts (H, P+1): initial values and onset (s); base: misfit without a
    change. known_onset: the onsets of `starts` are exact. space: its ranges bound the sizes; those of the observer's
    `search_space` by default.
    """
    free = torch.zeros(len(hypotheses), len(believed) + 1, dtype=torch.bool)
    free[:, -1] = not known_onset
    for i, hypothesis in enumerate(hypotheses):
        free[i, hypothesis.free] = True
    slots = _slots(free)
    incipient = torch.tensor([h.incipient for h in hypotheses])
    first, last = window.samples.time[0], window.samples.time[-2]
    oscillations, middle = oscillation_columns(observer.space.names), 0.5 * float(first + last)

    def linearise(values: Tensor, lanes: Tensor) -> Linearisation:
        point = slots.inserted(fixed, values, lanes)
        return _expansion(observer, window, believed, point, slots, lanes, incipient[lanes], middle)

    fixed = torch.cat([believed, first[None]]).repeat(len(starts), 1)
    fixed[:, -1] = starts[:, -1]
    for i, hypothesis in enumerate(hypotheses):
        fixed[i, list(hypothesis.recovered)] = starts[i, list(hypothesis.recovered)]
    space = observer.search_space(believed) if space is None else space
    low = torch.where(free, torch.cat([space.low(believed), first[None]]), fixed)
    high = torch.where(free, torch.cat([space.high(believed), last[None]]), fixed)
    starts = with_phases_at(torch.where(free, starts.clamp(low, high), fixed), oscillations, free, middle)
    for _, phase in oscillations:  # a full turn either way, so that no fit stops at +-pi
        low[:, phase] = torch.where(free[:, phase], starts[:, phase] - 2.0 * math.pi, low[:, phase])
        high[:, phase] = torch.where(free[:, phase], starts[:, phase] + 2.0 * math.pi, high[:, phase])
    settings = RefineSettings(iterations=ITERATIONS, decrease_tolerance=1e-3, step_tolerance=1e-6)
    box, every = (slots.of(low), slots.of(high)), torch.arange(len(hypotheses))
    refined = levenberg_marquardt(linearise, slots.of(starts), *box, settings)
    final = linearise(refined.theta, every)
    theta = with_phases_at(slots.inserted(fixed, refined.theta, every), oscillations, free, -middle)
    theta = with_wrapped_phases(theta, oscillations, free)
    std = std_with_phases_at_zero(_covariance(final.curvature, slots, theta), theta, oscillations, free, middle)
    width = slots.of(torch.cat([observer.space_width(), (last - first)[None]]).expand_as(fixed))
    level, limit = float(window.readings), _noise_limit(observer, window)
    slope = torch.where(held_back(refined.theta, final.gradient, *box), final.gradient.abs(), 0.0)
    change, age = theta - fixed, window.samples.time[-1] - theta[:, -1]
    room = torch.where(change > 0.0, high - fixed, fixed - low)
    share = (torch.maximum(change.abs(), std) / room).nan_to_num(0.0).clamp(max=1.0)
    occam_factors = [
        _log_occam_factor(final.curvature[i, :n, :n], slope[i, :n], width[i, :n], known_onset, hypothesis)
        for i, (n, hypothesis) in enumerate(zip(slots.counts, hypotheses, strict=True))
    ]
    return [
        HypothesisFit(
            hypothesis,
            theta[i, :-1],
            std[i, :-1],
            float(theta[i, -1]),
            float(std[i, -1]),
            base
            - float(final.cost[i])
            + prior(hypothesis)
            + (prior.growth(share[i, hypothesis.new], float(age[i])) if hypothesis.incipient else 0.0)
            + occam_factors[i],
            float(final.cost[i]),
            level,
            limit,
            tuple(
                c
                for c in hypothesis.sizes
                if free[i, c] and end_reached(space.parameters[c], float(theta[i, c])) is not None
            ),
        )
        for i, hypothesis in enumerate(hypotheses)
    ]


@dataclass(frozen=True)
class _Slots:
    """The free columns of H points (H, P+1), gathered so that a fit has no more columns than it needs.

    columns, used (H, Q): those of each point come first, the other slots are not used. Q is a power of two: pairwise
    sums over the slots then do not depend on the other points.
    """

    columns: Tensor
    used: Tensor

    def of(self, values: Tensor) -> Tensor:
        """Values (H, P+1) in the slots (H, Q); zero in those that are not used."""
        return torch.where(self.used, values.gather(1, self.columns), 0.0)

    def inserted(self, points: Tensor, values: Tensor, lanes: Tensor) -> Tensor:
        """The points (H, P+1) at the indices `lanes` (L,), with values (L, Q) in their free columns."""
        result, (row, slot) = points[lanes], self.used[lanes].nonzero(as_tuple=True)
        result[row, self.columns[lanes][row, slot]] = values[row, slot]
        return result

    @property
    def counts(self) -> list[int]:
        """Number of free columns of each point."""
        return self.used.sum(1).tolist()


def _slots(free: Tensor) -> _Slots:
    """Slots for the free columns of points, free (H, P+1)."""
    most = max(int(free.sum(1).max()), 1)
    columns = free.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, : 1 << (most - 1).bit_length()]
    return _Slots(columns, free.gather(1, columns))


def _covariance(curvature: Tensor, slots: _Slots, like: Tensor) -> Tensor:
    """Covariance (H, P+1, P+1) of all columns of points, zero for those that are not free, infinite variance where
    nothing determines them. curvature (H, Q, Q)."""
    covariance = like.new_zeros(*like.shape, like.shape[-1])
    for lane, count in enumerate(slots.counts):
        columns = slots.columns[lane, :count]
        covariance[lane, columns.unsqueeze(1), columns] = certainty(curvature[lane, :count, :count]).covariance
    return covariance


def _log_occam_factor(
    curvature: Tensor, slope: Tensor, width: Tensor, known_onset: bool, hypothesis: Hypothesis
) -> float:
    """Log of the posterior's volume over the prior's, of the free columns, of which the last one is the onset.

    Independent faults have independent onsets; each further fault therefore costs as much as an onset of its own.
    """
    further = 0 if known_onset else max(len(hypothesis.new) - 1, 0)
    return log_volume(curvature, width, slope) + further * log_volume(curvature[-1:, -1:], width[-1:])


def _expansion(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    point: Tensor,
    slots: _Slots,
    lanes: Tensor,
    incipient: Tensor,
    middle: float,
) -> Linearisation:
    """Half the sum of squares of the white innovations about points (L, P+1) of `lanes` (L,), with slopes by central
    differences. Free phases are those at `middle` s.
    """
    oscillations, count = oscillation_columns(observer.space.names), len(point)
    length = float(window.samples.time[-1] - window.samples.time[0])
    steps = torch.cat([SIZE_STEP * observer.space_width(), 0.5 * torch.diff(window.samples.time).median()[None]])
    steps = steps.repeat(count, 1)
    for period, _ in oscillations:
        steps[:, period] = period_step(point[:, period], length)
    used, free = slots.used[lanes], torch.zeros_like(point, dtype=torch.bool)
    lane, slot = used.nonzero(as_tuple=True)
    column = slots.columns[lanes][lane, slot]
    free[lane, column] = True
    step, rows = steps[lane, column], torch.arange(len(lane))
    ahead, behind = point[lane].clone(), point[lane].clone()
    ahead[rows, column] += step
    behind[rows, column] -= step
    source = torch.cat([torch.arange(count), lane, lane])
    every = with_phases_at(torch.cat([point, ahead, behind]), oscillations, free[source], -middle)
    changes = ChangeHypotheses(every[:, :-1], every[:, -1], incipient[source])
    white = observer.white_innovations(window, believed, changes).flatten(1)
    error = white[:count]
    slope = (white[count : count + len(lane)] - white[count + len(lane) :]) / (2.0 * step).unsqueeze(1)
    gradient, curvature = error.new_zeros(used.shape), error.new_zeros(*used.shape, used.shape[-1])
    gradient[lane, slot] = (slope * error[lane]).sum(-1)
    for k, own in enumerate(slope.split(used.sum(1).tolist())):
        curvature[k, : len(own), : len(own)] = own @ own.mT
    return Linearisation(0.5 * error.square().sum(-1), gradient, curvature)


def misfit(white: Tensor) -> float:
    """Half the sum of squares of white innovations."""
    return 0.5 * float(white.square().sum())
