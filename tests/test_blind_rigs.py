"""The hidden rigs against closed forms, conservation of volume, and themselves in other company."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from fdi_torch.blind import case_drafts, cases, conditions
from fdi_torch.blind.case_causes import UNKNOWN, choose, unknown_to
from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.case_readings import READOUT_LAWS, SENSOR_LAWS
from fdi_torch.blind.cases import Case, as_csv, make
from fdi_torch.blind.conditions import WIDEST, as_built, asked_of_pumps, exercised
from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.inputs import SIGNALS, commanded, with_standstills
from fdi_torch.blind.kinds import KINDS, STANDARD
from fdi_torch.blind.laws_pipe import HEAD_LAWS, PIPE_LAWS
from fdi_torch.blind.laws_pump import PUMP_LAWS
from fdi_torch.blind.laws_tank import STORAGE_LAWS, TANK_LAWS
from fdi_torch.blind.named_effects import DRAWS, NominalRun, draw_effect
from fdi_torch.blind.places import EFFECTS, canonical, effect_places
from fdi_torch.blind.plants import Rig, Scales, cascaded_tanks, on_bench, quadruple_tank, three_tank
from fdi_torch.blind.sensor_noise import DRAWN, LONGEST, NoiseCorrelation, autoregressive, rippling, smoothed
from fdi_torch.blind.simulator import Drive, HiddenRigs, simulate
from fdi_torch.effects import build_network
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import OUTSIDE, Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine

AREA = 0.016


def rig_of(pipes: Sequence[Pipe], pumps: Sequence[Pump] = ()) -> PlantDescription:
    tanks = (Tank("A", AREA, 1.0), Tank("B", AREA, 1.0))
    return PlantDescription("two", tanks, tuple(pipes), tuple(pumps), (Sensor("a", "A"),))


def conducting(plant: PlantDescription, conductance: float) -> PlantDescription:
    """The plant with pipes of this conductance, m^2.5/s."""
    root = math.sqrt(2 * plant.gravity)
    pipes = (replace(p, discharge_coefficient=conductance / p.area / root) for p in plant.pipes)
    return replace(plant, pipes=tuple(pipes))


def run(
    plant: PlantDescription,
    conductance: float,
    start: Sequence[float],
    seconds: int,
    *off: Deviation,
    asked: float = 0.0,
) -> Array:
    """Levels (T, N) of one lane."""
    rigs = HiddenRigs([conducting(plant, conductance)], [off])
    flow = np.full((seconds + 1, len(plant.pumps)), asked)
    return simulate(rigs, [Drive(flow, np.array(start))])[0].levels


OUTLET = (Pipe("O", "A", OUTSIDE, 6e-5, 0.6),)
LINK = (Pipe("P", "A", "B", 6e-5, 0.6),)
PUMP = (Pump("Q", "A", 9e-5),)


def test_a_tank_drains_as_torricelli_says() -> None:
    k, seconds = 1.6e-4, 60
    level = run(rig_of(OUTLET), k, [0.5, 0.0], seconds)[:, 0]
    time = np.arange(seconds + 1)
    expected = (math.sqrt(0.5) - k * time / (2 * AREA)) ** 2
    np.testing.assert_allclose(level, expected, atol=1e-6)


def test_halving_the_step_quarters_the_error() -> None:
    k = 1.6e-4
    exact = (math.sqrt(0.5) - k * 60 / (2 * AREA)) ** 2
    rigs = HiddenRigs([conducting(rig_of(OUTLET), k)], [()])
    drive = Drive(np.zeros((61, 0)), np.array([0.5, 0.0]))
    coarse, fine = (abs(simulate(rigs, [drive], step)[0].levels[-1, 0] - exact) for step in (1.0, 0.5))
    # The first, Euler, step weighs in both alike with the square of the step.
    assert coarse / fine == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize(
    "off",
    [
        (),
        (Deviation("laminar_flow", "P", "viscous_and_inertial", {"head": 0.02}),),
        (Deviation("cross_flow", "A-B", "slot", {"conductance": 2e-5, "viscous": 1e-3}, other="B"),),
        (Deviation("overflow", "A", "notched_weir", {"crest": 0.3, "depth": 0.02, "flow": 7e-5}, other="B"),),
    ],
)
def test_water_that_only_changes_tanks_stays_in_them(off: tuple[Deviation, ...]) -> None:
    levels = run(rig_of(LINK), 1.6e-4, [0.5, 0.1], 300, *off)
    np.testing.assert_allclose(levels.sum(axis=1), 0.6, atol=1e-12)
    assert levels[-1, 0] < 0.45


def test_a_side_chamber_fills_until_it_stands_as_high() -> None:
    chamber = Deviation("unknown", "A", "side_chamber", {"area": 0.5 * AREA, "tau": 20.0})
    pumped = run(rig_of((), PUMP), 1.0, [0.2, 0.0], 200, chamber, asked=5e-5)[:, 0]
    # A steady inflow splits as the two cross-sections do, once the chamber follows.
    assert (pumped[200] - pumped[150]) == pytest.approx(5e-5 * 50 / (1.5 * AREA), rel=2e-3)


def test_a_slewing_pump_takes_its_time() -> None:
    asked = np.where(np.arange(61) >= 20, 5e-5, 0.0)
    volume = filled_by("slewing", {"rate": 2.5e-6}, 60, asked)
    t = np.maximum(np.arange(61) - 20.0, 0)
    expected = np.where(t < 20, 0.5 * 2.5e-6 * t**2, 5e-5 * (t - 10))
    np.testing.assert_allclose(volume, expected, atol=1e-9)


def test_what_a_conical_tank_is_given_is_in_it() -> None:
    slope, middle, flow, seconds = 0.5, 0.4, 5e-5, 100
    cone = Deviation("area_taper", "A", "cone", {"slope": slope, "reference": middle})
    levels = run(rig_of((), PUMP), 1.0, [0.2, 0.0], seconds, cone, asked=flow)[:, 0]
    volume = AREA * ((1 + slope * levels) ** 3 - 1) / (3 * slope) / (1 + slope * middle) ** 2
    np.testing.assert_allclose(volume - volume[0], flow * np.arange(seconds + 1), atol=1e-9)


def test_a_body_displaces_its_volume() -> None:
    body = Deviation("internal_body", "A", "block", {"low": 0.3, "high": 0.4, "share": 0.5, "chamfer": 0.2})
    sound = run(rig_of((), PUMP), 1.0, [0.2, 0.0], 100, asked=5e-5)[-1, 0]
    filled = run(rig_of((), PUMP), 1.0, [0.2, 0.0], 100, body, asked=5e-5)[-1, 0]
    # Its mean share of the cross-section: 0.5 x (1 - chamfer), over 0.1 m of level.
    assert filled - sound == pytest.approx(0.5 * 0.8 * 0.1, abs=1e-5)


def filled_by(law: str, numbers: dict[str, float], seconds: int, asked: Array) -> Array:
    """Volumes (T,) m^3 that a closed tank received from a pump that is off."""
    rigs = HiddenRigs([rig_of((), PUMP)], [(Deviation("x", "Q", law, numbers),)])
    return simulate(rigs, [Drive(asked[:, None], np.zeros(2))])[0].levels[:, 0] * AREA


def test_what_stands_above_a_rim_runs_over_into_the_tank_that_catches_it() -> None:
    low, wide = Tank("A", AREA, 0.3, overflow_to="B"), Tank("B", AREA, 1.0)
    plant = PlantDescription("two", (low, wide), (), PUMP, (Sensor("a", "A"),))
    levels = run(plant, 1.0, [0.25, 0.0], 60, asked=8e-5)
    np.testing.assert_allclose(levels.sum(axis=1), 0.25 + 8e-5 / AREA * np.arange(61), atol=1e-12)
    assert levels[-1] == pytest.approx([0.3, 0.25], abs=1e-12)
    lost = run(replace(plant, tanks=(replace(low, overflow_to=OUTSIDE), wide)), 1.0, [0.25, 0.0], 60, asked=8e-5)
    assert lost[-1] == pytest.approx([0.3, 0.0], abs=1e-12)


def test_a_rig_is_built_within_its_tolerances() -> None:
    plant = replace(three_tank().plant, tolerances={"P13.discharge_coefficient": 0.03, "h1.offset": 0.01})
    drawn = [as_built(plant, np.random.default_rng(seed)) for seed in range(400)]
    coefficients = np.array([p.pipes[0].discharge_coefficient for p in drawn]) / 0.6 - 1
    offsets = np.array([p.sensors[0].offset for p in drawn])
    assert coefficients.std() == pytest.approx(0.03, rel=0.1) and offsets.std() == pytest.approx(0.01, rel=0.1)
    assert np.abs(coefficients).max() <= WIDEST * 0.03 + 1e-12
    assert all(p.pipes[1:] == plant.pipes[1:] and p.tanks == plant.tanks for p in drawn)


def test_a_late_pump_delivers_the_same_later() -> None:
    asked = np.where(np.arange(61) >= 20, 5e-5, 0.0)
    volume = filled_by("late", {"delay": 7.5}, 60, asked)
    np.testing.assert_allclose(volume, 5e-5 * np.maximum(np.arange(61) - 27.5, 0), atol=1e-18 + 5e-5 * 0.021)


def test_a_slow_pump_has_its_time_constant() -> None:
    tau, asked = 8.0, np.where(np.arange(61) >= 20, 5e-5, 0.0)
    volume = filled_by("slow", {"tau": tau}, 60, asked)
    t = np.maximum(np.arange(61) - 20.0, 0)
    np.testing.assert_allclose(volume, 5e-5 * (t - tau * (1 - np.exp(-t / tau))), atol=1e-9)


def test_backlash_holds_a_flow_until_the_slack_is_used_up() -> None:
    asked = np.array([5.0] * 10 + [4.5] * 10 + [2.0] * 11) * 1e-5
    delivered = np.diff(filled_by("backlash", {"slack": 1e-5}, 30, asked))
    np.testing.assert_allclose(delivered, np.array([4.0] * 20 + [3.0] * 10) * 1e-5, atol=1e-12)


def test_a_damped_sensor_follows_a_ramp_late_by_its_time_constant() -> None:
    time = np.arange(400.0)
    for law in ("damped", "damped_twice"):
        shown = SENSOR_LAWS[law](0.001 * time[:, None], time, {"tau": np.array([12.0])})[:, 0]
        assert (0.001 * time - shown)[-1] == pytest.approx(0.012, rel=1e-6)


def test_a_late_sensor_shows_the_level_of_before() -> None:
    time = np.arange(50.0)
    shown = SENSOR_LAWS["late_reading"](0.01 * time[:, None], time, {"delay": np.array([4.25])})[:, 0]
    np.testing.assert_allclose(shown, 0.01 * np.maximum(time - 4.25, 0), atol=1e-15)


def test_noise_has_the_colour_and_size_asked_for() -> None:
    colour = autoregressive(0.8)
    e = colour.noise(np.random.default_rng(1), 20000, np.array([0.3, 0.6]))
    assert e.std(axis=0) == pytest.approx([0.3, 0.6], rel=0.05)
    assert np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1] == pytest.approx(0.8, abs=0.02)
    assert colour.repeats == pytest.approx((1 + 0.8**2) / (1 - 0.8**2), rel=1e-12)


@pytest.mark.parametrize("colour", [smoothed(5), rippling(10.0, 4.0)], ids=lambda c: c.name)
def test_mean_squares_of_coloured_noise_scatter_as_said(colour: NoiseCorrelation) -> None:
    samples, runs = 500, 2000
    squares = np.mean(colour.noise(np.random.default_rng(3), samples, np.ones(runs)) ** 2, axis=0)
    assert squares.mean() == pytest.approx(1.0, rel=0.01)
    assert squares.std() == pytest.approx(np.sqrt(2 * colour.repeats / samples), rel=0.06)


@pytest.mark.parametrize("draw", [draw for _, draw in DRAWN], ids=range(len(DRAWN)))
def test_each_correlation_that_is_drawn_has_the_size_and_the_correlation_that_it_declares(
    draw: Callable[[np.random.Generator], NoiseCorrelation],
) -> None:
    """Of 200,000 readings, with the standard error of a correlation of such noise (Bartlett, 1946)."""
    samples, std = 200_000, np.array([0.3, 2.0])
    for seed in range(3):
        colour = draw(np.random.default_rng(seed))
        assert colour.name and len(colour.kernel) <= LONGEST
        e = colour.noise(np.random.default_rng(100 + seed), samples, std)
        assert e.shape == (samples, 2)
        error = np.sqrt(colour.repeats / samples)
        np.testing.assert_allclose(e.std(axis=0), std, rtol=4 * error)
        middle = len(colour.kernel) - 1
        for lag in (1, 2, 5, 10, 40):
            declared = colour.correlations[middle + lag] if lag <= middle else 0.0
            measured = np.mean(e[lag:] * e[:-lag], axis=0) / std**2
            np.testing.assert_allclose(measured, declared, atol=5 * error)


def test_the_shares_of_drawn_correlations_sum_to_one() -> None:
    assert sum(share for share, _ in DRAWN) == pytest.approx(1.0, abs=1e-12)


TOWER, PHIAL = Scales(time=100.0, length=10.0, area=1e4), Scales(time=0.1, length=0.1, area=0.01)


def of_size(scales: Scales) -> Rig:
    """The three tanks of another size, as their plant file alone has them exercised."""
    back = Scales(1 / scales.time, 1 / scales.length, 1 / scales.area)
    return exercised(on_bench(three_tank().plant, back), scales)


@pytest.mark.parametrize(
    "rig",
    [three_tank(), quadruple_tank(), cascaded_tanks(), of_size(TOWER), of_size(PHIAL)],
    ids=["three", "quadruple", "cascaded", "tower", "phial"],
)
def test_two_independent_simulations_of_a_sound_rig_agree(rig: Rig) -> None:
    """The hidden rig without any effect and the library's plant: other code, other integrator, the same water."""
    plant, scales, seconds = rig.plant, rig.scales, 200
    commands = commanded(rig, np.random.default_rng(2), seconds + 1)
    start = [0.2 * t.height * (1 + 0.3 * i) for i, t in enumerate(plant.tanks)]
    rigs = HiddenRigs([plant], [()])
    hidden = simulate(rigs, [Drive(asked_of_pumps(plant, commands), np.array(start))])[0].levels
    full = zip(rig.believed.tanks, start, strict=True)
    started = replace(rig.believed, tanks=tuple(replace(t, start_level=scales.length * h) for t, h in full))
    pump = plant.pumps[0]
    recording = Recording(
        time=scales.time * torch.arange(seconds + 1, dtype=torch.float64),
        inputs=torch.tensor(scales.command(pump) * commands * (1e-6 if pump.gain_unit == "1" else 1.0)),
        outputs=torch.zeros(seconds + 1, len(plant.sensors), dtype=torch.float64),
        input_names=plant.channels(),
        output_names=tuple(s.name for s in plant.sensors),
        input_units=("m^3/s",) * commands.shape[1],
        output_units=("m",) * len(plant.sensors),
    )
    layout = lay_out(recording, plant.channels(), 0.5 * scales.time)
    engine = ReferenceEngine(build_network(started), ParameterSpace(), layout)
    library = engine.levels(torch.zeros(1, 0, dtype=torch.float64))[0].numpy()
    np.testing.assert_allclose(hidden, library / scales.length, atol=2e-5)


