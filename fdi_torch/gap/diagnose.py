"""The gap diagnosis: recalibration, which effects, where, the posterior; then the answer, with the hold-out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fdi_torch.gap.answer import Answer, Verdict
from fdi_torch.gap.answer_assembly import build_answer
from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.diagnosis_result import DiagnosisResult
from fdi_torch.gap.free_form import fitted_free_form
from fdi_torch.gap.library import possible_places
from fdi_torch.gap.marginal_likelihood import with_disturbances
from fdi_torch.gap.noise_model import Noise, estimate_noise, quantization_step
from fdi_torch.gap.posterior import CauseHypothesis, Posterior, weighed
from fdi_torch.gap.preprocess.outliers import sensor_with_outliers
from fdi_torch.gap.preprocess.sensor_limits import noise_before_clipping, with_noise_limits
from fdi_torch.gap.problem import PLAIN, DiagnosisProblem, Settings, problem_of
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.search import ExplanationPool, search
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of_all, with_simulated_levels
from fdi_torch.recording import Recording

CONTENT = 0.95
ProgressCallback = Callable[[float, str], None]


def diagnose(
    plant: PlantDescription,
    recording: Recording | Sequence[Recording],
    holdout: Recording | Sequence[Recording] | None = None,
    settings: Settings = PLAIN,
    tell: ProgressCallback = lambda share, text: None,
) -> Answer:
    """What keeps the plant file from explaining the recording, or several recordings by the same causes.

    Hold-outs only measure how far the gap closes.
    """
    recordings = (recording,) if isinstance(recording, Recording) else tuple(recording)
    holdouts = () if holdout is None else (holdout,) if isinstance(holdout, Recording) else tuple(holdout)
    return solve_problem(problem_of(plant, recordings, holdouts, settings), tell)


def solve_problem(case: DiagnosisProblem, tell: ProgressCallback = lambda share, text: None) -> Answer:
    """The diagnosis, stage by stage."""
    data, library, plant = case.data, case.library, case.data.plant
    tell(0.05, "noise and recalibration")
    fitter, null, quantization_steps = _recalibrated(data)
    reach = with_simulated_levels(operating_range_of_all(case.recordings, plant), plant, null.linearised.levels[0])
    tell(0.2, "which effects")
    known = {p.prefix for p in case.told} | {name.rpartition(".")[0] for name in data.nuisance}
    options = options_of([p for p in library if not p.effect.quantizes and p.prefix not in known], fitter, reach)
    judged = ExplanationPool(fitter, len(library))
    found = search(judged, null, options, case.most)
    tell(0.6, "where")
    believed = weighed(judged, found, plant, possible_places(plant), case.named_only)
    content = believed.content(CONTENT)
    rounded = [
        ("sensor_quantization", s.name) for s, step in zip(plant.sensors, quantization_steps, strict=True) if step > 0.0
    ]
    rounded = [c for c in rounded if any((p.effect.name, p.location) == c for p in library)]
    rounded += [(p.effect.name, p.location) for p in case.told]
    straying = None if case.named_only else sensor_with_outliers(case.strays[0])
    unnamed = _free_form(believed, reach)
    sure = believed.probabilities[0] >= CONTENT
    verdict = _verdict(content, sure, bool(rounded), straying)
    tell(0.8, "hold-out")
    finding = DiagnosisResult(
        fitter,
        library,
        reach,
        found,
        believed,
        content,
        unnamed,
        verdict,
        rounded,
        quantization_steps,
        case.told,
        case.strays,
    )
    return build_answer(finding, case.held)


def _verdict(content: Sequence[CauseHypothesis], sure: bool, rounded: bool, straying: str | None) -> Verdict:
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
    under = with_disturbances(best.explanation.fitter, best.fit, replace(best.place.noise, wander=None))
    kept = [p for p in best.fit.candidate.placements if (p.effect.name, p.location) in best.causes]
    return fitted_free_form(under, best.fit, kept, best.place.location, best.place.periods, reach)


def _recalibrated(data: DataSet) -> tuple[Fitter, Fit, list[float]]:
    """The noise of each channel, the recalibrated plant under it, and the step of each rounded channel."""
    channels = len(data.plant.sensors)
    spread = data.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    first = Fitter(data, Noise(1e-2 * spread, torch.zeros(channels, dtype=spread.dtype)))
    null = first.fit(Candidate())
    residual = data.readings - null.linearised.readings[0]
    noise = estimate_noise(residual, data.mask, rows=data.rows)
    values = [data.readings[data.mask[:, c], c] for c in range(channels)]
    quantization_steps = [quantization_step(v, float(noise.std[c])) for c, v in enumerate(values)]
    noise = estimate_noise(residual, data.mask, quantization_steps, data.rows)
    noise = noise_before_clipping(noise, data, null.linearised.readings[0])
    fitter = Fitter(with_noise_limits(data, null, noise), noise)
    return fitter, fitter.fit(Candidate(), null), quantization_steps
