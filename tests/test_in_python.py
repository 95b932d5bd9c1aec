"""The Python interface: a rig in code equals its file, and the functions return results with a display."""

from __future__ import annotations

import doctest
import re
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

import fdi_torch
from fdi_torch import Pipe, PlacedEffect, Plant, Pump, Recording, Sensor, Tank
from fdi_torch.config import plant_in_code
from fdi_torch.config.plant_file import build_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import Source
from fdi_torch.config.run_file import build_run
from fdi_torch.config.yaml_files import shipped_plants
from fdi_torch.quantities import displayed_in
from tests.rigs import blank_recording

IN_YAML = """
name: rig
gravity: 9.81 m/s^2
tanks:
  A: {area: 200 cm^2, height: 60 cm, start_level: 30 cm, overflow_to: B}
  B: {area: 0.03 m^2, height: 2 ft, leak_reference: drain}
pipes:
  link: {source: A, target: B, area: 0.6 cm^2, discharge_coefficient: 60 %, valve: v, unrecorded: 1}
  drain: {source: B, target: outside, area: 0.5 cm^2, discharge_coefficient: 0.62, elevation: 5 mm}
pumps:
  Q: {target: A, max_flow: 6 l/min, gain: 2 l/min/V, command: u}
sensors:
  h: {tank: A}
  p: {tank: B, gain: 98.1 mbar/m, offset: 2 mbar, low: 0 mbar, high: 100 mbar, channel: pB}
tolerances: {"*.discharge_coefficient": 3 %, h.offset: 2 mm, Q.pump_lag.time_constant: 1 s}
varying: ["*.offset"]
effects:
  - {effect: pump_lag, location: Q, parameters: {time_constant: 8 s}}
"""


def in_code(**changes: Any) -> Plant:
    parts: dict[str, Any] = {
        "tanks": [
            Tank("A", area="200 cm^2", height="60 cm", start_level="30 cm", overflow_to="B"),
            Tank("B", area=0.03, height="2 ft", leak_reference="drain"),
        ],
        "pipes": [
            Pipe("link", "A", "B", area="0.6 cm^2", discharge_coefficient="60 %", valve="v", unrecorded=1),
            Pipe("drain", "B", "outside", area="0.5 cm^2", discharge_coefficient=0.62, elevation="5 mm"),
        ],
        "pumps": [Pump("Q", "A", max_flow="6 l/min", gain="2 l/min/V", command="u")],
        "sensors": [
            Sensor("h", "A"),
            Sensor("p", "B", gain="98.1 mbar/m", offset="2 mbar", low="0 mbar", high="100 mbar", channel="pB"),
        ],
        "tolerances": {"*.discharge_coefficient": "3 %", "h.offset": "2 mm", "Q.pump_lag.time_constant": 1.0},
        "varying": ["*.offset"],
        "effects": [PlacedEffect("pump_lag", "Q", {"time_constant": "8 s"})],  # type: ignore[dict-item]
        "name": "rig",
    }
    return Plant(**(parts | changes))


def test_a_plant_in_code_equals_its_file_both_ways() -> None:
    plant = in_code()
    read = build_plant(yaml.safe_load(IN_YAML), "rig.yaml")
    assert plant == read and read == plant
    assert build_plant(yaml.safe_load(fdi_torch.dump_plant(plant)), "again") == plant
    assert plant.channel_units() == {"u": "V", "v": "1"} and plant.sensors[1].unit == "Pa"
    assert in_code(gravity="981 cm/s^2") == plant and in_code(gravity=1.62) != plant


@pytest.mark.parametrize("name", shipped_plants())
def test_every_shipped_plant_can_be_taken_apart_and_put_together_in_code(name: str) -> None:
    shipped = fdi_torch.load_plant(name)
    again = Plant(
        shipped.tanks,
        shipped.pipes,
        shipped.pumps,
        shipped.sensors,
        effects=shipped.effects,
        tolerances=shipped.tolerances,
        varying=shipped.varying,
        gravity=shipped.gravity,
        name=shipped.name,
    )
    assert again == shipped and again.effects == shipped.effects


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda: Tank("A", area="200 cm", height=1.0), "tanks.A.area: expected a quantity in m^2, got '200 cm'"),
        (
            lambda: Tank("A", 0.02, 0.6, "70 cm"),
            "tanks.A.start_level: expected a level from the floor to 60 cm, got 70 cm",
        ),
        (lambda: Pump("Q", "A", max_flow=1e-4, gain="2 bar"), "pumps.Q.gain: expected a quantity in 1 or m^3/s/V or"),
        (lambda: Sensor("h", "A", gain="1 s"), "sensors.h.gain: expected a quantity in 1 or Pa/m or V/m"),
        (lambda: Sensor("h", "A", offset="1 V"), "sensors.h.offset: expected a quantity in m, got '1 V'"),
        (lambda: Pipe("P", "A", "B", area="1e14 m^2", discharge_coefficient=0.6), "pipes.P.area: expected a quantity"),
        (lambda: in_code(sensors=[]), "sensors: expected at least one, got none"),
        (lambda: in_code(tolerances={"linc.area": 0.1}), "tolerances.linc.area: expected a constant"),
        (lambda: in_code(tanks=Tank("A", 0.02, 0.6)), "expected a list such as [Tank(...), ...], got a Tank"),
        (lambda: in_code(tanks=["A"]), "tanks: expected a list such as [Tank(...), ...], got a str"),
        (lambda: in_code(tolerances={"link.area": -0.1}), "tolerances.link.area: expected a positive tolerance"),
        (lambda: in_code(varying=["link.area"]), "varying: expected a constant with a tolerance"),
        (lambda: in_code(gravity="9.81 m"), "gravity: expected a quantity in m/s^2"),
        (lambda: in_code(effects=[PlacedEffect("pump_lag", "A")]), "effects.0: A.pump_lag: expected a place of kind"),
        (
            lambda: in_code(effects=[PlacedEffect("pump_lag", "Q", {"tau": 1.0})]),
            "effects.0.parameters: expected a parameter of pump_lag",
        ),
        (
            lambda: in_code(pipes=[Pipe("drain", "A", "B", 1e-4, 60.0)]),
            "at most 10, got 60; is it in per cent",
        ),
        (lambda: in_code(pipes=[Pipe("drain", "A", "B", 1e-4, 0.6, unrecorded=2)]), "expected an opening from 0 to 1"),
    ],
)
def test_what_is_wrong_is_said_with_component_and_field(wrong: Any, sentence: str) -> None:
    with pytest.raises(ValueError) as told:
        wrong()
    assert sentence in str(told.value)


