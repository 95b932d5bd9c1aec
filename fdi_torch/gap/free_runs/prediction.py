"""Free run of a plant file along a recording; only the first samples of the recording are used.

The first samples determine the initial levels and, within their tolerances, the constants that vary from recording to
recording (such as the zero of a sensor that is zeroed before each run): a tank whose sensor reads below zero is empty,
and the sensor has an offset. If the recording was cut from a longer one in which a pump had run, the pump's hose is
full. A longer initial segment determines what varies more accurately, and the levels at its end; it is then no part of
the prediction (`initial_state.py`).

`leave_one_file_out` predicts each file by a plant fitted to all others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from fdi_torch.effects import effects_of, without_startup_effects
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import DataSet, data_set_of
from fdi_torch.gap.free_runs.initial_state import estimate_initial_state
from fdi_torch.names import matching
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.scales import length_scale
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.collocation import Collocation

START_SAMPLES = 50  # for the initial levels
HALVINGS = 4  # halvings of the simulation step
CONVERGED = 1e-5  # largest defect of a converged trajectory, in units of the plant's length scale
NEARLY_CONVERGED = 10.0  # in units of CONVERGED: a defect that shorter steps need not improve
MOST_STEPS = 4000  # in the first attempt; levels change more slowly than close samples
UNMEASURED_STARTS = (0.1, 0.25, 0.5, 0.8)  # initial levels, as shares of the height, of a tank without a sensor


@dataclass(frozen=True)
class Prediction:
    """readings (S, C) in SI, in the order of the plant's sensors. start_levels: m. own: constants that were
    estimated from the first samples, SI. rmse: by sensor, over all samples or those after the initial segment.

    settled: whether the trajectory converged to CONVERGED, scaled with the size of the tanks. defect: the largest
    correction of a state in the last iteration, m.
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
    tell: Tell = silent,
) -> Prediction:
    """Simulate the plant along the recording with the constants of its file, from estimated initial levels.

    step: of the simulation, s; None for half the sampling interval (in long recordings the MOST_STEPS-th part of them),
    and less if a rim or another sharp bend keeps the trajectory from converging.

    settle: length of the initial segment (s), used in place of start_samples. The run continues from the levels at its
    end, and errors are counted after it. vary: patterns of further constants with a tolerance that the first samples
    determine. tell(share, text): receives the progress.

    Raises ValueError if there is no sample to start from, or none left to predict.
    """
    skipped = 0
    if settle is not None:
        start_samples = skipped = _samples_within(recording, settle)
    if start_samples < 1:
        raise ValueError(f"expected at least 1 sample for the start levels, got {start_samples}")
    plant = without_startup_effects(with_varying(plant, vary), recording.ran)
    nominal_effects = effects_of(plant)
    duration = float(recording.time[-1] - recording.time[0])
    step = step or max(0.5 * float(torch.median(torch.diff(recording.time))), duration / MOST_STEPS)
    defect = math.inf
    for attempt in range(HALVINGS):
        tell(attempt / HALVINGS, f"steps of {step:.3g} s")
        data = data_set_of(plant, nominal_effects, recording, step)
        prediction, previous = _run(data, start_samples, skipped), defect
        defect = prediction.defect
        stalled = defect < NEARLY_CONVERGED * CONVERGED * length_scale(plant) and defect > 0.5 * previous
        if prediction.settled or stalled:  # an empty tank oscillates at its floor with any step
            break
        step *= 0.5
    tell(1.0, "done")
    return prediction


def _samples_within(recording: Recording, seconds: float) -> int:
    """Number of samples in the first seconds. Raises ValueError unless readings are left to predict."""
    first = float(recording.time[0])
    samples = int((recording.time <= first + seconds).sum())
    if seconds <= 0 or not bool(recording.mask[samples:].any()):
        length = float(recording.time[-1]) - first
        raise ValueError(
            f"{recording.source}: expected an initial segment of more than 0 s and less than the {length:g} s of "
            f"the recording, got {seconds:g} s"
        )
    return samples


def with_varying(plant: PlantDescription, patterns: Collection[str]) -> PlantDescription:
    """The plant with further varying constants. Raises ValueError for a pattern that matches none with a tolerance."""
    more = matching("a constant with a tolerance to vary", patterns, plant.tolerances)
    return replace(plant, varying=tuple(dict.fromkeys([*plant.varying, *more])))


def _run(data: DataSet, start_samples: int, skipped: int) -> Prediction:
    plant = data.plant
    early = data.mask.clone()
    early[start_samples:] = False
    if not bool(early.any()):
        source = data.recording.source
        raise ValueError(f"{source}: expected readings among the first {start_samples} samples, got none")
    # The rough noise is a share of the readings' spread, so that a sensor that hardly moves would outweigh all others.
    noise = Noise.rough(data.readings).at_least(sample_noise(data.readings, data.mask.to(data.readings)))
    fitter = Fitter(replace(data, mask=early), noise)
    engine, theta = _start_from_segment(fitter, skipped) if skipped else _start_from_samples(fitter)
    run = engine.converge(theta)
    readings = run.readings[0]
    residuals = torch.where(data.mask, data.readings - readings, 0.0)
    values = dict(zip(engine.space.names, theta[0].tolist(), strict=True))
    return Prediction(
        readings,
        residuals,
        {t.name: values[f"{t.name}.start_level"] for t in plant.tanks},
        {name: values[name] for name in plant.varying},
        rmse_by_sensor(plant, residuals[skipped:], data.mask[skipped:]),
        float(run.defect.max()) < CONVERGED * length_scale(plant),
        float(run.defect.max()),
    )


