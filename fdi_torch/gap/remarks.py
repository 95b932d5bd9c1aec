"""What a reader of the answer has to know beside it, one sentence each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from fdi_torch.effects import effect
from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter, standard_errors
from fdi_torch.gap.diagnosis_result import DiagnosisResult, unexplained_chi_square
from fdi_torch.gap.free_form import discrepancy_tables
from fdi_torch.gap.holdout import HeldOut
from fdi_torch.gap.model_comparison import causal_places
from fdi_torch.gap.noise_model import low_frequency_excess
from fdi_torch.gap.preprocess.outliers import SensorOutliers
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recordings.check import data_warnings

AT_END = 1e-3  # of a parameter's range
SHOWN_TIMES = 5  # of strays
WORSE = 1.1  # times the error of the recalibrated plant
SWINGS = 0.03  # amplitude of an oscillation worth a word, as a share of the free form's scale


def remarks_on(found: DiagnosisResult, held: Sequence[HeldOut]) -> list[str]:
    """Of the inputs, the plant file, the parameters found, and the hold-outs."""
    data = found.fitter.data
    remarks: list[str] = []
    remarks += dict.fromkeys(s for part in data.parts for s in data_warnings(part.recording, data.plant))
    inputs = [column for part in data.parts for column in part.recording.inputs.T]
    if all(float(torch.diff(column).abs().max()) == 0.0 for column in inputs):
        remarks.append(
            "the inputs never change, so that most effects cannot be told from another or from a constant within its "
            "tolerance; `fdi gap --plan` with inputs that step shows what they would tell"
        )
    if not data.plant.tolerances:
        remarks.append(
            "the plant file lists no tolerances, so that every constant is taken to be exact and what is a little off "
            "looks like an effect; list them under tolerances, as in P13.discharge_coefficient: 3 %"
        )
    if not found.best.converged:
        remarks.append(
            "the fit of the likeliest explanation has not converged: its sizes may be off by more than their standard "
            "errors; a longer recording, or --library with fewer effects, may settle it"
        )
    remarks += [_astray(s) for group in found.outliers for s in group]
    remarks += [*_believed_outside(data.plant), *_at_their_ends(found), *_period(found)]
    remarks += [_carries_nothing(found, h) for h in held if found.free_form_fit and _worse(h)]
    return remarks + [sentence for h in held if (sentence := rig_difference(found, h))]


def _astray(strays: SensorOutliers) -> str:
    """How many readings of a sensor were left out, and when."""
    at = [f"{a:.6g}" if a == b else f"{a:.6g} to {b:.6g}" for a, b in (s.times for s in strays.each)]
    when = ", ".join(at[:SHOWN_TIMES]) + (f" s and {len(at) - SHOWN_TIMES} more" if len(at) > SHOWN_TIMES else " s")
    count = f"{strays.samples} reading" + ("s" if strays.samples > 1 else "")
    source = Path(strays.source).name or "the recording"
    return (
        f"{count} of {strays.sensor} in {source} jump away and back, or stand still, as no tank can; left out of all "
        f"fits ({when})"
    )


def _worse(held: HeldOut) -> bool:
    """Whether the free form runs farther from a hold-out than the recalibrated plant does."""
    with_form, without = (float((held.weight * held.squares(m)).sum()) for m in ("augmented", "recalibrated"))
    return with_form > WORSE**2 * without


def _carries_nothing(found: DiagnosisResult, held: HeldOut) -> str:
    """What a free form says that fails on a hold-out."""
    source = Path(held.data.recording.source).name or "the hold-out"
    return (
        f"the free function that stands for what is unknown at {' and '.join(causal_places(found))} does worse on "
        f"{source} than none: what is missing there keeps a memory or has times of its own, or goes beyond what the "
        "recording shows; take the place from this answer, not the function"
    )


def _period(found: DiagnosisResult) -> list[str]:
    """Whether what has no name comes and goes by itself."""
    shape: Any = discrepancy_tables(found.free_form_fit)["tables"] if found.free_form_fit else {}
    waves = [(t["at"][0], t["share"][0]) for name, t in shape.items() if name.endswith(".period")]
    return [
        f"what is unknown at {place} comes and goes with a period of {period:.3g} s; its phase belongs to each "
        "recording's own clock, so that it closes nothing on a hold-out"
        for place in causal_places(found)
        for period, share in waves
        if share > SWINGS
    ]


def _believed_outside(plant: PlantDescription) -> list[str]:
    """Parameters of the plant file's own effects that lie outside their sensible range."""
    told = []
    for placed in plant.effects:
        for p in effect(placed.effect).parameters(placed.location, plant):
            value, (unit, scale) = placed.parameters.get(p.name, p.nominal), display_unit(p.unit)
            if not p.low <= value <= p.high:
                name, ends = (
                    f"{placed.location}.{placed.effect}.{p.name}",
                    f"{scale * p.low:.4g} to {scale * p.high:.4g}",
                )
                told.append(
                    f"the plant file has {name} at {scale * value:.4g} {unit}".rstrip()
                    + f", outside its sensible range ({ends} {unit}".rstrip()
                    + "): all that is found rests on it"
                )
    return told