def test_the_example_of_a_plant_runs() -> None:
    names = {name: getattr(fdi_torch, name) for name in ("Plant", "Tank", "Pipe", "Pump", "Sensor")}
    example = doctest.DocTestFinder(recurse=False).find(plant_in_code.Plant, "Plant", globs=names)
    assert doctest.DocTestRunner().run(example[0]).attempted == 1 and not doctest.DocTestRunner().failures


RIG = Plant(
    tanks=[Tank("A", area="200 cm^2", height="60 cm")],
    pipes=[Pipe("drain", "A", "outside", area="0.5 cm^2", discharge_coefficient=0.6)],
    pumps=[Pump("Q", "A", max_flow="6 l/min")],
    sensors=[Sensor("h", "A")],
    tolerances={"*.discharge_coefficient": "1 %"},
    name="one tank",
)
STEPS = {"Q": {"steps": [["0 s", "3 l/min"], ["100 s", "4 l/min"], ["200 s", "2.5 l/min"]]}}


def simulated(**faults: Any) -> Recording:
    noise = {"std": {"h": "1 mm"}}
    return fdi_torch.simulate(RIG, inputs=STEPS, duration="300 s", noise=noise, faults=faults, seed=3)


def test_a_plant_file_keeps_the_units_of_quantities_in_code() -> None:
    """Whatever unit another quantity of that kind was given in first; a changed component has none of its own."""
    weir = fdi_torch.Weir("over", "A", "B", crest="45 cm", width="30 mm")
    plant = in_code(tanks=[Tank("A", area="0.1 m^2", height="1 m"), Tank("B", area=0.03, height="2 ft")], weirs=[weir])
    written = plant_mapping(plant)
    assert written["weirs"]["over"] | {"crest": "45 cm", "width": "30 mm"} == written["weirs"]["over"]
    assert written["tanks"]["B"]["height"] == "2 ft" and written["sensors"]["p"]["offset"] == "2 mbar"
    moved = plant_mapping(replace(plant, weirs=(replace(weir, crest=0.4),)))
    assert moved["weirs"]["over"]["crest"] == "0.4 m" and plant == build_plant(written, Source("plant"))


def test_every_job_takes_a_run_as_a_mapping_or_a_file(tmp_path: Path) -> None:
    """One run for all: simulate it, then gap, predict and refit of what it simulates equal those of the recording."""
    recording = simulated(**{"A.leak": 0.3})
    keys = {"inputs": STEPS, "duration": "300 s", "noise": {"std": {"h": "1 mm"}}, "faults": {"A.leak": 0.3}}
    run = {"plant": RIG, "simulate": keys, "seed": 3}
    assert torch.equal(fdi_torch.simulate(run).outputs, recording.outputs)
    assert torch.equal(
        fdi_torch.simulate({**run, "simulate": {**keys, "seed": 3}, "seed": 0}).outputs, recording.outputs
    )
    file = tmp_path / "run.yaml"
    file.write_text(yaml.safe_dump({**run, "plant": plant_mapping(RIG)}))
    assert torch.equal(fdi_torch.simulate(file).outputs, recording.outputs)
    real = {"plant": RIG, "recordings": [recording]}
    for of_run in (run, file, real):
        assert fdi_torch.predict(of_run).headline == fdi_torch.predict(RIG, recording).headline
    assert fdi_torch.refit(real).fit.fitted == fdi_torch.refit(RIG, recording).fit.fitted
    library = {"library": "leak", "out": tmp_path}
    assert fdi_torch.gap(real, **library).headline == fdi_torch.gap(RIG, recording, **library).headline  # type: ignore[arg-type]
    with pytest.raises(fdi_torch.ConfigError, match=r"simulate: inputs: expected every channel of the plant, .* for Q"):
        fdi_torch.simulate(RIG)
    with pytest.raises(TypeError, match=r"simulate: expected either a run or a plant with .* of simulate, got both"):
        fdi_torch.simulate(run, duration="100 s")
    with pytest.raises(ValueError, match=r"expected simulate, got none"):
        fdi_torch.simulate(real)
    with pytest.raises(TypeError, match=r"expected the name of a file, or its keys .* got a Plant"):
        fdi_torch.predict(RIG)


