"""The gap diagnosis: recalibration, search for effects, localization, posterior of the hypotheses, answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from fdi_torch.estimate.misfit import EXACT
from fdi_torch.gap.answer import UNKNOWN, Answer, CauseName, Verdict
from fdi_torch.gap.answer_assembly import build_answer
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.cause_hypothesis import CauseHypothesis
from fdi_torch.gap.channel_noise import Noise, estimate_noise, quantization_step
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.diagnosis_result import DiagnosisResult
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.free_form import fitted_free_form
from fdi_torch.gap.library import possible_places
from fdi_torch.gap.marginal_likelihood import with_disturbances
from fdi_torch.gap.posterior import Posterior, posterior_of
from fdi_torch.gap.preprocess.outliers import sensor_with_outliers
from fdi_torch.gap.preprocess.sensor_limits import noise_before_clipping, with_noise_limits
from fdi_torch.gap.problem import DEFAULT_SETTINGS, DiagnosisProblem, Settings, problem_of
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.stage_progress import StageProgress
from fdi_torch.gap.structure_search import search
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of_all, with_simulated_levels
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording

CREDIBLE_LEVEL = 0.95


def diagnose(
    plant: PlantDescription,
    recording: Recording | Sequence[Recording],
    holdout: Recording | Sequence[Recording] | None = None,
    settings: Settings = DEFAULT_SETTINGS,
    progress: Tell = silent,
) -> Answer:
    """Find out why the plant file does not explain one or several recordings, by causes that are common to all.

    Hold-outs are used only to measure which share of the gap the causes close.
    """
    recordings = (recording,) if isinstance(recording, Recording) else tuple(recording)
    holdouts = () if holdout is None else (holdout,) if isinstance(holdout, Recording) else tuple(holdout)
    return solve_problem(problem_of(plant, recordings, holdouts, settings), progress)


def solve_problem(problem: DiagnosisProblem, progress: Tell = silent) -> Answer:
    """Run the stages of the diagnosis. progress: receives the share done and the name of the stage."""
    data, library, plant = problem.data, problem.library, problem.data.plant
    progress(0.05, "noise and recalibration")
    fitter, null, quantization_steps = recalibrate(data)
    operating_range = with_simulated_levels(
        operating_range_of_all(problem.recordings, plant), plant, null.linearised.levels[0]
    )
    progress(0.2, "which effects")
    present = {p.prefix for p in problem.known_effects} | {ParameterName.parse(name).prefix for name in data.nuisance}
    options = options_of(
        [p for p in library if not p.effect.quantizes and p.prefix not in present], fitter, operating_range
    )
    pool = ExplanationPool(fitter, null, len(library), StageProgress(progress, "which effects", 0.2, 0.6))
    result = search(pool, options, problem.settings.most)
    progress(0.6, "where")
    pool.progress = StageProgress(progress, "where", 0.6, 0.8)
    posterior = posterior_of(pool, result, options, plant, possible_places(plant), problem.settings.named_only)
    credible_set = posterior.credible_set(CREDIBLE_LEVEL)
    rounded = {s.name for s, step in zip(plant.sensors, quantization_steps, strict=True) if step > 0.0}
    from_readings = [p.cause for p in library if p.effect.quantizes and p.location in rounded]
    from_readings += [p.cause for p in problem.known_effects]
    if not problem.settings.named_only and (sensor := sensor_with_outliers(problem.outliers[0])):
        from_readings.append((UNKNOWN, sensor))
    free_form_fit = _free_form(posterior, operating_range)
    verdict = verdict_of(credible_set, is_sure(posterior), from_readings)
    progress(0.8, "hold-out")
    diagnosis = DiagnosisResult(
        fitter,
        library,
        operating_range,
        result,
        posterior,
        credible_set,
        free_form_fit,
        verdict,
        from_readings,
        quantization_steps,
        problem.known_effects,
        problem.outliers,
    )
    answer = build_answer(diagnosis, problem.holdouts)
    remarks = dict.fromkeys(problem.remarks)
    if verdict != "no_gap":
        progress(0.95, "examining the recordings")
        explanation = None if posterior.best.unknown else posterior.best.fit
        remarks |= dict.fromkeys(_recording_faults(problem, explanation))
    return replace(answer, remarks=[*remarks, *answer.remarks])


def _recording_faults(problem: DiagnosisProblem, explanation: Fit | None) -> list[str]:
    """What is probably wrong with the recordings.

    explanation: named effects that explain them, against which a fault of a recording is weighed: causes that are sure
    may be no more than the best set of effects for swapped sensors.
    """
    effects = None
    if explanation is not None:
        effects = Candidate(explanation.candidate.placements, (explanation.effect_values,))
    return [text for check in problem.checks if (text := check.thorough_finding(effects))]


def is_sure(posterior: Posterior) -> bool:
    """Whether the likeliest hypothesis has 95 % and, if it names causes, its fit has converged.

    Laplace's approximation holds at a maximum. Away from it, the evidence and the sizes depend on where the fit ended.
    """
    best = posterior.best
    return posterior.probabilities[0] >= CREDIBLE_LEVEL and (not best.causes or best.fit.converged)


def verdict_of(credible_set: Sequence[CauseHypothesis], sure: bool, from_readings: Sequence[CauseName]) -> Verdict:
    """The verdict of a credible set of hypotheses.

    sure: as `is_sure`. from_readings: causes that the readings show without a model.
    """
    best = credible_set[0]
    if not best.causes and not best.unknown and not from_readings:
        return "no_gap" if sure else "ambiguous"
    if all(h.unknown for h in credible_set) or any(effect == UNKNOWN for effect, _ in from_readings):
        return "unknown"
    return "named" if sure else "ambiguous"


def _free_form(posterior: Posterior, operating_range: OperatingRange) -> Fit | None:
    """The fit of free functions at the unknown of the likeliest hypothesis; None if it has no unknown."""
    best = posterior.best
    if best.unknown is None:
        return None
    # The free functions shall explain what the drift of a sensor would absorb.
    fitter = with_disturbances(best.explanation.fitter, best.fit, replace(best.unknown.noise, wander=None))
    placements = [p for p in best.fit.candidate.placements if p.cause in best.causes]
    return fitted_free_form(fitter, best.fit, placements, best.unknown, operating_range)


def recalibrate(data: DataSet) -> tuple[Fitter, Fit, list[float]]:
    """The noise of each channel, the constants fitted under it, and the quantization step of each channel."""
    null = Fitter(data, Noise.rough(data.readings)).fit(Candidate())
    residual = data.readings - null.linearised.readings[0]
    noise = estimate_noise(residual, data.mask, data.rows)
    quantization_steps = []
    for c, values in enumerate(map(data.recorded, range(len(data.plant.sensors)))):
        of_one_reading = float(noise.std[c]) * math.sqrt(len(values) / int(data.mask[:, c].sum()))
        quantization_steps.append(quantization_step(values, of_one_reading))
    # A recording without noise tells no more than the simulation, whose readings err a little.
    exact = EXACT * torch.where(data.mask, data.readings, 0.0).abs().amax(dim=0)
    noise = estimate_noise(residual, data.mask, data.rows, quantization_steps).at_least(exact)
    noise = noise_before_clipping(noise, data, null.linearised.readings[0])
    fitter = Fitter(with_noise_limits(data, null, noise), noise)
    return fitter, fitter.fit(Candidate(), null), quantization_steps
