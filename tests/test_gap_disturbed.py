"""Random flows into the tanks are no gap and hide no larger cause; the rig here has its own integrator."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fdi_torch import Pipe, Plant, Sensor, Tank
from fdi_torch.cli import main
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.effects import effect
from fdi_torch.estimate.evidence import ODDS
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.library import possible_places
from fdi_torch.gap.localization.localize import localize
from fdi_torch.gap.marginal_likelihood import evidence_under, with_disturbances, with_estimated_noise
from fdi_torch.gap.onsets import fine_onsets
from fdi_torch.gap.problem import checked_data_set, problem_of
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.remarks import implausible_flows
from fdi_torch.gap.screening import Option, options_of, screen
from fdi_torch.gap.structure_search import search
from fdi_torch.plant.constants import flow_scale
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of_all
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_writing import write_csv
from tests.rigs import blank_recording
from tests.test_gap import nominal_plant
from tests.test_gap import recorded as gap_recording

SUBSTEPS = 10  # a second
LIBRARY = ("pump_gain", "plugging", "leak", "sensor_bias")
SAMPLES = 700


def recorded(
    flow: float,
    hold: int,
    seed: int,
    plugged: float = 0.0,
    onset: float = 0.0,
    inflow: float = 0.0,
    between: tuple[int, int] = (0, SAMPLES),
    switched: tuple[int, ...] = (),
    blocked_pipe: str = "P13",
) -> Recording:
    """Three tanks by Euler steps of a tenth of a second, read each second with 1 mm of noise.

    flow: standard deviation of the random flow into each tank, m^3/s, new every `hold` s. plugged: by how much the
    coefficient of one pipe is lower from `onset` on; at the instants `switched`, it returns and falls again. inflow:
    m^3/s, into T1 between two instants.
    """
    plant, generator = nominal_plant(), torch.Generator().manual_seed(seed)
    tanks = [t.name for t in plant.tanks]
    levels = 15e-6 + 60e-6 * torch.rand(SAMPLES // 70 + 1, 2, generator=generator, dtype=torch.float64)
    inputs = levels.repeat_interleave(70, dim=0)[:SAMPLES]
    random = flow * torch.randn(SAMPLES // hold + 1, 3, generator=generator, dtype=torch.float64)
    disturbing = random.repeat_interleave(hold, dim=0)[:SAMPLES]
    level, rows = [0.3, 0.2, 0.25], []
    for second in range(SAMPLES):
        rows.append(list(level))
        for _ in range(SUBSTEPS):
            into = disturbing[second].tolist()
            into[0] += inflow if between[0] <= second < between[1] else 0.0
            for pump, command in zip(plant.pumps, inputs[second].tolist(), strict=True):
                into[tanks.index(pump.target)] += command
            for pipe in plant.pipes:
                far = level[tanks.index(pipe.target)] if pipe.target in tanks else 0.0
                head = level[tanks.index(pipe.source)] - far
                blocked = second >= onset and sum(second >= t for t in switched) % 2 == 0
                lost = plugged if pipe.name == blocked_pipe and blocked else 0.0
                root = math.copysign(math.sqrt(2.0 * plant.gravity * abs(head)), head)
                through = (1.0 - lost) * pipe.discharge_coefficient * pipe.area * root
                into[tanks.index(pipe.source)] -= through
                if pipe.target in tanks:
                    into[tanks.index(pipe.target)] += through
            level = [max(h + q / (SUBSTEPS * t.area), 0.0) for h, q, t in zip(level, into, plant.tanks, strict=True)]
    noise = 1e-3 * torch.randn(SAMPLES, 3, generator=generator, dtype=torch.float64)
    blank = blank_recording(plant, inputs, torch.arange(SAMPLES, dtype=torch.float64))
    return replace(blank, outputs=torch.tensor(rows, dtype=torch.float64) + noise, mask=None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("flow", "hold", "seed"), [(4e-5, 1, 2), (2e-5, 5, 1)])
def test_large_random_flows_are_no_unknown_cause(flow: float, hold: int, seed: int) -> None:
    """The lag of a pipe's flow is close to a random flow of the same step, if it is computed from later readings."""
    fitter, null, _ = recalibrate(problem_of(nominal_plant(), (recorded(flow, hold, seed),), (), Settings()).data)
    under, likely = with_estimated_noise(fitter, null)
    found = localize(under, null, likely.noise, possible_places(nominal_plant()))
    odds = ODDS.unknown / len(possible_places(nominal_plant()))
    assert all(place.parameters > 0 for place in found.discrepancies), "a discrepancy without regressors is none"
    gains = [place.gain - found.itself for place in found.discrepancies]
    assert gains and sum(odds * math.exp(gain) for gain in gains) < 0.5