def test_a_rig_in_code_from_simulation_to_report(here: Path) -> None:
    recording = simulated(**{"A.leak": 0.3})
    again = simulated(**{"A.leak": 0.3})
    assert torch.equal(recording.outputs, again.outputs)
    assert "301 samples, 300 s" in repr(recording) and "<table>" in recording._repr_html_()
    found = fdi_torch.train(RIG, recording, ["A.leak"], output={"folder": "results"})
    assert found.log.parent.name == "results"
    assert "nominal" in found.brief().header and "simulated" not in found.brief().header
    run = {"plant": RIG, "recordings": [recording], "estimate": {"parameters": ["A.leak"]}}
    assert torch.equal(fdi_torch.train(run).estimate.value, found.estimate.value)
    row = found.table().columns["parameter"].index("A.leak.size")
    estimate_of, error_of = (found.table().columns[name][row] for name in ("estimate", "std error"))
    assert abs(estimate_of - 0.3) < 4.0 * error_of < 0.2
    assert found.headline.startswith("single fault: leak at A (size 0.") and "A.leak.size" in repr(found)
    assert "<table>" in found._repr_html_()
    assert "<b>Estimate of 3 parameters: converged</b>" in found.estimate._repr_html_()
    assert repr(found.estimate).startswith("Estimate: converged\nparameter") and "A.leak.size" in repr(found.estimate)
    # 200 cm^2 x 60 cm are 12 l, which leave in 2 A sqrt(H) / (0.6 * 0.5e-4 * sqrt(2 g)) = 233.17 s
    sizes = "".join(f'<td style="text-align: right">{size}</td>' for size in (200, 60, 12, 233))
    assert f'<td style="text-align: left">A</td>{sizes}' in RIG._repr_html_()
    for html in (found._repr_html_(), RIG._repr_html_(), fdi_torch.predict(RIG, recording)._repr_html_()):
        assert "<svg" in html and "var(--" not in html  # a notebook does not define the variables of our pages
        assert "max-width" in html
    assert re.search(r"mcap: train, started 20.*, completed$", repr(fdi_torch.read_run(found.log)))
    page = fdi_torch.report(found.log)
    assert page.page.read_text().count("one tank") and "leak at A" in page.table().columns["says"][0]


def test_a_gap_is_found_closed_and_adopted_in_python(tmp_path: Path) -> None:
    recording, other = simulated(**{"Q.pump_lag.time_constant": "12 s"}), simulated(**{"Q.pump_gain.factor": 0.8})
    found = fdi_torch.gap(RIG, other, recording, out=tmp_path, library=("pump_gain", "leak"))
    assert found.answer.verdict == "named" and "pump gain at Q" in found.headline
    assert found.table().columns["parameter"] == ["factor"] and len(found.explanations()) >= 1
    assert "<svg" in found._repr_html_() and "probability, %" in found._repr_html_()
    better = found.adopted()
    before, after = (fdi_torch.predict(plant, other).prediction.rmse["h"] for plant in (RIG, better))
    assert after < 0.5 * before
    name = "drain.discharge_coefficient"
    assert 0.0 < found.narrowed().tolerances[name] < RIG.tolerances[name] == better.tolerances[name]
    with pytest.raises(ValueError, match=r"gap: expected a setting .* got 'recording'; the nearest is 'recordings'"):
        fdi_torch.gap(plant="three_tank", recording="run.csv")
    with pytest.raises(ValueError, match=r"gap: expected a setting .* got 'libary'; the nearest is 'library'"):
        fdi_torch.gap(RIG, other, libary=())


def test_a_monitor_runs_along_a_recording_in_memory(tmp_path: Path) -> None:
    faults = {"A.leak": 0.3, "A.leak.onset": "400 s"}
    noise = {"std": {"h": "1 mm"}}
    recording = fdi_torch.simulate(RIG, inputs={"Q": "3 l/min"}, duration="700 s", noise=noise, faults=faults)
    keys = {"fault_free": ["0 s", "300 s"], "faults": ["A.leak"], "output": {"folder": str(tmp_path)}}
    found = fdi_torch.monitor(RIG, recording, **keys)
    assert fdi_torch.monitor({"plant": RIG, "recording": recording, **keys}).headline == found.headline
    headline = r"1 alarm in 700 s; leak at A \(size (.*) ± (.*), (.*) l/min now\)"
    size, error, flow = map(float, re.fullmatch(headline, found.headline).groups())  # type: ignore[union-attr]
    assert abs(size - 0.3) < 3.0 * error < 0.01
    assert 0.0 < flow < 3.0  # of the inflow
    table = found.table().columns
    kinds = [kind for kind in table["kind"] if kind not in ("notice", "watching")]
    assert kinds[:2] == ["alarm", "isolated"]
    assert "isolated" in repr(found) and "stds" not in repr(found)
    assert found._repr_html_().count("<svg") == 1 and "threshold" in found._repr_html_()
    isolated = table["kind"].index("isolated")
    assert table["onset"][isolated] == pytest.approx(400.0, abs=3.0) and table["units"][isolated] == ("1",)


