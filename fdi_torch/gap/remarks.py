"""What a reader of the answer has to know beside it, one sentence each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from fdi_torch.effects import effect
from fdi_torch.gap.ceiling import guilty_places
from fdi_torch.gap.closure import HeldOut
from fdi_torch.gap.finding import Finding
from fdi_torch.gap.freeform import shape_of
from fdi_torch.gap.same_rig import other_rig
from fdi_torch.gap.strays import Strays
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recordings.check import data_warnings

AT_END = 1e-3  # of a parameter's range
SHOWN_TIMES = 5  # of strays
WORSE = 1.1  # times the error of the recalibrated plant
SWINGS = 0.03  # amplitude of an oscillation worth a word, as a share of the free form's scale


def remarks_on(found: Finding, held: Sequence[HeldOut]) -> list[str]:
    """Of the inputs, the plant file, the parameters found, and the hold-outs."""
    subject = found.fitter.subject
    remarks: list[str] = []
    remarks += dict.fromkeys(s for part in subject.parts for s in data_warnings(part.recording, subject.plant))
    inputs = [column for part in subject.parts for column in part.recording.inputs.T]
    if all(float(torch.diff(column).abs().max()) == 0.0 for column in inputs):
        remarks.append(
            "the inputs never change, so that most effects cannot be told from another or from a constant within its "
            "tolerance; `fdi gap --plan` with inputs that step shows what they would tell"
        )
    if not subject.plant.tolerances:
        remarks.append(
            "the plant file lists no tolerances, so that every constant is taken to be exact and what is a little off "
            "looks like an effect; list them under tolerances, as in P13.discharge_coefficient: 3 %"
        )
    if not found.best.converged:
        remarks.append(
            "the fit of the likeliest explanation has not converged: its sizes may be off by more than their standard "
            "errors; a longer recording, or --library with fewer effects, may settle it"
        )
    remarks += [_astray(s) for group in found.strays for s in group]
    remarks += [*_believed_outside(subject.plant), *_at_their_ends(found), *_period(found)]
    remarks += [_carries_nothing(found, h) for h in held if found.unnamed and _worse(h)]
    return remarks + [sentence for h in held if (sentence := other_rig(found, h))]


def _astray(strays: Strays) -> str:
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


def _carries_nothing(found: Finding, held: HeldOut) -> str:
    """What a free form says that fails on a hold-out."""
    source = Path(held.subject.recording.source).name or "the hold-out"
    return (
        f"the free function that stands for what is unknown at {' and '.join(guilty_places(found))} does worse on "
        f"{source} than none: what is missing there keeps a memory or has times of its own, or goes beyond what the "
        "recording shows; take the place from this answer, not the function"
    )


def _period(found: Finding) -> list[str]:
    """Whether what has no name comes and goes by itself."""
    shape: Any = shape_of(found.unnamed)["tables"] if found.unnamed else {}
    waves = [(t["at"][0], t["share"][0]) for name, t in shape.items() if name.endswith(".period")]
    return [
        f"what is unknown at {place} comes and goes with a period of {period:.3g} s; its phase belongs to each "
        "recording's own clock, so that it closes nothing on a hold-out"
        for place in guilty_places(found)
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


def _at_their_ends(found: Finding) -> list[str]:
    """Parameters that were stopped by the end of their sensible range."""
    told, fit = [], found.named
    for name, value in fit.effect_values.items():
        parameter, (unit, scale) = fit.space[name], display_unit(fit.space[name].unit)
        width = parameter.high - parameter.low
        ends = [e for e in (parameter.low, parameter.high) if math.isfinite(e) and e != parameter.nominal]
        near = [e for e in ends if abs(value - e) < AT_END * (width if math.isfinite(width) else abs(e))]
        if near:
            end = f"{scale * near[0]:.4g} {unit}".rstrip()
            told.append(
                f"{name} would lie at the end of its sensible range ({end}): that effect alone is hardly the cause"
            )
    return told
