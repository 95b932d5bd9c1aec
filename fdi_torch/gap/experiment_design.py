"""Experiment design: the step inputs, among several, that distinguish two rival explanations soonest.

Both explanations are simulated with their fitted parameters. The separation is the chi-square of the difference of
their predictions that remains after the parameters of the first were adjusted, within the information of the recordings
and the tolerances, and with free initial levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording

DESIGNS, SEED = 6, 0
DURATION, HOLDS = 1500.0, (60.0, 120.0, 250.0)  # in units of the plant's time scale
SEPARABLE = 20.0  # chi-square units: odds of 20000 to 1
LARGEST_COMMAND, HIGHEST_LEVEL = 0.8, 0.95  # highest share of a pump's limit, and of a tank's height
RIDGE = 1e-10


def discriminating_input(fitter: Fitter, first: Fit, second: Fit) -> Mapping[str, Any] | None:
    """The design with the largest separation that keeps all tanks below their rim; None if none is safe, or if the
    plant has no inputs."""
    if not fitter.data.plant.channels():
        return None
    generator, scale = torch.Generator().manual_seed(SEED), time_scale(fitter.data.plant)
    best: Mapping[str, Any] | None = None
    for k in range(DESIGNS):
        recording = _design(fitter, scale * HOLDS[k % len(HOLDS)], generator)
        separation = _separation(fitter, first, second, recording)
        if separation is None:
            continue
        total, after = separation
        if best is None or total > best["separation"]:
            interval = recording.interval
            samples = None if after is None else round(after / interval) + 1
            best = {"separation": total, "parted_after": after, "parted_after_samples": samples}
            best |= {"input": _step_table(recording, interval)}
    return best


def _design(fitter: Fitter, hold: float, generator: torch.Generator) -> Recording:
    """Random steps of all inputs, no two at the same time."""
    data = fitter.data
    interval = max(data.recording.interval, data.row_spacing)
    duration = time_scale(fitter.data.plant) * DURATION
    time = torch.arange(0.0, duration, interval, dtype=torch.float64)
    columns = []
    for low, high in _limits(fitter):
        steps = torch.rand(int(duration / hold) + 2, generator=generator, dtype=torch.float64)
        shift = float(torch.rand(1, generator=generator, dtype=torch.float64))
        index = torch.clamp(torch.floor(time / hold + shift).long(), max=len(steps) - 1)
        columns.append(low + (high - low) * steps[index])
    return data.plant.recording(time, torch.stack(columns, dim=1), time.new_zeros(len(time), len(data.plant.sensors)))


def _limits(fitter: Fitter) -> list[tuple[float, float]]:
    """Lowest and highest value of each input, in its SI unit."""
    plant = fitter.data.plant
    limits = {channel: (0.2, 1.0) for channel in plant.channels()}
    for pump in plant.metered_flows():
        full = LARGEST_COMMAND * pump.full_command
        limits[pump.channel] = (0.1 * full, full)
    return [limits[channel] for channel in plant.channels()]


def _separation(fitter: Fitter, first: Fit, second: Fit, recording: Recording) -> tuple[float, float | None] | None:
    """Chi-square between both predictions, and after how many seconds it suffices; None if a tank gets too full."""
    data = fitter.data
    step = float(torch.median(data.experiment.steps))
    planned = data_set_of(data.plant, data.nominal_effects, recording, step)
    planned_fitter = Fitter(planned, fitter.noise)
    (predicted, slopes, levels), (rival, _, other_levels) = (
        _planned_run(planned_fitter, fit) for fit in (first, second)
    )
    heights = torch.tensor([t.height for t in data.plant.tanks], dtype=torch.float64)
    if bool((levels > HIGHEST_LEVEL * heights).any()) or bool((other_levels > HIGHEST_LEVEL * heights).any()):
        return None
    difference, slopes = (fitter.noise.whiten(x, planned.mask) for x in (predicted - rival, slopes))
    separation = _cumulative_separation(difference, slopes, _prior_information(fitter, first))
    sufficient = (separation > SEPARABLE).nonzero().flatten()
    return float(separation[-1]), float(recording.time[sufficient[0]]) if len(sufficient) else None


def _prior_information(fitter: Fitter, fit: Fit) -> Tensor:
    """Information matrix (P, P) of a fit's parameters for a new run, from tolerances and recordings.

    Initial levels, and constants that vary between recordings, have none.
    """
    scale = fitter.box(fit.space)[2]
    curvature = fitter.curvature(fit) / (scale * scale.unsqueeze(1))
    indices = [fit.space.index(n) for n in _in_one_run(fit)]
    per_recording = fitter.data.per_recording
    common = torch.tensor([n not in per_recording for n in _in_one_run(fit)])
    return torch.where(common & common.unsqueeze(1), curvature[indices][:, indices], 0.0)


def _in_one_run(fit: Fit) -> list[str]:
    """Parameters of a fit that one recording has, without those of further recordings."""
    return [n for n in fit.space.names if not ParameterName.parse(n).recording]


def _cumulative_separation(difference: Tensor, slopes: Tensor, information: Tensor) -> Tensor:
    """Chi-square (S,) of whitened differences (S, C) up to each sample, with the parameters projected out.

    slopes (S, C, P): of the prediction. information (P, P): on the parameters.
    """
    scale = torch.sqrt((slopes**2).sum(dim=(0, 1)) + torch.diagonal(information)).clamp(min=1e-300)
    j, prior = slopes / scale, information / (scale * scale.unsqueeze(1))
    curvature = torch.cumsum(torch.einsum("scp,scq->spq", j, j), dim=0) + prior
    pull = torch.cumsum(torch.einsum("scp,sc->sp", j, difference), dim=0)
    explained = (pull * torch.linalg.solve(curvature + RIDGE * torch.eye(len(scale)).to(j), pull)).sum(dim=1)
    return torch.cumsum((difference**2).sum(dim=1), dim=0) - explained


def _planned_run(planned_fitter: Fitter, fit: Fit) -> tuple[Tensor, Tensor, Tensor]:
    """Readings (S, C), slopes (S, C, P) and levels of a fit under the planned input."""
    engine = planned_fitter.engine(fit.candidate, list(fit.effect_values))
    values = {n: v for n, v in fit.values.items() if n in engine.space}
    theta = engine.space.vector(values).unsqueeze(0)
    linearised, tanks = engine.converge(theta), len(planned_fitter.data.plant.tanks)
    columns = [engine.space.index(n) for n in _in_one_run(fit)]
    return linearised.readings[0], linearised.jacobian[0][..., columns], linearised.levels[0, :, :tanks]


def planned_recording(table: Mapping[str, Any], plant: PlantDescription) -> Recording:
    """The input of an answer as a recording without readings."""
    time = torch.arange(0.0, table["duration"] + 0.5 * table["interval"], table["interval"], dtype=torch.float64)
    columns = []
    for channel in plant.channels():
        at = torch.tensor(table[channel]["at"], dtype=torch.float64)
        step = torch.searchsorted(at, time, right=True) - 1
        columns.append(torch.tensor(table[channel]["value"], dtype=torch.float64)[step])
    return plant.recording(time, torch.stack(columns, dim=1), time.new_full((len(time), len(plant.sensors)), torch.nan))


def _step_table(recording: Recording, interval: float) -> dict[str, Any]:
    """The steps of each input: times and values, in SI."""
    table: dict[str, Any] = {
        "duration": float(recording.time[-1]),
        "interval": interval,
        "unit": dict(zip(recording.input_names, recording.input_units, strict=True)),
    }
    for name, column in zip(recording.input_names, recording.inputs.T, strict=True):
        changes = torch.cat([torch.tensor([True]), torch.diff(column) != 0.0])
        table[name] = {"at": recording.time[changes].tolist(), "value": column[changes].tolist()}
    return table