@cache
def case_of_first_size() -> Case:
    return make(plans(1, 7, ("null",)), exercised(three_tank().plant), 7)[0]


@pytest.mark.parametrize("scales", [TOWER, PHIAL], ids=["tower", "phial"])
def test_a_rig_of_another_size_is_recorded_in_its_own_size_and_pace(
    scales: Scales, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    rig, same = of_size(scales), case_of_first_size()
    (case,) = make(plans(1, 7, ("null",)), rig, 7)
    np.testing.assert_allclose(case.readings[0], same.readings[0], atol=1e-9)
    for part, noise in same.truth["noise_rms_m"].items():
        assert case.truth["noise_rms_m"][part] == pytest.approx([scales.length * n for n in noise])
    path = tmp_path / "large.csv"
    path.write_text(as_csv(rig, case.commands[0], case.readings[0], "seal"))
    found = read_csv(path, rig.plant.channels(), [s.column for s in rig.plant.sensors])
    assert found.time[-1].item() == pytest.approx(scales.time * 3600)
    np.testing.assert_allclose(found.inputs.numpy() / scales.flow, 1e-6 * case.commands[0], atol=1e-12)
    np.testing.assert_allclose(found.outputs.numpy() / scales.length, case.readings[0], atol=5.1e-6)


def test_a_step_that_does_not_divide_a_second_is_refused() -> None:
    rigs = HiddenRigs([rig_of(OUTLET)], [()])
    with pytest.raises(ValueError, match="a step that divides one second"):
        simulate(rigs, [Drive(np.zeros((3, 0)), np.zeros(2))], 0.03)


def test_a_law_twice_in_a_rig_is_refused() -> None:
    holes = [Deviation("leak", t, "floor_hole", {"conductance": 1e-5}) for t in ("A", "B")]
    with pytest.raises(ValueError, match="each law once"):
        HiddenRigs([rig_of(OUTLET)], [holes])


def test_a_tank_has_no_past_commands() -> None:
    rigs = HiddenRigs([rig_of(OUTLET)], [()])
    rigs.tank_groups = HiddenRigs([rig_of((), PUMP)], [(Deviation("x", "Q", "late", {"delay": 1.0}),)]).pump_groups
    rigs.tank_groups[0].law = lambda level, other, now, p, state: (now.asked(p["delay"]), None)
    with pytest.raises(ValueError, match="use a pump law"):
        simulate(rigs, [Drive(np.zeros((3, 0)), np.zeros(2))])


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"input_low": 0.9}, "0 <= input_low < input_high <= 1"),
        ({"plant": rig_of(OUTLET)}, "expected pumps and sensors"),
        ({"plant": rig_of((Pipe("V", "A", "B", 6e-5, 0.6, valve="v"),), PUMP)}, "pipes without valves"),
        (
            {"plant": replace(rig_of(OUTLET, PUMP), effects=(PlacedEffect("leak", "A"),))},
            "got leak at A; leave them out",
        ),
    ],
)
def test_a_rig_that_cannot_be_exercised_is_refused(changes: dict[str, object], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Rig(**({"plant": rig_of(OUTLET, PUMP)} | changes))  # type: ignore[arg-type]


def test_a_rig_that_always_overflows_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conditions, "_MOST_TRIALS", 2)
    small = PlantDescription("small", (Tank("A", AREA, 1.0),), (), (Pump("Q", "A", 0.1),), (Sensor("a", "A"),))
    with pytest.raises(ValueError, match="lower input_high"):
        make(plans(1, 1, ("null",)), Rig(small), 1)


