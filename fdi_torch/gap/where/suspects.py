"""Where: how much of the gap a discrepancy of each component alone could close, and in how few forms; no library asked.

    log evidence of a component = -(what it leaves open) / (2 T) + what its forms cost   (sparse.py)

T is what the best component leaves open beside the noise, spread over the forms: no list of forms is complete, and what
none of them can do parts nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.gap.where.components import balance_of
from fdi_torch.gap.where.line import STANDS_OUT, spectral_line
from fdi_torch.gap.where.sparse import sparse
from fdi_torch.gap.where.survey import Regression, Survey

HARMONICS = 3
STEPS, FEW_STEPS = 120, 40  # in time
NEAR = 120.0  # nats behind the likeliest within which places are rivals
MORE_STEPS = 400  # in time, to part rivals
CHOICE = 2.0  # nats, of choosing a form among some hundred, beside the one that its size costs
ROUNDS = (10, 40)  # at a first temperature, which tells what is left open, and at the one that follows from it
FIRST_HEAT, FREEDOM = 1e4, 300.0  # chi-square units left open that a unit of temperature stands for, at first and then


@dataclass(frozen=True)
class Suspect:
    """leaves: chi-square units that the component's best discrepancy leaves open. evidence: its log Bayes factor
    against the likeliest component. periods: of its sines, s."""

    location: str
    leaves: float
    evidence: float
    periods: tuple[float, ...] = ()


def suspects(fitter: Fitter, fit: Fit, places: Sequence[str], waves: bool, closely: bool) -> list[Suspect]:
    """All places, the likeliest first. Where the residual has a line in its spectrum, a place may also come and go in
    its period; waves: whether line or not, in the strongest period. closely: with fine courses in time.
    """
    line = spectral_line(fitter.white(fit.near)[0][0], _spacing(fitter), 0.0 if waves else STANDS_OUT)
    periods = tuple(line / k for k in range(1, HARMONICS + 1)) if line else ()
    survey = Survey(fitter, fit, periods, STEPS if closely else FEW_STEPS)
    evidence, leaves = _weighed([survey.of(place) for place in places])
    best = max(evidence)
    found = [Suspect(p, o, e - best, periods) for p, o, e in zip(places, leaves, evidence, strict=True)]
    return sorted(found, key=lambda s: -s.evidence)


def parted(fitter: Fitter, fit: Fit, found: Sequence[Suspect]) -> list[Suspect]:
    """The likeliest and its rivals in the order of what evidence a closer look gives them, with what they left open at
    the first.

    What flows into a tank or out of it makes one balance: its pump, its outlet and itself can take up each other's
    discrepancies, but only the one that has it needs few forms. With thresholds and steps that lie far apart, even
    that one needs many.
    """
    plant = fitter.subject.plant
    shared = balance_of(found[0].location, plant)
    near = [s for s in found if s.evidence > -NEAR and balance_of(s.location, plant) == shared]
    if shared is None or len(near) < 2:
        return list(found)
    survey = Survey(fitter, fit, near[0].periods, MORE_STEPS, closely=True)
    evidence, _ = _weighed([survey.of(s.location) for s in near], CHOICE)
    order = sorted(range(len(near)), key=lambda k: -evidence[k])
    near = [replace(s, evidence=e - max(evidence)) for s, e in zip(near, evidence, strict=True)]
    rest = [s for s in found if s.location not in {n.location for n in near}]
    return [*(near[k] for k in order), *rest]


def _weighed(each: Sequence[Regression], choice: float = 0.0) -> tuple[list[float], list[float]]:
    """Log evidence, a form costing `choice` nats, and what is left open, for every regression."""
    width = max(len(r.score) for r in each)
    gram, score = (torch.zeros(len(each), *(width,) * d, dtype=torch.float64) for d in (2, 1))
    for k, r in enumerate(each):
        count = len(r.score)
        gram[k, :count, :count], score[k, :count] = r.gram, r.score
    unexplained = torch.tensor([r.unexplained for r in each], dtype=torch.float64)
    noise = torch.tensor([r.noise for r in each], dtype=torch.float64)
    heat = 1.0 + max(float((unexplained - noise).median()), 0.0) / FIRST_HEAT
    for rounds in ROUNDS:
        found = sparse(gram, score, heat, rounds)  # anew: what a high temperature sends to nothing is slow to return
        leaves = unexplained - found.closes - noise
        evidence = found.evidence - choice * found.needs - 0.5 * unexplained / heat
        heat = 1.0 + max(float(leaves.min()), 0.0) / FREEDOM
    return evidence.tolist(), leaves.clamp(min=0.0).tolist()


def _spacing(fitter: Fitter) -> float:
    return float(torch.median(torch.diff(fitter.subject.recording.time)))
