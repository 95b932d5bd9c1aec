"""All effects of a plant file fitted anew together, with its constants: the last step after causes were adopted.

A cause that was adopted early was fitted while others were still missing. No effect is searched here. A parameter with
a tolerance stays near what the plant file says (valves of one make are nearly alike), one without is free.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from fdi_torch.effects import build_network, effect
from fdi_torch.gap.answer import with_constants
from fdi_torch.gap.candidate_fit import Candidate, Fit, Fitter, standard_errors
from fdi_torch.gap.dataset import DataSet, RecordingPart
from fdi_torch.gap.free_runs.between_runs import DETERMINED, RunConstant
from fdi_torch.gap.noise_model import Noise, estimate_noise
from fdi_torch.gap.preprocess.sensor_limits import limits_of
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.names import matching
from fdi_torch.plant.description import PlacedEffect, PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of_all
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.joint_collocation import name_in_recording

TURNS = 3  # of the noise and the fit under it
WIDE = 0.5  # of a range


@dataclass(frozen=True)
class Refit:
    """plant: with effects and constants as fitted. rmse: by sensor, in SI; before: of the plant as it was, its
    constants and start levels fitted. parameters: how many were fitted, start levels included. fitted: value and
    standard error, misfit included, of what all recordings have in common. own: of what each has for itself, but for
    start levels.
    """

    plant: PlantDescription
    before: Mapping[str, float]
    rmse: Mapping[str, float]
    parameters: int
    fitted: Mapping[str, tuple[float, float]]
    own: Sequence[RunConstant] = ()


def refit(
    plant: PlantDescription,
    recordings: Recording | Sequence[Recording],
    leave_out: Collection[str] = (),
    step: float | None = None,
    hold: Collection[str] = (),
    white: float | None = None,
    vary: Collection[str] = (),
) -> Refit:
    """step: of the simulation, s; None for half the sampling interval. leave_out: effects that the plant is to lose.

    hold: patterns of constants that stay as the plant file has them. white: errors count as white noise of that size
    (SI) in every reading, whatever is left of the fast ones; that is what a free run asks for where equations are not
    quite the rig's, while the noise itself lets fast errors count for more than slow ones. vary: patterns of constants
    with a tolerance that each recording is to have for itself, beside those that the plant file says.

    Raises ValueError for a pattern of either that no name fits.
    """
    kept = tuple(e for e in plant.effects if e.effect not in leave_out)
    placed = [Placement(effect(e.effect), e.location, e.parameters) for e in kept]
    prefixes = {p.prefix for p in placed}
    tolerances = {n: v for n, v in plant.tolerances.items() if n.count(".") == 1 or n.rpartition(".")[0] in prefixes}
    held = set(matching("a constant of the plant to hold", hold, build_network(plant).constants.names))
    varying = dict.fromkeys([*plant.varying, *matching("a constant with a tolerance to vary", vary, tolerances)])
    bare = replace(
        plant,
        effects=kept,
        tolerances={n: v for n, v in tolerances.items() if n not in held},
        varying=tuple(n for n in varying if n not in held),
    )
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    step = step or 0.5 * recordings[0].interval
    data = checked_data_set(bare, placed, recordings, step)
    start = {n: v for n, v in _start(kept, plant, recordings).items() if n not in tolerances}
    start = {n: v for n, v in start.items() if n not in held}
    free = [p for p in placed if any(n.startswith(f"{p.prefix}.") for n in start)]
    spread = data.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    size = 1e-2 * spread if white is None else torch.full_like(spread, white)
    fitter = Fitter(data, Noise(size, torch.zeros_like(spread)))
    null = _with_a_trajectory(fit_by_continuation(fitter, Candidate()), recordings)
    fit, base = null, null if white is None else None
    for _ in range(TURNS if white is None else 1):
        if white is None:
            fitter = Fitter(data, estimate_noise(data.readings - fit.linearised.readings[0], data.mask))
        candidate = Candidate(tuple(free), (start,))
        fit = base = _with_a_trajectory(fit_by_continuation(fitter, candidate, base), recordings)
        found = {n: v for n, v in fit.effect_values.items() if n in start}
        start = {n: v for n, v in found.items() if n not in _undetermined(fitter, fit)}
    own = _own(fitter, fit)
    better = replace(_with(bare, fit, _typical(own, fit, bare)), tolerances=tolerances, varying=plant.varying)
    return Refit(better, _rmse(fitter, null), _rmse(fitter, fit), len(fit.space), _errors(fitter, fit), own)


def _with_a_trajectory(fit: Fit, recordings: Sequence[Recording]) -> Fit:
    """The fit. Raises ValueError where its levels over time were never found, so that nothing can be said of it."""
    if trajectory_found(fit):
        return fit
    named = ", ".join(dict.fromkeys(r.source for r in recordings if r.source)) or "the recordings"
    raise ValueError(
        f"refit: from the plant file's values no course of the levels through {named} was found; begin with other"
        " values of its effects, leave one of them out (--leave-out), or simulate in finer steps (--step)"
    )


def _undetermined(fitter: Fitter, fit: Fit) -> set[str]:
    """Parameters whose standard error, misfit included, is a good part of their range: the recording does not show
    them, and what the plant file says is better than an end of the range.
    """
    low, high, _ = fitter.box(fit.space)
    errors = _errors(fitter, fit)
    widths = dict(zip(fit.space.names, (high - low).tolist(), strict=True))
    return {n for n in fit.effect_values if n in errors and errors[n][1] > WIDE * widths[n]}


def _errors(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    """Values with standard errors, misfit included, of what all recordings have in common."""
    own = set(fitter.data.per_recording)
    return {n: each for n, each in _all_errors(fitter, fit).items() if n.partition("@")[0] not in own}


def _all_errors(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    misfit = max(1.0, (fit.cost / float(fitter.data.mask.sum())) ** 0.5)
    stds = standard_errors(fitter, fit)
    return {n: (v, misfit * stds[n]) for n, v in fit.values.items()}


def _own(fitter: Fitter, fit: Fit) -> tuple[RunConstant, ...]:
    """What varies from recording to recording, by name and then in the recordings' order."""
    errors, parts = _all_errors(fitter, fit), fitter.data.parts
    return tuple(
        RunConstant(name, part.recording.source, float(part.recording.time[0]), *errors[name_in_recording(name, k)])
        for name in fitter.data.plant.varying
        for k, part in enumerate(parts)
    )