def test_runs_are_compared_in_python_as_by_the_command(tmp_path: Path) -> None:
    """Two estimates of one leak from two recordings, in the units of the first run's plant."""
    rig = replace(RIG, units={**RIG.units, "m": "mm"})
    noise, logs = {"std": {"h": "1 mm"}}, []
    for seed in (3, 4):
        recording = fdi_torch.simulate(
            rig, inputs=STEPS, duration="300 s", noise=noise, faults={"A.leak": 0.3}, seed=seed
        )
        run = {"plant": rig, "recordings": [recording], "estimate": {"parameters": ["A.leak"]}}
        logs.append(fdi_torch.train(run | {"output": {"folder": str(tmp_path), "name": f"seed{seed}"}}).log)
    found = fdi_torch.compare(logs)
    estimates = {row[0]: row for row in zip(*found.table().columns.values(), strict=True)}
    names = ["parameter", "unit", "seed3", "seed3 std error", "seed4", "seed4 std error", "p", "agree"]
    assert list(found.table().columns) == [*names, "difference, std errors"]
    for name, wanted in zip(("A.leak.size", "A.start_level"), ("1", "mm"), strict=True):
        (result,) = (each for each in found.comparison.results if each.name == name)
        scale = 1000.0 if wanted == "mm" else 1.0
        numbers = [scale * x for pair in zip(result.values, result.std, strict=True) for x in pair]
        assert estimates[name] == (
            name,
            wanted,
            *map(pytest.approx, numbers),
            result.p_value,
            result.agree,
            result.apart,
        )
    assert found.headline.startswith("seed3: Single fault: leak at A") and found.headline.endswith(
        "there they agree at 95 %."
    )
    assert "They read different recordings" in found.headline and not found.comparison.same_data
    shown = re.search(r"A.leak.size +1 +(\S+ ± \S+) +(\S+ ± \S+) +\S+ +yes", repr(found))
    assert repr(found).startswith("ComparisonResult: seed3: ") and shown
    for each in zip(shown.groups(), estimates["A.leak.size"][2:6:2], estimates["A.leak.size"][3:6:2], strict=True):
        assert [*map(float, each[0].split(" ± "))] == [pytest.approx(x, rel=0.05) for x in each[1:]]
    html = found._repr_html_()
    assert "<table>" in html and html.count("<svg") == len(found.pictures) > 0 and "var(--" not in html
    assert "seed4" in found.settings().columns and len(found.to_pandas()) == len(estimates)
    with pytest.raises(ValueError, match="expected at least two logs to compare, got 1"):
        fdi_torch.compare(logs[:1])


def test_tables_are_in_the_units_that_the_user_wrote(tmp_path: Path) -> None:
    """A rig in mm and l/min; another plant, in ft, is in use when the results are printed."""
    rig = replace(RIG, units={**RIG.units, "m": "mm"})
    recording = fdi_torch.simulate(rig, inputs=STEPS, duration="300 s", noise={"std": {"h": "1 mm"}}, seed=3)
    run = {"plant": rig, "recordings": [recording], "estimate": {"parameters": ["A.leak"]}}
    found = fdi_torch.train(run | {"output": {"folder": str(tmp_path)}})
    free, calibrated = fdi_torch.predict(rig, recording), fdi_torch.refit(rig, recording)
    with displayed_in({"m": "ft"}):
        estimate, ranges = found.table().columns, recording.table().columns
        level = estimate["parameter"].index("A.start_level")
        assert estimate["unit"][level] == "mm"
        assert estimate["estimate"][level] == pytest.approx(1e3 * float(found.result.estimate.value[level]), rel=1e-12)
        assert free.table().columns["unit"] == ["mm"]
        assert free.table().columns["RMSE"][0] == pytest.approx(1e3 * free.prediction.rmse["h"], rel=1e-12)
        assert ranges["unit"] == ["l/min", "mm"]
        assert ranges["highest"][0] == pytest.approx(6e4 * float(recording.inputs.max()), rel=1e-12)
        shown = [*map(repr, (found, free, calibrated, recording)), found.profile("A.start_level")[0].headline]
    assert " mm" in calibrated.headline and shown[-1].endswith("mm") and "ft" not in "".join(shown[:-1]).split()


def test_a_plant_prints_as_its_file() -> None:
    assert build_plant(yaml.safe_load(str(in_code())), "text") == in_code()


def test_a_plant_shows_its_name_and_the_number_of_its_components() -> None:
    assert repr(fdi_torch.load_plant("three_tank")) == "<Plant three_tank: 3 tanks, 3 pipes, 2 pumps, 3 sensors>"


def test_a_wrong_argument_of_simulate_is_named_as_an_argument() -> None:
    for arguments, problem in (
        ({"inputs": {"Q": "3 bananas"}}, r"inputs\.Q: expected a quantity in m\^3/s"),
        ({"duration": "3 m"}, "duration: expected a quantity in s"),
        ({"inputs": {"Q": "3 l/min"}, "faults": {"X.leak": 0.3}}, r"faults: X\.leak: plant .*: expected one of"),
    ):
        wrong: Any = arguments
        with pytest.raises(fdi_torch.ConfigError, match=f"^simulate: {problem}"):
            fdi_torch.simulate(RIG, **wrong)


def test_shares_of_progress_have_three_decimals(tmp_path: Path) -> None:
    shares: list[float] = []
    run = simulated()
    fdi_torch.train(
        RIG, run, ["A.leak"], output={"folder": str(tmp_path)}, tell=lambda share, text: shares.append(share)
    )
    assert len(set(shares)) > 3 and shares == [round(share, 3) for share in shares]


def test_an_integration_step_with_a_unit_is_refused_in_a_sentence() -> None:
    fitting: Any = fdi_torch.set_up(RIG, [simulated()], ["A.leak"], "equilibrium")
    for method in (fitting.engines, fitting.problem):
        with pytest.raises(ValueError, match=r"expected the integration step as a number of seconds, got '1 s'"):
            method("1 s")


