"""From what was found to what is handed over: causes with their errors, shares, rivals, closure, remarks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.answer import Amount, Answer, Cause, Explanation
from fdi_torch.gap.closure import Closure, closure
from fdi_torch.gap.finding import Finding, in_order, left_open
from fdi_torch.gap.fitting import Fit, Fitter, subject_of
from fdi_torch.gap.freeform import shape_of
from fdi_torch.gap.library import twins
from fdi_torch.gap.next_input import next_input
from fdi_torch.parameters import display_unit
from fdi_torch.recording import Recording

MOST_EXPLANATIONS = 12
PASSES = 0.02  # share of the gap left open by an impostor that a fit test would let pass


def answered(found: Finding, holdout: Recording | None, step: float) -> Answer:
    """step: of the hold-out's simulation, s."""
    has_causes = found.verdict in ("named", "ambiguous")
    gap = max(found.gap, 1.0)
    where = [(s.location, min(max(s.closes / gap, 0.0), 1.0)) for s in found.places]
    explanations = found.weighed.explanations
    if found.unnamed:
        place = found.unnamed.candidate.placements[0].location
        where = sorted(where, key=lambda w: w[0] != place)
        explanations = (Explanation((), 1.0, place),)
    closed = _closure(found, holdout, step)
    return Answer(
        verdict=found.verdict,
        p_value=_p_value(found),
        where=where,
        causes=_causes(found) if has_causes else (),
        ambiguity_set=[(*e.causes, *found.rounded) for e in found.standing] if has_causes else [],
        posterior=[
            Explanation(() if e.unknown_at else (*e.causes, *found.rounded), e.probability, e.unknown_at)
            for e in explanations[:MOST_EXPLANATIONS]
        ],
        closure=closed,
        noise=_noise(found.fitter, found.lattice),
        shape=shape_of(found.unnamed) if found.unnamed else None,
        next_input=_next(found) if found.verdict == "ambiguous" else None,
        impostors=_impostors(found) if has_causes else None,
        remarks=_remarks(found, closed),
    )


def _next(found: Finding) -> Mapping[str, Any] | None:
    """The input that would part the two likeliest explanations."""
    weighed = found.weighed
    parting = next_input(found.fitter, weighed.fits[0], weighed.fits[1])
    between = [[{"effect": n, "location": at} for n, at in e.causes] for e in weighed.explanations[:2]]
    return {"between": between, **parting} if parting else None


def _impostors(found: Finding) -> dict[str, object]:
    """What would be left open, had the library lacked what was named: the best of the fits without it.

    would_pass: whether that impostor would have closed all but two per cent of the gap.
    """
    named = found.named
    others = [f for f in found.search.fits if f.key and not f.key & named.key]
    if not others:
        return {"best": [], "left_open": 1.0, "would_pass": False}
    best = min(others, key=lambda f: f.cost)
    left = min((left_open(found.fitter, named) + best.cost - named.cost) / max(found.gap, 1.0), 1.0)
    causes = [{"effect": name, "location": place} for name, place in in_order(best)]
    return {"best": causes, "left_open": left, "would_pass": left < PASSES}


def _remarks(found: Finding, closed: Mapping[str, Any]) -> list[str]:
    remarks, subject = [], found.fitter.subject
    if all(float(torch.diff(column).abs().max()) == 0.0 for column in subject.recording.inputs.T):
        remarks.append("the inputs never change: most effects cannot be told apart; --plan shows what steps would tell")
    if len(subject.nuisance) == len(subject.plant.tanks):
        remarks.append("the plant file gives no tolerances: every constant is taken to be exact")
    far_off = closed and closed["augmented"] > 3.0 * closed["noise_floor"] and (closed["closed"] or 0.0) < 0.5
    if far_off and found.explained:
        remarks.append("what explains the recording does not explain the hold-out: is it of the same rig?")
    return remarks


def _causes(found: Finding) -> tuple[Cause, ...]:
    fitter, fit = found.fitter, found.named
    plant, stds = fitter.subject.plant, standard_errors(fitter, fit)
    causes = []
    for p in fit.candidate.placements:
        amounts = {}
        for name, value in fit.effect_values.items():
            if name.rpartition(".")[0] == p.prefix:
                amounts[name.rpartition(".")[2]] = Amount(value, stds[name], fit.space[name].unit)
        causes.append(Cause(p.effect.name, p.location, amounts, twins((p.effect.name, p.location), plant)))
    steps = {s.name: (step, s.unit) for s, step in zip(plant.sensors, found.lattice, strict=True)}
    for name, place in found.rounded:
        causes.append(Cause(name, place, {"step": Amount(steps[place][0], 0.0, steps[place][1])}))
    return tuple(causes)


def standard_errors(fitter: Fitter, fit: Fit) -> dict[str, float]:
    """Of every parameter of a fit, tolerances included, in its unit."""
    scale = fitter.box(fit.space)[2]
    curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.near, scale)[2][0]
    variance = torch.diagonal(torch.linalg.pinv(curvature, hermitian=True))
    return dict(zip(fit.space.names, (torch.sqrt(variance.clamp(min=0.0)) * scale).tolist(), strict=True))


def _p_value(found: Finding) -> float:
    """Chance that noise alone lets some option of the library gain as much (Bonferroni over the options)."""
    if found.rounded:
        return 0.0
    screen, null = found.search.screens[found.null.key], found.null
    singles = [f.cost for f in found.search.fits if len(f.key) == 1]
    gain = max(float(screen.gain.max()), null.cost - min(singles, default=null.cost))
    return min(1.0, len(screen.options) * math.erfc(math.sqrt(max(gain, 0.0) / 2.0)))


def _closure(found: Finding, holdout: Recording | None, step: float) -> Mapping[str, Any]:
    if holdout is None:
        return {}
    fitter = found.fitter
    subject = subject_of(fitter.subject.plant, fitter.subject.believed, holdout, step)
    unit, scale = display_unit(subject.plant.sensors[0].unit)
    fits: dict[str, Fit | None] = {"nominal": None, "recalibrated": found.null, "augmented": found.best}
    done: Closure = closure(subject, fitter.noise, fits, found.lattice, scale, unit)
    return {
        "metric": "free-run RMSE on the hold-out, per sensor and pooled, in the sensor's unit",
        "unit": done.unit,
        **done.pooled,
        "per_sensor": done.per_sensor,
        "closed": done.closed,
        "closed_ci95": done.closed_ci95,
        "augmented_with": [{"effect": n, "location": at} for n, at in in_order(found.best)],
    }


def _noise(fitter: Fitter, lattice: Sequence[float]) -> Mapping[str, Any]:
    sensors = fitter.subject.plant.sensors
    std: Tensor = fitter.noise.std
    return {
        s.name: {"std": float(std[i]), "ar1": float(fitter.noise.ar[i]), "rounded_to": lattice[i], "unit": s.unit}
        for i, s in enumerate(sensors)
    }
