"""Free runs of a plant file, and the joint refit of what it holds."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import yaml

import fdi_torch
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.effects import build_network
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.free_runs.between_runs import between_run_spread
from fdi_torch.gap.free_runs.prediction import _starts, leave_one_file_out, predict
from fdi_torch.gap.free_runs.refit import refit
from fdi_torch.gap.recomputed import Recomputed
from fdi_torch.plant.description import OUTSIDE, Pipe, PlacedEffect, PlantDescription, Sensor, Tank
from fdi_torch.recording import Recording
from fdi_torch.simulate.simulated_recording import clean_readings

NOISE = 0.01  # V


def rig() -> PlantDescription:
    """Two cascaded tanks, the level of the upper one unseen, behind a pump that lags."""
    plant = load_plant("cascaded_tanks")
    return replace(plant, effects=(PlacedEffect("pump_lag", "pump", {"time_constant": 30.0}),))


def recording(plant: PlantDescription) -> Recording:
    """300 samples, 4 s apart, of the plant itself, with noise."""
    time = 4.0 * torch.arange(300, dtype=torch.float64)
    volts = 2.6 + 0.8 * torch.sin(time / 70.0) + 0.4 * torch.sin(time / 31.0)
    blank = Recording(
        time, volts.unsqueeze(1), torch.full((300, 1), 5.0).double(), ("u_pump",), ("y_lower_level",), ("V",), ("V",)
    )
    generator = torch.Generator().manual_seed(0)
    noise = NOISE * torch.randn(300, 1, dtype=torch.float64, generator=generator)
    return replace(blank, outputs=predict(plant, blank).readings + noise)


def test_the_free_run_of_the_right_plant_is_off_by_the_noise_and_finds_the_unseen_level() -> None:
    plant = rig()
    run = recording(plant)
    found = predict(plant, run)
    assert found.settled
    assert found.rmse["level"] == pytest.approx(NOISE, rel=0.15)
    assert predict(replace(plant, effects=()), run).rmse["level"] > 5 * NOISE


def test_only_the_first_samples_are_used() -> None:
    plant = rig()
    run = recording(plant)
    later = run.outputs.clone()
    later[60:] += 1.0
    moved = predict(plant, replace(run, outputs=later)).start_levels
    assert moved == pytest.approx(predict(plant, run).start_levels, rel=1e-9)


def test_nothing_to_start_from_is_said() -> None:
    plant = rig()
    with pytest.raises(ValueError, match="at least 1 sample"):
        predict(plant, recording(plant), start_samples=0)
    run = recording(plant).masked([(0.0, 300.0)])
    with pytest.raises(ValueError, match="among the first 50 samples, got none"):
        predict(plant, run)


def test_a_refit_finds_what_the_effects_are_and_loses_those_left_out() -> None:
    plant = rig()
    run = recording(plant)
    wrong = replace(plant, effects=(PlacedEffect("pump_lag", "pump", {"time_constant": 20.0}),))
    found = refit(wrong, run)
    assert found.rmse["level"] == pytest.approx(NOISE, rel=0.15)
    assert found.rmse["level"] < found.before["level"]
    assert predict(found.plant, run).rmse["level"] == pytest.approx(NOISE, rel=0.2)
    assert found.plant.effects[0].parameters["time_constant"] == pytest.approx(30.0, rel=0.1)
    assert refit(wrong, run, leave_out=["pump_lag"]).plant.effects == ()


def test_a_refit_that_finds_no_course_of_the_levels_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Fitter.fit

    def lost(fitter: Fitter, *asked: Any, **options: Any) -> Fit:
        fit = found(fitter, *asked, **options)
        broken = replace(fit.linearised, jacobian=torch.full_like(fit.linearised.jacobian, torch.nan))
        return replace(fit, trajectory=Recomputed(lambda: broken))

    plant = rig()
    run = replace(recording(plant), source="a.csv")
    monkeypatch.setattr(Fitter, "fit", lost)
    with pytest.raises(
        ValueError,
        match=r"no trajectory of the levels along a\.csv was found from the plant file's values",
    ):
        refit(plant, run)


def tank(**changes: object) -> PlantDescription:
    """One tank, filled by a pump whose command is known, emptied through a valve; its sensor zeroed before each run."""
    data = {
        "tanks": {"T": {"area": "100 cm^2", "height": "50 cm"}},
        "pipes": {"OUT": {"source": "T", "area": "0.5 cm^2", "discharge_coefficient": 0.6, "valve": "v"}},
        "pumps": {"Q": {"target": "T", "max_flow": "100 cm^3/s"}},
        "sensors": {"h": {"tank": "T"}},
        "tolerances": {"OUT.discharge_coefficient": 0.3, "Q.gain": 0.2, "h.offset": "2 cm"},
        "varying": ["h.offset"],
    }
    return build_plant({**data, **changes}, "tank")


def filling(gain: float, offset: float, seed: int, name: str = "a") -> Recording:
    """200 s of a tank like that, with a pump of another gain, read with an offset (m)."""
    time = torch.arange(201, dtype=torch.float64)
    flow = 1e-6 * (60.0 + 30.0 * torch.sin(time / (9.0 + seed)))
    inputs = torch.stack([flow, (time > 100.0).double()], dim=1)
    blank = torch.full((201, 1), 0.1, dtype=torch.float64)
    rig = tank(pumps={"Q": {"target": "T", "max_flow": "200 cm^3/s", "gain": gain}}, varying=[])
    empty = Recording(time, inputs, blank, ("Q", "v"), ("h",), ("m^3/s", "1"), ("m",), source=name, sha256=name)
    levels = predict(rig, empty).readings
    noise = 1e-4 * torch.randn(201, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return replace(empty, outputs=levels + offset + noise)


def test_what_varies_is_told_by_the_stretch_that_a_run_settles_in_and_errors_are_counted_after_it() -> None:
    """A pump that delivers a tenth more in this run. (Of the sensor's zero a closed tank tells nothing.)"""
    run = filling(1.1, 0.0, 1)
    plain, told = (predict(tank(), run, settle=40.0, vary=vary) for vary in ((), ("Q.*",)))
    assert set(plain.own) == {"h.offset"} and set(told.own) == {"h.offset", "Q.gain"}
    assert told.own["Q.gain"] == pytest.approx(1.1, abs=2e-3)
    assert told.rmse["h"] < 1e-3 < 0.1 * plain.rmse["h"]
    later = told.residuals[run.time > 40.0, 0]
    assert told.rmse["h"] == pytest.approx(float((later**2).mean()) ** 0.5, rel=1e-12)
    spoilt = run.outputs.clone()
    spoilt[run.time > 40.0] += 0.1
    again = predict(tank(), replace(run, outputs=spoilt), settle=40.0, vary=("Q.*",))
    assert again.own["Q.gain"] == pytest.approx(told.own["Q.gain"], rel=1e-4)


def test_water_that_goes_missing_while_the_plant_settles_bends_nothing_and_the_run_goes_on_from_where_it_led() -> None:
    """A pump that delivers 70 % of what it is asked for in the first 20 s, and all of it ever after."""
    asked = filling(1.0, 0.0, 1)
    short = asked.inputs.clone()
    short[asked.time < 20.0, 0] *= 0.7
    missed = float((asked.inputs - short)[:, 0].sum()) / 0.01  # m: of a tank of 100 cm^2
    levels = predict(tank(varying=[]), replace(asked, inputs=short), start_samples=1).readings
    noise = 1e-4 * torch.randn(201, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    run = replace(asked, outputs=levels + noise)
    assert missed > 0.03 and predict(tank(), run, start_samples=3).rmse["h"] > 0.5 * missed
    found = predict(tank(), run, settle=30.0)
    assert found.settled and found.rmse["h"] < 1e-3
    assert found.own["h.offset"] == pytest.approx(0.0, abs=1e-3)


def test_a_tank_that_no_sensor_shows_changes_nothing_in_how_the_others_settle() -> None:
    """The tank empties in free fall into another, of which the level above tells nothing."""
    asked = filling(1.0, 0.0, 1)
    short = asked.inputs.clone()
    short[asked.time < 20.0, 0] *= 0.7
    run = replace(asked, outputs=predict(tank(varying=[]), replace(asked, inputs=short), start_samples=1).readings)
    size = {"area": "0.5 cm^2", "discharge_coefficient": 0.6}
    pipes = {
        "OUT": {"source": "T", "target": "below", "free_fall": True, "valve": "v", **size},
        "END": {"source": "below", **size},
    }
    tanks = {name: {"area": "100 cm^2", "height": "50 cm"} for name in ("T", "below")}
    alone, above = (predict(plant, run, settle=30.0) for plant in (tank(), tank(tanks=tanks, pipes=pipes)))
    assert above.own["h.offset"] == pytest.approx(alone.own["h.offset"], abs=1e-5)
    assert above.rmse["h"] == pytest.approx(alone.rmse["h"], abs=1e-5)


def test_a_tank_at_rest_in_steps_of_its_sensor_leaves_the_zero_where_it_is_believed() -> None:
    """The valve opens in the last seconds of the stretch, faster than the plant has it; before, nothing moves."""
    asked = filling(1.0, 0.0, 1)
    time = asked.time
    opened = (time > 36.0).double()
    still = torch.zeros_like(time)
    start = torch.full_like(asked.outputs, 0.3)
    wide = tank(
        pipes={"OUT": {"source": "T", "area": "0.8 cm^2", "discharge_coefficient": 0.6, "valve": "v"}}, varying=[]
    )
    full = replace(asked, inputs=torch.stack([still, opened], dim=1), outputs=start)
    levels = predict(wide, full, start_samples=1).readings
    run = replace(full, outputs=(levels / 4e-5).round() * 4e-5)
    found = predict(tank(tolerances={"h.offset": "1 mm"}), run, settle=40.0)
    assert abs(found.own["h.offset"]) < 1e-3
    after = int((time <= 40.0).sum())
    more = (
        0.6 * 0.3e-4 * math.sqrt(2 * 9.81 * 0.3) / 1e-2
    )  # m/s that the plant does not know of, for 4 s in the stretch
    assert abs(float(found.residuals[after, 0])) < 2.0 * more


def test_a_run_needs_something_to_settle_in_and_something_left() -> None:
    run = filling(1.1, 0.0, 1)
    for seconds in (0.0, 200.0, 1e4):
        with pytest.raises(ValueError, match="an initial segment of more than 0 s and less than the 200 s"):
            predict(tank(), run, settle=seconds)
    with pytest.raises(ValueError, match=r"with a tolerance to vary .*got 'Z.gain'; the nearest is 'Q.gain'"):
        predict(tank(), run, vary=("Z.gain",))


def row_of_tanks(unmeasured: int) -> PlantDescription:
    """Tanks that drain from one into the next, of which only the last has a sensor."""
    names = [f"T{i}" for i in range(unmeasured + 1)]
    tanks = tuple(Tank(name, 1e-3, 0.5) for name in names)
    ends = zip(names, [*names[1:], OUTSIDE], strict=True)
    pipes = tuple(Pipe(f"P{i}", a, b, 2e-5, 0.6) for i, (a, b) in enumerate(ends))
    return PlantDescription("row", tanks, pipes, sensors=(Sensor("h", names[-1]),))


@pytest.mark.parametrize(("unmeasured", "count"), [(0, 1), (1, 4), (2, 16), (8, 4 + 12 * 8)])
def test_the_starts_of_tanks_without_a_sensor_grow_in_proportion_to_their_number(unmeasured: int, count: int) -> None:
    assert len(_starts(row_of_tanks(unmeasured), {f"T{unmeasured}.start_level": 0.3})) == count


def test_the_initial_levels_of_four_tanks_without_a_sensor_are_found() -> None:
    plant, levels = row_of_tanks(4), (0.1, 0.4, 0.15, 0.3, 0.2)
    time = torch.arange(0.0, 120.0, 2.0, dtype=torch.float64)
    blank = plant.recording(time, time.new_zeros(len(time), 0), time.new_zeros(len(time), 1))
    network = build_network(plant)
    clean = clean_readings(network, blank, {f"T{i}.start_level": h for i, h in enumerate(levels)})
    noise = 1e-4 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = predict(plant, replace(blank, outputs=clean + noise), start_samples=60)
    assert found.start_levels == pytest.approx({f"T{i}": h for i, h in enumerate(levels)}, abs=0.025)


@pytest.mark.parametrize("start", [0.05, 0.0503, 0.0506, 0.0509, 0.0512])
def test_a_tank_that_runs_dry_over_an_outlet_that_ends_below_it_settles_at_its_floor(start: float) -> None:
    """A drain hose 10 cm long, open from the start; 10 cm^3/s come in from 150 s on, less than it draws from the floor:
    5e-5 m^2 * 0.6 * sqrt(2 g d) = 42 cm^3/s.
    """
    effects = [{"effect": "outlet_drop", "location": "OUT", "parameters": {"drop": "10 cm"}}]
    time = torch.arange(0.0, 300.0, 2.0, dtype=torch.float64)
    inputs = torch.stack([1e-5 * (time > 150.0), torch.ones_like(time)], dim=1)
    blank = torch.full((150, 1), start, dtype=torch.float64)
    run = Recording(time, inputs, blank, ("Q", "v"), ("h",), ("m^3/s", "1"), ("m",))
    found = predict(tank(effects=effects, varying=[]), run, start_samples=1, step=2.0)
    level = found.readings[:, 0]
    assert found.settled
    # A dh/dt = -C a sqrt(2 g (h + d)) ends after (A / C a) sqrt(2 / g) (sqrt(h0 + d) - sqrt(d)), some 14 s
    dry = 1e-2 / (0.6 * 5e-5) * math.sqrt(2.0 / 9.81) * (math.sqrt(start + 0.1) - math.sqrt(0.1))
    assert float(level[time < dry - 2.0].min()) > 1e-3
    assert float(level[time > dry + 2.0].abs().max()) < 1e-6


def test_a_tank_that_is_filled_again_after_it_ran_dry_settles() -> None:
    """A first guess has it dry where it is not, for as long as it takes to empty: that must not have to be unlearnt
    one step at a time.
    """
    effects = [{"effect": "outlet_drop", "location": "OUT", "parameters": {"drop": "5 cm"}}]
    plant = tank(tanks={"T": {"area": "400 cm^2", "height": "50 cm"}}, effects=effects, varying=[])
    time = torch.arange(0.0, 1200.0, 2.0, dtype=torch.float64)
    inputs = torch.stack([6e-5 * (time % 600.0 < 250.0), (time % 600.0 >= 200.0).double()], dim=1)
    blank = torch.zeros(600, 1, dtype=torch.float64)
    found = predict(plant, Recording(time, inputs, blank, ("Q", "v"), ("h",), ("m^3/s", "1"), ("m",)), 1, step=2.0)
    level = found.readings[:, 0]
    assert found.settled
    assert float(level[100]) == pytest.approx(0.3, abs=1e-6)  # 200 s of 60 cm^3/s into 400 cm^2
    assert float(level[299].abs()) < 1e-6
    torch.testing.assert_close(level[:300], level[300:], rtol=0.0, atol=1e-6)  # empty between, so both cycles are one


def test_a_sensor_that_reads_less_than_nothing_is_off_and_its_tank_empty() -> None:
    run = filling(1.0, 0.0, 1)
    early = replace(run, outputs=run.outputs - float(run.outputs[0]) - 0.01)
    found = predict(tank(), early, start_samples=3)
    assert found.start_levels["T"] == pytest.approx(0.0, abs=1e-3)
    assert predict(tank(varying=[]), early, start_samples=3).rmse["h"] > found.rmse["h"]


def test_several_recordings_share_what_does_not_vary_and_held_constants_stay() -> None:
    runs = [filling(1.1, 0.004, 1), filling(1.1, -0.004, 2, "b")]
    found = refit(tank(), runs, white=1e-4)
    value, error = found.fitted["Q.gain"]
    assert abs(value - 1.1) < 4.0 * error < 0.05
    assert found.plant.pumps[0].gain == value
    assert found.plant.varying == ("h.offset",) and "h.offset" not in found.fitted
    held = refit(tank(), runs, white=1e-4, hold=["Q.*"])
    assert held.plant.pumps[0].gain == 1.0 and held.plant.tolerances["Q.gain"] == 0.2
    assert held.rmse["h"] > found.rmse["h"]


def test_what_a_refit_is_to_hold_or_to_vary_must_be_there() -> None:
    runs = [filling(1.0, 0.0, 1)]
    with pytest.raises(ValueError, match=r"a constant of the plant to hold .*got 'Q.gian'; the nearest is 'Q.gain'"):
        refit(tank(), runs, hold=["Q.gian"])
    with pytest.raises(ValueError, match=r"with a tolerance to vary \(.*\), got 'Q.max_flow'"):
        refit(tank(), runs, vary=["Q.max_flow"])


def test_what_each_recording_has_for_itself_is_told_with_how_much_it_differs() -> None:
    runs = [filling(0.9, 0.0, 1), filling(1.0, 0.0, 2, "b"), filling(1.1, 0.0, 3, "c")]
    found = refit(tank(), runs, white=1e-4, vary=["Q.*"])
    gains = [own for own in found.own if own.name == "Q.gain"]
    assert [own.source for own in gains] == ["a", "b", "c"]
    for own, truth in zip(gains, (0.9, 1.0, 1.1), strict=True):
        assert abs(own.value - truth) < 4.0 * own.std < 0.05
        assert own.nominal == 1.0 and 0.9 < own.share < 1.0, "nearly all from the readings"
    told = between_run_spread(gains, 0.2)
    assert told is not None and told.std == pytest.approx(0.1, rel=0.05) and told.low < 0.1 < told.high
    assert "Q.gain" not in found.fitted
    # The next recording is best believed to have what is typical: the plant file's 1.0 counts as one recording more.
    assert refit(tank(), [runs[0]], white=1e-4, vary=["Q.*"]).plant.pumps[0].gain == pytest.approx(0.95, abs=0.01)
    assert refit(tank(), runs[1:], white=1e-4, vary=["Q.*"]).plant.pumps[0].gain == pytest.approx(1.0, abs=0.01)
    higher = [runs[2], filling(1.15, 0.0, 4, "d")]
    assert refit(tank(), higher, white=1e-4, vary=["Q.*"]).plant.pumps[0].gain == pytest.approx(1.1, abs=0.01)


def test_a_file_is_predicted_by_what_the_others_say() -> None:
    runs = [filling(1.1, 0.0, 1), filling(1.1, 0.0, 2, "b"), filling(1.2, 0.0, 3, "c")]
    trials = leave_one_file_out(tank(), runs, runs, lambda rest: refit(tank(), rest, white=1e-4).plant, 3)
    assert [t.source for t in trials] == ["a", "b", "c"]
    assert trials[0].refitted["h"] < trials[0].as_is["h"]  # 1.1 and 1.2 are nearer to 1.1 than the believed 1 is
    alone = leave_one_file_out(tank(), runs[:2], runs[2:], lambda rest: refit(tank(), rest, white=1e-4).plant, 3)
    assert alone[0].refitted["h"] == pytest.approx(trials[2].refitted["h"], rel=1e-6)
    with pytest.raises(ValueError, match="recordings of another file"):
        leave_one_file_out(tank(), runs[:1], runs[:1], lambda rest: tank(), 3)


def test_a_sensor_that_hardly_moves_does_not_bend_the_initial_levels_of_the_others() -> None:
    """The level of the basin barely changes, and is off by an error of its outlet. A settles within the first samples:
    a wrong level of A at first could make up for a part of that error."""
    text = """{tanks: {A: {area: 0.1 m^2, height: 1 m}, basin: {area: 1 m^2, height: 1 m}},
        pipes: {fall: {source: A, target: basin, area: 3 cm^2, discharge_coefficient: 0.6, free_fall: true},
          out: {source: basin, target: outside, area: 12 cm^2, discharge_coefficient: %s}},
        pumps: {Q: {target: A, max_flow: 3 m^3/h}}, sensors: {a: {tank: A}, b: {tank: basin}}}"""
    true, wrong = (build_plant(yaml.safe_load(text % c), "rig") for c in (0.66, 0.6))
    steps = {"Q": {"steps": [["0 s", "1.2 m^3/h"], ["2000 s", "2.2 m^3/h"]]}}
    noise = {"std": {"a": "1 mm", "b": "1 mm"}}
    run = fdi_torch.simulate(true, inputs=steps, duration="4000 s", sample_time="10 s", noise=noise)
    found = predict(wrong, run)
    assert found.start_levels["A"] == pytest.approx(float(run.outputs[:10, 0].mean()), abs=0.003)
    assert found.rmse["a"] == pytest.approx(0.001, rel=0.2)