def test_arguments_of_another_kind_are_named() -> None:
    blank: Any = simulated()
    for function in (fdi_torch.train, fdi_torch.monitor, fdi_torch.study):
        with pytest.raises(TypeError, match=r"expected the name of a file, or its keys .* got a Plant"):
            function(RIG)  # type: ignore[operator]
    with pytest.raises(TypeError, match="plant: expected a Plant or the name of a plant file, got a Recording"):
        fdi_torch.predict(blank, RIG)  # type: ignore[arg-type]
    with pytest.raises(
        fdi_torch.ConfigError, match=r"inputs.Q: expected a value such as .* or \{steps: .*got \[3, 4\]"
    ):
        fdi_torch.simulate(RIG, inputs={"Q": [3, 4]})
    with pytest.raises(
        fdi_torch.ConfigError, match=r"A.leak.onset: expected less than the duration of 100 s, got 200 s"
    ):
        late: dict[str, Any] = {"A.leak": 0.2, "A.leak.onset": "200 s"}
        fdi_torch.simulate(RIG, inputs={"Q": "3 l/min"}, duration="100 s", faults=late)
    with pytest.raises(fdi_torch.ConfigError, match=r"simulate: noise: expected \{std: .*, got '1 mm'"):
        fdi_torch.simulate(RIG, inputs={"Q": "3 l/min"}, noise="1 mm")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"start level of A: expected equilibrium, free or a level in m, got 'eq'"):
        fdi_torch.set_up(RIG, [simulated()], ["A.leak"], "eq")  # type: ignore[arg-type]
    frame: Any = {1, 2}
    for function in (fdi_torch.gap, fdi_torch.predict):
        with pytest.raises(fdi_torch.ConfigError, match=r"expected a file name, .*fdi_torch.read_frame\), got a set"):
            function(RIG, frame)  # type: ignore[operator]
    with pytest.raises(fdi_torch.ConfigError, match=r"train: recordings.0: expected a file name, .* got a set"):
        fdi_torch.train({"plant": RIG, "recordings": [frame], "estimate": {"parameters": ["A.leak"]}})
    with pytest.raises(fdi_torch.ConfigError, match=r"fault_free: expected a value, .* \(interval"):
        fdi_torch.monitor(RIG, simulated())
    with pytest.raises(
        fdi_torch.ConfigError, match=r"fault_free: expected a list, got '300 s' .* as in \[0 s, 300 s\]"
    ):
        fdi_torch.monitor(RIG, simulated(), fault_free="300 s")
    with pytest.raises(TypeError, match="monitor: expected a recording beside fault_free, got none"):
        fdi_torch.monitor(RIG, fault_free=["0 s", "300 s"])
    with pytest.raises(TypeError, match=r"train: expected recordings beside the parameters, seed, got none"):
        fdi_torch.train(RIG, parameters=["A.leak"], seed=1)
    with pytest.raises(TypeError, match=r"got a Plant; name its recordings as the next argument"):
        fdi_torch.gap(RIG)
    with pytest.raises(
        fdi_torch.ConfigError, match=r"train: expected a known key .* got 'sede'; the nearest is 'seed'"
    ):
        fdi_torch.train(RIG, simulated(), ["A.leak"], sede=1)
    with pytest.raises(fdi_torch.ConfigError, match=r"expected either recordings or simulate, got neither; add one"):
        fdi_torch.train(RIG, [])
    for function in (fdi_torch.gap, fdi_torch.refit):
        with pytest.raises(ValueError, match=r"(gap|refit): expected a recording with at least two samples, got none"):
            function(RIG, [])  # type: ignore[operator]
    for setting, said in (
        ({"most": 0}, "most: expected at least one effect, got 0"),
        ({"step": -1.0}, "step: expected"),
    ):
        with pytest.raises(ValueError, match=said):
            fdi_torch.gap(RIG, simulated(), **setting)
    with pytest.raises(ValueError, match="report: expected at least one log, got none"):
        fdi_torch.report([])
    with pytest.raises(TypeError, match=r"expected a pandas\.DataFrame, got a dict; make one by pandas\.DataFrame"):
        fdi_torch.read_frame({"t_s": [0, 1]}, RIG)
    with pytest.raises(
        TypeError, match=r"expected time, inputs and outputs to be tensors, got a list; .* torch\.tensor"
    ):
        fdi_torch.Recording([0, 1], [[1], [1]], [[1], [1]], ("Q",), ("h",), ("m^3/s",), ("m",))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected a file that ends in \.fmu, got notes\.txt; rename it"):
        fdi_torch.export_fmu(RIG, "notes.txt")
    with pytest.raises(TypeError, match="predict: expected one recording, got a list of 2"):
        fdi_torch.predict(RIG, [simulated(), simulated()])  # type: ignore[arg-type]
    with pytest.raises(
        fdi_torch.ConfigError, match=r"fault_free: expected a value, .* \(interval .* as in \[0 s, 300 s\]"
    ):
        fdi_torch.monitor({"plant": RIG, "recording": simulated()})


def refused_calls() -> dict[str, Callable[[], Any]]:
    """Mistakes that are noticed far inside: by YAML, by pydantic, by the readers of units, files and logs."""
    unfinished, without_q, no_reading = Path("unfinished.yaml"), Path("without_q.csv"), Path("no_reading.csv")
    unfinished.write_text("plant: three_tank\nsimulate: {inputs: [")
    without_q.write_text("t_s,h_m,pB_mbar\n0,0.1,2\n1,0.1,2\n")
    no_reading.write_text("t_s,Q_V,h_m,pB_mbar\n0,1,0.1,x\n1,1,0.1,2\n")
    train, estimate = fdi_torch.train, {"parameters": ["A.leak"]}
    return {
        "YAML": lambda: fdi_torch.load_run("unfinished.yaml"),
        "a plant": lambda: fdi_torch.load_plant("three_tnk"),
        "no file": lambda: train({"plant": RIG, "recordings": ["none.csv"], "estimate": estimate}),
        "a column": lambda: train({"plant": RIG, "recordings": ["without_q.csv"], "estimate": estimate}),
        "a cell": lambda: fdi_torch.gap(RIG, "no_reading.csv"),
        "a parameter": lambda: train(
            {"plant": RIG, "simulate": {"duration": "3 s"}, "estimate": {"parameters": ["A.lek"]}}
        ),
        "a unit": lambda: fdi_torch.simulate(RIG, inputs={"Q": "3 bananas"}, duration="10 s"),
        "a dimension": lambda: fdi_torch.simulate(RIG, inputs={"Q": "3 cm"}, duration="10 s"),
        "a key": lambda: fdi_torch.monitor({"plant": RIG, "recordng": simulated()}),
        "a plant's quantity": lambda: Tank("A", area="3 cm", height="1 m"),
        "a log": lambda: fdi_torch.read_run("none.mcap"),
    }