def rmse_by_sensor(plant: PlantDescription, residuals: Tensor, mask: Tensor) -> dict[str, float]:
    """Root mean square by sensor of the residuals (S, C) in mask (S, C), in the sensor's unit."""
    mean_squares = torch.where(mask, residuals**2, 0.0).sum(dim=0) / mask.sum(dim=0)
    return dict(zip((s.name for s in plant.sensors), mean_squares.sqrt().tolist(), strict=True))


def _start_from_samples(fitter: Fitter) -> tuple[Collocation, Tensor]:
    """The engine, and its parameters (1, P): initial levels and varying constants from the readings that the fitter
    sees."""
    plant = fitter.data.plant
    engine = _engine(fitter, (), [*(f"{t.name}.start_level" for t in plant.tanks), *plant.varying])
    theta = torch.stack([engine.space.vector(start) for start in _starts(plant, fitter.first_levels())])
    ends = fitter.descend(engine, theta)
    best = int(torch.nan_to_num(ends.cost, nan=torch.inf).argmin())
    return engine, ends.theta[best : best + 1]


def _start_from_segment(fitter: Fitter, samples: int) -> tuple[Collocation, Tensor]:
    """The engine and its parameters (1, P) from the first samples as an initial segment with unknown inflows."""
    data = fitter.data
    plant = replace(data.plant, tolerances={n: data.plant.tolerances[n] for n in data.plant.varying})
    first, step = data.recording.stretch(0, samples), float(data.experiment.steps.max())
    segment = data_set_of(plant, data.nominal_effects, first, step)
    state = estimate_initial_state(segment, _starts(plant, fitter.first_levels()), fitter.noise)
    engine = _engine(fitter, state.placements, list(state.values))
    return engine, engine.space.vector(state.values).unsqueeze(0)


def _engine(fitter: Fitter, placements: Sequence[Placement], names: Sequence[str]) -> Collocation:
    network = fitter.network(placements)
    return Collocation(network, ParameterSpace(network.constants[n] for n in names), fitter.data.experiment)


def _starts(plant: PlantDescription, measured: Mapping[str, float]) -> list[dict[str, float]]:
    """Initial values: measured levels, and those of tanks without a sensor, of which all but one are equally full.

    Of u such tanks these are 4 + 12 u starts, or all 4^u combinations of two or fewer.
    """
    full = {f"{t.name}.start_level": t.height for t in plant.tanks if f"{t.name}.start_level" not in measured}
    differing = product(UNMEASURED_STARTS, full, UNMEASURED_STARTS)
    shares = [dict.fromkeys(full, share) | {name: other} for share, name, other in differing] or [{}]
    starts = [{**measured, **{name: s * full[name] for name, s in each.items()}} for each in shares]
    return [start for i, start in enumerate(starts) if start not in starts[:i]]


@dataclass(frozen=True)
class LeftOutRun:
    """A free run along one recording from start to stop (s): root mean square errors by sensor (SI).

    as_is: of the plant file as given. refitted: of the plant fitted to other recordings.
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
    progress: Tell = silent,
    settle: float | None = None,
) -> list[LeftOutRun]:
    """Predict each trial by the plant file as given, and by the plant that `fit` returns for the recordings of
    all other files.

    Files are identified by the hash of their contents. settle: as in `predict`, s. Raises ValueError if no recording
    would be left to fit.
    """
    refitted: dict[str, PlantDescription] = {}
    runs = []
    for k, run in enumerate(trials):
        progress(k / len(trials), run.source)
        if run.sha256 not in refitted:
            others = [r for r in recordings if r.sha256 != run.sha256]
            if not others:
                raise ValueError(f"{run.source}: expected recordings of another file to fit to, got none; give more")
            refitted[run.sha256] = fit(others)
        runs += predicted_beside((plant, refitted[run.sha256]), [run], start_samples, settle=settle)
    return runs


def predicted_beside(
    plants: tuple[PlantDescription, PlantDescription],
    trials: Sequence[Recording],
    start_samples: int,
    progress: Tell = silent,
    settle: float | None = None,
) -> list[LeftOutRun]:
    """Predict each trial by the plant file as given, and by the refitted one; settle: as in `predict`, s."""
    runs = []
    for k, run in enumerate(trials):
        progress(k / len(trials), run.source)
        as_is, refitted = (predict(p, run, start_samples, settle=settle).rmse for p in plants)
        runs.append(LeftOutRun(run.source, float(run.time[0]), float(run.time[-1]), as_is, refitted))
    return runs
