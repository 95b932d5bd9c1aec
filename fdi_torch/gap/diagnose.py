"""The gap diagnosis: noise floor, recalibration, where, which, and how far the gap closes on data not used."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.gap.answer import Amount, Answer, Cause, CauseName, Explanation, Verdict
from fdi_torch.gap.closure import Closure, closure
from fdi_torch.gap.evidence import log_evidence, posterior, temperature
from fdi_torch.gap.fitting import Candidate, Fit, Fitter, Subject, subject_of
from fdi_torch.gap.floor import Noise, estimate_noise, lattice_step, slow_excess, with_rounding
from fdi_torch.gap.freeform import shape_of
from fdi_torch.gap.library import canonical, library_of, possible_places, twins
from fdi_torch.gap.next_input import next_input
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.where import Suspect, refit, suspects
from fdi_torch.gap.which import Search, search
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach, reach_of
from fdi_torch.recording import Recording

CONTENT = 0.95
REFITS = 3
PATIENT = 40  # rounds for the recalibration, on which all else rests
UNEXPLAINED = 0.1  # share of the gap left open at which nothing has been explained
LEFT_SHARE, LEFT_LEAST = 2e-3, 150.0  # share of the gap, and chi-square units, worth asking the free forms about
FAR_BETTER = 0.35
Tell = Callable[[float, str], None]


@dataclass(frozen=True)
class Settings:
    """library, leave_out: as in `library_of`. step: of the simulation, s; None for the sampling interval."""

    library: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    step: float | None = None


def diagnose(
    plant: PlantDescription,
    recording: Recording,
    holdout: Recording | None = None,
    settings: Settings = Settings(),
    tell: Tell = lambda share, text: None,
) -> Answer:
    """What keeps the plant file from explaining the recording; the hold-out only measures how far the gap closes."""
    library = library_of(plant, settings.library, settings.leave_out)
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    subject = subject_of(plant, believed, recording, settings.step or _interval(recording))
    tell(0.05, "noise floor and recalibration")
    fitter, null, lattice = _recalibrated(subject)
    reach = reach_of(recording, plant)
    tell(0.2, "which effect")
    options = options_of([p for p in library if not p.effect.rounds], fitter, reach)
    found = search(fitter, null, options)
    tell(0.6, "where")
    places, refits = _places(fitter, found, plant, reach)
    rounded = [("sensor_quantization", s.name) for s, step in zip(plant.sensors, lattice, strict=True) if step > 0.0]
    rounded = [c for c in rounded if any((p.effect.name, p.location) == c for p in library)]
    weighed = _weighed(fitter, found, len(library), plant)
    unknown = _unnamed(fitter, weighed.fits[0], found, refits)
    tell(0.8, "hold-out")
    return _answer(fitter, found, places, weighed, unknown, rounded, lattice, holdout, settings)


def _places(fitter: Fitter, found: Search, plant: PlantDescription, reach: Reach) -> tuple[list[Suspect], list[Fit]]:
    """Every place with what it could close; the likeliest refitted in full where the library leaves something open."""
    gap, left = _gap(fitter, found), _left(fitter, found.best)
    heat = temperature(found.null.cost - found.best.cost)
    everywhere = possible_places(plant)
    places = suspects(fitter, found.null, everywhere, reach, heat, waves=left > UNEXPLAINED * gap > 0.0)
    if left < max(LEFT_SHARE * gap, LEFT_LEAST):
        return places, []
    return places, [refit(fitter, found.null, s, reach) for s in places[:REFITS]]


def _unnamed(fitter: Fitter, named: Fit, found: Search, refits: Sequence[Fit]) -> Fit | None:
    """The free discrepancy of one place that closes what no effect of the library does, if there is one.

    Equations that differ a little leave a little open, and a free discrepancy at the same place cannot do much
    better; where one place alone does far better than all that has a name, or nothing named does, it has no name.
    """
    if not refits:
        return None
    best = min(refits, key=lambda f: f.cost)
    gap, left = _gap(fitter, found), _left(fitter, named)
    if _left(fitter, best) > UNEXPLAINED * gap:
        best = refits[0]  # no place alone does it: the likeliest one to first order
    free = _left(fitter, best)
    nothing_named = left > UNEXPLAINED * gap
    far_better = free < FAR_BETTER * left and left - free > max(LEFT_SHARE * gap, LEFT_LEAST)
    return best if nothing_named or far_better else None


def _interval(recording: Recording) -> float:
    return float(torch.median(torch.diff(recording.time)))


def _left(fitter: Fitter, fit: Fit) -> float:
    """What a fit leaves open, chi-square units."""
    return max(slow_excess(fitter.white(fit.near)[0][0]), 0.0)


def _gap(fitter: Fitter, found: Search) -> float:
    """What the recalibrated plant leaves open: what the best explanation closes, and what that leaves."""
    return found.null.cost - found.best.cost + _left(fitter, found.best)


def _recalibrated(subject: Subject) -> tuple[Fitter, Fit, list[float]]:
    """The noise of each channel, the recalibrated plant under it, and the step of each rounded channel."""
    channels = len(subject.plant.sensors)
    spread = subject.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    first = Fitter(subject, Noise(1e-2 * spread, torch.zeros(channels, dtype=spread.dtype)))
    null = first.fit(Candidate(), rounds=PATIENT)
    residual = subject.readings - null.near.readings[0]
    noise = estimate_noise(residual, subject.mask)
    values = [subject.readings[subject.mask[:, c], c] for c in range(channels)]
    lattice = [lattice_step(v, float(noise.std[c])) for c, v in enumerate(values)]
    noise = estimate_noise(residual, subject.mask, [step > 0.0 for step in lattice])
    fitter = Fitter(subject, with_rounding(noise, lattice, null.near.readings[0]))
    return fitter, fitter.fit(Candidate(), null, rounds=PATIENT), lattice


@dataclass(frozen=True)
class Weighed:
    """Explanations with their probabilities, likeliest first; fit: the best one of each."""

    explanations: tuple[Explanation, ...]
    fits: tuple[Fit, ...]


def _weighed(fitter: Fitter, found: Search, choices: int, plant: PlantDescription) -> Weighed:
    """All fits of the search by their evidence; names of one thing count once."""
    heat = temperature(found.null.cost - found.best.cost)
    scores: dict[frozenset[CauseName], tuple[float, Fit]] = {}
    for fit in found.fits:
        key = frozenset(canonical(c, plant) for c in fit.key)
        score = log_evidence(fitter, fit, heat, choices)
        if key not in scores or score > scores[key][0]:
            scores[key] = (score, fit)
    ranked = sorted(scores.values(), key=lambda item: -item[0])
    weights = posterior([score for score, _ in ranked])
    pairs = zip(ranked, weights, strict=True)
    return Weighed(tuple(Explanation(_ordered(f), w) for (_, f), w in pairs), tuple(f for _, f in ranked))


def _ordered(fit: Fit) -> tuple[CauseName, ...]:
    return tuple((p.effect.name, p.location) for p in fit.candidate.placements)


def _answer(
    fitter: Fitter,
    found: Search,
    places: Sequence[Suspect],
    weighed: Weighed,
    unnamed: Fit | None,
    rounded: Sequence[CauseName],
    lattice: Sequence[float],
    holdout: Recording | None,
    settings: Settings,
) -> Answer:
    explanations, fit = weighed.explanations, weighed.fits[0]
    standing = _content(explanations)
    verdict: Verdict = "unknown" if unnamed else _verdict(standing, rounded)
    causes = () if verdict in ("no_gap", "unknown") else _causes(fitter, fit, rounded, lattice)
    gap = max(_gap(fitter, found), 1.0)
    where = [(s.location, min(max(s.closes / gap, 0.0), 1.0)) for s in places]
    if unnamed:
        place = unnamed.candidate.placements[0].location
        where = sorted(where, key=lambda w: w[0] != place)
        explanations = (Explanation((), 1.0, place),)
    return Answer(
        verdict=verdict,
        p_value=_p_value(found, rounded),
        where=where,
        causes=causes,
        ambiguity_set=[(*e.causes, *rounded) for e in standing] if causes else [],
        posterior=[
            Explanation(() if e.unknown_at else (*e.causes, *rounded), e.probability, e.unknown_at)
            for e in explanations[:12]
        ],
        closure=(closed := _closure(fitter, found, unnamed or fit, lattice, holdout, settings)),
        noise=_noise(fitter, lattice),
        shape=shape_of(unnamed) if unnamed else None,
        next_input=_next(fitter, weighed) if verdict == "ambiguous" else None,
        impostors=_impostors(fitter, found, fit) if causes else None,
        remarks=_remarks(fitter, found, unnamed or fit, closed),
    )


def _next(fitter: Fitter, weighed: Weighed) -> Mapping[str, Any] | None:
    """The input that would part the two likeliest explanations."""
    found = next_input(fitter, weighed.fits[0], weighed.fits[1])
    between = [[{"effect": n, "location": at} for n, at in e.causes] for e in weighed.explanations[:2]]
    return {"between": between, **found} if found else None


def _impostors(fitter: Fitter, found: Search, named: Fit) -> dict[str, object]:
    """What would be left open, had the library lacked what was named: the best of the fits without it.

    would_pass: whether that impostor would have closed all but two per cent of the gap.
    """
    others = [f for f in found.fits if f.key and not f.key & named.key]
    gap = max(_gap(fitter, found), 1.0)
    if not others:
        return {"best": [], "left_open": 1.0, "would_pass": False}
    best = min(others, key=lambda f: f.cost)
    left = min((_left(fitter, named) + best.cost - named.cost) / gap, 1.0)
    causes = [{"effect": name, "location": place} for name, place in _ordered(best)]
    return {"best": causes, "left_open": left, "would_pass": left < 0.02}


def _remarks(fitter: Fitter, found: Search, best: Fit, closed: Mapping[str, Any]) -> list[str]:
    remarks = []
    if all(float(torch.diff(column).abs().max()) == 0.0 for column in fitter.subject.recording.inputs.T):
        remarks.append("the inputs never change: most effects cannot be told apart; --plan shows what steps would tell")
    if len(fitter.subject.nuisance) == len(fitter.subject.plant.tanks):
        remarks.append("the plant file gives no tolerances: every constant is taken to be exact")
    explained = _left(fitter, best) < UNEXPLAINED * max(_gap(fitter, found), float(fitter.subject.mask.sum()))
    if closed and explained and closed["augmented"] > 3.0 * closed["noise_floor"] and (closed["closed"] or 0.0) < 0.5:
        remarks.append("what explains the recording does not explain the hold-out: is it of the same rig?")
    return remarks


def _content(explanations: Sequence[Explanation]) -> list[Explanation]:
    """The fewest explanations that hold 95 % together."""
    kept, held = [], 0.0
    for explanation in explanations:
        kept.append(explanation)
        held += explanation.probability
        if held >= CONTENT:
            break
    return kept


def _verdict(standing: Sequence[Explanation], rounded: Sequence[CauseName]) -> Verdict:
    if not standing[0].causes and not rounded:
        return "no_gap"
    return "named" if len(standing) == 1 else "ambiguous"


def _causes(fitter: Fitter, fit: Fit, rounded: Sequence[CauseName], lattice: Sequence[float]) -> tuple[Cause, ...]:
    plant, stds = fitter.subject.plant, _standard_errors(fitter, fit)
    causes = []
    for p in fit.candidate.placements:
        amounts = {}
        for name, value in fit.effect_values.items():
            if name.rpartition(".")[0] == p.prefix:
                amounts[name.rpartition(".")[2]] = Amount(value, stds[name], fit.space[name].unit)
        causes.append(Cause(p.effect.name, p.location, amounts, twins((p.effect.name, p.location), plant)))
    steps = {s.name: (step, s.unit) for s, step in zip(plant.sensors, lattice, strict=True)}
    for name, place in rounded:
        causes.append(Cause(name, place, {"step": Amount(steps[place][0], 0.0, steps[place][1])}))
    return tuple(causes)


def _standard_errors(fitter: Fitter, fit: Fit) -> dict[str, float]:
    scale = fitter.box(fit.space)[2]
    curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.near, scale)[2][0]
    variance = torch.diagonal(torch.linalg.pinv(curvature, hermitian=True))
    return dict(zip(fit.space.names, (torch.sqrt(variance.clamp(min=0.0)) * scale).tolist(), strict=True))


def _p_value(found: Search, rounded: Sequence[CauseName]) -> float:
    """Chance that noise alone lets some option of the library gain as much (Bonferroni over the options)."""
    if rounded:
        return 0.0
    screen = found.screens[found.null.key]
    singles = [f.cost for f in found.fits if len(f.key) == 1]
    gain = max(float(screen.gain.max()), found.null.cost - min(singles, default=found.null.cost))
    return min(1.0, len(screen.options) * math.erfc(math.sqrt(max(gain, 0.0) / 2.0)))


def _closure(
    fitter: Fitter, found: Search, best: Fit, lattice: Sequence[float], holdout: Recording | None, settings: Settings
) -> Mapping[str, Any]:
    if holdout is None:
        return {}
    subject = subject_of(fitter.subject.plant, fitter.subject.believed, holdout, settings.step or _interval(holdout))
    unit, scale = display_unit(subject.plant.sensors[0].unit)
    fits: dict[str, Fit | None] = {"nominal": None, "recalibrated": found.null, "augmented": best}
    done: Closure = closure(subject, fitter.noise, fits, lattice, scale, unit)
    return {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": done.unit,
        **done.pooled,
        "per_sensor": done.per_sensor,
        "closed": done.closed,
        "closed_ci95": done.closed_ci95,
        "augmented_with": [{"effect": n, "location": at} for n, at in _ordered(best)],
    }


def _noise(fitter: Fitter, lattice: Sequence[float]) -> Mapping[str, Any]:
    sensors = fitter.subject.plant.sensors
    std: Tensor = fitter.noise.std
    return {
        s.name: {"std": float(std[i]), "ar1": float(fitter.noise.ar[i]), "rounded_to": lattice[i], "unit": s.unit}
        for i, s in enumerate(sensors)
    }
