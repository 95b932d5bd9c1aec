"""Work beyond the machine's memory is refused before anything is allocated, with the amount that it would need."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fdi_torch import capacity
from fdi_torch.capacity import expect_room, memory
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.rehearsal_file import load_rehearsal
from fdi_torch.config.run_file import load_run
from fdi_torch.config.study_file import load_study
from fdi_torch.estimate.evolution import EvolutionSettings, evolve
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.windows import cut_up
from fdi_torch.jobs.run_setup import fitting_of, recordings_of, requested_space
from fdi_torch.monitor.stepper import substeps
from fdi_torch.recording import Recording
from fdi_torch.simulate.experiment import grid_nodes
from fdi_torch.simulate.step_control import ADDED_UP, StepControl


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of one megabyte."""
    monkeypatch.setattr(capacity, "memory", lambda: 1_000_000)


def test_what_fits_is_not_refused(small: None) -> None:
    expect_room(125_000, "work", "do less")
    with pytest.raises(ValueError, match=r"fits into the 0.001 GB .* got work, which takes 0.001 GB at least; do less"):
        expect_room(125_001, "work", "do less")
    with pytest.raises(ValueError, match="takes nan GB"):
        expect_room(float("nan"), "work", "do less")


def test_the_memory_there_is_lies_within_that_of_the_machine() -> None:
    lines = Path("/proc/meminfo").read_text().splitlines()
    total = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemTotal"))
    assert 0 < memory() <= total


TIME = torch.tensor([0.0, 1.0, 1e18], dtype=torch.float64)
STILL = torch.zeros(3, 2, dtype=torch.float64)


@pytest.mark.parametrize("step", [1e-12, 1e-300, 1.0])
def test_steps_without_number(step: float) -> None:
    """More than an integer holds, and than a number of double precision holds."""
    with pytest.raises(ValueError, match=r"got \S+ integration steps of \S+ s through 1e\+18 s, which takes \S+ GB"):
        grid_nodes(TIME, STILL, "zero_order", step)


def test_steps_of_an_observer() -> None:
    assert len(substeps(0.0, 1.0, 0.1)) == 10
    with pytest.raises(ValueError, match=r"1e\+12 integration steps of 1e-12 s through 1 s"):
        substeps(0.0, 1.0, 1e-12)


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        (EvolutionSettings(population=10**13, evaluations=10**15), r"a population of 1e\+13"),
        (EvolutionSettings(memory=10**14), r"a memory of 1e\+14"),
        (EvolutionSettings(archive_share=1e12), r"an archive of 3.6e\+13"),
        (EvolutionSettings(archive_share=1e308), "an archive of inf"),
    ],
)
def test_searches_that_no_machine_holds(settings: EvolutionSettings, what: str) -> None:
    def never(candidates: torch.Tensor, lanes: torch.Tensor) -> torch.Tensor:
        raise AssertionError

    low = torch.zeros(2, dtype=torch.float64)
    with pytest.raises(ValueError, match=what):
        evolve(never, low, low + 1.0, settings)


@pytest.mark.parametrize("change", ["duration=1e12 s", "sample_time=1e-12 s", "sample_time=1e-320 s"])
def test_simulations_that_no_machine_holds(change: str) -> None:
    run = load_run(None, [f"simulate.{change}"])
    where = rf"default.yaml with --set simulate.{change}: simulate"
    with pytest.raises(ConfigError, match=rf"{where}: expected work that fits into .* got \S+ samples"):
        recordings_of(run)


@pytest.mark.parametrize("key", ["search", "refine"])
@pytest.mark.parametrize("value", ["0 s", "-1 s"])
def test_a_step_is_positive(key: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"estimate.step.{key}: expected auto or a positive time, got {value}"):
        load_run(None, [f"estimate.step.{key}={value}"])


@pytest.fixture(scope="module")
def fitting() -> Fitting:
    run = load_run(None, ["simulate.duration=100 s"])
    return fitting_of(run, requested_space(run), recordings_of(run))


def test_steps_below_the_rounding_of_levels_are_refused(fitting: Fitting) -> None:
    with pytest.raises(ValueError, match=r"1e\+14 integration steps of 1e-12 s .* above the rounding of levels"):
        fitting.engines(1e-12)
    with pytest.raises(ValueError, match="expected a positive integration step, got 0 s"):
        fitting.engines(0.0)
    plant = load_plant("three_tank")
    shortest = StepControl.for_tolerance(ADDED_UP * 2.0**-52 * 1.001, replace(plant)).resolution
    assert StepControl.for_fixed_step(1.01 * shortest, plant).resolution == pytest.approx(1.01 * shortest)


def test_windows_shorter_than_a_sampling_interval(fitting: Fitting) -> None:
    (recording,) = fitting.recordings
    assert isinstance(recording, Recording) and len(cut_up(recording, 10.0)) == 10
    with pytest.raises(ValueError, match=r"longer than the sampling interval \(1 s\), got 1e-09 s"):
        cut_up(recording, 1e-9)


def test_studies_and_rehearsals_that_no_machine_holds() -> None:
    with pytest.raises(ValueError, match=r"got 1e\+13 trials of each setting"):
        load_study("configs/studies/table3_noise.yaml", ["study.trials=10000000000000"])
    with pytest.raises(ValueError, match=r"got \S+ samples, one every 1e-12 s"):
        load_rehearsal("configs/rehearsals/false_alarms.yaml", ["sampling=1e-12 s", "false_alarms.lasts=1e6 s"])