@pytest.mark.parametrize(
    "what",
    [
        "YAML",
        "a plant",
        "no file",
        "a column",
        "a cell",
        "a parameter",
        "a unit",
        "a dimension",
        "a key",
        "a plant's quantity",
        "a log",
    ],
)
def test_the_traceback_of_a_mistake_shows_its_message_alone(here: Path, what: str) -> None:
    """Not the errors of YAML, pydantic and pint from which the message was made."""
    with pytest.raises((ValueError, OSError)) as refused:
        refused_calls()[what]()
    shown = "".join(traceback.format_exception(refused.value))
    assert shown.count("Traceback (most recent call last)") == 1, shown


def test_one_recording_and_one_effect_need_no_list(tmp_path: Path) -> None:
    blank, estimate = simulated(), {"parameters": ["A.leak"]}
    run = build_run({"plant": RIG, "recordings": blank, "estimate": estimate}, tmp_path, Source("train"))
    assert [entry.in_memory is blank for entry in run.config.recordings] == [True]
    found = fdi_torch.gap(RIG, blank, library="leak", out=tmp_path)
    assert found.answer.verdict


def test_constant_inputs_of_the_differential_equation_are_a_tensor_or_numbers() -> None:
    level = torch.tensor([0.2], dtype=torch.float64)
    by_tensor, by_list = (RIG.ode(u)(level[0], level) for u in (torch.tensor([5e-5], dtype=torch.float64), [5e-5]))
    outflow = 0.6 * 0.5e-4 * (2.0 * 9.81 * 0.2) ** 0.5
    assert torch.equal(by_tensor, by_list) and float(by_list) == pytest.approx((5e-5 - outflow) / 0.02)
    with pytest.raises(ValueError, match=r"expected inputs of Q, got a tensor of shape \(2,\)"):
        RIG.ode([1.0, 2.0])


def test_a_calibration_in_python_recovers_the_constant_and_narrows_its_tolerance() -> None:
    true = replace(RIG, pipes=(Pipe("drain", "A", "outside", area="0.5 cm^2", discharge_coefficient=0.65),))
    recording = fdi_torch.simulate(true, inputs=STEPS, duration="300 s", noise={"std": {"h": "1 mm"}}, seed=3)
    wide = replace(RIG, tolerances={"drain.discharge_coefficient": 0.3})
    found = fdi_torch.refit(wide, recording)
    value, error = found.fit.fitted["drain.discharge_coefficient"]
    assert abs(value - 0.65) < 4.0 * error < 0.01 and found.plant.pipes[0].discharge_coefficient == value
    assert found.plant.tolerances == wide.tolerances
    assert found.narrowed().tolerances["drain.discharge_coefficient"] == pytest.approx(error / value, rel=0.05)
    assert "mean square error h 0.09" in found.headline and "discharge_coefficient" in repr(found)


def test_refit_and_predict_tell_how_far_they_are() -> None:
    for job in (fdi_torch.refit, fdi_torch.predict):
        shares: list[float] = []
        job(RIG, simulated(), tell=lambda share, text, shares=shares: shares.append(share))
        assert shares[0] == 0.0 and shares[-1] == 1.0 and shares == sorted(shares)


def test_draws_tell_how_far_they_are(tmp_path: Path) -> None:
    pytest.importorskip("emcee")
    told: list[tuple[float, str]] = []
    found = fdi_torch.train(RIG, simulated(), ["A.leak"], output={"folder": str(tmp_path)})
    found.sample(8, most_steps=200, tell=lambda share, text: told.append((share, text)))
    assert told[-1][0] <= 1.0 and told[-1][1].startswith("draws: ")


def test_an_effect_without_a_field_means_its_size() -> None:
    fitting = fdi_torch.set_up(RIG, [simulated()], ["A.leak", "Q.gain"], "equilibrium")
    assert fitting.space.names == ("A.leak.size", "Q.gain")
    with pytest.raises(ValueError, match=r"got 'A.heigt'; the nearest is 'A.height'"):
        fdi_torch.set_up(RIG, [simulated()], ["A.heigt"])
    with pytest.raises(ValueError, match=r"parameters: expected .* got 'A.leek'; the nearest is 'A.leak'"):
        fdi_torch.set_up(RIG, [simulated()], ["A.leek"])


@pytest.mark.parametrize("level", ["70 cm", "-1 cm"])
def test_an_initial_level_lies_between_floor_and_rim(level: str) -> None:
    with pytest.raises(ValueError, match=rf"start level of A: expected a level from the floor to .*, got {level}"):
        fdi_torch.simulate(RIG, inputs={"Q": "3 l/min"}, duration="10 s", start_levels={"A": level})


def test_an_initial_level_that_is_free_needs_no_mention() -> None:
    with pytest.raises(ValueError, match=r"A.start_level: expected no initial level among the parameters, as it is"):
        fdi_torch.set_up(RIG, [simulated()], ["A.start_level"])
    assert fdi_torch.set_up(RIG, [simulated()], ["A.start_level"], "equilibrium").space.names == ("A.start_level",)


def test_the_catalogue_takes_the_name_of_a_plant() -> None:
    assert fdi_torch.effects("three_tank").headline == fdi_torch.effects(fdi_torch.load_plant("three_tank")).headline
    assert len(fdi_torch.effects()) > len(fdi_torch.effects("three_tank"))


