"""Where: how likely a discrepancy of each component is, whatever its law; the library is not asked.

A discrepancy is a sum of few forms of the component's own variables (forms.py), about the trajectory that was read, or,
of a sensor, something slow and random (wandering.py). Its log evidence is that of the forms (sparse.py), each chosen
among all of the component, under the noise that is most likely beside it, as for an explanation by named effects
(gap/evidence.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import RARE
from fdi_torch.estimate.kalman import StateNoise
from fdi_torch.gap.disturbances import disturbed, most_likely
from fdi_torch.gap.evidence import occam
from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.gap.where import wandering
from fdi_torch.gap.where.line import spectral_line
from fdi_torch.gap.where.promise import promised
from fdi_torch.gap.where.sparse import sparse
from fdi_torch.gap.where.survey import Discrepancy, Survey, regressed
from fdi_torch.simulate.collocation import Linearised

HARMONICS = 3
STEPS = 120  # in time
ROUNDS = 40  # of the sparse regression
MOST_TURNS = 4  # in which the noise beside a discrepancy and the discrepancy are worked out
SETTLED = 0.1  # nats that a turn has to gain for another
LEARNT_FROM = 3  # places that are always looked at: they tell how much more there may be than is promised


@dataclass(frozen=True)
class Place:
    """A discrepancy at a component beside a fit. gain: in log evidence over the fit without it, prior odds left out.
    size: of what it does to the readings, root of the sum of squares in units of the sensors' noise. periods: of its
    sines, s. noise: beside it.
    """

    location: str
    gain: float
    size: float
    periods: tuple[float, ...]
    noise: StateNoise


def localized(
    fitter: Fitter, fit: Fit, noise: StateNoise, places: Sequence[str], needed: float = -math.inf
) -> list[Place]:
    """The places, the likeliest first; none where no discrepancy could gain what is needed, in log evidence.

    fitter: under the noise of the fit.
    """
    base = _likelihood(fitter, fit, fit.near)
    line = spectral_line(fitter.white(fit.near)[0][0], _spacing(fitter))
    periods = tuple(line / k for k in range(1, HARMONICS + 1)) if line else ()
    survey = Survey(fitter, fit, periods, STEPS)
    if _most(fitter, fit, noise, survey.steps) - base < needed:
        return []
    starts = [(n, disturbed(fitter, fit, n)) for n in (noise, _quiet(noise))]
    promises = _promises(survey, starts, fit, places, base)

    def weighed(own: Discrepancy, place: str, noise: StateNoise, under: Fitter) -> _Beside:
        (found,) = _weighed(under, fit, [own])
        return _Beside(place, noise, found, _likelihood(under, fit, own.near) + found.evidence - base)

    found: list[Place] = []
    beyond, refining = -math.inf, 0.0  # the most that places gained over what one form promised, and by their own noise
    for place in sorted(places, key=lambda p: -promises[p]):
        if len(found) >= LEARNT_FROM and promises[place] + beyond < needed:
            break
        own, turn = survey.of(place), 0
        best = first = max((weighed(own, place, *start) for start in starts), key=_gain)
        while (len(found) < LEARNT_FROM or best.gain + refining >= needed) and turn < MOST_TURNS:
            explained = own.columns @ best.weighed.mean
            likely = most_likely(fitter, fit, own.near, explained, best.noise, climb=turn == 0).noise
            again = weighed(own, place, likely, disturbed(fitter, fit, likely))
            turn, settled = turn + 1, again.gain < best.gain + SETTLED
            best = max(best, again, key=_gain)
            if settled:
                break
        beyond, refining = max(beyond, best.gain - promises[place]), max(refining, best.gain - first.gain)
        needed = max(needed, best.gain + math.log(RARE))
        found.append(Place(place, best.gain, _size(fitter, own, best.weighed), periods, best.noise))
    for wanders in _wandering(fitter, fit, noise, places, base, needed):
        found = [p for p in found if p.location != wanders.location or p.gain > wanders.gain]
        if all(p.location != wanders.location for p in found):
            found.append(wanders)
    return sorted(found, key=_gain, reverse=True)


def _wandering(
    fitter: Fitter, fit: Fit, noise: StateNoise, places: Sequence[str], base: float, needed: float
) -> list[Place]:
    """Sensors that may wander, as far as what they gain could matter."""
    sensors = [s.name for s in fitter.subject.plant.sensors]

    def weighed(noise: StateNoise) -> Place:
        assert noise.wander is not None
        gain = _likelihood(disturbed(fitter, fit, noise), fit, fit.near) - base - wandering.cost(fitter, noise.wander)
        return Place(sensors[noise.wander.channel], gain, wandering.size(fitter, noise.wander), (), noise)

    starts = [wandering.begun(fitter, fit, _quiet(noise), sensors.index(p)) for p in places if p in sensors]
    found: list[Place] = []
    refining = 0.0
    for first in sorted(map(weighed, starts), key=_gain, reverse=True):
        if found and first.gain + refining < needed:
            break
        best = max(first, weighed(wandering.likeliest(fitter, fit, first.noise)), key=_gain)
        refining = max(refining, best.gain - first.gain)
        needed = max(needed, best.gain + math.log(RARE))
        assert best.noise.wander is not None
        if not wandering.is_rounding(fitter, best.noise.wander):
            found.append(best)
    return found


def _promises(
    survey: Survey, starts: Sequence[tuple[StateNoise, Fitter]], fit: Fit, places: Sequence[str], base: float
) -> dict[str, float]:
    """Log evidence that one form of each place promises, under whichever noise promises more."""
    found = dict.fromkeys(places, -math.inf)
    for _, under in starts:
        ahead = _likelihood(under, fit, survey.near) - base
        for place, gain in promised(survey, under, fit, places, torch.Generator().manual_seed(0)).items():
            found[place] = max(found[place], ahead + gain)
    return found


def _most(fitter: Fitter, fit: Fit, noise: StateNoise, forms: int) -> float:
    """Log evidence that no discrepancy beside a fit can exceed: one form that explains all that is no sensors' noise.

    A form that takes G from chi-square costs half of 1 + log G nats at its most likely precision, and log(forms) more
    where it is chosen among so many.
    """
    still = disturbed(fitter, fit, replace(noise, intensity=torch.zeros_like(noise.intensity)))
    count, (residual, _) = int(fitter.subject.mask.sum()), still.white(fit.near)
    cost = 0.5 * (1.0 + math.log(max(float(residual.square().sum()) - count, 1.0))) + math.log(forms)
    # The parameters are known no better than beside the random flows.
    return -0.5 * count - 0.5 * still.log_det - cost + occam(fitter, fit.space, fit.theta, fitter.white(fit.near)[1][0])


def _size(fitter: Fitter, found: Discrepancy, weighed: _Weighed) -> float:
    moved = found.columns @ weighed.mean
    return float(torch.linalg.vector_norm(fitter.noise.whiten(moved, fitter.subject.mask)))


def _quiet(noise: StateNoise) -> StateNoise:
    """As if hardly any tank were disturbed."""
    return replace(noise, intensity=(0.1 * noise.intensity.min()).expand_as(noise.intensity).clone())


@dataclass(frozen=True)
class _Beside:
    """A discrepancy at a place under one noise."""

    location: str
    noise: StateNoise
    weighed: _Weighed
    gain: float


def _gain(found: _Beside | Place) -> float:
    return found.gain


@dataclass(frozen=True)
class _Weighed:
    evidence: float
    closes: float
    mean: Tensor


def _weighed(fitter: Fitter, fit: Fit, each: Sequence[Discrepancy]) -> list[_Weighed]:
    """Log evidence of the forms of each discrepancy over none of them, every form chosen among all."""
    regressions = [regressed(fitter, fit, found) for found in each]
    width = max(len(r.score) for r in regressions)
    gram, score = (torch.zeros(len(each), *(width,) * d, dtype=torch.float64) for d in (2, 1))
    for k, r in enumerate(regressions):
        gram[k, : len(r.score), : len(r.score)], score[k, : len(r.score)] = r.gram, r.score
    found = sparse(gram, score, ROUNDS)
    choice = [math.log(len(r.score)) for r in regressions]
    return [
        _Weighed(
            float(found.evidence[k] - choice[k] * found.needs[k]), float(found.closes[k]), found.mean[k, : len(r.score)]
        )
        for k, r in enumerate(regressions)
    ]


def _likelihood(fitter: Fitter, fit: Fit, near: Linearised) -> float:
    """Log evidence of the fit about a trajectory, prior odds left out."""
    space, theta = fit.space, fit.theta
    residual, jacobian = (x[0] for x in fitter.white(near))
    scale, pull, off = fitter.priors(space, theta)
    rows = torch.cat([(jacobian * scale).flatten(0, 1), torch.diag(pull + 1e-9)])
    right = torch.cat([residual.flatten(), -off])
    basis, _ = torch.linalg.qr(rows)
    left = right - basis @ (basis.T @ right)
    return -0.5 * float(left @ left) - 0.5 * fitter.log_det + occam(fitter, space, theta, jacobian)


def _spacing(fitter: Fitter) -> float:
    return float(torch.median(torch.diff(fitter.subject.recording.time)))
