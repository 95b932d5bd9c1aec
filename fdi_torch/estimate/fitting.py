"""What is to be fitted: a plant, its recordings and the parameters in question, as problems at any step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.effects import build_network, placements_for
from fdi_torch.estimate.objectives import Objective, Problem, Term
from fdi_torch.parameters import Parameter, ParameterSpace, display_unit
from fdi_torch.plant.description import PlantDescription, Tank
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.inverted_sensor import levels_from_readings
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.engine_choice import adaptive_engine, make_engine
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.step_control import StepControl

StartLevel = Literal["equilibrium", "free"] | float
StartLevels = StartLevel | Mapping[str, StartLevel]
EngineKind = Literal["auto", "reference", "compiled"]

# A start level that is estimated is searched this share of its tank's height about the first readings.
START_SEARCH_SHARE = 0.05
FIRST_READINGS = 5
# An adaptive solver sees inputs that run linearly as their means over so long; in units of the plant's time scale.
LONGEST_STEP = 1.0
# One of a lane's own steps costs about as much as so many of RK4 that all lanes take alike.
OWN_STEP_COST = 16


@dataclass(frozen=True)
class Fitting:
    """One set of parameters common to several recordings, beside the start levels of each.

    space: all that is estimated, common ones first; the start levels of recording k > 0 bear a suffix '@k'.
    networks, own_spaces: the plant of each recording with its nominal start levels, and what is estimated there.
    columns: which columns of theta each recording takes.
    """

    space: ParameterSpace
    recordings: tuple[Recording, ...]
    networks: tuple[TankNetwork, ...]
    own_spaces: tuple[ParameterSpace, ...]
    columns: tuple[Tensor, ...]
    engine: EngineKind = "auto"

    @property
    def plant(self) -> PlantDescription:
        return self.networks[0].description

    @property
    def is_slow(self) -> bool:
        """Whether each operation of each step costs a call from Python, so that steps have to be saved."""
        return self.engine == "reference"

    def beginning(self, samples: int) -> Fitting:
        """The same with the first samples of each recording only."""
        cut = [r.stretch(0, samples) for r in self.recordings]
        return replace(self, recordings=tuple(cut))

    def engines(self, step: float, adaptive: bool = False) -> list[Engine]:
        """An engine for each recording, in steps no longer than `step` s, or by an adaptive solver about as exact."""
        if not step > 0.0:
            raise ValueError(f"expected a positive integration step, got {step:g} s")
        engines = []
        for network, own, recording in zip(self.networks, self.own_spaces, self.recordings, strict=True):
            divides = not adaptive and self._takes_own_steps(recording, network, step)
            longest = LONGEST_STEP * time_scale(self.plant) if adaptive or divides else step
            own_steps = _own_steps(step, recording, self.plant) if divides else None
            experiment = lay_out(recording, self.plant.channels(), longest, own_steps)
            if adaptive:
                engines.append(adaptive_engine(network, own, experiment, step))
            else:
                device = recording.time.device.type
                engines.append(make_engine(network, own, experiment, self.engine, device=device))
        return engines

    def takes_own_steps(self, step: float) -> bool:
        """Whether lanes divide the time between samples by themselves: costs are exact to their tolerance only."""
        return any(
            self._takes_own_steps(recording, network, step)
            for recording, network in zip(self.recordings, self.networks, strict=True)
        )

    def _takes_own_steps(self, recording: Recording, network: TankNetwork, step: float) -> bool:
        """Where they cost less than fixed ones, and inputs are held between samples, so that nothing is lost."""
        steps = float(recording.time[-1] - recording.time[0]) / step
        held = recording.hold == "zero_order" and all(p.effect.stage is not Stage.COMMAND for p in network.placements)
        return held and not self.is_slow and steps > OWN_STEP_COST * len(recording)

    def problem(self, step: float, objective: Objective = "likelihood", adaptive: bool = False) -> Problem:
        """Raises ValueError where the objective is correlation and readings that count stand still."""
        for recording in self.recordings if objective == "correlation" else ():
            _expect_variation(recording, self.plant)
        parts = zip(self.engines(step, adaptive), self.recordings, self.columns, strict=True)
        terms = [Term(engine, readings_of(recording, self.plant), columns) for engine, recording, columns in parts]
        return Problem(self.space, terms, objective)


def _own_steps(step: float, recording: Recording, plant: PlantDescription) -> StepControl:
    try:
        return StepControl.for_fixed_step(step, plant)
    except ValueError as error:
        span = float(recording.time[-1] - recording.time[0])
        raise ValueError(f"{span / step:.3g} integration steps of {step:g} s through {span:g} s: {error}") from error


def set_up(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    parameters: Iterable[str | Parameter],
    start: StartLevels | Sequence[StartLevels] = "free",
    engine: EngineKind = "auto",
) -> Fitting:
    """The fitting of `parameters` ('T1.leak.size', or a Parameter with its own range) to recordings.

    start: 'equilibrium' (the plant file's level, or rest under the first inputs), 'free' (estimated) or a level in m,
    for all tanks or by tank, and for all recordings or one for each.
    Raises ValueError for an unknown parameter or a channel that is not recorded.
    """
    wanted = list(parameters)
    names = [p if isinstance(p, str) else p.name for p in wanted]
    placements = placements_for(names)
    reference = build_network(plant, placements)
    common = [reference.constants[p] if isinstance(p, str) else p for p in wanted]
    networks, own_spaces, columns, joint = [], [], [], list(common)
    starts = start if isinstance(start, Sequence) and not isinstance(start, str) else [start] * len(recordings)
    for k, (recording, chosen) in enumerate(zip(recordings, starts, strict=True)):
        levels, free = start_levels(plant, reference, recording, chosen)
        tanks = tuple(replace(t, start_level=float(h)) for t, h in zip(plant.tanks, levels, strict=True))
        networks.append(build_network(replace(plant, tanks=tanks), placements))
        own_spaces.append(ParameterSpace([*common, *free]))
        columns.append(torch.tensor([*range(len(common)), *range(len(joint), len(joint) + len(free))]))
        joint += [replace(p, name=p.name if k == 0 else f"{p.name}@{k}") for p in free]
    return Fitting(ParameterSpace(joint), tuple(recordings), tuple(networks), tuple(own_spaces), tuple(columns), engine)


def start_levels(
    plant: PlantDescription, network: TankNetwork, recording: Recording, wanted: StartLevels
) -> tuple[Tensor, list[Parameter]]:
    """Start levels (tanks,) in m, and those of them that are to be estimated, with the range to search."""
    by_tank = wanted if isinstance(wanted, Mapping) else {tank.name: wanted for tank in plant.tanks}
    unknown = set(by_tank) - {tank.name for tank in plant.tanks}
    if unknown:
        raise ValueError(f"start levels: expected tanks of plant {plant.name}, got {', '.join(sorted(unknown))}")
    rest = shown = None
    levels, free = [], []
    for i, tank in enumerate(plant.tanks):
        choice = by_tank.get(tank.name, "free")
        if choice == "free":
            shown = shown or levels_shown_first(plant, network, recording)
            parameter = _free_start(tank, shown[i])
            levels.append(parameter.nominal)
            free.append(parameter)
        elif choice == "equilibrium" and tank.start_level is None:
            if rest is None:
                rest = equilibrium(network, _first_inputs(plant, recording))
            levels.append(float(rest[i]))
        else:
            levels.append(float(tank.start_level or 0.0) if isinstance(choice, str) else choice)
    return torch.tensor(levels, dtype=torch.float64), free


def _first_inputs(plant: PlantDescription, recording: Recording) -> Tensor:
    columns = [recording.input_names.index(c) for c in plant.channels() if c in recording.input_names]
    return recording.inputs[0, columns]


def _free_start(tank: Tank, shown: float | None) -> Parameter:
    """shown: the level (m) that the first readings show; None where no sensor sees the tank."""
    level = min(max(0.5 * tank.height if shown is None else shown, 0.0), tank.height)
    reach = tank.height if shown is None else START_SEARCH_SHARE * tank.height
    low, high = max(0.0, level - reach), min(tank.height, level + reach)
    return Parameter(f"{tank.name}.start_level", "m", level, low, high, meaning=f"level of {tank.name} at t = 0")


def levels_shown_first(plant: PlantDescription, network: TankNetwork, recording: Recording) -> list[float | None]:
    """The level of each tank that the first few readings of its sensor show, m; None where no sensor sees it."""
    readings, seen = [], set()
    for sensor in plant.sensors:
        valid = recording.outputs[:0, 0]
        if sensor.column in recording.output_names:
            column = recording.output_names.index(sensor.column)
            valid = recording.outputs[:, column][recording.mask[:, column]][:FIRST_READINGS]
        seen |= {sensor.tank} if len(valid) else set()
        readings.append(valid.median() if len(valid) else network.nominal.new_tensor(torch.nan))
    values = network.bind(ParameterSpace(), network.nominal.new_zeros(0))
    levels = levels_from_readings(
        network, readings, network.start_levels(values), network.nominal.new_zeros(()), values
    )
    return [float(h) if tank.name in seen else None for tank, h in zip(plant.tanks, levels, strict=True)]


def _expect_variation(recording: Recording, plant: PlantDescription) -> None:
    for sensor in (s for s in plant.sensors if s.column in recording.output_names):
        column = recording.output_names.index(sensor.column)
        seen = recording.outputs[recording.mask[:, column], column]
        if len(seen) and bool((seen == seen[0]).all()):
            unit, scale = display_unit(sensor.unit)
            value = f"{scale * float(seen[0]):g} {unit}"
            raise ValueError(
                f"{recording.source}: {sensor.column}: expected readings that vary, got {value} "
                "throughout, whose correlation is undefined; set estimate.objective.search to likelihood, or leave "
                f"the sensor out: columns: {{{sensor.column}: {{recorded: false}}}}"
            )


def readings_of(recording: Recording, plant: PlantDescription) -> Readings:
    """The recording's outputs in the order of the plant's sensors, with weight 0 where masked."""
    columns = []
    for sensor in plant.sensors:
        if sensor.column not in recording.output_names:
            known = ", ".join(recording.output_names) or "none"
            raise ValueError(f"{recording.source}: expected readings of sensor '{sensor.column}', got {known}")
        columns.append(recording.output_names.index(sensor.column))
    mask = recording.mask[:, columns]
    values = torch.where(mask, recording.outputs[:, columns], torch.zeros_like(recording.outputs[:, columns]))
    return Readings(values, mask.to(values.dtype))