def test_every_function_takes_a_plant_or_its_name(here: Path) -> None:
    Path("rig.yaml").write_text(fdi_torch.dump_plant(RIG))
    fdi_torch.write_csv(simulated(), Path("run.csv"))
    named = fdi_torch.set_up("rig.yaml", "run.csv", ["A.leak"])
    itself = fdi_torch.set_up(RIG, simulated(), ["A.leak"])
    theta = itself.space.nominal()[None]
    assert named.space.names == itself.space.names
    assert torch.equal(named.engines(1.0)[0].readings(theta), itself.engines(1.0)[0].readings(theta))
    constants = fdi_torch.build_network("three_tank").constants.names
    assert constants == fdi_torch.build_network(fdi_torch.load_plant("three_tank")).constants.names
    assert fdi_torch.dump_plant("three_tank") == fdi_torch.dump_plant(fdi_torch.load_plant("three_tank"))
    by_name, by_path, by_plant = (fdi_torch.read_recording("run.csv", x) for x in ("rig.yaml", Path("rig.yaml"), RIG))
    assert torch.equal(by_name.outputs, by_plant.outputs) and torch.equal(by_path.outputs, by_plant.outputs)
    wrong: Any = 3
    for call in (
        lambda: fdi_torch.set_up(wrong, simulated(), []),
        lambda: fdi_torch.build_network(wrong),
        lambda: fdi_torch.dump_plant(wrong),
        lambda: fdi_torch.read_recording("run.csv", wrong),
        lambda: fdi_torch.export_fmu(wrong, "rig.fmu"),
        lambda: fdi_torch.gap(wrong, simulated()),
        lambda: fdi_torch.effects(wrong),
    ):
        with pytest.raises(TypeError, match="plant: expected a Plant or the name of a plant file, got a int"):
            call()


def test_the_beginning_of_one_of_several_recordings_has_its_own_start_level() -> None:
    long, short = simulated(), simulated().stretch(0, 120)
    both = fdi_torch.set_up(RIG, [long, short], ["A.leak", "Q.gain"], "free")
    assert both.space.names == ("A.leak.size", "Q.gain", "A.start_level", "A.start_level@1")
    beginning = both.beginning(1, 50)
    (engine,), theta = beginning.engines(1.0), both.space.nominal()[None] + 0.01
    own = theta[:, beginning.columns[0]]
    assert beginning.columns[0].tolist() == [0, 1, 3] and len(beginning.recordings[0]) == 50
    assert torch.equal(engine.readings(own), both.engines(1.0)[1].readings(own)[:, :50])


def test_each_recording_has_its_own_noise_and_the_estimate_that_of_all() -> None:
    runs = [
        fdi_torch.simulate(RIG, inputs=STEPS, duration=f"{seconds} s", noise={"std": {"h": noise}}, seed=3)
        for seconds, noise in ((200, "1 mm"), (600, "4 mm"))
    ]
    found = fdi_torch.estimate_parameters(fdi_torch.set_up(RIG, runs, ["A.leak"]))
    assert [float(noise[0]) for noise in found.noise] == pytest.approx([1e-3, 4e-3], rel=0.15)
    pooled = (0.25 * found.noise[0] ** 2 + 0.75 * found.noise[1] ** 2).sqrt()
    assert found.estimate.noise_std is not None
    assert torch.allclose(found.estimate.noise_std, pooled, rtol=0.01)


def test_a_recording_at_hand_is_asked_for_the_plant_s_channels() -> None:
    blank = simulated()
    with pytest.raises(fdi_torch.ConfigError, match=r"expected a sensor 'h', got x"):
        fdi_torch.predict(RIG, Recording(blank.time, blank.inputs, blank.outputs, ("Q",), ("x",), ("m^3/s",), ("m",)))


def test_results_become_data_frames() -> None:
    pandas = pytest.importorskip("pandas")
    recording = simulated()
    frame = recording.to_pandas()
    assert list(frame.columns) == ["Q", "h"] and frame.attrs["units"] == {"t": "s", "Q": "m^3/s", "h": "m"}
    assert frame["h"].to_numpy() == pytest.approx(recording.outputs[:, 0].numpy())
    told = fdi_torch.predict(RIG, recording).to_pandas()
    assert isinstance(told, pandas.DataFrame) and list(told.columns) == ["sensor", "unit", "RMSE"]
    assert len(fdi_torch.effects().to_pandas()) == len(fdi_torch.EFFECTS)


def test_a_recording_comes_back_from_its_data_frame() -> None:
    pytest.importorskip("pandas")
    recording = simulated()
    again = fdi_torch.read_frame(recording.to_pandas(), RIG)
    assert torch.equal(again.time, recording.time) and torch.equal(again.inputs, recording.inputs)
    assert torch.equal(again.outputs, recording.outputs) and again.source == "data frame"