def test_a_rig_of_its_plant_file_alone_is_filled_half() -> None:
    given, found = three_tank(), exercised(three_tank().plant)
    assert (found.input_low, found.input_high) == (given.input_low, given.input_high)
    assert found.noise_unit == pytest.approx(given.noise_unit, rel=0.05)
    narrow = replace(given.plant, pipes=tuple(replace(p, area=0.5 * p.area) for p in given.plant.pipes))
    assert 0.3 < exercised(narrow).input_high < 0.6


def test_a_rig_that_cannot_drain_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conditions, "LEAST", 0.5)  # as a share of max_flow; each input that is tried takes 0.2 s
    with pytest.raises(ValueError, match="check that every tank drains"):
        exercised(rig_of((), PUMP))


def test_strange_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="got fancy"):
        plans(3, 1, ("single", "fancy"))


def test_leaving_out_nothing_that_exists_is_refused() -> None:
    with pytest.raises(ValueError, match="has a place in this plant"):
        choose(KINDS["left_out"], quadruple_tank(), 1, 0, (), ("cross_flow_of_oil",))


def test_a_library_that_names_all_leaves_nothing_unknown() -> None:
    assert "check_valve" not in [u.law for u in unknown_to(("check_valve",))]
    with pytest.raises(ValueError, match="lacks some effect"):
        unknown_to([u.effect for u in UNKNOWN])


