"""From what was found to what is handed over: causes with their errors, shares, rivals, closure, remarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from fdi_torch.gap.answer import UNKNOWN, Amount, Answer, Cause, CauseName, Explanation, names
from fdi_torch.gap.candidate_fit import Fitter, standard_errors
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.diagnosis_result import DiagnosisResult, p_value
from fdi_torch.gap.discrepancy_curves import curves_at
from fdi_torch.gap.experiment_design import discriminating_input
from fdi_torch.gap.free_form import discrepancy_tables
from fdi_torch.gap.holdout import HeldOut, run_reference_models
from fdi_torch.gap.identifiability import identifiability, simulated_confusions
from fdi_torch.gap.library import equivalent_causes
from fdi_torch.gap.model_comparison import (
    causal_places,
    closure_to_dict,
    constants_of,
    prediction_arrays,
    reference_models,
)
from fdi_torch.gap.posterior import CauseHypothesis
from fdi_torch.gap.preprocess.outliers import sensor_with_outliers
from fdi_torch.gap.remarks import remarks_on
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement

MOST_EXPLANATIONS = 12


def build_answer(found: DiagnosisResult, holdouts: Sequence[DataSet]) -> Answer:
    """holdouts: laid out for the same plant."""
    has_causes = found.verdict in ("named", "ambiguous")
    believed = found.posterior
    held = _held_out(found, holdouts)
    shown = zip(believed.hypotheses[:MOST_EXPLANATIONS], believed.probabilities, strict=False)
    return Answer(
        verdict=found.verdict,
        p_value=_p_value(found),
        where=_where(found),
        causes=_causes(found),
        ambiguity_set=[_names(found, h) for h in found.credible_set] if has_causes else [],
        posterior=[Explanation((*h.causes, *found.from_readings), p, h.unknown_at) for h, p in shown],
        unexamined=believed.unexamined,
        converged=found.best.converged,
        closure=closure_to_dict(held, found) if held else {},
        noise=_noise(found.fitter, found.quantization_steps),
        disturbances=_disturbances(found),
        shape=discrepancy_tables(found.free_form_fit) if found.free_form_fit else None,
        next_input=_next(found) if found.verdict == "ambiguous" else None,
        impostors=_impostors(found) if has_causes else None,
        excitation=_excitation(found),
        constants=_constants(found),
        curves=_curves(found),
        remarks=remarks_on(found, held),
        arrays=prediction_arrays(found, held),
    )


def _names(found: DiagnosisResult, hypothesis: CauseHypothesis) -> tuple[CauseName, ...]:
    """All that a hypothesis holds, something unknown among it."""
    unknown = ((UNKNOWN, hypothesis.unknown_at),) if hypothesis.unknown_at else ()
    return (*hypothesis.causes, *unknown, *found.from_readings)


def _where(found: DiagnosisResult) -> list[tuple[str, float]]:
    """Places by the probability that something is wrong there; first of all a sensor whose readings jump, where that is
    all that is wrong."""
    places = list(found.posterior.places)
    best = found.posterior.best
    if found.verdict == "unknown" and not best.place and (straying := sensor_with_outliers(found.outliers[0])):
        places = [(straying, 1.0), *((p, share) for p, share in places if p != straying)]
    return places


def _held_out(found: DiagnosisResult, holdouts: Sequence[DataSet]) -> list[HeldOut]:
    """Free runs of all models on all hold-outs."""
    if not holdouts:
        return []
    models, nominal_effects = reference_models(found), found.fitter.data.nominal_effects
    return [
        run_reference_models(
            replace(each, nominal_effects=nominal_effects), found.fitter.noise, models, found.quantization_steps
        )
        for each in holdouts
    ]


def _curves(found: DiagnosisResult) -> list[dict[str, Any]]:
    """The discrepancy at every guilty place; not drawn for several recordings at once."""
    if found.verdict == "no_gap" or found.fitter.data.further:
        return []
    places = causal_places(found)
    return [curve.to_dict() for place in places for curve in curves_at(found.fitter, found.best, place, found.reach)]


def _constants(found: DiagnosisResult) -> dict[str, dict[str, object]]:
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


def _next(found: DiagnosisResult) -> Mapping[str, Any] | None:
    """The input that would part the two likeliest explanations."""
    first, second = found.posterior.hypotheses[:2]
    parting = discriminating_input(found.fitter, first.fit, second.fit)
    between = [names(_names(found, h)) for h in (first, second)]
    return {"between": between, **parting} if parting else None


def _impostors(found: DiagnosisResult) -> dict[str, object]:
    """How often another cause would have passed for one that was named alone, simulated."""
    if len(found.effects_fit.key) != 1:
        return {}
    (cause,) = found.effects_fit.key
    gap = max(found.gap, 1.0)
    return {"simulated": simulated_confusions(found.search.shown.pairs, cause, gap, found.fitter.data.plant)}


def _excitation(found: DiagnosisResult) -> dict[str, Any]:
    """What this recording's inputs cannot show or tell apart, by the names of the answer."""
    shown = identifiability(found.search.shown, found.fitter.data.plant)
    twins_found = [{"between": names((a, b)), "parted_by": left} for a, b, left in shown.equivalent_causes]
    return {"hidden": names(shown.hidden), "inseparable": twins_found}


