"""What next: of many step inputs within the pumps' limits, the one under which two rival explanations part soonest.

Both are simulated with what was fitted. What the first one's parameters cannot take up of their difference, within what
the recording so far and the tolerances say of them and from free start levels, is over the noise the chi-square by
which the new run parts them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import lay_out

DESIGNS, SEED = 6, 0
DURATION, HOLDS = 1500.0, (60.0, 120.0, 250.0)  # s, of tanks on a bench
PARTED = 20.0  # chi-square units: odds of 20000 to 1
HIGH, FULL = 0.8, 0.95  # of a pump's limit, and of a tank's height
TINY = 1e-10


def discriminating_input(fitter: Fitter, first: Fit, second: Fit) -> Mapping[str, Any] | None:
    """The best of the designs under which no tank comes near its rim; None where none of them is safe."""
    generator, pace = torch.Generator().manual_seed(SEED), time_scale(fitter.data.plant)
    best: Mapping[str, Any] | None = None
    for k in range(DESIGNS):
        recording = _design(fitter, pace * HOLDS[k % len(HOLDS)], generator)
        parted = _separation(fitter, first, second, recording)
        if parted is None:
            continue
        total, when = parted
        if best is None or total > best["separation"]:
            interval = recording.interval
            samples = None if when is None else round(when / interval) + 1
            best = {"separation": total, "parted_after": when, "parted_after_samples": samples}
            best |= {"input": _table(recording, interval)}
    return best


def _design(fitter: Fitter, hold: float, generator: torch.Generator) -> Recording:
    """Random steps of all channels, none of which changes with another."""
    data = fitter.data
    interval = data.recording.interval
    duration = time_scale(fitter.data.plant) * DURATION
    time = torch.arange(0.0, duration, interval, dtype=torch.float64)
    columns = []
    for low, high in _limits(fitter):
        steps = torch.rand(int(duration / hold) + 2, generator=generator, dtype=torch.float64)
        shift = float(torch.rand(1, generator=generator, dtype=torch.float64))
        index = torch.clamp(torch.floor(time / hold + shift).long(), max=len(steps) - 1)
        columns.append(low + (high - low) * steps[index])
    blank = torch.zeros(len(time), len(data.plant.sensors), dtype=torch.float64)
    outputs = tuple(s.column for s in data.plant.sensors)
    units = tuple(s.unit for s in data.plant.sensors)
    inputs = torch.stack(columns, dim=1)
    channels = data.plant.channels()
    return Recording(
        time, inputs, blank, channels, outputs, tuple(data.plant.channel_units()[c] for c in channels), units
    )


def _limits(fitter: Fitter) -> list[tuple[float, float]]:
    """Lowest and highest value of each channel, in its SI unit."""
    plant = fitter.data.plant
    limits = {channel: (0.2, 1.0) for channel in plant.channels()}
    for pump in plant.pumps:
        full = HIGH * pump.max_flow / pump.gain
        limits[pump.channel] = (0.1 * full, full)
    return [limits[channel] for channel in plant.channels()]


def _separation(fitter: Fitter, first: Fit, second: Fit, recording: Recording) -> tuple[float, float | None] | None:
    """Chi-square between both predictions, and after how many seconds it is enough; None where a tank gets too full."""
    data = fitter.data
    step = float(torch.median(data.experiment.steps))
    planned_recording = replace(
        data_set_of(data.plant, data.nominal_effects, recording, step),
        experiment=lay_out(recording, data.plant.channels(), step),
    )
    there = Fitter(planned_recording, fitter.noise)
    (seen, slopes, levels), (other, _, other_levels) = (_run(there, fit) for fit in (first, second))
    heights = torch.tensor([t.height for t in data.plant.tanks], dtype=torch.float64)
    if bool((levels > FULL * heights).any()) or bool((other_levels > FULL * heights).any()):
        return None
    difference = there.noise.whiten(seen - other, planned_recording.mask)
    grown = _grown(difference, there.noise.whiten(slopes, planned_recording.mask), _known(fitter, first))
    enough = (grown > PARTED).nonzero().flatten()
    return float(grown[-1]), float(recording.time[enough[0]]) if len(enough) else None


def _known(fitter: Fitter, fit: Fit) -> Tensor:
    """(P, P): what tolerances and the recordings so far say of a fit's parameters in a new run; nothing of its start
    levels, nor of what varies from run to run.
    """
    scale = fitter.box(fit.space)[2]
    curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.linearised, scale)[2][0] / (
        scale * scale.unsqueeze(1)
    )
    kept = [fit.space.index(n) for n in _in_one_run(fit)]
    own = fitter.data.per_recording
    without_time_course = torch.tensor([n not in own for n in _in_one_run(fit)])
    return torch.where(without_time_course & without_time_course.unsqueeze(1), curvature[kept][:, kept], 0.0)


def _in_one_run(fit: Fit) -> list[str]:
    """The parameters of a fit that one recording has; '@' marks what belongs to further ones."""
    return [n for n in fit.space.names if "@" not in n]


def _grown(difference: Tensor, slopes: Tensor, known: Tensor) -> Tensor:
    """(S,): of whitened differences (S, C), up to each sample, what the parameters with slopes (S, C, P) cannot take up
    within what is known of them, (P, P).
    """
    scale = torch.sqrt((slopes**2).sum(dim=(0, 1)) + torch.diagonal(known)).clamp(min=1e-300)
    j, prior = slopes / scale, known / (scale * scale.unsqueeze(1))
    curvature = torch.cumsum(torch.einsum("scp,scq->spq", j, j), dim=0) + prior
    pull = torch.cumsum(torch.einsum("scp,sc->sp", j, difference), dim=0)
    taken = (pull * torch.linalg.solve(curvature + TINY * torch.eye(len(scale)).to(j), pull)).sum(dim=1)
    return torch.cumsum((difference**2).sum(dim=1), dim=0) - taken


def _run(there: Fitter, fit: Fit) -> tuple[Tensor, Tensor, Tensor]:
    """Readings (S, C), slopes (S, C, P) and levels of a fit under the planned input."""
    engine = there.engine(fit.candidate, list(fit.effect_values))
    known = {n: v for n, v in fit.values.items() if n in engine.space}
    theta = engine.space.vector(known).unsqueeze(0)
    linearised = engine.converge(theta, engine.constant_guess(theta), rounds=30)
    columns = [engine.space.index(n) for n in _in_one_run(fit)]
    return linearised.readings[0], linearised.jacobian[0][..., columns], linearised.levels[0]


def planned_recording(table: Mapping[str, Any], plant: PlantDescription) -> Recording:
    """The input of an answer as a recording that has yet to be read: its outputs are empty."""
    time = torch.arange(0.0, table["duration"] + 0.5 * table["interval"], table["interval"], dtype=torch.float64)
    channels = plant.channels()
    columns = []
    for channel in channels:
        at = torch.tensor(table[channel]["at"], dtype=torch.float64)
        since = torch.searchsorted(at, time, right=True) - 1
        columns.append(torch.tensor(table[channel]["value"], dtype=torch.float64)[since])
    units = tuple(table["unit"][c] for c in channels)
    names, reading_units = tuple(s.column for s in plant.sensors), tuple(s.unit for s in plant.sensors)
    blank = torch.full((len(time), len(names)), torch.nan, dtype=torch.float64)
    return Recording(time, torch.stack(columns, dim=1), blank, channels, names, units, reading_units)


def _table(recording: Recording, interval: float) -> dict[str, Any]:
    """The steps of each channel: when, and to what, in SI."""
    table: dict[str, Any] = {
        "duration": float(recording.time[-1]),
        "interval": interval,
        "unit": dict(zip(recording.input_names, recording.input_units, strict=True)),
    }
    for name, column in zip(recording.input_names, recording.inputs.T, strict=True):
        changes = torch.cat([torch.tensor([True]), torch.diff(column) != 0.0])
        table[name] = {"at": recording.time[changes].tolist(), "value": column[changes].tolist()}
    return table