def test_every_law_belongs_to_an_effect_or_an_unknown() -> None:
    laws = {*PUMP_LAWS, *HEAD_LAWS, *PIPE_LAWS, *TANK_LAWS, *STORAGE_LAWS, *SENSOR_LAWS, *READOUT_LAWS}
    rig = three_tank()
    built, rng = rig.plant, np.random.default_rng(4)
    levels, asked = rng.uniform(0.2, 0.5, (1000, 3)), rng.uniform(1e-5, 7e-5, (1000, 2))
    around = NominalRun(built, levels, asked, 1.0, rng)
    drawn = {draw_effect(effect, around, place).law for effect, place in effect_places(built) * 30}
    assert drawn | {u.law for u in UNKNOWN} == laws and not drawn & {u.law for u in UNKNOWN}


def test_the_vocabulary_is_the_protocols() -> None:
    assert set(DRAWS) == set(EFFECTS)
    assert len(effect_places(three_tank().plant)) == 62
    assert canonical(("plugging", "OUT2"), three_tank().plant) == ("leak", "T2")
    assert canonical(("plugging", "P13"), three_tank().plant) == ("plugging", "P13")


@pytest.mark.parametrize("rig", [three_tank(), quadruple_tank(), cascaded_tanks()], ids=lambda r: r.plant.name)
def test_inputs_stay_within_the_pumps(rig: Rig) -> None:
    rng = np.random.default_rng(5)
    signals = [signal for inputs in SIGNALS.values() for signal in inputs]
    for commands in (
        with_standstills(rig, rng, 3601, rig.plant.channels()[0]),
        *(commanded(rig, rng, 3601, signal) for signal in signals),
    ):
        assert commands.shape == (3601, len(rig.plant.channels())) and np.ptp(commands, axis=0).min() > 0
        assert (commands >= 0).all()
        for i, channel in enumerate(rig.plant.channels()):
            pump = next(p for p in rig.plant.pumps if p.channel == channel)
            unit = 1e-6 if pump.gain_unit == "1" else 1.0
            assert (commands[:, i] * unit * pump.gain <= pump.max_flow * 1.001).all()


