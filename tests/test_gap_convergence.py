"""Fits end at a minimum from any start, and report if they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fdi_torch.cli import DONE, main
from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import effect
from fdi_torch.estimate.fitting import set_up
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter, standard_errors
from fdi_torch.gap.diagnose import recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.marginal_likelihood import log_evidence
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording
from tests.rigs import blank_recording, random_steps

RIG = """
plant: three_tank
simulate:
  inputs:
    Q1: {steps: [[0 s, 50 cm^3/s], [300 s, 75 cm^3/s], [700 s, 35 cm^3/s]]}
    Q2: {steps: [[0 s, 50 cm^3/s], [500 s, 25 cm^3/s], [900 s, 60 cm^3/s]]}
  duration: 1200 s
  faults: {T1.leak: 0.1, P32.plugging: 0.4}
  noise: {std: {h1: 1 mm, h2: 1 mm, h3: 1 mm}}
output: {name: rig}
"""
THREE_TANK = load_plant("three_tank")
PLUGGING = Placement(effect("plugging"), "P32")
SIZE = "P32.plugging.size"


def recalibrated(plant: PlantDescription, recording: Recording) -> tuple[Fitter, Fit]:
    fitter, null, _ = recalibrate(problem_of(plant, [recording], [], DEFAULT_SETTINGS).data)
    return fitter, null


def recorded(
    plant: PlantDescription, blank: Recording, values: dict[str, float], seed: int, noise: float = 1e-3
) -> Recording:
    """What sensors read, by another engine than the fits'. values: constants by name, SI. noise: of the levels, m."""
    fitting = set_up(plant, [blank], list(values), start="equilibrium")
    theta = fitting.space.vector(values)
    readings = fitting.engines(step=0.25)[0].readings(theta.unsqueeze(0))[0]
    scatter = noise * torch.randn(readings.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return replace(blank, outputs=readings + scatter, mask=None)  # type: ignore[arg-type]


def plugging_fits(fitter: Fitter, null: Fit, sizes: list[float]) -> list[Fit]:
    """A fit of each start."""
    return [fitter.fit(Candidate((PLUGGING,), ({SIZE: size},)), null) for size in sizes]


def test_plugging_and_leak_are_estimated_within_two_standard_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rig.yaml").write_text(RIG)
    assert main(["simulate", "--config", "rig.yaml", "--out", ".", "--quiet"]) == DONE
    fitter, null = recalibrated(THREE_TANK, named_recordings("rig.csv", THREE_TANK, Path())[0])
    leak = Placement(effect("leak"), "T1")
    fit = fitter.fit(Candidate((leak, PLUGGING), ({"T1.leak.size": 0.1, SIZE: 0.1},)), null)
    error = standard_errors(fitter, fit)[SIZE]
    assert fit.converged
    assert abs(fit.values[SIZE] - 0.4) < 2.0 * error < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("number", range(12))
def test_a_plugged_pipe_ends_at_the_best_of_several_starts(number: int) -> None:
    truth = 0.15 + 0.35 * number / 11
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 1200.0, seed=number), {SIZE: truth}, seed=number)
    fitter, null = recalibrated(THREE_TANK, recording)
    fit, *others = plugging_fits(fitter, null, [0.1, -0.1, 0.3, 0.6, truth])
    assert fit.converged
    assert fit.cost < min(other.cost for other in others) + 0.5


def test_a_fit_without_enough_evaluations_has_not_converged() -> None:
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {SIZE: 0.4}, seed=0)
    fitter, null = recalibrated(THREE_TANK, recording)
    candidate = Candidate((PLUGGING,), ({SIZE: 0.1},))
    cut, whole = fitter.fit(candidate, null, cap=2), fitter.fit(candidate, null)
    assert not cut.converged and cut.cost > whole.cost + 1.0
    assert whole.converged


def test_a_start_that_is_given_up_has_not_converged() -> None:
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {SIZE: 0.4}, seed=0)
    fitter, null = recalibrated(THREE_TANK, recording)
    elsewhere = Candidate((Placement(effect("plugging"), "P13"),), ({"P13.plugging.size": 0.1},))
    target = plugging_fits(fitter, null, [0.1])[0].cost
    assert not fitter.fit(elsewhere, null, target=target).converged
    assert fitter.fit(elsewhere, null).converged