@pytest.mark.slow
def test_a_law_with_many_changes_is_located_although_a_random_flow_hides_each_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An outlet that is blocked at times. Steps of the flow into its tank explain nearly the same, and come first."""
    samples = 2000
    monkeypatch.setattr(f"{__name__}.SAMPLES", samples)
    recording = recorded(1e-6, 15, 4, plugged=0.4, switched=tuple(range(137, samples, 200)), blocked_pipe="OUT2")
    fitter, null, _ = recalibrate(problem_of(nominal_plant(), (recording,), (), Settings()).data)
    under, likely = with_estimated_noise(fitter, null)
    found = localize(under, null, likely.noise, ["T2", "OUT2", "P32", "h2"])
    gains = {each.location: each.gain for each in found.discrepancies}
    assert gains["OUT2"] > gains["T2"] > gains["h2"]


def diagnosed(recording: Recording) -> Answer:
    answer = diagnose(nominal_plant(), recording, settings=Settings(LIBRARY))
    total = sum(e.probability for e in answer.posterior) + answer.unexamined
    assert total < 1.0 + 1e-9 and answer.unexamined > 0.0
    assert all(0.0 <= share <= 1.0 + 1e-9 for _, share in answer.where)
    return answer


@pytest.mark.parametrize(("flow", "hold"), [(0.0, 1), (4e-6, 1), (1.5e-6, 15)], ids=["none", "white", "held 15 s"])
def test_random_flows_are_no_gap(flow: float, hold: int) -> None:
    answer = diagnosed(recorded(flow, hold, seed=3))
    assert answer.verdict == "no_gap" and not answer.causes
    if hold == 1 and flow:
        sizes = [answer.disturbances[t]["std"] for t in ("T1", "T2", "T3")]
        times = [answer.disturbances[t]["correlation_time"] for t in ("T1", "T2", "T3")]
        assert times == [0.0] * 3 and sizes == pytest.approx([flow] * 3, rel=0.3)


def test_a_plugging_in_mid_record_is_found_despite_random_flows() -> None:
    """An unknown law of the pipe that begins at one time says nearly the same."""
    answer = diagnosed(recorded(1.5e-6, 15, seed=5, plugged=0.4, onset=350.0))
    assert answer.posterior[0].probability > 0.9 and answer.where[0] == ("P13", pytest.approx(1.0, abs=0.03))
    (cause,) = answer.causes
    assert (cause.effect, cause.location) == ("plugging", "P13")
    size, onset = cause.parameters["size"], cause.parameters["onset"]
    assert abs(size.value - 0.4) < 5.0 * size.std < 0.3
    assert abs(onset.value - 350.0) < max(5.0 * onset.std, 2.0)


def test_an_onset_is_found_although_slow_random_flows_explain_a_flow_that_changed_long_ago() -> None:
    recording = recorded(3e-6, 100, seed=3, plugged=0.2, onset=385.0)
    problem = problem_of(nominal_plant(), [recording], [], Settings(("plugging",)))
    fitter, null, _ = recalibrate(problem.data)
    pool = ExplanationPool(fitter, null, len(problem.library))
    reach = operating_range_of_all(problem.recordings, problem.data.plant)
    best = search(pool, options_of(problem.library, fitter, reach), most=1).best
    assert best.key == {("plugging", "P13")}
    start = Candidate(best.fit.candidate.placements, ({"P13.plugging.size": 0.2, "P13.plugging.onset": 385.0},))
    assert best.fit.cost < best.fitter.fit(start, best.fit).cost + 0.5
    assert abs(best.fit.values["P13.plugging.onset"] - 385.0) < 5.0


@pytest.mark.parametrize(
    ("between", "flow", "hold"),
    [((20, 60), 0.0, 1), ((95, 330), 3e-6, 100), ((180, 560), 3e-6, 100), ((20, 60), 3e-6, 100)],
)
def test_both_ends_of_an_interval_are_found_wherever_they_are(between: tuple[int, int], flow: float, hold: int) -> None:
    recording = recorded(flow, hold, seed=6, inflow=-3e-5, between=between)
    problem = problem_of(nominal_plant(), [recording], [], Settings(("unmetered_flow", "leak")))
    fitter, null, _ = recalibrate(problem.data)
    pool = ExplanationPool(fitter, null, len(problem.library))
    reach = operating_range_of_all(problem.recordings, problem.data.plant)
    best = search(pool, options_of(problem.library, fitter, reach), most=1).best
    assert ("unmetered_flow", "T1") in best.key
    begin, lasting = best.fit.values["T1.unmetered_flow.begin"], best.fit.values["T1.unmetered_flow.duration"]
    assert begin == pytest.approx(between[0], abs=3.0) and begin + lasting == pytest.approx(between[1], abs=3.0)
    assert best.fit.values["T1.unmetered_flow.flow"] == pytest.approx(-3e-5, rel=0.3)


def test_the_two_effects_that_explain_most_together_are_fitted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """A weak pump into a tank with a leak: each of them seems to be the other."""
    truth = {"Q1.pump_gain.factor": 0.85, "T1.leak.size": 0.1}
    problem = problem_of(nominal_plant(), [gap_recording(truth, 4, samples=300)], [], Settings(("pump_gain", "leak")))
    fitter, null, _ = recalibrate(problem.data)
    pool, fitted = ExplanationPool(fitter, null, len(problem.library)), []
    monkeypatch.setattr(pool, "_fitted", lambda fitter, base, candidates, rivals=(): fitted.extend(candidates) or [])
    base: Any = RankedExplanation(null, fitter, None, 0.0)  # type: ignore[arg-type]
    pool.explanations[base.key] = base
    reach = operating_range_of_all(problem.recordings, problem.data.plant)
    screening = screen(fitter, null, options_of(problem.library, fitter, reach))
    pool.extend(base, screening, screening)
    assert {("pump_gain", "Q1"), ("leak", "T1")} in [candidate.key for candidate in fitted]


def test_flows_decay_by_the_time_between_samples_in_whatever_order_the_recordings_come() -> None:
    each, told, steps = [gap_recording({}, 3, samples=300), gap_recording({}, 4).every(8)], [], []
    levels = torch.full((3,), 1e-3, dtype=torch.float64)
    noise = StateNoise(torch.full((3,), 4e-6, dtype=torch.float64), 20.0, torch.ones(3, dtype=torch.float64))
    for recordings in (each, each[::-1]):
        fitter = Fitter(checked_data_set(nominal_plant(), (), recordings, 1.0), Noise(levels, 300.0 * levels))
        null = fitter.fit(Candidate())
        under = with_disturbances(fitter, null, noise)
        assert under.whitening is not None
        for rows, recording in zip(fitter.data.rows, recordings, strict=True):
            decay = under.whitening.own.kept(20.0)[rows][:-1]
            assert decay.tolist() == pytest.approx([math.exp(-recording.interval / 20.0)] * len(decay))
        told.append(under.cost(null) + under.log_det)
        steps.append(float(checked_data_set(nominal_plant(), (), recordings, None).experiment.steps.max()))
    assert told[0] == pytest.approx(told[1], rel=1e-6) and steps[0] == steps[1]


def test_onsets_are_as_dense_as_the_random_flows_require() -> None:
    fitter, null, _ = recalibrate(problem_of(nominal_plant(), [recorded(0.0, 1, seed=3)], [], Settings(LIBRARY)).data)
    placement = Placement(effect("plugging"), "P13")
    options = [Option(placement, {"P13.plugging.size": 0.1, "P13.plugging.onset": time}) for time in (300.0, 600.0)]
    assert fine_onsets(options, fitter) == []
    counts = []
    for flow, time in ((1e-6, 100.0), (8e-6, 100.0), (8e-6, 0.0)):
        noise = StateNoise(torch.full((3,), flow, dtype=torch.float64), time, torch.ones(3, dtype=torch.float64))
        counts.append(len(fine_onsets(options, with_disturbances(fitter, null, noise))))
    slow, fast, white = counts
    assert white == 0 and fast == pytest.approx(4 * slow, rel=0.05)


def test_a_calibration_beside_random_flows_narrows_tolerances_that_hold_the_truth(tmp_path: Path) -> None:
    """`fdi refit` takes the residual for noise of the sensors: its OUT2 lies 26 of its standard errors away."""
    plant, file = tmp_path / "rig.yaml", write_csv(recorded(4e-6, 10, 3), tmp_path / "run.csv")
    plant.write_text(dump_plant(nominal_plant()))
    words = ["gap", "--plant", str(plant), "--recording", str(file), "--library", ",".join(LIBRARY), "--quiet"]
    calibrated = tmp_path / "calibrated.yaml"
    assert main([*words, "--out", str(tmp_path), "--adopt", str(calibrated), "--narrow"]) == 0
    found, nominal = load_plant(calibrated), nominal_plant()
    for pipe, truth in zip(found.pipes, nominal.pipes, strict=True):
        name = f"{pipe.name}.discharge_coefficient"
        share = pipe.discharge_coefficient / truth.discharge_coefficient - 1.0
        assert abs(share) < 3.0 * found.tolerances[name] < 3.0 * nominal.tolerances[name]


def test_the_evidence_beside_strong_flows_is_that_about_the_own_trajectory() -> None:
    """A plugged tank runs dry. Without plugging, flows keep it filled, and a fit under them may run dry earlier."""
    outlet = Pipe("out", "T", "outside", area=0.45e-4, discharge_coefficient=0.6)
    tank, tolerances = Tank("T", area=0.06, height=0.8), {"*.discharge_coefficient": 0.03}
    plant = Plant([tank], pipes=[outlet], sensors=[Sensor("h", tank="T")], tolerances=tolerances)
    generator = torch.Generator().manual_seed(3)
    level, flow, levels = 0.75, 0.0, []
    for shock in torch.randn(1200, generator=generator).tolist():
        levels.append([level])
        flow = math.exp(-1.0 / 15.0) * flow + 2e-6 * math.sqrt(1.0 - math.exp(-2.0 / 15.0)) * shock
        root = math.sqrt(2.0 * plant.gravity * level)
        level = max(level + (flow - 0.8 * outlet.discharge_coefficient * outlet.area * root) / tank.area, 0.0)
    blank = blank_recording(plant, torch.zeros(1200, 0, dtype=torch.float64), torch.arange(1200.0).double())
    noise = 8e-4 * torch.randn(1200, 1, generator=generator, dtype=torch.float64)
    drain = replace(blank, outputs=torch.tensor(levels, dtype=torch.float64) + noise, mask=None)
    fitter, null, _ = recalibrate(problem_of(plant, (drain,), (), Settings()).data)
    found = ExplanationPool(fitter, null, 20).evaluate(null)
    about = with_disturbances(fitter, found.fit, found.noise)
    assert evidence_under(about, found.fit, 20) == pytest.approx(found.log_evidence, abs=1.0)


@pytest.mark.parametrize(
    ("share", "correlation_time", "doubted"), [(2.0, 500.0, True), (0.5, 500.0, False), (2.0, 0.0, False)]
)
def test_random_flows_above_what_a_full_tank_discharges_are_doubted(
    share: float, correlation_time: float, doubted: bool
) -> None:
    """A white flow of the same standard deviation moves the level by less, since its mean over any time is small."""
    flows = torch.tensor(
        [share * flow_scale(nominal_plant(), t.name) for t in nominal_plant().tanks], dtype=torch.float64
    )
    remarks = implausible_flows(
        nominal_plant(), StateNoise(flows, correlation_time, torch.ones(3, dtype=torch.float64)), 1.0
    )
    assert [r.partition(" ")[0] for r in remarks] == (["T1", "T2", "T3"] if doubted else [])
