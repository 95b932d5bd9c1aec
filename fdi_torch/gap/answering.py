"""From what was found to what is handed over: causes with their errors, shares, rivals, closure, remarks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from fdi_torch.gap.answer import Amount, Answer, Cause, Explanation, names
from fdi_torch.gap.ceiling import constants_of, guilty_places, models_of
from fdi_torch.gap.closure import HeldOut, run_all
from fdi_torch.gap.closure_answer import closure_in_full
from fdi_torch.gap.curves import curves_at
from fdi_torch.gap.evidence import posterior, temperature
from fdi_torch.gap.excitation import excitation
from fdi_torch.gap.finding import Finding, chance, in_order
from fdi_torch.gap.fitting import Fitter, left_open
from fdi_torch.gap.freeform import shape_of
from fdi_torch.gap.impostors import PASSES, simulated_impostors
from fdi_torch.gap.library import twins
from fdi_torch.gap.next_input import next_input
from fdi_torch.gap.remarks import remarks_on
from fdi_torch.gap.standard_errors import standard_errors
from fdi_torch.gap.strays import most_astray
from fdi_torch.gap.subject import Subject
from fdi_torch.gap.traces import traces

MOST_EXPLANATIONS = 12
NAMELESS = 0.9  # how often what is told as unknown has no name: of 109 recordings of the withheld check, 92


def answered(found: Finding, holdouts: Sequence[Subject]) -> Answer:
    """holdouts: laid out for the same plant."""
    has_causes = found.verdict in ("named", "ambiguous")
    gap = max(found.gap, 1.0)
    where = [(s.location, max(1.0 - s.leaves / gap, 0.0)) for s in found.places]
    explanations = found.weighed.explanations
    if found.unnamed:
        explanations = _nameless(found)
    held = _held_out(found, holdouts)
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
        closure=closure_in_full(held, found) if held else {},
        noise=_noise(found.fitter, found.lattice),
        shape=shape_of(found.unnamed) if found.unnamed else None,
        next_input=_next(found) if found.verdict == "ambiguous" else None,
        impostors=_impostors(found) if has_causes else None,
        excitation=_excitation(found),
        constants=_constants(found),
        curves=_curves(found),
        remarks=remarks_on(found, held),
        arrays=traces(found, held),
    )


def _nameless(found: Finding) -> tuple[Explanation, ...]:
    """Something unknown at each place by its evidence; what has a name keeps a tenth."""
    places = [s for s in found.places if math.isfinite(s.leaves)]
    weights = posterior([s.evidence for s in places])
    unknown = [Explanation((), NAMELESS * w, s.location) for s, w in zip(places, weights, strict=True)]
    named = [replace(e, probability=(1.0 - NAMELESS) * e.probability) for e in found.weighed.explanations]
    return tuple(sorted([*unknown, *named], key=lambda e: -e.probability))


def _held_out(found: Finding, holdouts: Sequence[Subject]) -> list[HeldOut]:
    """Free runs of all models on all hold-outs."""
    if not holdouts:
        return []
    models, believed = models_of(found), found.fitter.subject.believed
    return [run_all(replace(each, believed=believed), found.fitter.noise, models, found.lattice) for each in holdouts]


def _curves(found: Finding) -> list[dict[str, Any]]:
    """The discrepancy at every guilty place; not drawn for several recordings at once."""
    if found.verdict == "no_gap" or found.fitter.subject.further:
        return []
    heat = temperature(found.null.cost - found.search.best.cost)
    places = guilty_places(found)
    return [
        curve.to_dict() for place in places for curve in curves_at(found.fitter, found.best, place, found.reach, heat)
    ]


def _constants(found: Finding) -> dict[str, dict[str, object]]:
    """What each calibration constant is believed to be, and what it becomes without and with the causes."""
    errors = standard_errors(found.fitter, found.best)
    null, best, space = constants_of(found.null), constants_of(found.best), found.best.space
    return {
        name: {
            "nominal": space[name].nominal,
            "tolerance": space[name].std,
            "recalibrated": null[name],
            "augmented": best[name],
            "std": errors[name],
            "unit": space[name].unit,
        }
        for name in null
    }


def _next(found: Finding) -> Mapping[str, Any] | None:
    """The input that would part the two likeliest explanations."""
    weighed = found.weighed
    parting = next_input(found.fitter, weighed.fits[0], weighed.fits[1])
    between = [names(e.causes) for e in weighed.explanations[:2]]
    return {"between": between, **parting} if parting else None


def _impostors(found: Finding) -> dict[str, object]:
    """What would be left open, had the library lacked what was named: the best of the fits without it; and, for one
    cause alone, how often another would have passed for it.

    would_pass: whether that impostor would have closed all but two per cent of the gap.
    """
    named, gap = found.named, max(found.gap, 1.0)
    others = [f for f in found.search.fits if f.key and not f.key & named.key]
    best = min(others, key=lambda f: f.cost, default=None)
    left = 1.0 if best is None else min((left_open(found.fitter, named) + best.cost - named.cost) / gap, 1.0)
    told: dict[str, object] = {"best": names(in_order(best)) if best else [], "left_open": left}
    told["would_pass"] = left < PASSES
    if len(named.key) == 1:
        (cause,) = named.key
        screen = found.search.screens[found.null.key]
        told["simulated"] = simulated_impostors(screen, cause, gap, found.fitter.subject.plant)
    return told


def _excitation(found: Finding) -> dict[str, Any]:
    """What this recording's inputs cannot show or tell apart, by the names of the answer."""
    shown = excitation(found.search.screens[found.null.key], found.fitter.subject.plant)
    twins_found = [{"between": names((a, b)), "parted_by": left} for a, b, left in shown.twins]
    return {"hidden": names(shown.hidden), "inseparable": twins_found}


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
    steps = {s.name: ("step", step) for s, step in zip(plant.sensors, found.lattice, strict=True)}
    limits = {(p.effect.name, p.location): ("limit", (p.values or {})["limit"]) for p in found.told}
    units = {s.name: s.unit for s in plant.sensors}
    for name, place in found.rounded:
        parameter, value = limits.get((name, place), steps[place])
        causes.append(Cause(name, place, {parameter: Amount(value, 0.0, units[place])}))
    return tuple(causes)


def _p_value(found: Finding) -> float:
    """Chance that it is noise; what the values themselves tell is none."""
    if found.rounded or (found.verdict == "unknown" and most_astray(found.strays[0])):
        return 0.0
    return chance(found.search)


def _noise(fitter: Fitter, lattice: Sequence[float]) -> Mapping[str, Any]:
    sensors = fitter.subject.plant.sensors
    std: Tensor = fitter.noise.std
    return {
        s.name: {"std": float(std[i]), "ar1": float(fitter.noise.alike[i]), "rounded_to": lattice[i], "unit": s.unit}
        for i, s in enumerate(sensors)
    }
