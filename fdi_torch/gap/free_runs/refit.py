"""Refit of all effects of a plant file together with its constants; the last step after causes were adopted.

A cause that was adopted early was fitted while others were missing. No effect is searched here. A parameter with a
tolerance stays near its value in the plant file; one without is free.

Near a kink of the equations, such as a rim or the root of a small head, the fit may fail to find a first trajectory.
`fit_by_continuation` then smooths the kinks more strongly, as for steps that are WIDENINGS times as long, and lets each
solution start the next, less smoothed one (continuation: Allgower and Georg, 1990).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from fdi_torch.effects import build_network, effect, effects_of
from fdi_torch.gap.answer import with_constants
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter, standard_errors
from fdi_torch.gap.channel_noise import Noise, estimate_noise
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.free_runs.between_runs import DETERMINED, RunConstant
from fdi_torch.gap.free_runs.prediction import rmse_by_sensor, with_varying
from fdi_torch.gap.preprocess.sensor_limits import limits_of
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.names import matching
from fdi_torch.parameters import ParameterName, by_prefix, common_name, name_in_recording
from fdi_torch.plant.description import PlacedEffect, PlantDescription, with_tolerances
from fdi_torch.plant.operating_range import operating_range_of_all
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_limits import expect_no_denied_rim
from fdi_torch.recordings.plant_units import expect_right_units

TURNS = 3  # alternations between noise and fit
WIDE = 0.5  # share of a range; a larger standard error means undetermined


@dataclass(frozen=True)
class Refit:
    """plant: with fitted effects and constants. before, rmse: errors by sensor (SI) with constants only, and with all,
    fitted. parameters: how many were fitted, initial levels included. fitted: value and standard error, misfit
    included, of what all recordings share. own: constants specific to each recording, without initial levels."""

    plant: PlantDescription
    before: Mapping[str, float]
    rmse: Mapping[str, float]
    parameters: int
    fitted: Mapping[str, tuple[float, float]]
    own: Sequence[RunConstant] = ()

    def narrowed(self) -> PlantDescription:
        """The plant with the standard errors of the fit as tolerances where these are smaller."""
        return narrowed(self.plant, {name: std for name, (_, std) in self.fitted.items()})


def narrowed(plant: PlantDescription, errors: Mapping[str, float]) -> PlantDescription:
    """The plant with these standard errors of a fit, by constant and in SI, as tolerances where they are smaller.

    That is what the recordings show of constants that stay the same in later ones; the fit does not know how far
    they drift from day to day.
    """
    constants = build_network(plant).constants
    shares = {n: std / constants[n].std for n, std in errors.items() if n in plant.tolerances}
    narrower = {n: float(f"{s * plant.tolerances[n]:.2g}") for n, s in shares.items() if 0.0 < s < 1.0}
    return replace(plant, tolerances={**plant.tolerances, **narrower})


def refit(
    plant: PlantDescription,
    recordings: Recording | Sequence[Recording],
    leave_out: Collection[str] = (),
    step: float | None = None,
    hold: Collection[str] = (),
    white: float | None = None,
    vary: Collection[str] = (),
    tell: Tell = silent,
) -> Refit:
    """Fit all effects and constants of a plant to recordings.

    step: of the simulation, s; None for half the sampling interval. leave_out: effects to remove from the plant. hold:
    patterns of constants that are not fitted. white: standard deviation of white noise of the levels, m, that replaces
    the estimated noise. Use it for free runs with equations that are not quite the rig's: the estimated noise weights
    fast errors more than slow ones. vary: patterns of further constants with a tolerance that each recording has for
    itself. tell(share, text): receives the progress.

    Raises ValueError for a pattern that matches no name.
    """
    held_names = set(matching("a constant of the plant to hold", hold, build_network(plant).constants.names))
    omitted = {e.prefix for e in plant.effects if e.effect in leave_out}
    plant = replace(plant, effects=tuple(e for e in plant.effects if e.prefix not in omitted))
    plant = with_tolerances(plant, lambda name: name.prefix not in omitted)
    held_plant = with_tolerances(with_varying(plant, vary), lambda name: str(name) not in held_names)
    placements = effects_of(plant)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    for recording in recordings:
        expect_right_units(held_plant, recording)
        expect_no_denied_rim(held_plant, recording)
    step = step or 0.5 * recordings[0].interval
    data = checked_data_set(held_plant, placements, recordings, step)
    fixed = {*plant.tolerances, *held_names}
    start = {n: v for n, v in _initial_values(plant, recordings).items() if n not in fixed}
    free = [p for p in placements if p.prefix in by_prefix(start)]
    noise = Noise.rough(data.readings)
    if white is not None:
        noise = Noise.white(white * data.readings.new_tensor([abs(s.gain) for s in plant.sensors]))
    fitter = Fitter(data, noise)
    turns = TURNS if white is None else 1
    tell(0.0, "fit of the constants")
    null = _with_a_trajectory(fit_by_continuation(fitter, Candidate()), recordings)
    fit, base = null, null if white is None else None
    for turn in range(turns):
        tell((1 + turn) / (1 + turns), f"fit of constants and effects, turn {turn + 1} of {turns}")
        if white is None:
            residual = data.readings - fit.linearised.readings[0]
            fitter = Fitter(data, estimate_noise(residual, data.mask, data.rows))
        candidate = Candidate(tuple(free), (start,))
        fit = base = _with_a_trajectory(fit_by_continuation(fitter, candidate, base), recordings)
        effect_values = {n: v for n, v in fit.effect_values.items() if n in start}
        start = {n: v for n, v in effect_values.items() if n not in _undetermined(fitter, fit)}
    run_constants = _run_constants(fitter, fit)
    refitted = replace(
        _refitted_plant(held_plant, fit, _typical(run_constants, fit, held_plant)),
        tolerances=plant.tolerances,
        varying=plant.varying,
    )
    residuals = (data.readings - each.linearised.readings[0] for each in (null, fit))
    before, after = (rmse_by_sensor(plant, residual, data.mask) for residual in residuals)
    tell(1.0, "done")
    return Refit(refitted, before, after, len(fit.space), _errors(fitter, fit), run_constants)


def _with_a_trajectory(fit: Fit, recordings: Sequence[Recording]) -> Fit:
    """The fit. Raises ValueError if its trajectory did not converge."""
    if trajectory_found(fit):
        return fit
    named = ", ".join(dict.fromkeys(r.source for r in recordings if r.source)) or "the recordings"
    raise ValueError(
        f"refit: no trajectory of the levels along {named} was found from the plant file's values; start from other"
        " values of its effects, leave one of them out (--leave-out), or simulate in finer steps (--step)"
    )


def _undetermined(fitter: Fitter, fit: Fit) -> set[str]:
    """Parameters whose standard error, misfit included, is a large part of their range; they keep the plant file's
    value."""
    low, high, _ = fitter.box(fit.space)
    errors = _errors(fitter, fit)
    widths = dict(zip(fit.space.names, (high - low).tolist(), strict=True))
    return {n for n in fit.effect_values if n in errors and errors[n][1] > WIDE * widths[n]}


def _errors(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    """Values and standard errors, misfit included, of what all recordings share."""
    per_recording = set(fitter.data.per_recording)
    return {n: each for n, each in _all_errors(fitter, fit).items() if common_name(n) not in per_recording}


def _all_errors(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    misfit = max(1.0, (fit.cost / float(fitter.data.mask.sum())) ** 0.5)
    stds = standard_errors(fitter, fit)
    return {n: (v, misfit * stds[n]) for n, v in fit.values.items()}


def _run_constants(fitter: Fitter, fit: Fit) -> tuple[RunConstant, ...]:
    """Constants that vary between recordings, by name and then in the order of the recordings."""
    errors, stds = _all_errors(fitter, fit), standard_errors(fitter, fit)

    def constant(name: str, own: str, recording: Recording) -> RunConstant:
        prior = fit.space[own]
        share = 1.0 - (stds[own] / prior.std) ** 2
        return RunConstant(name, recording.source, float(recording.time[0]), *errors[own], prior.nominal, share)

    return tuple(
        constant(name, name_in_recording(name, k), part.recording)
        for name in fitter.data.plant.varying
        for k, part in enumerate(fitter.data.parts)
    )


def _initial_values(plant: PlantDescription, recordings: Sequence[Recording]) -> dict[str, float]:
    """Present values of the effects' parameters that a fit may change; limits that the readings show are not fitted."""
    operating_range = operating_range_of_all(recordings, plant)
    start: dict[str, float] = {}
    for placed in plant.effects:
        movable = {n for s in effect(placed.effect).starts(placed.location, plant, operating_range) for n in s}
        if not effect(placed.effect).quantizes and not any(
            _is_limit_from_readings(placed, plant, r) for r in recordings
        ):
            values = {n: v for n, v in placed.parameters.items() if n in movable}
            start |= {placed.full_name(n): v for n, v in values.items()}
    return start


