"""A plant file on trial: its free run along a recording, whose first samples alone are used, for the start levels.

What the plant file says varies from recording to recording (the zero of a sensor that is zeroed before each run) is
taken from the same samples, within its tolerance: a tank that reads less than nothing is empty, and its sensor off.
Where the recording was cut from a longer one in which a pump had run, its hose is full. A longer stretch at the start
tells more of what varies, and the levels at its end; it is then no part of what is predicted (`settling`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from fdi_torch.effects import effect, without_startup_effects
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.dataset import DataSet, data_set_of
from fdi_torch.gap.free_runs.initial_state import estimate_initial_state
from fdi_torch.gap.noise_model import Noise
from fdi_torch.names import matching
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.scales import length_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 50
CORRECTIONS, HALVINGS = 80, 4
SETTLED = 1e-5  # m, on a bench
NEARLY = 10.0  # so many times as far, and shorter steps do not help
MOST_STEPS = 4000  # of the first try; samples may be closer, levels do not change as fast
UNSEEN_STARTS = (0.1, 0.25, 0.5, 0.8)  # shares of the height, for a tank that no sensor sees


@dataclass(frozen=True)
class Prediction:
    """readings (S, C) in SI as the plant's sensors have them; start_levels in m; own: what else was taken from the
    first samples, SI; rmse by sensor, over all samples, or those after the stretch that the plant settled in.

    settled: whether the trajectory is the model's to SETTLED, or as much more as tanks are larger; defect, m: by how
    much it is not.
    """

    readings: Tensor
    residuals: Tensor
    start_levels: Mapping[str, float]
    own: Mapping[str, float]
    rmse: Mapping[str, float]
    settled: bool
    defect: float


def predict(
    plant: PlantDescription,
    recording: Recording,
    start_samples: int = START_SAMPLES,
    step: float | None = None,
    settle: float | None = None,
    vary: Collection[str] = (),
) -> Prediction:
    """The free run of the plant as its file has it. step: of the simulation, s; None for half the sampling interval (in
    a long run of close samples the MOST_STEPS-th part of it), and less where a rim that runs over, or another sharp
    bend, keeps the trajectory from settling.

    settle: s; all of so much is used for the start, in place of start_samples: the run goes on from the levels at its
    end, and errors are counted after it. vary: patterns of constants with a tolerance that are taken from there too,
    beside those that the plant file says.

    Raises ValueError where there is no first sample to start from, or none left to predict.
    """
    counted = 0
    if settle is not None:
        start_samples = counted = _samples_within(recording, settle)
    if start_samples < 1:
        raise ValueError(f"expected at least 1 sample for the start levels, got {start_samples}")
    plant = without_startup_effects(_varying(plant, vary), recording.ran)
    nominal_effects = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    span = float(recording.time[-1] - recording.time[0])
    step = step or max(0.5 * float(torch.median(torch.diff(recording.time))), span / MOST_STEPS)
    left = math.inf
    for _ in range(HALVINGS):
        data = data_set_of(plant, nominal_effects, recording, step)
        found, before = _run(data, start_samples, counted), left
        left = found.defect
        stuck = left < NEARLY * SETTLED * length_scale(plant) and left > 0.5 * before
        if found.settled or stuck:  # an empty tank flickers at its floor, whatever the step
            break
        step *= 0.5
    return found


def _samples_within(recording: Recording, seconds: float) -> int:
    """How many samples lie in the first so many seconds; some reading must be left to predict."""
    first = float(recording.time[0])
    samples = int((recording.time <= first + seconds).sum())
    if seconds <= 0 or not bool(recording.mask[samples:].any()):
        length = float(recording.time[-1]) - first
        raise ValueError(
            f"{recording.source}: expected a stretch to settle in of more than 0 s and less than the {length:g} s of "
            f"the recording, got {seconds:g} s"
        )
    return samples


def _varying(plant: PlantDescription, patterns: Collection[str]) -> PlantDescription:
    """The plant of which more varies. Raises ValueError for a pattern that no constant with a tolerance has."""
    more = matching("a constant with a tolerance to vary", patterns, plant.tolerances)
    return replace(plant, varying=tuple(dict.fromkeys([*plant.varying, *more])))


def _run(data: DataSet, start_samples: int, counted: int) -> Prediction:
    plant = data.plant
    early = data.mask.clone()
    early[start_samples:] = False
    if not bool(early.any()):
        source = data.recording.source
        raise ValueError(f"{source}: expected readings among the first {start_samples} samples, got none")
    spread = data.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    fitter = Fitter(replace(data, mask=early), Noise(1e-2 * spread, torch.zeros_like(spread)))
    engine, theta, levels = _by_stretch(fitter, counted) if counted else _by_samples(fitter, data)
    run = engine.converge(theta, levels, CORRECTIONS)
    readings = run.readings[0]
    residuals = torch.where(data.mask, data.readings - readings, torch.zeros_like(readings))
    rmse = torch.sqrt((residuals[counted:] ** 2).sum(dim=0) / data.mask[counted:].sum(dim=0))
    values = dict(zip(engine.space.names, theta[0].tolist(), strict=True))
    return Prediction(
        readings,
        residuals,
        {t.name: values[f"{t.name}.start_level"] for t in plant.tanks},
        {name: values[name] for name in plant.varying},
        dict(zip((s.name for s in plant.sensors), rmse.tolist(), strict=True)),
        float(run.defect.max()) < SETTLED * length_scale(plant),
        float(run.defect.max()),
    )


Begun = tuple[Collocation, Tensor, Tensor]
"""The engine, parameters (1, P) and a guess of the levels (1, K+1, tanks)."""


def _by_samples(fitter: Fitter, data: DataSet) -> Begun:
    """Start levels, and what varies, from the readings that the fitter sees."""
    plant = fitter.data.plant
    engine = _engine(fitter, (), [*(f"{t.name}.start_level" for t in plant.tanks), *plant.varying])
    theta = torch.stack([engine.space.vector(start) for start in _starts(plant, fitter.first_levels())])
    guess = Fitter(data, fitter.noise).first_trajectory(engine, theta)
    ends = fitter.descend(engine, theta, guess)
    best = int(torch.nan_to_num(ends.cost, nan=torch.inf).argmin())
    return engine, ends.theta[best : best + 1], ends.linearised.levels[best : best + 1]


def _by_stretch(fitter: Fitter, samples: int) -> Begun:
    """The same from the first so many samples, in which water may come and go unseen."""
    data = fitter.data
    plant = replace(data.plant, tolerances={n: data.plant.tolerances[n] for n in data.plant.varying})
    first, step = data.recording.stretch(0, samples), float(data.experiment.steps.max())
    stretch = data_set_of(plant, data.nominal_effects, first, step)
    found = estimate_initial_state(stretch, _starts(plant, fitter.first_levels()), fitter.noise)
    engine = _engine(fitter, found.placements, list(found.values))
    theta = engine.space.vector(found.values).unsqueeze(0)
    return engine, theta, engine.constant_guess(theta)


def _engine(fitter: Fitter, placements: Sequence[Placement], names: Sequence[str]) -> Collocation:
    network = fitter.network(placements)
    return Collocation(network, ParameterSpace(network.constants[n] for n in names), fitter.data.experiment)


def _starts(plant: PlantDescription, seen: Mapping[str, float]) -> list[dict[str, float]]:
    """Where the descent begins: levels as first read; several where no sensor tells."""
    unseen = [t for t in plant.tanks if f"{t.name}.start_level" not in seen]
    grids = [[(f"{t.name}.start_level", share * t.height) for share in UNSEEN_STARTS] for t in unseen]
    return [{**seen, **dict(choice)} for choice in product(*grids)]


@dataclass(frozen=True)
class LeftOutRun:
    """A free run along one recording (start, stop in s): root mean square errors by sensor (SI) of the plant as it is
    (`as_is`) and as fitted to all files but that one (`refitted`).
    """

    source: str
    start: float
    stop: float
    as_is: Mapping[str, float]
    refitted: Mapping[str, float]


def leave_one_file_out(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    trials: Sequence[Recording],
    fit: Callable[[Sequence[Recording]], PlantDescription],
    start_samples: int,
    tell: Callable[[float, str], None] = lambda share, text: None,
    settle: float | None = None,
) -> list[LeftOutRun]:
    """trials: what is run freely; for each, `fit` sees the recordings of all other files. Recordings of one file are
    told by the hash of its contents. settle: as `predict` has it, s. Raises ValueError where that would leave none to
    fit.
    """
    refitted: dict[str, PlantDescription] = {}
    found = []
    for k, run in enumerate(trials):
        tell(k / len(trials), run.source)
        if run.sha256 not in refitted:
            rest = [r for r in recordings if r.sha256 != run.sha256]
            if not rest:
                raise ValueError(f"{run.source}: expected recordings of another file to fit to, got none; give more")
            refitted[run.sha256] = fit(rest)
        plants = plant, refitted[run.sha256]
        as_is, without = (predict(p, run, start_samples, settle=settle).rmse for p in plants)
        found.append(LeftOutRun(run.source, float(run.time[0]), float(run.time[-1]), as_is, without))
    return found
