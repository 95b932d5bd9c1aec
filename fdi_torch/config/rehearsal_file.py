"""Rehearsal files: a simulated plant with noise, and the Monte Carlo validations of the monitor to run on it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BeforeValidator, Field

from fdi_torch.config.monitor_file import WindowConfig
from fdi_torch.config.resolved_config import JobConfig, ResolvedFile, resolve, values_in
from fdi_torch.config.simulation import expect_room_for_samples, reading_noise
from fdi_torch.config.strict import ScaledSeconds, Share, Strict, quantity
from fdi_torch.effects import build_network, full_name, placements_for
from fdi_torch.monitor.monitor_setup import with_shapes
from fdi_torch.monitor.monte_carlo.detection_plan import DetectionPlan, FalseAlarmPlan
from fdi_torch.monitor.monte_carlo.isolation_plan import IsolationPlan
from fdi_torch.monitor.monte_carlo.simulated_runs import SimulatedRig, moving_commands, moving_set_points
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import parse_quantity
from fdi_torch.simulate.equilibrium import equilibrium

Metres = Annotated[float, BeforeValidator(lambda value: quantity(value, "m"))]


class NoiseConfig(Strict):
    correlation: float = Field(0.0, ge=0, lt=1, description="of the measurement noise with its last sample, AR(1)")
    wander: Metres = Field(0.0, ge=0, description="standard deviation of the levels' random walk per sample")


class FalseAlarmConfig(Strict):
    noises: dict[str, NoiseConfig] = Field(min_length=1, description="each by a name")
    runs: int = Field(500, ge=1, description="number of fault-free runs")
    lasts: ScaledSeconds = Field(3600.0, gt=0, description="duration of each run, and of runs for noise estimation, s")
    calibrations: int = Field(8, ge=1, description="number of runs from which the noise is estimated")


class _FaultyRuns(Strict):
    faults: list[str] = Field(min_length=1, description="faults, one per run; under naming, abrupt and incipient")
    onset: ScaledSeconds = Field(300.0, description="onset of the fault, s")
    lasts: ScaledSeconds = Field(900.0, description="duration of each run, s")
    window: WindowConfig = Field(default_factory=WindowConfig)


class FaultsFoundConfig(_FaultyRuns):
    sizes: list[Share] = Field([0.02, 0.05, 0.1, 0.2], min_length=1, description="shares of the fault's range")
    runs: int = Field(500, ge=1, description="number of runs of each size")
    named: int = Field(100, ge=0, description="number of these runs in which the monitor also isolates the fault")


class NamingConfig(_FaultyRuns):
    loops: list[Literal["closed", "open"]] = Field(["closed", "open"], description="level control, or commands alone")
    swing: Metres = Field(0.03, description="change of the set points each minute")
    share: Share = Field(0.5, description="relative change of the commands each minute")
    runs: int = Field(200, ge=1, description="number of runs of each loop")
    times: float = Field(3.0, gt=0, description="size of the faults as a multiple of the smallest isolable size")


class RehearsalConfig(JobConfig):
    inputs: list[str | float] = Field(
        description="list of constant commands, one per channel of the plant, in its order"
    )
    reading_noise: str = Field("1 mm", description="standard deviation: 1 mm (of the level), or h1 = 1 mm, p2 = 2 mV")
    sampling: ScaledSeconds = Field(1.0, gt=0, description="sampling interval, s")
    false_alarms_every: ScaledSeconds = Field(20000.0, description="design mean time between false alarms, s")
    detector: Literal["fixed", "cusum"] = Field("cusum", description="detector that raises alarms under naming")
    false_alarms: FalseAlarmConfig | None = Field(None, description="measure the false alarm rate")
    faults_found: FaultsFoundConfig | None = Field(None, description="measure detection delay, power and isolation")
    naming: NamingConfig | None = Field(None, description="measure isolation of component, sensor and actuator faults")


Plan = FalseAlarmPlan | DetectionPlan | IsolationPlan


@dataclass(frozen=True)
class Rehearsal(ResolvedFile[RehearsalConfig]):
    """A resolved rehearsal file. plans: the validations to run."""

    plans: tuple[Plan, ...]


def load_rehearsal(path: str | Path, overrides: Iterable[str] = ()) -> Rehearsal:
    """A rehearsal file with overrides. Raises ConfigError with one sentence per problem."""
    data, base, source = values_in(path, overrides, "rehearsal")
    config, plant, text = resolve(RehearsalConfig, data, base, source)
    plans = tuple(_plans(config, plant))
    if not plans:
        raise ValueError(f"{source}: expected false_alarms, faults_found or naming, got none of them; add one")
    return Rehearsal(config, plant, base, source, text, plans)


def _plans(c: RehearsalConfig, plant: PlantDescription) -> Iterable[Plan]:
    every = c.false_alarms_every

    def count(seconds: float) -> int:
        expect_room_for_samples(seconds, c.sampling)
        return int(seconds / c.sampling) + 1

    if (f := c.false_alarms) is not None:
        rigs = {name: _rig(c, plant, (), noise) for name, noise in f.noises.items()}
        yield FalseAlarmPlan(rigs, f.runs, count(f.lasts), f.calibrations, every, c.seed)
    if (d := c.faults_found) is not None:
        rig, settings = _rig(c, plant, d.faults), d.window.settings()
        yield DetectionPlan(
            rig, settings, d.runs, d.named, count(d.lasts), tuple(d.sizes), d.onset, every, c.seed
        )  # fmt: skip
    if (n := c.naming) is not None:
        for loop in n.loops:
            rig, settings = _rig(c, plant, n.faults, None, loop), n.window.settings()
            yield IsolationPlan(
                rig, loop, c.detector, settings, n.runs, count(n.lasts), n.onset, n.times, every, c.seed
            )  # fmt: skip


def _inputs(c: RehearsalConfig, plant: PlantDescription) -> torch.Tensor:
    units = plant.channel_units()
    if len(c.inputs) != len(units):
        raise ValueError(f"inputs: expected {len(units)} ({', '.join(units)}), got {len(c.inputs)}")
    amounts = [parse_quantity(str(text), unit) for text, unit in zip(c.inputs, units.values(), strict=True)]
    return torch.tensor(amounts, dtype=torch.float64)


def _rig(
    c: RehearsalConfig,
    plant: PlantDescription,
    faults: Iterable[str],
    noise: NoiseConfig | None = None,
    loop: str | None = None,
) -> SimulatedRig:
    names = with_shapes([full_name(name, plant) for name in faults], plant)
    network, inputs, noise = build_network(plant, placements_for(names)), _inputs(c, plant), noise or NoiseConfig()
    space = ParameterSpace(network.constants[name] for name in names)
    levels = equilibrium(network, inputs)
    std = torch.tensor(reading_noise(c.reading_noise, plant), dtype=torch.float64)
    controller = None
    if loop == "open":
        controller = moving_commands(plant, inputs, c.naming.share if c.naming else 0.0)
    elif loop == "closed":
        controller = moving_set_points(plant, inputs, levels, c.naming.swing if c.naming else 0.0)
    return SimulatedRig(network, space, inputs, levels, std, c.sampling, noise.wander, noise.correlation, controller)