def _is_limit_from_readings(placed: PlacedEffect, plant: PlantDescription, recording: Recording) -> bool:
    """Whether the effect is a limit of a sensor that the readings themselves show."""
    values = (recording.valid_readings(s.column) for s in plant.sensors if s.name == placed.location)
    return any(limits_of(x).get(placed.effect) == placed.parameters.get("limit", math.nan) for x in values)


def _typical(run_constants: Sequence[RunConstant], fit: Fit, plant: PlantDescription) -> dict[str, float]:
    """Expected value of each varying constant in the next recording: the median of its well-determined values and of
    the plant file's, which counts as one more."""
    typical = {}
    for name in plant.varying:
        determined = [o.value for o in run_constants if o.name == name and o.std < DETERMINED * plant.tolerances[name]]
        if determined:
            typical[name] = statistics.median([*determined, fit.space[name].nominal])
    return typical


def _refitted_plant(plant: PlantDescription, fit: Fit, typical: dict[str, float]) -> PlantDescription:
    """The plant with fitted constants and effects, and typical values of what varies between recordings."""
    per_recording = {*plant.varying, *(f"{tank.name}.start_level" for tank in plant.tanks)}
    common = {n: v for n, v in fit.values.items() if common_name(n) not in per_recording} | typical
    constants = {n: v for n, v in common.items() if ParameterName.parse(n).is_constant}
    fitted = by_prefix(common)
    effects = tuple(replace(e, parameters={**e.parameters, **fitted.get(e.prefix, {})}) for e in plant.effects)
    return replace(with_constants(plant, constants), effects=effects)


WIDENINGS = (64.0, 16.0, 4.0, 2.0)


def fit_by_continuation(fitter: Fitter, candidate: Candidate, base: Fit | None = None) -> Fit:
    """Fit a candidate; by continuation from smoothed plants if its trajectory does not converge at once."""
    direct = fitter.fit(candidate, base)
    if trajectory_found(direct):
        return direct
    for widening in WIDENINGS:
        smooth = Fitter(_smoothed(fitter.data, widening), fitter.noise).fit(candidate, base)
        if trajectory_found(smooth):
            base = smooth
    continued = fitter.fit(candidate, base) if base is not None else direct
    return continued if trajectory_found(continued) else direct


def trajectory_found(fit: Fit) -> bool:
    """Whether the fit's trajectory converged."""
    return math.isfinite(fit.cost) and bool(torch.isfinite(fit.linearised.jacobian).all())


def _smoothed(data: DataSet, widening: float) -> DataSet:
    return replace(data, experiments=tuple(replace(e, resolution=widening * e.resolution) for e in data.experiments))
