"""A fitting problem: a plant, its recordings and the parameters to estimate, for any integration step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.device import on_its_device, tensors_on
from fdi_torch.effects import build_network, full_name, placements_for, unknown_parameter
from fdi_torch.estimate.objectives import Objective, Problem, Term
from fdi_torch.names import counted
from fdi_torch.parameters import Parameter, ParameterSpace, name_in_recording
from fdi_torch.plant.description import PlantDescription, Tank
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.inverted_sensor import levels_from_readings
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.simulate.build import can_compile
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.engine_choice import adaptive_engine, make_engine
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import Experiment, expect_step, lay_out
from fdi_torch.simulate.resampling import step_means
from fdi_torch.simulate.step_control import StepControl
from fdi_torch.simulate.step_length import commensurate_step

StartLevel = Literal["equilibrium", "free"] | float
StartLevels = StartLevel | Mapping[str, StartLevel]
EngineKind = Literal["auto", "reference", "compiled", "traced"]

# An estimated initial level is searched within this fraction of the tank's height on either side of the level that the
# first readings show (their median).
START_SEARCH_SHARE = 0.05
FIRST_READINGS = 5
# An adaptive solver receives linearly interpolated inputs as means over intervals of about this length, in units of the
# plant's time scale.
INPUT_STEP = 1.0
# Cost of one step with individual step control per lane, in units of a fixed RK4 step common to all lanes.
OWN_STEP_COST = 16


@dataclass(frozen=True)
class Fitting:
    """Parameters common to several recordings, together with the initial levels of each recording.

    space: all estimated parameters, the common ones first; initial levels of recording k > 0 have the suffix '@k'.
    networks: the plant with the nominal initial levels of each recording.
    own_spaces: the parameters of each recording, i.e. the common ones and its own initial levels.
    columns: the columns of theta that hold these, for each recording.
    """

    space: ParameterSpace
    recordings: tuple[Recording, ...]
    networks: tuple[TankNetwork, ...]
    own_spaces: tuple[ParameterSpace, ...]
    columns: tuple[Tensor, ...]
    engine: EngineKind = "auto"

    def __repr__(self) -> str:
        recordings = counted(len(self.recordings), "recording")
        return f"Fitting of {self.plant.name} to {recordings}; the columns of theta are\n{self.space}"

    @property
    def plant(self) -> PlantDescription:
        return self.networks[0].description

    @property
    def device(self) -> torch.device:
        """The device on which the problem is computed, that of its recordings."""
        return self.recordings[0].time.device

    @property
    def is_slow(self) -> bool:
        """Whether the engine evaluates every integration step in Python, so that steps are expensive."""
        return self.engine == "reference"

    def beginning(self, k: int, samples: int) -> Fitting:
        """The problem of the first `samples` samples of recording k alone; `space` remains that of all recordings."""
        recordings = (self.recordings[k].stretch(0, samples),)
        own = (self.networks[k],), (self.own_spaces[k],), (self.columns[k],)
        return replace(self, recordings=recordings, networks=own[0], own_spaces=own[1], columns=own[2])

    @on_its_device
    def engines(self, step: float) -> list[Engine]:
        """A simulation engine for each recording, with its samples, in equal steps of at most `step` s between samples.

        Each engine's repr says its step: a sampling interval of 10 s makes 5 s of 7 s. A step longer than that interval
        ends where inputs switch, and the readings within it are interpolated.
        Raises ValueError if step <= 0.
        """
        numbers = range(len(self.recordings))
        return [self._engine(k, self._experiment(k, step, False), step, False) for k in numbers]

    def _experiment(self, k: int, step: float, adaptive: bool) -> Experiment:
        """Recording k on the grid of its simulation."""
        expect_step(step)
        recording = self.recordings[k]
        uses_own_steps = not adaptive and self._takes_own_steps(k, step)
        input_step = commensurate_step(INPUT_STEP * time_scale(self.plant), recording.interval)
        longest = input_step if adaptive or uses_own_steps else step
        step_control = _step_control(step, recording, self.plant) if uses_own_steps else None
        return lay_out(recording, self.plant.channels(), longest, step_control)

    def _engine(self, k: int, experiment: Experiment, step: float, adaptive: bool) -> Engine:
        network, space = self.networks[k], self.own_spaces[k]
        if adaptive:
            return adaptive_engine(network, space, experiment, step)
        return make_engine(network, space, experiment, self.engine, device=experiment.nodes.device.type)

    def takes_own_steps(self, step: float) -> bool:
        """Whether the step length is controlled separately for each lane in at least one recording.

        The cost is then exact only up to the tolerance of the step control.
        """
        return any(self._takes_own_steps(k, step) for k in range(len(self.recordings)))

    def _takes_own_steps(self, k: int, step: float) -> bool:
        """True if the inputs are constant between samples, and the compiled engine's control of each lane's steps is
        cheaper than fixed steps."""
        recording = self.recordings[k]
        steps = float(recording.time[-1] - recording.time[0]) / step
        acts_on_commands = any(p.effect.stage is Stage.COMMAND for p in self.networks[k].placements)
        inputs_constant = recording.hold == "zero_order" and not acts_on_commands
        is_cheaper = inputs_constant and steps > OWN_STEP_COST * len(recording)
        return is_cheaper and self.engine in ("auto", "compiled") and self.device.type == "cpu" and can_compile()

    @on_its_device
    def problem(
        self, step: float, objective: Objective = "likelihood", adaptive: bool = False, averaged: bool = True
    ) -> Problem:
        """The estimation problem with integration steps of at most `step` s.

        averaged: readings of one fixed step are replaced by their mean, see `simulate.resampling`. Raises ValueError if
        the objective is 'correlation' and a channel's readings are constant.
        """
        terms = []
        for k, recording in enumerate(self.recordings):
            if objective == "correlation":
                _expect_variation(recording, self.plant)
            experiment, data = self._experiment(k, step, adaptive), readings_of(recording, self.plant)
            if averaged and not adaptive:
                experiment, means, counts = step_means(experiment, data.values, data.weight > 0)
                data = Readings(means, counts)
            terms.append(Term(self._engine(k, experiment, step, adaptive), data, self.columns[k]))
        return Problem(self.space, terms, objective)


def _step_control(step: float, recording: Recording, plant: PlantDescription) -> StepControl:
    """Step control about as accurate as fixed steps of `step` s. Raises ValueError if that accuracy is out of range."""
    try:
        return StepControl.for_fixed_step(step, plant)
    except ValueError as error:
        span = float(recording.time[-1] - recording.time[0])
        raise ValueError(f"{span / step:.3g} integration steps of {step:g} s through {span:g} s: {error}") from None


def set_up(
    plant: PlantDescription,
    recordings: Recording | Sequence[Recording],
    parameters: Iterable[str | Parameter],
    start: StartLevels | Sequence[StartLevels] = "free",
    engine: EngineKind = "auto",
) -> Fitting:
    """Set up the fit of `parameters` ('T1.leak', 'T1.leak.size', or a Parameter with its own range) to one or several
    recordings.

    plant, recordings: `fdi_torch.set_up` also takes their names, as `gap` does. A recording in memory is taken as it
    is; one from a file is split into segments with known inputs.
    start: initial levels, one choice for all tanks or a mapping by tank, for all recordings or a sequence with one
    entry per recording. A choice is 'equilibrium' (the level of the plant file, else the equilibrium under the first
    inputs), 'free' (estimated) or a level in m. The fit is computed on the device of the recordings.
    Raises ValueError for an unknown parameter or choice, and for a channel that is not recorded.
    """
    recordings = [recordings] if isinstance(recordings, Recording) else recordings
    requested = [full_name(p, plant) if isinstance(p, str) else p for p in parameters]
    names = [p if isinstance(p, str) else p.name for p in requested]
    with tensors_on(recordings[0].time.device):
        placements = placements_for(names)
        reference = build_network(plant, placements)
        for p in requested:
            if isinstance(p, str) and p not in reference.constants:
                raise ValueError(f"parameters: {unknown_parameter(p, reference.constants, plant)}")
        common = [reference.constants[p] if isinstance(p, str) else p for p in requested]
        networks, own_spaces, columns, joint = [], [], [], list(common)
        starts = start if isinstance(start, Sequence) and not isinstance(start, str) else [start] * len(recordings)
        for k, (recording, recording_start) in enumerate(zip(recordings, starts, strict=True)):
            levels, free = start_levels(plant, reference, recording, recording_start)
            if twice := [p.name for p in free if p.name in names]:
                raise ValueError(
                    f"{twice[0]}: expected no initial level among the parameters, as it is estimated anyway"
                )
            tanks = tuple(replace(t, start_level=float(h)) for t, h in zip(plant.tanks, levels, strict=True))
            networks.append(build_network(replace(plant, tanks=tanks), placements))
            own_spaces.append(ParameterSpace([*common, *free]))
            columns.append(torch.tensor([*range(len(common)), *range(len(joint), len(joint) + len(free))]))
            joint += [replace(p, name=name_in_recording(p.name, k)) for p in free]
        return Fitting(
            ParameterSpace(joint), tuple(recordings), tuple(networks), tuple(own_spaces), tuple(columns), engine
        )


def start_levels(
    plant: PlantDescription, network: TankNetwork, recording: Recording, start: StartLevels
) -> tuple[Tensor, list[Parameter]]:
    """Initial levels (tanks,) in m, and parameters with search ranges for those that are estimated.

    start: 'equilibrium', 'free' or a level in m, see `set_up`. A tank that a mapping omits is 'free'. Raises ValueError
    for an unknown tank, and for a level below the floor or above the rim.
    """
    by_tank = start if isinstance(start, Mapping) else {tank.name: start for tank in plant.tanks}
    unknown = set(by_tank) - {tank.name for tank in plant.tanks}
    if unknown:
        raise ValueError(f"start levels: expected tanks of {plant.title}, got {', '.join(sorted(unknown))}")
    rest_levels = first_levels = None
    levels, free = [], []
    for i, tank in enumerate(plant.tanks):
        choice = by_tank.get(tank.name, "free")
        if isinstance(choice, str) and choice not in ("equilibrium", "free"):
            raise ValueError(f"start level of {tank.name}: expected equilibrium, free or a level in m, got '{choice}'")
        if choice == "free":
            first_levels = first_levels or levels_shown_first(plant, network, recording)
            parameter = _free_start(tank, first_levels[i])
            levels.append(parameter.nominal)
            free.append(parameter)
        elif choice == "equilibrium" and tank.start_level is None:
            if rest_levels is None:
                rest_levels = equilibrium(network, _first_inputs(plant, recording))
            levels.append(float(rest_levels[i]))
        else:
            level = float(tank.start_level or 0.0) if isinstance(choice, str) else choice
            tank.check_level(level, f"start level of {tank.name}")
            levels.append(level)
    return torch.tensor(levels, dtype=torch.float64), free


def _first_inputs(plant: PlantDescription, recording: Recording) -> Tensor:
    columns = [recording.input_names.index(c) for c in plant.channels() if c in recording.input_names]
    return recording.inputs[0, columns]


def _free_start(tank: Tank, observed: float | None) -> Parameter:
    """Parameter of an initial level. observed: level (m) in the first readings; None for a tank without readings."""
    level = min(max(0.5 * tank.height if observed is None else observed, 0.0), tank.height)
    half_range = tank.height if observed is None else START_SEARCH_SHARE * tank.height
    low, high = max(0.0, level - half_range), min(tank.height, level + half_range)
    return Parameter(f"{tank.name}.start_level", "m", level, low, high, meaning=f"level of {tank.name} at t = 0")


def levels_shown_first(plant: PlantDescription, network: TankNetwork, recording: Recording) -> list[float | None]:
    """Level of each tank, m, from the median of its sensor's first readings; None for a tank without readings."""
    readings, observed_tanks = [], set()
    for sensor in plant.sensors:
        valid = recording.valid_readings(sensor.column)[:FIRST_READINGS]
        observed_tanks |= {sensor.tank} if len(valid) else set()
        readings.append(valid.median() if len(valid) else network.nominal.new_tensor(torch.nan))
    values = network.bind(ParameterSpace(), network.nominal.new_zeros(0))
    levels = levels_from_readings(
        network, readings, network.start_levels(values), network.nominal.new_zeros(()), values
    )
    return [float(h) if tank.name in observed_tanks else None for tank, h in zip(plant.tanks, levels, strict=True)]


def _expect_variation(recording: Recording, plant: PlantDescription) -> None:
    """Raise ValueError if a sensor has no valid readings, or constant ones: their correlation is undefined."""
    for sensor in plant.sensors:
        readings = recording.valid_readings(sensor.column)
        without = f"leave the sensor out: columns: {{{sensor.column}: {{recorded: false}}}}"
        if not len(readings):
            raise ValueError(f"{recording.source}: {sensor.column}: expected valid readings, got none; {without}")
        if bool((readings == readings[0]).all()):
            value = quantity_text(float(readings[0]), sensor.unit, 6, sensor.column)
            raise ValueError(
                f"{recording.source}: {sensor.column}: expected readings that vary, got {value} "
                f"throughout, whose correlation is undefined; set estimate.objective.search to likelihood, or {without}"
            )


def readings_of(recording: Recording, plant: PlantDescription) -> Readings:
    """The recording's outputs in the order of the plant's sensors, with weight 0 where masked.

    Raises ValueError if a sensor's column is missing.
    """
    columns = recording.output_columns(plant.outputs())
    mask = recording.mask[:, columns]
    values = torch.where(mask, recording.outputs[:, columns], torch.zeros_like(recording.outputs[:, columns]))
    return Readings(values, mask.to(values.dtype))