def _start(
    kept: Collection[PlacedEffect], plant: PlantDescription, recordings: Sequence[Recording]
) -> dict[str, float]:
    """Where each effect has what a fit may move of it; a limit that the values themselves tell is not fitted."""
    reach = operating_range_of_all(recordings, plant)
    start: dict[str, float] = {}
    for placed in kept:
        movable = {n for s in effect(placed.effect).starts(placed.location, plant, reach) for n in s}
        if not effect(placed.effect).quantizes and not any(_told(placed, plant, r) for r in recordings):
            values = {n: v for n, v in placed.parameters.items() if n in movable}
            start |= {f"{placed.location}.{placed.effect}.{n}": v for n, v in values.items()}
    return start


def _told(placed: PlacedEffect, plant: PlantDescription, recording: Recording) -> bool:
    for sensor in plant.sensors:
        if sensor.name == placed.location and sensor.column in recording.output_names:
            i = recording.output_names.index(sensor.column)
            found = limits_of(recording.outputs[recording.mask[:, i], i])
            return found.get(placed.effect) == placed.parameters.get("limit", float("nan"))
    return False


def _typical(own: Sequence[RunConstant], fit: Fit, plant: PlantDescription) -> dict[str, float]:
    """What the next recording is best believed to have of what differs: the median of those that tell it and of what
    the plant file says, which counts as one more: two recordings may both be odd.
    """
    found = {}
    for name in plant.varying:
        told = [o.value for o in own if o.name == name and o.std < DETERMINED * plant.tolerances[name]]
        if told:
            found[name] = statistics.median([*told, fit.space[name].nominal])
    return found


def _with(plant: PlantDescription, fit: Fit, typical: dict[str, float]) -> PlantDescription:
    """Constants and effects as fitted; of what each recording has for itself what is typical."""
    own = {*plant.varying, *(f"{tank.name}.start_level" for tank in plant.tanks)}
    common = {n: v for n, v in fit.values.items() if n.partition("@")[0] not in own} | typical
    constants = {n: v for n, v in common.items() if n.count(".") == 1}
    found = {n: v for n, v in common.items() if n.count(".") == 2}
    effects = []
    for placed in plant.effects:
        prefix = f"{placed.location}.{placed.effect}"
        fitted = {n.rpartition(".")[2]: v for n, v in found.items() if n.rpartition(".")[0] == prefix}
        effects.append(replace(placed, parameters={**placed.parameters, **fitted}))
    return replace(with_constants(plant, constants), effects=tuple(effects))


def _rmse(fitter: Fitter, fit: Fit) -> dict[str, float]:
    mask = fitter.data.mask
    squares = torch.where(mask, (fitter.data.readings - fit.linearised.readings[0]) ** 2, 0.0)
    each = torch.sqrt(squares.sum(dim=0) / mask.sum(dim=0)).tolist()
    return dict(zip((s.name for s in fitter.data.plant.sensors), each, strict=True))


WIDENINGS = (64.0, 16.0, 4.0, 2.0)


def fit_by_continuation(fitter: Fitter, candidate: Candidate, base: Fit | None = None) -> Fit:
    """The fit, as it is where its course of the levels is found at once."""
    found = fitter.fit(candidate, base)
    if trajectory_found(found):
        return found
    for widening in WIDENINGS:
        wide = Fitter(_drawn_smooth(fitter.data, widening), fitter.noise).fit(candidate, base)
        if trajectory_found(wide):
            base = wide
    again = fitter.fit(candidate, base) if base is not None else found
    return again if trajectory_found(again) else found


def trajectory_found(fit: Fit) -> bool:
    """Whether the course of its levels was found."""
    return math.isfinite(fit.cost) and bool(torch.isfinite(fit.linearised.jacobian).all())


def _drawn_smooth(data: DataSet, widening: float) -> DataSet:
    def wider(experiment: Experiment) -> Experiment:
        return replace(experiment, resolution=widening * experiment.resolution)

    further: list[RecordingPart] = [replace(part, experiment=wider(part.experiment)) for part in data.further]
    return replace(data, experiment=wider(data.experiment), further=tuple(further))
