"""Remarks on an answer, one sentence each: doubts about the inputs, the plant file, the parameters, the hold-outs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS, all_placements, effect
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.estimate.uncertainty import end_reached
from fdi_torch.gap.answer import CERTAIN
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter, standard_errors
from fdi_torch.gap.channel_noise import low_frequency_excess
from fdi_torch.gap.constant_remarks import Constants, constant_remarks
from fdi_torch.gap.diagnosis_result import DiagnosisResult, unexplained_chi_square
from fdi_torch.gap.free_form import discrepancy_tables
from fdi_torch.gap.holdout import HeldOut
from fdi_torch.gap.identifiability import exact_areas_like, unsearched_equivalents
from fdi_torch.gap.library import equivalence_class
from fdi_torch.gap.preprocess.outliers import SensorOutliers
from fdi_torch.gap.screening import options_of
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.constants import flow_scale
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.quantities import quantity_text
from fdi_torch.recordings.check import data_warnings

SHOWN_TIMES = 5  # outliers whose times are listed
WORSE = 1.1  # error of the free form over that of the recalibrated plant
SWINGS = 0.03  # smallest amplitude of an oscillation, as a share of the free form's scale


def remarks_on(result: DiagnosisResult, held: Sequence[HeldOut], constants: Constants) -> list[str]:
    """Remarks on the fitted constants, the inputs, the plant file, the fitted effects, and the hold-outs."""
    data = result.fitter.data
    remarks = constant_remarks(constants, has_causes=result.verdict != "no_gap")
    remarks += dict.fromkeys(s for part in data.parts for s in data_warnings(part.recording, data.plant))
    inputs = [column for part in data.parts for column in part.recording.inputs.T]
    if inputs and all(float(torch.diff(column).abs().max()) == 0.0 for column in inputs):
        remarks.append(
            "the inputs never change, so that most effects cannot be distinguished from each other or from a constant "
            "within its tolerance; test inputs with steps by `fdi plan`, then record again"
        )
    if not data.plant.tolerances:
        remarks.append(
            "the plant file lists no tolerances, so that every constant counts as exact and a small error of one "
            "looks like an effect; list them under tolerances, as in P13.discharge_coefficient: 3 %, and calibrate "
            "them by fdi refit with a fault-free recording"
        )
    if not result.best.converged:
        remarks.append(
            "the fit of the likeliest explanation has not converged: its sizes may be off by more than half of their "
            "standard errors; use a longer recording, or fewer effects by --library"
        )
    remarks += implausible_flows(data.plant, result.posterior.best.noise, data.row_spacing)
    remarks += [_masked_outliers(s) for group in result.outliers for s in group]
    remarks += [*_nominal_values_out_of_range(data.plant), *_values_at_bounds(result), *_periods(result)]
    remarks += [*_exact_areas(result), *_equivalents_outside_library(result)]
    remarks += _warnings_of_holdouts(held, remarks, data.plant)
    on_holdouts = [remark(result, h) for remark in (_free_form_fails, rig_difference) for h in held]
    return remarks + [sentence for sentence in on_holdouts if sentence]


def _warnings_of_holdouts(held: Sequence[HeldOut], remarks: Sequence[str], plant: PlantDescription) -> list[str]:
    """What limits the trust in each hold-out, and is not among the remarks on the recordings."""
    return [
        f"{Path(h.data.recording.source).name or 'the hold-out'}: {warning}"
        for h in held
        for warning in data_warnings(h.data.recording, plant)
        if warning not in remarks
    ]


def implausible_flows(plant: PlantDescription, noise: StateNoise, interval: float) -> list[str]:
    """The remark on a random flow which, averaged over the time in which the full tank runs dry, exceeds what the full
    tank discharges: it stands for a wrong equation. interval: between readings, s."""
    memory, remarks = max(2.0 * noise.correlation_time, interval), []
    for tank, std in zip(plant.tanks, noise.intensity.tolist(), strict=True):
        most = flow_scale(plant, tank.name)
        if std * math.sqrt(min(memory * most / (tank.area * tank.height), 1.0)) > most:
            shown, limit = (quantity_text(x, "m^3/s", 3, tank.name) for x in (std, most))
            remarks.append(
                f"{tank.name} would need random flows of {shown}, although the full tank discharges {limit}: the plant "
                "file is far from the rig; check its areas, units and connections by fdi check and fdi predict"
            )
    return remarks


def _masked_outliers(outliers: SensorOutliers) -> str:
    """How many readings of a sensor are masked, and when they occurred."""
    at = [f"{a:.6g}" if a == b else f"{a:.6g} to {b:.6g}" for a, b in (s.times for s in outliers.each)]
    when = ", ".join(at[:SHOWN_TIMES]) + (f" s and {len(at) - SHOWN_TIMES} more" if len(at) > SHOWN_TIMES else " s")
    count = f"{outliers.samples} reading" + ("s" if outliers.samples > 1 else "")
    source = Path(outliers.source).name or "the recording"
    return f"{count} of {outliers.sensor} in {source}: outliers or stuck, masked in all fits ({when})"


def _free_form_fails(result: DiagnosisResult, held: HeldOut) -> str | None:
    """The remark on a free form that predicts a hold-out worse than the recalibrated plant, or None."""
    with_form, without = (float((held.weight * held.squares[m]).sum()) for m in ("augmented", "recalibrated"))
    if not result.free_form_fit or with_form <= WORSE**2 * without:
        return None
    source = Path(held.data.recording.source).name or "the hold-out"
    return (
        f"the free function for the unknown discrepancy at {result.posterior.best.unknown_at} "
        f"predicts {source} worse than the recalibrated plant: the discrepancy has memory, depends on time, or lies "
        "outside the recorded range; use the place from this answer, but not the function"
    )


def _periods(result: DiagnosisResult) -> list[str]:
    """Oscillations and periodic pulses of an unknown discrepancy."""
    unknown = result.posterior.best.unknown
    if result.free_form_fit is None or unknown is None:
        return []
    tables: Any = discrepancy_tables(result.free_form_fit)["tables"]
    waves = [(t["at"][0], t["share"][0]) for name, t in tables.items() if name.endswith(".period")]
    words = [f"acts for {on:.3g} s of every {period:.3g} s" for period, on in unknown.pulses] or [
        f"oscillates with a period of {period:.3g} s" for period, share in waves if share > SWINGS
    ]
    return [
        f"the unknown discrepancy at {unknown.location} {acts}; its phase differs between recordings, so that it "
        "explains nothing of a hold-out"
        for acts in words
    ]


def _equivalents_outside_library(result: DiagnosisResult) -> list[str]:
    """Effects that were not searched and would explain the readings about as well as a cause of the answer."""
    best, fitter, plant = result.posterior.best, result.fitter, result.fitter.data.plant
    if best.unknown:
        return []
    searched = {p.cause for p in (*result.library, *fitter.data.nominal_effects)}
    further = [
        p
        for p in all_placements(plant, [e for e in EFFECTS if not e.quantizes])
        if not searched & equivalence_class(p.cause, plant, {})
    ]
    options = options_of(further, fitter, result.operating_range)
    if not options:
        return []
    twins = {
        f"{p.effect.name} at {p.location}": unsearched_equivalents(fitter, best.fit, p, options, CERTAIN)
        for p in best.fit.candidate.placements
    }
    return [
        f"{' or '.join(f'{name} at {place}' for name, place in others)}, not in the library, would explain the "
        f"recording about as well as {cause}; search all effects by --library all"
        for cause, others in twins.items()
        if others
    ]


def _exact_areas(result: DiagnosisResult) -> list[str]:
    """Cross-sections without tolerance, each of which would explain the readings about as well as a cause."""
    best, fitter, plant = result.posterior.best, result.fitter, result.fitter.data.plant
    each = best.fit.candidate.placements
    causes: dict[str, Placement | Tensor] = {f"{p.effect.name} at {p.location}": p for p in each}
    if best.unknown:
        causes[f"something unknown at {best.unknown_at}"] = best.unknown.explained
    remarks = []
    for cause, explained in causes.items():
        areas = exact_areas_like(fitter, best.fit, explained, CERTAIN)
        given = [plant.tank(ParameterName.parse(name).place).area for name in areas]
        shown = [
            f"{name} {quantity_text(value, 'm^2', 3, name)} in place of {quantity_text(before, 'm^2', 3, name)}"
            for (name, value), before in zip(areas.items(), given, strict=True)
        ]
        if shown:
            remarks.append(
                f"a constant without a tolerance counts as exact, but {' or '.join(shown)} would explain the recording "
                f"about as well as {cause}: measure it, or list a tolerance, as in tolerances: {{{[*areas][-1]}: 10 %}}"
            )
    return remarks


def _nominal_values_out_of_range(plant: PlantDescription) -> list[str]:
    """Effect parameters of the plant file outside their sensible range."""
    remarks = []
    for placed in plant.effects:
        for p in effect(placed.effect).parameters(placed.location, plant):
            name = placed.full_name(p.name)
            value = placed.parameters.get(p.name, p.nominal)
            if not p.low <= value <= p.high:
                shown, low, high = (quantity_text(x, p.unit, name=name) for x in (value, p.low, p.high))
                remarks.append(
                    f"the plant file has {name} at {shown}, outside its sensible range ({low} to {high}), which "
                    "affects all results; check it"
                )
    return remarks


def _values_at_bounds(result: DiagnosisResult) -> list[str]:
    """Fitted parameters that reached a bound of their sensible range."""
    fit = result.effects_fit
    ends = {name: end_reached(fit.space[name], value) for name, value in fit.effect_values.items()}
    return [
        f"{name} is at the bound of its sensible range ({_shown(end, fit, name)}): that effect alone is probably not "
        "the cause"
        for name, end in ends.items()
        if end is not None
    ]


OPEN_SHARE, OPEN_LEAST = 0.2, 200.0  # unexplained share of the hold-out's gap, and chi-square, that require a refit
REFIT_EXPLAINS = 0.3  # share of the unexplained chi-square that a successful refit may leave
DIFFERENT = 5.0  # standard errors


def rig_difference(result: DiagnosisResult, held: HeldOut) -> str | None:
    """Whether the hold-out is of another rig, in one sentence, or None.

    If the best explanation leaves much of the hold-out unexplained, its causes and constants are fitted to the
    hold-out. If that succeeds, the sentence names what differs; otherwise the hold-out has a further cause.
    """
    if result.free_form_fit or not result.explained:
        return None
    mask, noise = held.data.mask, held.noise
    white = noise.whiten(held.data.readings - held.runs["augmented"], mask)
    unexplained = low_frequency_excess(white)
    gap = low_frequency_excess(noise.whiten(held.data.readings - held.runs["recalibrated"], mask))
    if unexplained < max(OPEN_SHARE * gap, OPEN_LEAST):
        return None
    fitter = Fitter(held.data, noise)
    refit = fitter.fit(Candidate(result.best.candidate.placements, (result.best.effect_values,)))
    source = Path(held.data.recording.source).name or "the hold-out"
    closes = unexplained_chi_square(fitter, refit) < REFIT_EXPLAINS * unexplained
    changed = ", ".join(_changed(result, fitter, refit)[:3]) if closes else ""
    if changed:
        return (
            f"{source} needs other constants than the recording ({changed}): it is of another rig, or the rig was "
            "changed in between; its closure is not meaningful"
        )
    return (
        f"the explanation of the recording does not explain {source}, whatever the constants: the hold-out has a "
        "further cause, or it is of another rig"
    )


def _changed(result: DiagnosisResult, fitter: Fitter, refit: Fit) -> list[str]:
    """Parameters that differ by many standard errors, the largest first: 'P13.discharge_coefficient 0.66, not 0.6'."""
    before, after = result.best.values, refit.values
    errors = standard_errors(result.fitter, result.best), standard_errors(fitter, refit)
    distance = {
        n: abs(after[n] - before[n]) / max(math.hypot(errors[0][n], errors[1][n]), 1e-300)
        for n in after
        if ParameterName.parse(n).field != "start_level"
    }
    names = sorted((n for n in distance if distance[n] > DIFFERENT), key=lambda n: -distance[n])
    return [f"{n} {_shown(after[n], refit, n)}, not {_shown(before[n], refit, n)}" for n in names]


def _shown(value: float, fit: Fit, name: str) -> str:
    return quantity_text(value, fit.space[name].unit, name=name)
