"""Assembly of the answer from the result of a diagnosis: causes with errors, probabilities, closure, remarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.estimate.diagnosis import fault_flow
from fdi_torch.gap.answer import UNKNOWN, Amount, Answer, Cause, CauseName, ProbableExplanation, names
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter, covariance, standard_errors
from fdi_torch.gap.cause_hypothesis import CauseHypothesis
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.diagnosis_result import DiagnosisResult
from fdi_torch.gap.discrepancy_curves import curves_at
from fdi_torch.gap.experiment_design import discriminating_input
from fdi_torch.gap.free_form import discrepancy_tables
from fdi_torch.gap.holdout import HeldOut, run_reference_models
from fdi_torch.gap.identifiability import identifiability, simulated_confusions
from fdi_torch.gap.library import equivalence_class
from fdi_torch.gap.model_comparison import (
    causal_places,
    closure_to_dict,
    constants_of,
    prediction_arrays,
    reference_models,
)
from fdi_torch.gap.remarks import remarks_on
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement, Stage

MOST_EXPLANATIONS = 12


def build_answer(result: DiagnosisResult, holdouts: Sequence[DataSet]) -> Answer:
    """Build the answer. holdouts: laid out for the same plant."""
    has_causes = result.verdict in ("named", "ambiguous")
    posterior = result.posterior
    runs, constants = _holdout_runs(result, holdouts), _constants(result)
    hypotheses = zip(posterior.hypotheses[:MOST_EXPLANATIONS], posterior.probabilities, strict=False)
    return Answer(
        verdict=result.verdict,
        p_value=result.p_value,
        where=_where(result),
        causes=_causes(result),
        ambiguity_set=[_names(result, h) for h in result.credible_set] if result.verdict != "no_gap" else [],
        posterior=[ProbableExplanation(_names(result, h), p) for h, p in hypotheses],
        unexamined=posterior.unexamined,
        converged=result.best.converged,
        closure=closure_to_dict(runs, result) if runs else {},
        noise=_noise(result.fitter, result.quantization_steps),
        disturbances=_disturbances(result),
        shape=discrepancy_tables(result.free_form_fit) if result.free_form_fit else None,
        next_input=_next_input(result) if result.verdict == "ambiguous" else None,
        impostors=_confusability(result) if has_causes else None,
        excitation=_identifiability(result),
        constants=constants,
        curves=_curves(result),
        remarks=remarks_on(result, runs, constants),
        arrays=prediction_arrays(result, runs),
    )


def _names(result: DiagnosisResult, hypothesis: CauseHypothesis) -> tuple[CauseName, ...]:
    """All causes of a hypothesis, something unknown among them."""
    return (*hypothesis.all_causes, *result.from_readings)


def _where(result: DiagnosisResult) -> list[tuple[str, float]]:
    """Places with the probability of a cause there, the likeliest first; 1 for a sensor with outliers."""
    shown = {place for effect, place in result.from_readings if effect == UNKNOWN}
    places = [(place, 1.0 if place in shown else share) for place, share in result.posterior.places]
    return sorted(places, key=lambda item: -item[1])


def _holdout_runs(result: DiagnosisResult, holdouts: Sequence[DataSet]) -> list[HeldOut]:
    """Free runs of all models on all hold-outs."""
    if not holdouts:
        return []
    models, nominal_effects = reference_models(result), result.fitter.data.nominal_effects
    return [
        run_reference_models(
            replace(each, nominal_effects=nominal_effects), result.fitter.noise, models, result.quantization_steps
        )
        for each in holdouts
    ]


def _curves(result: DiagnosisResult) -> list[dict[str, Any]]:
    """Curves of the discrepancy at every place with a cause; not drawn for several recordings at once."""
    if result.verdict == "no_gap" or result.fitter.data.further:
        return []
    places = causal_places(result)
    return [
        curve.to_dict()
        for place in places
        for curve in curves_at(result.fitter, result.best, place, result.operating_range)
    ]


def _constants(result: DiagnosisResult) -> dict[str, dict[str, object]]:
    """Each calibration constant: nominal, recalibrated, and fitted with the causes."""
    errors = standard_errors(result.fitter, result.best)
    null, best, space = constants_of(result.null), constants_of(result.best), result.best.space
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


def _next_input(result: DiagnosisResult) -> Mapping[str, Any] | None:
    """The input that distinguishes the two likeliest hypotheses."""
    first, second = result.posterior.hypotheses[:2]
    design = discriminating_input(result.fitter, first.fit, second.fit)
    between = [names(_names(result, h)) for h in (first, second)]
    return {"between": between, **design} if design else None


def _confusability(result: DiagnosisResult) -> dict[str, object]:
    """How often another cause would have been named in place of a single named one, by simulation."""
    if len(result.effects_fit.key) != 1:
        return {}
    (cause,) = result.effects_fit.key
    gap = max(result.gap, 1.0)
    return {"simulated": simulated_confusions(result.search.null_pairs, cause, gap, result.fitter.data.plant)}


def _identifiability(result: DiagnosisResult) -> dict[str, Any]:
    """Effects that this recording's inputs cannot show or separate, by the names of the answer."""
    shown = identifiability(result.search.null_pairs, result.fitter.data.plant)
    pairs = [{"between": names((a, b)), "parted_by": separation} for a, b, separation in shown.inseparable]
    return {"hidden": names(shown.hidden), "inseparable": pairs}