@pytest.mark.parametrize("removed", [("leak", "T1"), ("plugging", "P32")])
def test_an_explanation_that_stopped_elsewhere_is_refitted_from_a_better_one_that_contains_it(
    removed: tuple[str, str],
) -> None:
    truth = {"T1.leak.size": 0.1, SIZE: 0.4}
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), truth, seed=0)
    fitter, null = recalibrated(THREE_TANK, recording)
    pool = ExplanationPool(fitter, null, choices=60)
    placements = {p.prefix: p for p in (Placement(effect("leak"), "T1"), PLUGGING)}
    starts = {name: 0.1 for name in truth}
    both = pool.evaluate(fitter.fit(Candidate(tuple(placements.values()), (starts,)), null))
    left = next(p for p in placements.values() if (p.effect.name, p.location) != removed)
    elsewhere = fitter.fit(Candidate((left,), ({f"{left.prefix}.size": -0.5},)), null, cap=0)
    stopped = RankedExplanation(elsewhere, fitter, both.noise, log_evidence(fitter, elsewhere, 60))
    pool.explanations[stopped.key] = stopped
    pool.exchange_effects([])
    assert pool.explanations[stopped.key].log_evidence > stopped.log_evidence + 10.0


def test_the_recalibrated_plant_is_refitted_from_the_best_explanation() -> None:
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {SIZE: 0.4}, seed=0)
    fitter, null = recalibrated(THREE_TANK, recording)
    pool = ExplanationPool(fitter, null, choices=60)
    best = pool.evaluate(plugging_fits(fitter, null, [0.1])[0])
    elsewhere = replace(null, theta=0.9 * null.theta)
    start = Candidate(starts=({},))
    stopped = fitter.fit(start, elsewhere, cap=0)
    pool.explanations[null.key] = RankedExplanation(stopped, fitter, best.noise, log_evidence(fitter, stopped, 60))
    pool.exchange_effects([])
    assert pool.explanations[null.key].fit.cost < stopped.cost and pool.explanations[null.key].fit.converged


def six_tanks() -> PlantDescription:
    """Two ways lead from T1 to T5, so that levels are nearly equal all the time."""
    areas = {"T1": 225e-4, "T2": 138e-4, "T3": 144e-4, "T4": 280e-4, "T5": 235e-4, "T6": 236e-4}
    ways = {
        "P1_2": ("T1", "T2", 0.78e-4),
        "P1_3": ("T1", "T3", 0.74e-4),
        "P3_4": ("T3", "T4", 0.67e-4),
        "P3_5": ("T3", "T5", 0.64e-4),
        "P4_6": ("T4", "T6", 0.53e-4),
        "P2_5": ("T2", "T5", 0.65e-4),
        "OUT6": ("T6", "outside", 0.73e-4),
    }
    return PlantDescription(
        "six_tanks",
        tuple(Tank(n, area, 1.0, 0.2 + 0.05 * k) for k, (n, area) in enumerate(areas.items())),
        tuple(Pipe(n, source, target, area, 0.6) for n, (source, target, area) in ways.items()),
        tuple(Pump(f"Q{k}", f"T{k}", 400e-6) for k in (1, 4, 5)),
        tuple(Sensor(f"h{k}", f"T{k}") for k in range(1, 7)),
        tolerances={f"{n}.discharge_coefficient": 0.03 for n in ways},
    )


@pytest.mark.slow
def test_a_recalibration_at_nearly_equal_levels_gains_nothing_from_an_added_and_removed_effect() -> None:
    plant = six_tanks()
    time = torch.arange(3601, dtype=torch.float64)
    flows = [[8.6e-6, 30e-6, 18e-6], [19.6e-6, 12e-6, 25e-6], [12.8e-6, 20e-6, 6e-6]]
    inputs = torch.tensor(flows, dtype=torch.float64).T[(time / 1200.1).long()]
    off = {"P3_4.discharge_coefficient": 0.582, "OUT6.discharge_coefficient": 0.627}
    fitter, null = recalibrated(plant, recorded(plant, blank_recording(plant, inputs, time), off, seed=0))
    readings = float(fitter.data.mask.sum())
    assert null.converged and null.cost < readings + 5.0 * (2.0 * readings) ** 0.5
    flow = Placement(effect("unmetered_flow"), "T6")
    beside = fitter.fit(Candidate((flow,), ({"T6.unmetered_flow.flow": 1e-7},)), null)
    again = fitter.fit(Candidate(), beside)
    assert again.converged and again.cost > null.cost - 0.5
