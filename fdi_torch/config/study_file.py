"""Study files: a run file (often by `extends`) with a block `study` on what to vary and how often."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field

from fdi_torch.capacity import expect_room
from fdi_torch.config.estimation import estimated_space, parameter_values, placements_of
from fdi_torch.config.key_reference import meanings
from fdi_torch.config.problems import ConfigError, Source, validated
from fdi_torch.config.resolved_config import values_in
from fdi_torch.config.run_file import Run, RunConfig, build_run
from fdi_torch.config.simulation import planned_recording
from fdi_torch.config.strict import Decibel, ScaledSeconds, ScaledSteps, Share, Strict, scaled_to_plant
from fdi_torch.config.yaml_files import write_yaml
from fdi_torch.device import tensors_on, usable_device
from fdi_torch.effects import build_network
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.estimate.levenberg_marquardt import RefineSettings
from fdi_torch.names import unknown
from fdi_torch.plant.operating_range import bounded_by_recording
from fdi_torch.plant.scales import time_scale
from fdi_torch.study.estimators import ESTIMATORS, Estimator
from fdi_torch.study.study_plan import Method, Plan, Setting, fault_modes, fixed_faults, mode_faults, uniform_faults
from fdi_torch.untrusted_input import MOST_SETTINGS, MOST_TRIALS


class StudyConfig(Strict):
    faults: Literal["simulated", "uniform", "modes"] = Field(
        "simulated", description="those of simulate, uniformly distributed ones, or every subset of the parameters"
    )
    smallest: Share = Field(0.1, ge=0, lt=1, description="under modes: smallest size of a fault relative to its range")
    snr_db: list[Decibel | None] = Field([None], min_length=1, description="signal-to-noise ratios, dB; null: no noise")
    trials: int = Field(1000, ge=1, description="number of trials per setting")
    block: int = Field(100, ge=1, description="number of trials computed at once")
    estimators: list[Estimator] = Field(
        list(ESTIMATORS), min_length=1, description="estimators to compare; free and boxed are hybrid searches"
    )
    starts: int = Field(2, ge=1, description="number of members of the search that are refined")
    searches: int = Field(3, ge=1, description="maximum number of searches, for trials with residuals above the noise")
    search_step: ScaledSeconds = Field(5.0, gt=0, description="integration step of the search, s")
    search_every: int = Field(5, ge=1, description="decimation of the readings in the search")
    steps: ScaledSteps = Field(
        [1.0, 0.1], min_length=1, description="integration steps of the refinement, coarse to fine, s"
    )
    data_step: ScaledSeconds = Field(0.01, gt=0, description="integration step of the noise-free readings, s")
    population: int = Field(40, ge=4, description="population of the search")
    evaluations: int = Field(2000, ge=4, description="cost evaluations of each search")
    tolerance: float = Field(
        1e-5, gt=0, description="without noise: smallest error, relative to the range, that counts as a failure"
    )


class StudyFile(RunConfig):
    """A run file with a block `study`."""

    study: StudyConfig = Field(description="what to vary, and how often")


@dataclass(frozen=True)
class Study:
    """A resolved study file. text: YAML of the same study, including the plant."""

    config: StudyConfig
    run: Run
    plan: Plan
    text: str


def load_study(path: str | Path, overrides: list[str] | None = None) -> Study:
    """A study file with overrides. Raises ConfigError with one sentence per problem."""
    return build_study(*values_in(path, overrides or (), "study"))


def build_study(data: Mapping[str, Any], base: Path, source: Source) -> Study:
    """A study from the mapping of a study file; base: folder of relative paths."""
    if "study" not in data:
        raise ConfigError([f"{source}: expected a block study, got none; fdi train estimates a single run"])
    block = data["study"]
    run = build_run({key: value for key, value in data.items() if key != "study"}, base, source)
    config = validated(StudyConfig, block, source, meanings(StudyFile), within=("study",))
    config = scaled_to_plant(config, time_scale(run.plant))
    text = run.text + write_yaml({"study": block})
    return Study(config, run, _plan(config, run), text)


def _plan(config: StudyConfig, run: Run) -> Plan:
    fitting = _fitting(run)
    as_configured = ("search_step", "search_every", "starts", "searches", "data_step")
    method = Method(
        estimators=tuple(config.estimators),
        objective=run.config.estimate.objective.search,
        search=EvolutionSettings(population=config.population, evaluations=config.evaluations),
        steps=tuple(config.steps),
        refine=RefineSettings(iterations=run.config.estimate.refine.iterations),
        **{name: getattr(config, name) for name in as_configured},
    )
    definition = run.config.simulate.noise.definition if run.config.simulate else "variance"
    with tensors_on(fitting.device):
        settings = tuple(_settings(config, run, fitting))
    return Plan(fitting, settings, method, run.config.seed, definition, config.block)


def _fitting(run: Run) -> Fitting:
    """Plant, clock, inputs, known start levels and parameters; the readings are complete and zero."""
    simulated, estimate = run.config.simulate, run.config.estimate
    if simulated is None:
        raise ConfigError([f"{run.source}: expected simulate, got recordings; a study makes its own readings"])
    if not estimate.parameters:
        raise ConfigError([f"{run.source.at('estimate.parameters')}: expected at least one, got none"])
    network = build_network(run.plant, placements_of([p.name for p in estimate.parameters], run.plant))
    space = estimated_space(estimate, network.constants, run.plant, real_data=False)
    space = bounded_by_recording(space, simulated.duration)
    unbounded = [p.name for p in space if not (abs(p.low) < torch.inf and abs(p.high) < torch.inf)]
    if unbounded:
        raise ConfigError(
            [f"{run.source}: {unbounded[0]}: expected a finite range to search, got none; give low, high"]
        )
    planned = planned_recording(simulated, run.plant)
    zeros = torch.zeros_like(planned.outputs)
    planned = replace(planned, outputs=zeros, mask=torch.ones_like(planned.mask))
    planned = planned.to(usable_device(run.config.device))
    return set_up(run.plant, [planned], space, [simulated.start_levels], run.config.engine)


def _settings(config: StudyConfig, run: Run, fitting: Fitting) -> list[Setting]:
    """All combinations of signal-to-noise ratio and kind of fault."""
    space, created = fitting.space, []
    numbers = float(config.trials) * len(config.snr_db) * len(space)
    expect_room(numbers, f"{config.trials:.3g} trials of each setting", "lower study.trials")
    settings = float(len(config.snr_db)) * (2 ** len(space) - 1 if config.faults == "modes" else 1)
    if not settings <= MOST_SETTINGS or not settings * config.trials <= MOST_TRIALS:
        most = f"{MOST_SETTINGS} settings and {MOST_TRIALS} trials in all"
        got = f"{settings:.4g} settings of {config.trials} trials; take fewer of these, or split the study"
        raise ConfigError([f"{run.source.at('study')}: expected at most {most}, got {got}"])
    longest = run.config.simulate.duration if run.config.simulate else 0.0
    too_long = [step for step in (config.search_step, config.data_step, *config.steps) if step > longest]
    if too_long:
        raise ConfigError(
            [f"{run.source.at('study')}: expected steps within the {longest:g} s simulated, got {too_long[0]:g} s"]
        )
    for snr in config.snr_db:
        noise = "no noise" if snr is None else f"SNR {snr:g} dB"
        if config.faults == "simulated":
            created.append(Setting(noise, fixed_faults(_simulated(run, fitting), config.trials), snr))
        elif config.faults == "uniform":
            faults = uniform_faults(space, config.trials, run.config.seed, len(created))
            created.append(Setting(f"uniform faults, {noise}", faults, snr))
        else:
            for mode in fault_modes(space):
                name = " + ".join(space.names[i].removesuffix(".size") for i in mode)
                faults = mode_faults(space, mode, config.smallest, config.trials, run.config.seed, len(created))
                created.append(Setting(f"{name}, {noise}", faults, snr))
    return created


def _simulated(run: Run, fitting: Fitting) -> torch.Tensor:
    assert run.config.simulate is not None
    faults = run.config.simulate.faults
    network = build_network(run.plant, placements_of(faults, run.plant))
    values = parameter_values(faults, network.constants, run.plant)
    for name in values:
        if name not in fitting.space:
            sentence = unknown("an estimated parameter", name, fitting.space.names)
            raise ConfigError([f"{run.source.at('simulate.faults')}: {sentence}; estimate it too"])
    return fitting.space.vector(values)