def _causes(found: DiagnosisResult) -> tuple[Cause, ...]:
    fitter, fit = found.fitter, found.effects_fit
    plant, stds = fitter.data.plant, standard_errors(fitter, fit)
    causes = []
    named = [p for p in fit.candidate.placements if (p.effect.name, p.location) in found.posterior.best.causes]
    for p in named:
        amounts = {}
        for name, value in fit.effect_values.items():
            if name.rpartition(".")[0] == p.prefix:
                amounts[name.rpartition(".")[2]] = Amount(value, stds[name], fit.space[name].unit)
        causes.append(Cause(p.effect.name, p.location, amounts, equivalent_causes((p.effect.name, p.location), plant)))
    if found.posterior.best.unknown_at:
        causes.append(Cause(UNKNOWN, found.posterior.best.unknown_at))
    steps = {s.name: ("step", step) for s, step in zip(plant.sensors, found.quantization_steps, strict=True)}
    told = {(p.effect.name, p.location): p for p in found.limits}
    units = {s.name: s.unit for s in plant.sensors}
    for name, place in found.from_readings:
        if (name, place) in told:
            causes.append(Cause(name, place, _as_told(told[name, place], plant)))
        else:
            parameter, value = steps[place]
            causes.append(Cause(name, place, {parameter: Amount(value, 0.0, units[place])}))
    return tuple(causes)


def _as_told(placement: Placement, plant: PlantDescription) -> dict[str, Amount]:
    """What the values themselves tell of an effect."""
    parameters, values = placement.effect.parameters(placement.location, plant), placement.values or {}
    return {p.name: Amount(values[p.name], 0.0, p.unit) for p in parameters if p.name in values}


def _p_value(found: DiagnosisResult) -> float:
    """Chance that it is noise; what the values themselves tell is none."""
    if found.from_readings or (found.verdict == "unknown" and sensor_with_outliers(found.outliers[0])):
        return 0.0
    return p_value(found.search)


def _disturbances(found: DiagnosisResult) -> dict[str, dict[str, object]]:
    """The random flow into each tank beside the likeliest hypothesis."""
    best = found.posterior.best
    noise = best.place.noise if best.place else best.explanation.noise
    return {
        t.name: {"std": float(noise.intensity[i]), "unit": "m^3/s", "correlation_time": noise.correlation_time}
        for i, t in enumerate(found.fitter.data.plant.tanks)
    }


def _noise(fitter: Fitter, quantization_steps: Sequence[float]) -> Mapping[str, Any]:
    sensors = fitter.data.plant.sensors
    std: Tensor = fitter.noise.std
    return {
        s.name: {
            "std": float(std[i]),
            "ar1": float(fitter.noise.lag_one[i]),
            "rounded_to": quantization_steps[i],
            "unit": s.unit,
        }
        for i, s in enumerate(sensors)
    }
