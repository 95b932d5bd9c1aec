"""Studies: trials that depend on nothing but their number, resumed logs, limits and sums against known truths."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fdi_torch.cli.screen import Screen
from fdi_torch.cli.study import show
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError, Source
from fdi_torch.config.study_file import Study, build_study, load_study
from fdi_torch.effects import build_network
from fdi_torch.estimate.evolution import EvolutionResult, distant_members
from fdi_torch.estimate.refinement import starting_points
from fdi_torch.jobs.study import TRIAL, StudyResult, progress, run_study
from fdi_torch.logbook import read_run
from fdi_torch.plant.exact_constants import exact_constants_sentence, without_tolerance_sentence
from fdi_torch.quantities import displayed_in
from fdi_torch.report.material import gather
from fdi_torch.report.predictions import progress_of
from fdi_torch.report.setting_tables import setting_tables
from fdi_torch.study.monte_carlo import Trial, limits, make_trials, run_block, run_blocks
from fdi_torch.study.study_plan import Block, Plan, Setting, fault_modes, fixed_faults, mode_faults, uniform_faults
from fdi_torch.study.summary import (
    Ratio,
    Score,
    Summary,
    column,
    count_modes,
    covered,
    mean_with_error,
    rms_ratio,
    rms_with_error,
    share,
    summarise,
)

NOISE = "configs/studies/table3_noise.yaml"
QUICK = ["study.steps=[1 s]", "study.data_step=0.2 s", "study.evaluations=600", "study.population=24"]


def quick(folder: Path | None = None, *more: str) -> Study:
    """Seven trials at 30 dB in blocks of three, in coarse steps."""
    out = [] if folder is None else [f"output.folder={folder}"]
    return load_study(NOISE, [*QUICK, "study.trials=7", "study.block=3", "study.snr_db=[30]", *out, *more])


@pytest.fixture(scope="module")
def plan() -> Plan:
    return quick().plan


def all_trials(plan: Plan) -> dict[int, Trial]:
    return {trial.number: trial for block in run_blocks(plan, plan.blocks()) for trial in block}


def test_a_trial_is_the_same_in_any_block(plan: Plan) -> None:
    assert all_trials(plan) == all_trials(replace(plan, block=4))


def test_draws_differ_between_trials_settings_and_seeds(plan: Plan) -> None:
    block = Block(0, 0, 3, 0)
    other = [
        plan.noise(block, (2, 3)),
        plan.noise(replace(block, setting=1), (2, 3)),
        replace(plan, seed=5).noise(block, (2, 3)),
    ]
    draws = torch.cat(other).flatten(1)
    assert len(draws.unique(dim=0)) == 9
    again = plan.search_seeds(block, 1)
    assert len({*plan.search_seeds(block).tolist(), *again.tolist()}) == 6


def test_noise_has_the_level_asked_for(plan: Plan) -> None:
    trials = make_trials(plan, Block(0, 0, 7, 0))
    clean = trials.readings - trials.noise
    ratio = clean.var(dim=1, correction=0) / trials.std**2
    assert torch.allclose(10.0 * ratio.log10(), torch.full_like(ratio, 30.0), atol=1e-9)
    measured = trials.noise.square().mean(dim=1).sqrt() / trials.std
    assert bool(((measured - 1.0).abs() < 4.0 / (2 * 1001) ** 0.5).all())


# 1e-6; Table 3's fault, and the four-dimensional one whose sensitivities coarse steps get wrong by six times.
BOUNDS = {
    (0.3, 0.3, 0.5, 0.6, 1.0): ((203, 174, 268, 539, 744), (390, 601, 847, 849, 1300)),
    (0.1, 0.6, 0.5, 0.7, 1.0): ((374, 622, 785, 666, 2277), (1343, 1285, 1915, 2419, 3446)),
}


@pytest.mark.parametrize("fault", BOUNDS)
def test_bounds_are_those_of_central_differences_at_tight_steps(plan: Plan, fault: tuple[float, ...]) -> None:
    theta = torch.tensor(fault, dtype=torch.float64)
    tight = replace(plan, settings=(Setting("", fixed_faults(theta, 1), 50.0),))
    trials = make_trials(tight, Block(0, 0, 1, 0))
    found = limits(tight.fitting.engines(0.05)[0], trials)
    for bound, expected in zip((found.bound, found.correlation_bound), BOUNDS[fault], strict=True):
        assert torch.allclose(1e6 * bound[0], torch.tensor(expected, dtype=torch.float64), rtol=0.015)


def test_estimates_of_little_noise_are_those_of_the_linearised_estimator() -> None:
    fine = quick(None, "study.steps=[1 s, 0.1 s]", "study.data_step=0.1 s", "study.snr_db=[70]", "study.trials=3")
    for trial in run_block(fine.plan, Block(0, 0, 3, 0)):
        free, linear, bound = (column([trial], name)[0] for name in ("free", "linearised", "bound"))
        # The linearised one knows each channel's noise level; the other weighs by levels right to some per cent.
        assert bool(((free - linear).abs() < 0.25 * bound).all()), trial
        assert trial.status == "converged"


def test_faults_without_noise_are_found_wherever_they_lie() -> None:
    study = load_study(
        "configs/studies/random_faults.yaml",
        ["study.steps=[1 s, 0.1 s]", "study.data_step=0.02 s", "study.trials=6", "study.block=6"],
    )
    trials = list(all_trials(study.plan).values())
    summary = summarise(study.plan, study.plan.settings[0], trials)
    assert summary.failures == {"boxed": 0} and summary.worst["boxed"] < 1e-5
    assert {s.over_bound for s in summary.scores} == {None}


def test_a_running_study_tells_its_share_of_all_trials(tmp_path: Path) -> None:
    told = []

    def tell(share: float, text: str) -> None:
        (path,) = tmp_path.glob("*.partial")
        told.append((progress_of(gather(read_run(path, salvage=True))), share))

    run_study(quick(tmp_path, "study.snr_db=[30, 20]"), tell=tell)
    assert [progress.share for progress, _ in told] == [share for _, share in told]
    assert told[0][0].text == "3 of 14 trials" and told[-1][0].text == "14 of 14 trials"


def test_an_interrupted_study_goes_on_and_says_the_same(tmp_path: Path) -> None:
    whole = run_study(quick(tmp_path / "whole"))

    def interrupt(share: float, text: str) -> None:
        raise KeyboardInterrupt

    broken = quick(tmp_path / "broken")
    with pytest.raises(KeyboardInterrupt):
        run_study(broken, tell=interrupt)
    resumed = run_study(broken, resume=True)
    assert resumed.computed == 4
    assert resumed.trials == whole.trials and resumed.summaries == whole.summaries
    logs = [[m.data for m in read_run(r.log).messages([TRIAL])] for r in (whole, resumed)]
    assert logs[0] == logs[1] and len(logs[0]) == 7
    with pytest.raises(ValueError, match="expected a run that did not end, got a finished one"):
        run_study(broken, resume=True)
    with pytest.raises(ValueError, match="expected the log of this configuration, got another's"):
        run_study(quick(tmp_path / "broken", "study.trials=8"), resume=True)


def test_a_killed_study_goes_on_from_its_partial_log(tmp_path: Path) -> None:
    whole = run_study(quick(tmp_path))
    killed = tmp_path / "killed"
    killed.mkdir()
    study = quick(killed)
    assert run_study(study, resume=True).trials == whole.trials, "nothing to resume: starts anew"
    # Two thirds of a finished log, as a kill leaves it: no end, and the last chunk torn.
    (killed / "table3_noise.mcap").rename(killed / "table3_noise.mcap.partial")
    partial = killed / "table3_noise.mcap.partial"
    data = partial.read_bytes()
    partial.write_bytes(data[: len(data) * 2 // 3])
    assert run_study(study, resume=True).trials == whole.trials


def test_ten_thousand_trials_stay_below_ten_megabytes(tmp_path: Path, plan: Plan) -> None:
    from fdi_torch.jobs.study import log_trials
    from fdi_torch.logbook import RunLog

    trial = all_trials(replace(plan, settings=(replace(plan.settings[0], faults=plan.settings[0].faults[:1]),)))[0]
    generator = torch.Generator().manual_seed(0)

    def noisy(values: list[float] | float) -> list[float] | float:
        draws = torch.rand(len(values) if isinstance(values, list) else 1, generator=generator, dtype=torch.float64)
        return draws.tolist() if isinstance(values, list) else float(draws)

    count = 1000
    with RunLog(tmp_path / "many.mcap", "study") as log:
        many = [Trial(i, "SNR", "converged", {k: noisy(v) for k, v in trial.numbers.items()}) for i in range(count)]
        for first in range(0, count, 100):
            log_trials(log, plan.seed, many[first : first + 100])
    assert (tmp_path / "many.mcap").stat().st_size < 10e6 * count / 10_000


def test_a_noise_study_has_a_summary_for_each_level(tmp_path: Path) -> None:
    result = run_study(quick(tmp_path, "study.snr_db=[40, 20]", "study.trials=3"))
    assert [s.setting for s in result.summaries] == ["SNR 40 dB", "SNR 20 dB"]
    assert result.summaries[0].rho.value > result.summaries[1].rho.value
    assert len(list(read_run(result.log).messages(["/study/summary"]))) == 2


def test_modes_are_every_set_with_faults_of_a_least_size(plan: Plan) -> None:
    space = plan.fitting.space
    modes = fault_modes(space)
    assert len(modes) == 31 and len(set(modes)) == 31
    for k, mode in enumerate(modes):
        theta = mode_faults(space, mode, 0.1, 50, 1, k)
        away = (theta - space.nominal()).abs() / (space.high() - space.low())
        chosen = torch.zeros(5, dtype=torch.bool)
        chosen[list(mode)] = True
        assert bool((away[:, chosen] >= 0.1 - 1e-12).all()) and bool((away[:, ~chosen] == 0).all())
        assert bool(((theta >= space.low()) & (theta <= space.high())).all())
    with pytest.raises(ValueError, match=r"T1.leak.size: expected room for a fault of 1 of its range, got none"):
        mode_faults(space, (0,), 1.0, 5, 1, 0)


def test_uniform_faults_fill_the_box(plan: Plan) -> None:
    space = plan.fitting.space
    unit = (uniform_faults(space, 4000, 3) - space.low()) / (space.high() - space.low())
    assert bool(((unit > 0) & (unit < 1)).all())
    assert torch.allclose(unit.mean(0), torch.full((5,), 0.5, dtype=torch.float64), atol=4 / (12 * 4000) ** 0.5)
    assert torch.equal(uniform_faults(space, 10, 3), uniform_faults(space, 4000, 3)[:10])


def test_isolation_counts_what_is_missed_and_what_is_false(plan: Plan) -> None:
    space = plan.fitting.space
    nominal = space.nominal().tolist()

    def trial(truth: dict[int, float], free: dict[int, float]) -> Trial:
        vectors = [[changed.get(i, nominal[i]) for i in range(5)] for changed in (truth, free)]
        return Trial(0, "", "", {"truth": vectors[0], "free": vectors[1], "free_std": [0.01] * 5})

    found = count_modes(space, [trial({0: 0.3}, {0: 0.31}), trial({0: 0.3}, {2: 0.5}), trial({}, {3: 0.99})])
    assert found.labels == ("none", "T1.leak", "T3.leak")
    assert found.confusion == ((1, 0, 0), (0, 1, 1), (0, 0, 0))
    assert (found.right, found.missed, found.false) == (2, 1, 1)


def test_five_parameters_are_stated_with_95_percent_together(plan: Plan) -> None:
    """Bonferroni: 2.58 standard errors for each of five, not 1.96."""
    space = plan.fitting.space
    nominal = space.nominal()

    def away(errors: float) -> Trial:
        free = nominal + torch.tensor([0.01 * errors, 0.0, 0.0, 0.0, 0.0])
        return Trial(0, "", "", {"truth": nominal.tolist(), "free": free.tolist(), "free_std": [0.01] * 5})

    assert [count_modes(space, [away(errors)]).false for errors in (2.5, 2.6)] == [0, 1]


def test_each_estimator_fails_beyond_six_of_its_own_bounds(plan: Plan) -> None:
    truth, bound = plan.fitting.space.nominal(), torch.full((5,), 1e-3, dtype=torch.float64)

    def trial(errors: float) -> Trial:
        numbers = {"truth": truth, "free": truth + errors * bound, "correlation": truth + errors * bound}
        numbers |= {"bound": bound, "correlation_bound": 2.0 * bound, "rho": torch.ones(3)}
        return Trial(0, "", "converged", {name: value.tolist() for name, value in numbers.items()})

    trials = [trial(errors) for errors in (5.0, 7.0, 11.0, 13.0)]
    assert summarise(plan, Setting("", truth.expand(4, -1), 30.0), trials).failures == {"free": 3, "correlation": 1}


def test_distant_members_are_apart_or_the_best_again() -> None:
    population = torch.tensor([[[0.0], [0.01], [0.5]], [[0.0], [0.01], [0.02]]])
    taken = distant_members(population, torch.zeros(2, 3), torch.ones(1), 2)
    assert taken[..., 0].tolist() == [[0.0, 0.5], [0.0, 0.0]]
    population = torch.tensor([[[0.0], [0.5], [0.52], [0.9]]])
    assert distant_members(population, torch.zeros(1, 4), torch.ones(1), 3)[0, :, 0].tolist() == pytest.approx(
        [0.0, 0.5, 0.9]
    )


def test_the_refinement_starts_once_from_each_distant_member() -> None:
    population = torch.tensor([[[0.0], [0.01], [0.5], [0.52]]])
    count, cost = torch.ones(1, dtype=torch.int64), torch.arange(4.0)[None]
    found = EvolutionResult(population[:, 0], cost[:, 0], population, cost, count, count, count)
    assert starting_points(found, torch.zeros(1), torch.ones(1), 4)[:, 0].tolist() == [0.0, 0.5]


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(400, 500, generator=generator, dtype=torch.float64)
    rms = [rms_with_error(row) for row in draws]
    assert 0.92 < sum(r.low <= 1.0 <= r.high for r in rms) / 400 < 0.975
    other = draws + 0.3 * torch.randn(400, 500, generator=generator, dtype=torch.float64)
    truth = (1.0 + 0.3**2) ** 0.5
    ratios = [rms_ratio(a, b) for a, b in zip(other, draws, strict=True)]
    assert 0.92 < sum(r.low <= truth <= r.high for r in ratios) / 400 < 0.975
    hits = [covered(row, torch.ones(500, dtype=torch.float64)) for row in draws]
    assert 0.92 < sum(h.low <= 0.95 <= h.high for h in hits) / 400 < 0.985


def test_intervals_of_few_trials_are_wide_enough() -> None:
    draws = torch.randn(1000, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    means = [mean_with_error(row) for row in draws]
    assert 0.93 < sum(m.low <= 0.0 <= m.high for m in means) / 1000 < 0.97
    rms = [rms_with_error(row) for row in draws]
    assert 0.88 < sum(r.low <= 1.0 <= r.high for r in rms) / 1000 < 0.97
    assert rms_with_error(torch.zeros(3)) == Ratio(0.0, 0.0, 0.0)
    assert rms_with_error(torch.ones(1)) == Ratio(1.0, 0.0, math.inf)


def test_wilsons_interval() -> None:
    found = share(9, 10)
    assert (found.value, round(found.low, 4), round(found.high, 4)) == (0.9, 0.5958, 0.9821)


def test_time_left_is_that_of_the_trials_to_come() -> None:
    assert progress(60, 20, 100, 8.0) == (0.6, "60 of 100 trials, 8 s left")


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        ("configs/default.yaml", [], "expected a block study, got none; fdi train estimates a single run"),
        (NOISE, ["study.trails=5"], "got 'trails'; the nearest is 'trials'"),
        (NOISE, ["simulate.faults.T2.leak=0.1"], "expected an estimated parameter"),
        (NOISE, ["estimate.parameters=[]"], "estimate.parameters: expected at least one, got none"),
        (NOISE, ["simulate=null", "recordings=[{file: a.csv}]"], "expected simulate, got recordings"),
        (NOISE, ["estimate.parameters=[h1.offset]"], "expected a finite range to search"),
    ],
)
def test_what_is_wrong_with_a_study_file_is_said(file: str, change: list[str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence.replace("(", r"\(")):
        load_study(file, change)


def test_errors_are_in_the_unit_of_the_plant() -> None:
    none = Ratio(1.0, 1.0, 1.0)
    score = Score("free", "Q.pump_offset.size", "m^3/s", -2e-6, 1e-6, 3e-6, None, None, None)
    summary = Summary("SNR 40 dB", 4, (score,), {"free": 0}, {"free": 0.0}, 4, 0, none)
    with displayed_in({"m^3/s": "l/min"}):
        result = StudyResult((summary,), None, {}, 4, 1.0, Path("study.mcap"))
        table, ((printed,),) = result.table(), (table.cells() for table in result.tables())
    assert table.columns["unit"] == ["l/min"]
    assert table.columns["bias"] == pytest.approx([-0.12]) and table.columns["RMSE"] == pytest.approx([0.18])
    assert printed[:5] == ["free", "Q.pump_offset", "l/min", "-0.12 ± 0.12", "0.18"]


def test_the_accuracy_of_a_setting_is_said_beside_its_noise_in_the_unit_of_the_sensor() -> None:
    study = quick(None, "study.snr_db=[40]", "study.trials=4")
    trials = run_block(study.plan, Block(0, 0, 4, 0))
    summary = summarise(study.plan, study.plan.settings[0], trials)
    clean = make_trials(study.plan, Block(0, 0, 1, 0))
    swing = (clean.readings - clean.noise)[0].std(0, correction=0)
    assert [std for std, _ in summary.noise.values()] == pytest.approx((0.01 * swing).tolist(), rel=1e-6)
    units = {score.parameter: score.unit for score in summary.scores} | dict.fromkeys(summary.noise, "m")
    (table,) = setting_tables([(summary.setting, summary.trials, summary.numbers())], units)
    words = r"with noise of (\S+) cm at h1, .* at h3, (free|boxed) estimates leak at T1 \(true value (\S+)\) to ± "
    found = re.match(words, table.summary)
    assert found and float(found[1]) == pytest.approx(float(swing[0]), rel=1e-2)
    assert float(found[3]) == pytest.approx(summary.truth["T1.leak.size"])


def test_constants_that_count_as_exact_are_named_with_the_key_that_estimates_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plant = load_plant("three_tank")
    constants = build_network(plant).constants.names
    sentence = exact_constants_sentence(plant, ["T1.leak.size"], constants)
    assert sentence == (
        'constants with a tolerance count as exact here; estimate.calibrate: ["*.discharge_coefficient"] estimates them'
    )
    of_first = [name for name in plant.tolerances if name.startswith("P")][:1]
    assert len(of_first) == 1 and of_first[0] not in exact_constants_sentence(plant, of_first, constants)
    assert "*" not in exact_constants_sentence(plant, of_first, constants)
    assert exact_constants_sentence(plant, list(plant.tolerances), constants) == ""
    without = without_tolerance_sentence(plant, ["T1.area"], constants)
    assert "this fault: T2.area, T3.area, Q1.gain and Q2.gain; list" in without and "{T2.area: 5 %}" in without
    exact = ["T1.area", "T2.area", "T3.area", "Q1.gain", "Q2.gain"]
    assert without_tolerance_sentence(plant, exact, constants) == ""
    show(StudyResult((), None, {}, 0, 1.0, Path("study.mcap")), Screen(), sentence)
    assert f"{sentence}\n" in capsys.readouterr().out


def two_separate_tanks(sensor: dict[str, str], second: Any, snr_db: float | None) -> Plan:
    """Two tanks without a connection, in one of which a leak is estimated."""
    tank, drain = {"area": "200 cm^2", "height": "60 cm"}, {"area": "0.5 cm^2", "discharge_coefficient": 0.6}
    plant = {
        "tanks": {"A": tank, "B": tank},
        "pipes": {f"out{t}": {"source": t, "target": "outside", **drain} for t in "AB"},
        "pumps": {f"Q{t}": {"target": t, "max_flow": "6 l/min"} for t in "AB"},
        "sensors": {f"h{t}": {"tank": t, **sensor} for t in "AB"},
    }
    inputs = {"QA": {"steps": [["0 s", "3 l/min"], ["200 s", "4 l/min"]]}, "QB": second}
    data = {
        "plant": plant,
        "simulate": {"inputs": inputs, "duration": "600 s", "sample_time": "5 s", "faults": {"A.leak": 0.2}},
        "estimate": {"parameters": ["A.leak"], "calibrate": []},
        "study": {"snr_db": [snr_db], "trials": 2, "data_step": "1 s", "steps": ["5 s"], "search_step": "5 s"},
    }
    return build_study(data, Path.cwd(), Source("study.yaml")).plan


def test_bounds_without_noise_are_those_of_a_millimetre_in_any_unit_of_the_sensors() -> None:
    bounds = []
    for gain in ({}, {"gain": "98.1 mbar/m"}, {"gain": "0.27 mA/cm"}):
        plan = two_separate_tanks(gain, {"steps": [["0 s", "3 l/min"], ["300 s", "2 l/min"]]}, None)
        bounds.append(float(limits(plan.fitting.engines(5.0)[0], make_trials(plan, Block(0, 0, 1, 0))).bound))
    assert bounds[1:] == pytest.approx([bounds[0]] * 2, rel=1e-6) and bounds[0] > 1e-5


def test_a_constant_output_has_no_signal_to_noise_ratio() -> None:
    with pytest.raises(
        ValueError, match=r"study\.snr_db: expected outputs that vary in every trial, got a constant hB"
    ):
        make_trials(two_separate_tanks({}, "3 l/min", 30.0), Block(0, 0, 2, 0))
