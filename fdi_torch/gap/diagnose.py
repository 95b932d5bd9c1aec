"""The gap diagnosis: recalibration, which effects, where, the posterior; then the answer, with the hold-out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fdi_torch.gap.answer import Answer, Verdict
from fdi_torch.gap.answering import answered
from fdi_torch.gap.case import PLAIN, Case, Settings, case_of
from fdi_torch.gap.disturbances import disturbed
from fdi_torch.gap.finding import Finding
from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.floor import Noise, estimate_noise, lattice_step
from fdi_torch.gap.freeform import fitted_free_form
from fdi_torch.gap.library import possible_places
from fdi_torch.gap.limits import unclipped, with_clipped_noise
from fdi_torch.gap.posterior import Hypothesis, Posterior, weighed
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.search import Judged, search
from fdi_torch.gap.strays import most_astray
from fdi_torch.gap.subject import Subject
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of_all, with_simulated_levels
from fdi_torch.recording import Recording

CONTENT = 0.95
Tell = Callable[[float, str], None]


def diagnose(
    plant: PlantDescription,
    recording: Recording | Sequence[Recording],
    holdout: Recording | Sequence[Recording] | None = None,
    settings: Settings = PLAIN,
    tell: Tell = lambda share, text: None,
) -> Answer:
    """What keeps the plant file from explaining the recording, or several recordings by the same causes.

    Hold-outs only measure how far the gap closes.
    """
    recordings = (recording,) if isinstance(recording, Recording) else tuple(recording)
    holdouts = () if holdout is None else (holdout,) if isinstance(holdout, Recording) else tuple(holdout)
    return solved(case_of(plant, recordings, holdouts, settings), tell)


def solved(case: Case, tell: Tell = lambda share, text: None) -> Answer:
    """The diagnosis, stage by stage."""
    subject, library, plant = case.subject, case.library, case.subject.plant
    tell(0.05, "noise and recalibration")
    fitter, null, lattice = _recalibrated(subject)
    reach = with_simulated_levels(operating_range_of_all(case.recordings, plant), plant, null.near.levels[0])
    tell(0.2, "which effects")
    known = {p.prefix for p in case.told} | {name.rpartition(".")[0] for name in subject.nuisance}
    options = options_of([p for p in library if not p.effect.quantizes and p.prefix not in known], fitter, reach)
    judged = Judged(fitter, len(library))
    found = search(judged, null, options, case.most)
    tell(0.6, "where")
    believed = weighed(judged, found, plant, possible_places(plant), case.named_only)
    content = believed.content(CONTENT)
    rounded = [("sensor_quantization", s.name) for s, step in zip(plant.sensors, lattice, strict=True) if step > 0.0]
    rounded = [c for c in rounded if any((p.effect.name, p.location) == c for p in library)]
    rounded += [(p.effect.name, p.location) for p in case.told]
    straying = None if case.named_only else most_astray(case.strays[0])
    unnamed = _free_form(believed, reach)
    sure = believed.probabilities[0] >= CONTENT
    verdict = _verdict(content, sure, bool(rounded), straying)
    tell(0.8, "hold-out")
    finding = Finding(
        fitter, library, reach, found, believed, content, unnamed, verdict, rounded, lattice, case.told, case.strays
    )
    return answered(finding, case.held)


def _verdict(content: Sequence[Hypothesis], sure: bool, rounded: bool, straying: str | None) -> Verdict:
    """sure: that of the likeliest. straying: a sensor whose readings jump, as no effect of the library makes them."""
    best = content[0]
    if not best.causes and not best.place and not rounded:
        return "unknown" if straying else "no_gap"
    if all(h.place for h in content):
        return "unknown"
    return "named" if sure else "ambiguous"


def _free_form(believed: Posterior, reach: OperatingRange) -> Fit | None:
    """The discrepancy of the likeliest hypothesis as functions of its place's variables, if it has one."""
    best = believed.best
    if best.place is None:
        return None
    # What a sensor wanders by is for the functions to tell.
    under = disturbed(best.explanation.fitter, best.fit, replace(best.place.noise, wander=None))
    kept = [p for p in best.fit.candidate.placements if (p.effect.name, p.location) in best.causes]
    return fitted_free_form(under, best.fit, kept, best.place.location, best.place.periods, reach)


def _recalibrated(subject: Subject) -> tuple[Fitter, Fit, list[float]]:
    """The noise of each channel, the recalibrated plant under it, and the step of each rounded channel."""
    channels = len(subject.plant.sensors)
    spread = subject.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    first = Fitter(subject, Noise(1e-2 * spread, torch.zeros(channels, dtype=spread.dtype)))
    null = first.fit(Candidate())
    residual = subject.readings - null.near.readings[0]
    noise = estimate_noise(residual, subject.mask, rows=subject.rows)
    values = [subject.readings[subject.mask[:, c], c] for c in range(channels)]
    lattice = [lattice_step(v, float(noise.std[c])) for c, v in enumerate(values)]
    noise = estimate_noise(residual, subject.mask, lattice, subject.rows)
    noise = unclipped(noise, subject, null.near.readings[0])
    fitter = Fitter(with_clipped_noise(subject, null, noise), noise)
    return fitter, fitter.fit(Candidate(), null), lattice