def test_a_round_of_kinds_holds_each_once() -> None:
    order = [p.kind for p in plans(4 * len(STANDARD), 7, STANDARD)]
    rounds = [order[i : i + len(STANDARD)] for i in range(0, len(order), len(STANDARD))]
    assert all(sorted(r) == sorted(STANDARD) for r in rounds)
    assert len({tuple(r) for r in rounds}) > 1


@pytest.mark.slow
def test_a_case_is_the_same_in_any_company(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    rig, all_plans = three_tank(), plans(9, 3, STANDARD)
    together, alone = make(all_plans, rig, 3), make(all_plans[4:5], rig, 3)
    for a, b in zip(together[4].readings, alone[0].readings, strict=True):
        np.testing.assert_array_equal(a, b)
    assert together[4].truth == alone[0].truth


@pytest.mark.slow
@pytest.mark.parametrize("rig", [three_tank(), quadruple_tank(), cascaded_tanks()], ids=lambda r: r.plant.name)
def test_full_effects_show_and_stay_in_the_tanks(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise, a full effect moves some reading by more than the quietest noise; the null moves none."""
    monkeypatch.setattr(cases, "STEP", 0.5)
    for case in make(plans(40, 11, ("single", "null")), rig, 11):
        gap, truth = case.truth["gap_rms_m"]["recording"], case.truth
        quantised = truth["causes"] and truth["causes"][0]["effect"] == "sensor_quantization"
        assert np.isfinite(case.readings[0]).all()
        assert gap == 0 if truth["kind"] == "null" or quantised else gap > 0.05 * rig.noise_unit


def test_the_equilibrium_of_a_plant_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[Rig] = []
    monkeypatch.setattr(case_drafts, "levels_at_rest", lambda rig: computed.append(rig) or np.full(3, len(computed)))
    first, second = three_tank(), quadruple_tank()
    rest = case_drafts._equilibria([first, second, first])
    assert [levels.tolist() for levels in rest] == [[1.0] * 3, [2.0] * 3, [1.0] * 3]
    assert len(computed) == 2


def test_a_cause_that_another_hides_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A weir above all levels, beside a leak."""
    rig, plan = three_tank(), plans(1, 1, ("pair",))
    shows = Deviation("leak", "T1", "floor_hole", {"conductance": 3e-5})
    never = Deviation("overflow", "T3", "brim", {"crest": 0.99, "depth": 0.01, "flow": 7e-5})
    monkeypatch.setattr(case_drafts, "_with_sizes", lambda draft, *_: replace(draft, deviations=(shows, never)))
    monkeypatch.setattr(cases, "STEP", 0.5)
    truth = make(plan, rig, 1)[0].truth
    assert truth["causes"] == [{"effect": "leak", "location": "T1"}]
    assert [d["effect"] for d in truth["deviations"]] == ["leak", "overflow"]