def _causes(result: DiagnosisResult) -> tuple[Cause, ...]:
    """Causes with parameters and standard errors. A cause that is read off the readings, such as their rounding, has no
    standard error.
    """
    fitter, fit = result.fitter, result.effects_fit
    plant, stds, causes = fitter.data.plant, standard_errors(fitter, fit), []
    placements = [p for p in fit.candidate.placements if p.cause in result.posterior.best.causes]
    for p in placements:
        amounts = amounts_of(fitter, fit, p, stds)
        others = {c for c in equivalence_class(p.cause, plant, fit.values) if effect(c[0]).searched} - {p.cause}
        causes.append(Cause(*p.cause, amounts, tuple(sorted(others)), _flow(fitter, fit, p, amounts)))
    if result.posterior.best.unknown_at:
        causes.append(Cause(UNKNOWN, result.posterior.best.unknown_at))
    steps = dict(zip((s.name for s in plant.sensors), result.quantization_steps, strict=True))
    rounded = [replace(p, values={"step": steps[p.location]}) for p in result.library if p.effect.quantizes]
    shown = {p.cause: _amounts_from_readings(p, plant) for p in (*result.limits, *rounded)}
    return (*causes, *(Cause(*name, shown.get(name, {})) for name in result.from_readings))


def amounts_of(fitter: Fitter, fit: Fit, placement: Placement, stds: Mapping[str, float]) -> dict[str, Amount]:
    """Fitted parameters of an effect. stds: standard errors of all parameters of the fit.

    A ramp that has not ended when the recording does shows a rate only, in which size and ramp cancel. It is reported
    as one that ends with the recording, with the size that it has reached.
    """
    fitted = fit.values_of([placement])
    size, *_ = (placement.full_name(p.name) for p in placement.effect.parameters(placement.location, fitter.data.plant))
    onset, ramp = placement.full_name("onset"), placement.full_name("ramp")
    left = fitter.data.longest_duration - fitted.get(onset, 0.0)
    if 0.0 < left <= fitted.get(ramp, 0.0):
        growth = (fitted[size] - fit.space[size].nominal) / fitted[ramp]
        slopes = torch.zeros(2, len(fit.space), dtype=fit.theta.dtype)  # of size and ramp, by the fitted parameters
        slopes[0, fit.space.index(size)] = left / fitted[ramp]
        if onset in fitted:
            slopes[:, fit.space.index(onset)] = torch.tensor([-growth, -1.0], dtype=slopes.dtype)
        variance = torch.diagonal(slopes @ covariance(fitter, fit, held=(ramp,)) @ slopes.T).clamp(min=0.0)
        fitted = {**fitted, size: fit.space[size].nominal + growth * left, ramp: left}
        stds = {**stds, **dict(zip((size, ramp), torch.sqrt(variance).tolist(), strict=True))}
    return {ParameterName.parse(n).field: Amount(value, stds[n], fit.space[n].unit) for n, value in fitted.items()}


def _flow(fitter: Fitter, fit: Fit, placement: Placement, amounts: Mapping[str, Amount]) -> float | None:
    """The flow that an effect adds at the mean levels and inputs of the first recording, m^3/s; None if it adds none or
    if its size is a flow.
    """
    size = placement.effect.parameters(placement.location, fitter.data.plant)[0]
    if placement.effect.stage is not Stage.BALANCE or placement.effect.states or size.unit == "m^3/s":
        return None
    plant, recording, nodes = fitter.data.plant, fitter.data.recording, fitter.data.experiment.nodes
    path = fit.linearised.levels[0, : len(nodes), : len(plant.tanks)]
    levels = torch.trapezoid(path, nodes, dim=0) / (nodes[-1] - nodes[0])
    inputs = recording.inputs[:, recording.input_columns(plant.channels())].mean(dim=0)
    which, theta = fit.space.index(placement.full_name(size.name)), fit.theta.clone()
    theta[which] = amounts[size.name].value
    flow, _ = fault_flow(fitter.network(fit.candidate.placements), fit.space, theta, which, levels, inputs)
    return flow or None


def _amounts_from_readings(placement: Placement, plant: PlantDescription) -> dict[str, Amount]:
    """Parameters of an effect that the readings show without a fit."""
    parameters, values = placement.effect.parameters(placement.location, plant), placement.values or {}
    return {p.name: Amount(values[p.name], 0.0, p.unit) for p in parameters if p.name in values}


def _disturbances(result: DiagnosisResult) -> dict[str, dict[str, object]]:
    """The random flow into each tank under the likeliest hypothesis."""
    noise = result.posterior.best.noise
    return {
        t.name: {"std": float(noise.intensity[i]), "unit": "m^3/s", "correlation_time": noise.correlation_time}
        for i, t in enumerate(result.fitter.data.plant.tanks)
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