def test_a_data_frame_in_the_user_s_units_names_them_and_is_read_again() -> None:
    pytest.importorskip("pandas")
    rig = replace(RIG, units={**RIG.units, "m": "mm", "m^3/s": "l/min"})
    recording = fdi_torch.simulate(rig, inputs=STEPS, duration="300 s")
    frame = recording.to_pandas(own_units=True)
    assert list(frame.columns) == ["Q [l/min]", "h [mm]"] and frame.index.name == "t [s]"
    assert frame["h [mm]"].to_numpy() == pytest.approx(1000.0 * recording.outputs[:, 0].numpy())
    again = fdi_torch.read_frame(frame, rig)
    torch.testing.assert_close(again.outputs, recording.outputs, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(again.inputs, recording.inputs, rtol=1e-12, atol=0.0)


def test_a_simulation_beyond_the_limits_of_a_pump_says_so() -> None:
    limit = RIG.pumps[0].max_flow
    recording = fdi_torch.simulate(RIG, inputs={"Q": f"{2e6 * limit:g} cm^3/s"}, duration="60 s")
    assert repr(recording).splitlines()[-1].startswith("- Q asks for up to ")


def test_a_recording_comes_back_from_its_csv_file(tmp_path: Path) -> None:
    recording = simulated()
    missing = replace(recording, mask=recording.mask & (torch.arange(len(recording)) != 2).unsqueeze(1))
    again = fdi_torch.read_recording(str(fdi_torch.write_csv(missing, str(tmp_path / "new" / "run.csv"))), RIG)
    for name in ("time", "inputs", "outputs", "mask"):
        then, now = getattr(missing, name), getattr(again, name)
        torch.testing.assert_close(now[again.mask[:, 0]], then[missing.mask[:, 0]], rtol=1e-11, atol=0.0)
    assert torch.equal(again.mask, missing.mask) and again.output_units == ("m",)


def test_a_data_frame_follows_the_rules_of_files() -> None:
    pandas = pytest.importorskip("pandas")
    stamps = pandas.date_range("2026-03-29 08:30", periods=4, freq="2s", tz="UTC")
    frame = pandas.DataFrame({"time": stamps, "Q_cm3_s": [50.0, 50.0, 60.0, 60.0], "LT1": [100.0, None, 120.0, 130.0]})
    columns = {"h": {"column": "LT1", "unit": "mm"}}
    found = fdi_torch.read_frame(frame, RIG, columns=columns)
    assert found.time.tolist() == [0.0, 2.0, 4.0, 6.0] and found.mask[:, 0].tolist() == [True, False, True, True]
    assert found.outputs[2, 0] == 0.12 and found.began is not None
    assert fdi_torch.read_frame(frame.set_index("time").rename_axis(None), RIG, columns=columns).began == found.began
    with pytest.raises(fdi_torch.ConfigError, match=r"^data frame: expected a column for h "):
        fdi_torch.read_frame(frame, RIG)
    with pytest.raises(fdi_torch.ConfigError, match=r"data frame: colums: |data frame: expected a known key"):
        fdi_torch.read_frame(frame, RIG, colums=columns)


def test_a_file_is_read_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t_s,Q_cm3_s,h_cm\n0,50,10\n1,50,11\n")
    assert fdi_torch.read_recording(str(tmp_path / "run.csv"), RIG).outputs[:, 0].tolist() == [0.1, 0.11]
    (tmp_path / "other.csv").write_text("t_s,Q_cm3_s,LT1\n0,50,10\n1,50,11\n")
    entry = {"file": str(tmp_path / "other.csv"), "columns": {"h": {"column": "LT1", "unit": "cm"}}}
    assert fdi_torch.read_recording(entry, RIG).outputs[:, 0].tolist() == [0.1, 0.11]
    with pytest.raises(fdi_torch.ConfigError, match=r"recording: expected a known key .* the nearest is 'columns'"):
        fdi_torch.read_recording({**entry, "colums": {}}, RIG)


def test_trajectories_become_labelled_arrays() -> None:
    pytest.importorskip("xarray")
    recording = simulated()
    assert recording.to_xarray()["h"].attrs["units"] == "m" and recording.to_xarray().sizes == {"time": 301}
    run = fdi_torch.predict(RIG, recording).to_xarray()
    residual = run["measured"] - run["predicted"]
    assert float(abs(residual - run["residual"]).max()) == 0.0 and str(run["unit"].values[0]) == "m"


def test_an_estimate_becomes_a_labelled_array(tmp_path: Path) -> None:
    pytest.importorskip("xarray")
    found = fdi_torch.train(RIG, simulated(), ["A.leak"], output={"folder": str(tmp_path)})
    table, estimate = found.estimate.to_xarray(), found.estimate
    one = table.sel(parameter="A.leak.size")
    assert float(one["value"]) == float(estimate.value[0]) and str(one["unit"].values) == "1"
    assert float(one["high"] - one["value"]) == pytest.approx(1.96 * float(one["std"]), rel=1e-3)
    same = table["covariance"].sel(parameter="A.leak.size", other="A.leak.size")
    assert float(same) == pytest.approx(float(one["std"]) ** 2)


def test_a_refit_predicts_hold_outs() -> None:
    """The area of the drain in the plant file is wrong by 10 %: the refitted plant predicts another run better."""
    wrong = replace(RIG, tolerances={"drain.area": 0.2})
    wrong = replace(wrong, pipes=tuple(replace(p, area=1.1 * p.area) if p.name == "drain" else p for p in wrong.pipes))
    noise = {"std": {"h": "1 mm"}}
    fitted, other = simulated(), fdi_torch.simulate(RIG, inputs={"Q": "4 l/min"}, duration="200 s", noise=noise, seed=7)
    calibration = fdi_torch.refit(wrong, fitted, other)
    (trial,) = calibration.trials
    assert trial.refitted["h"] < 0.5 * trial.as_is["h"]
    assert trial.as_is["h"] == fdi_torch.predict(wrong, other).prediction.rmse["h"]
    assert not fdi_torch.refit(wrong, fitted).trials
    with pytest.raises(ValueError, match="expected a hold-out other than the recording"):
        fdi_torch.refit(wrong, fitted, holdouts=[fitted])


def test_a_library_that_is_not_there_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"expected the library pandas, got none; pip install 'fdi_torch\[pandas\]'"):
        simulated().to_pandas()


def test_an_effect_at_a_place_of_another_kind_is_refused_in_a_sentence() -> None:
    plant = fdi_torch.load_plant("three_tank")
    blank = blank_recording(plant, torch.full((3, 2), 1e-5, dtype=torch.float64), torch.arange(3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"Q1\.leak: expected a place of kind tank \(T1, T2, T3\), got pump Q1"):
        fdi_torch.set_up(plant, [blank], ["Q1.leak"])