def _at_their_ends(found: DiagnosisResult) -> list[str]:
    """Parameters that were stopped by the end of their sensible range."""
    told, fit = [], found.effects_fit
    for name, value in fit.effect_values.items():
        parameter, (unit, scale) = fit.space[name], display_unit(fit.space[name].unit)
        width = parameter.high - parameter.low
        ends = [e for e in (parameter.low, parameter.high) if math.isfinite(e) and e != parameter.nominal]
        linearised = [e for e in ends if abs(value - e) < AT_END * (width if math.isfinite(width) else abs(e))]
        if linearised:
            end = f"{scale * linearised[0]:.4g} {unit}".rstrip()
            told.append(
                f"{name} would lie at the end of its sensible range ({end}): that effect alone is hardly the cause"
            )
    return told


OPEN_SHARE, OPEN_LEAST = 0.2, 200.0  # of the hold-out's own gap, and chi-square units
EXPLAINS = 0.3  # of what was open, left by the new fit
APART = 5.0  # standard errors


def rig_difference(found: DiagnosisResult, held: HeldOut) -> str | None:
    """One sentence where the hold-out does not fit to what was found in the recording, else None."""
    if found.free_form_fit or not found.explained:
        return None
    mask, noise = held.data.mask, held.noise
    white = noise.whiten(held.data.readings - held.runs["augmented"], mask)
    still = low_frequency_excess(white)
    gap = low_frequency_excess(noise.whiten(held.data.readings - held.runs["recalibrated"], mask))
    if still < max(OPEN_SHARE * gap, OPEN_LEAST):
        return None
    fitter = Fitter(held.data, noise)
    again = fitter.fit(Candidate(found.best.candidate.placements, (found.best.effect_values,)))
    source = held.data.recording.source or "the hold-out"
    changed = _changed(found, fitter, again) if unexplained_chi_square(fitter, again) < EXPLAINS * still else []
    if changed:
        needed = ", ".join(changed[:3])
        return (
            f"{source} needs other constants than the recording ({needed}): it is of another rig, or the rig was "
            "changed in between; how far the gap closes there says little"
        )
    return (
        f"what explains the recording does not explain {source}, whatever the constants: something acts there that the "
        "recording does not show, or it is of another rig"
    )


def _changed(found: DiagnosisResult, fitter: Fitter, again: Fit) -> list[str]:
    """What differs by many standard errors, farthest first, as in 'P13.discharge_coefficient 0.66, not 0.6'."""
    before, after = found.best.values, again.values
    errors = standard_errors(found.fitter, found.best), standard_errors(fitter, again)
    apart = {
        n: abs(after[n] - before[n]) / max(math.hypot(errors[0][n], errors[1][n]), 1e-300)
        for n in after
        if not n.endswith(".start_level")
    }
    names = sorted((n for n in apart if apart[n] > APART), key=lambda n: -apart[n])
    return [f"{n} {_shown(after[n], again, n)}, not {_shown(before[n], again, n)}" for n in names]


def _shown(value: float, fit: Fit, name: str) -> str:
    unit, scale = display_unit(fit.space[name].unit)
    return f"{scale * value:.4g} {unit}".rstrip()
