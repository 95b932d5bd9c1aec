"""Run files: shipped files are valid, defaults are as documented, and errors are sentences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from fdi_torch.config.estimation import estimated_space, parameter_values, placements_of
from fdi_torch.config.loaded_recordings import LoadedRecording, load_recordings, read_recording
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.config.problems import ConfigError, Source
from fdi_torch.config.run_file import Run, build_run, load_run
from fdi_torch.config.simulation import NoiseConfig, noise_std, planned_recording
from fdi_torch.config.yaml_files import SHIPPED, read_yaml
from fdi_torch.effects import build_network
from fdi_torch.jobs.run_setup import fitting_of, requested_space, simulate_recording
from fdi_torch.parameters import ParameterSpace

PAPER = ["T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size"]
TABLE_2 = {
    "1d": (0.1, 1.0, 0.0, 1.0, 1.0),
    "2d": (0.1, 0.6, 0.0, 1.0, 1.0),
    "3d": (0.1, 0.6, 0.5, 1.0, 1.0),
    "4d": (0.1, 0.6, 0.5, 0.7, 1.0),
    "5d": (0.1, 0.6, 0.5, 0.7, 0.9),
}
# Beside run files, configs/real/ has the plant files from which and to which the chains of gap diagnoses go.
REAL_RUNS = sorted(path for path in SHIPPED.glob("real/*.yaml") if "tanks" not in read_yaml(path))
SHIPPED_RUNS = [SHIPPED / "default.yaml", *sorted(SHIPPED.glob("paper/*.yaml")), *REAL_RUNS]


def run(**changes: Any) -> Run:
    data = {
        "plant": "three_tank",
        "simulate": {"inputs": {"Q1": "50 cm^3/s", "Q2": "50 cm^3/s"}, "faults": {"T1.leak": 0.3}},
        "estimate": {"parameters": ["T1.leak"]},
    }
    return build_run({**data, **changes}, Path.cwd(), Source("run.yaml"))


def network_constants(wanted: Run) -> ParameterSpace:
    assert wanted.config.simulate is not None
    names = [*(p.name for p in wanted.config.estimate.parameters), *wanted.config.simulate.faults]
    return build_network(wanted.plant, placements_of(names, wanted.plant)).constants


def space(wanted: Run, real_data: bool = False) -> ParameterSpace:
    return estimated_space(wanted.config.estimate, network_constants(wanted), wanted.plant, real_data)


def test_a_pattern_stands_for_all_faults_of_a_kind() -> None:
    wanted = run(estimate={"parameters": ["*.leak", {"name": "P*.plugging", "high": 0.5}, "Q1.pump_gain.factor"]})
    found = requested_space(wanted)
    leaks, pipes = [f"T{k}.leak.size" for k in (1, 2, 3)], ["P13.plugging.size", "P32.plugging.size"]
    assert list(found.names) == [*leaks, *pipes, "Q1.pump_gain.factor"]
    assert [found[name].high for name in pipes] == [0.5, 0.5]
    with pytest.raises(ConfigError, match=r"expected a pattern such as \*\.leak or P1\.\*, got 'A\*\.leak'"):
        requested_space(run(estimate={"parameters": ["A*.leak"]}))


@pytest.mark.parametrize("path", SHIPPED_RUNS, ids=lambda path: path.stem)
def test_every_shipped_run_is_understood(path: Path) -> None:
    wanted = load_run(path)
    names = [p.name for p in wanted.config.estimate.parameters]
    network = build_network(wanted.plant, placements_of(names, wanted.plant))
    assert len(estimated_space(wanted.config.estimate, network.constants, wanted.plant, bool(wanted.config.recordings)))


def test_the_built_in_default_is_table_3_at_30_db() -> None:
    wanted = load_run()
    simulate = wanted.config.simulate
    assert simulate is not None
    assert (simulate.duration, simulate.sample_time, simulate.noise.snr_db) == (1000.0, 1.0, 30.0)
    assert space(wanted).names == tuple(PAPER)
    values = parameter_values(dict(simulate.faults), network_constants(wanted), wanted.plant)
    assert values == dict(zip(PAPER, (0.3, 0.3, 0.5, 0.6, 1.0), strict=True))
    assert space(wanted)["OUT2.net_outlet.size"].low == -1.0
    assert space(wanted)["OUT2.net_outlet.size"].high == 1.0


@pytest.mark.parametrize(("case", "theta"), TABLE_2.items())
def test_table_2_configs_hold_the_true_faults_and_no_noise(case: str, theta: tuple[float, ...]) -> None:
    simulate = load_run(SHIPPED / "paper" / f"table2_{case}.yaml").config.simulate
    assert simulate is not None and simulate.noise.snr_db is None
    assert tuple(simulate.faults.values()) == theta


@pytest.mark.parametrize("snr", [50, 40, 30, 20, 10])
def test_table_3_configs_differ_in_noise_only(snr: int) -> None:
    wanted, default = load_run(SHIPPED / "paper" / f"table3_snr{snr}.yaml").config.simulate, load_run().config.simulate
    assert wanted is not None and default is not None and wanted.noise.snr_db == snr
    assert wanted.model_copy(update={"noise": default.noise}) == default


def test_a_run_reads_back_from_its_text_with_the_plant_in_it() -> None:
    wanted = load_run(overrides=["simulate.faults.T1.leak=0.2", "seed=7"])
    again = build_run(yaml.safe_load(wanted.text), Path("/"), Source("log"))
    assert again.plant == wanted.plant
    assert again.config.model_copy(update={"plant": "three_tank"}) == wanted.config
    assert wanted.config.simulate is not None
    assert (wanted.config.seed, wanted.config.simulate.faults["T1.leak"]) == (7, 0.2)


def test_overrides_reach_into_lists() -> None:
    assert load_run(overrides=["estimate.parameters.1.low=-0.5"]).config.estimate.parameters[1].low == -0.5


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("estimate.search.populaton=3", "estimate.search: expected a known key .* got 'populaton'; .* 'population'"),
        ("estimat.search=3", "expected a known key .* got 'estimat'; the nearest is 'estimate'"),
        ("estimate.search.population=2", "estimate.search: expected a population of at least 4, got 2"),
        ("simulate.duration=1000", "simulate.duration: expected a quantity in s, got the bare number 1000"),
        ("simulate.duration=1000 cm", "simulate.duration: expected a quantity in s .* got '1000 cm'"),
        ("engine=fast", "engine: expected 'auto', 'reference', 'compiled' or 'traced', got 'fast'"),
        ("device=gpu", "device: expected cpu, cuda or a number of a GPU such as cuda:1, got 'gpu'; correct it"),
        ("seed=-1", "seed: expected greater than or equal to 0, got -1"),
        ("plant=three_tanks", "plant: expected a plant file .* got 'three_tanks'; the nearest is 'three_tank'"),
        ("plant=7", "plant: expected a shipped plant, a plant file or a plant, got 7"),
        ("estimate.calibrate=all", "estimate.calibrate: expected auto or a list of names, got 'all'"),
        ("estimate.step.search=1", "estimate.step.search: expected a quantity in s, got the bare number 1"),
        ("simulate=null", "expected either recordings or simulate, got neither; add one"),
        ("recordings=[{file: x.csv}]", "expected either recordings or simulate, got both; keep one"),
        ("estimate.parameters.9.low=1", "--set .* estimate.parameters: expected an index below 5, got '9'"),
        ("seed.deep=1", "seed: expected a valid integer, got {'deep': 1}"),
        ("seed", "--set seed: expected KEY=VALUE"),
        ("seed={", "--set seed={: line 1: not valid YAML"),
        ("simulate.start_levels.T1=5", "start_levels: expected free, equilibrium or a level such as '50 cm', got 5"),
    ],
)
def test_a_wrong_value_is_named_with_its_field(override: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence) as error:
        load_run(overrides=[override])
    assert len(error.value.problems) == 1


def test_all_problems_are_said_at_once() -> None:
    with pytest.raises(ConfigError) as error:
        load_run(overrides=["seed=-1", "simulate.duration=5"])
    assert len(error.value.problems) == 2


def test_files_that_extend_each_other_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("extends: b.yaml")
    (tmp_path / "b.yaml").write_text("extends: a.yaml")
    with pytest.raises(ConfigError, match=r"extends: expected at most 8 files in a row, got more; a circle\?"):
        load_run(tmp_path / "a.yaml")


def test_boxes_and_beliefs_can_be_changed_with_units() -> None:
    wanted = run(
        estimate={"parameters": [{"name": "T1.leak.height", "low": "1 cm", "nominal": "5 cm", "std": "10 mm"}]}
    )
    height = space(wanted)["T1.leak.height"]
    assert (height.low, height.nominal, height.std) == pytest.approx((0.01, 0.05, 0.01))


@pytest.mark.parametrize(
    ("estimate", "sentence"),
    [
        ({"parameters": ["T1.leek.size"]}, "expected an effect of the library, got 'leek'; the nearest is 'leak'"),
        ({"parameters": ["P13.area_"]}, "estimate.parameters.0: expected a parameter .* the nearest is 'P13.area'"),
        (
            {"parameters": ["h1.sensor_bias.size"]},
            "expected h1.sensor_bias.bias or h1.sensor_bias.onset or h1.sensor_bias.ramp, got 'h1.sensor_bias.size'; "
            "the size is h1.sensor_bias.bias",
        ),
        ({"parameters": ["T1.leak", "T1.leak.size"]}, "expected each parameter once, got T1.leak.size twice"),
        ({"parameters": [{"name": "T1.leak", "low": 2}]}, r"parameters.0: T1.leak: .* expected low <= nominal"),
        (
            {"parameters": [{"name": "T1.leak", "high": "2 cm"}]},
            r"parameters.0: T1.leak: expected a number or a share",
        ),
        ({"parameters": ["T1.leak"], "calibrate": ["*.gian"]}, "estimate.calibrate: .* got '\\*.gian'"),
    ],
)
def test_what_cannot_be_estimated_is_refused(estimate: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        space(run(estimate=estimate))


def test_tolerances_are_calibrated_where_data_are_real_and_only_there() -> None:
    assert space(run()).names == ("T1.leak.size",)
    calibrated = space(run(), real_data=True)
    assert calibrated.names[1:] == tuple(f"{pipe}.discharge_coefficient" for pipe in ("P13", "P32", "OUT2"))
    assert calibrated["P13.discharge_coefficient"].std == pytest.approx(0.03 * 0.6)


def test_constants_to_calibrate_by_pattern() -> None:
    wanted = run(estimate={"parameters": ["T1.leak"], "calibrate": ["Q?.gain"]})
    assert space(wanted).names == ("T1.leak.size", "Q1.gain", "Q2.gain")


@pytest.mark.parametrize(
    ("faults", "sentence"),
    [
        ({"T1.leak.size": "3 cm"}, "simulate.faults.T1.leak.size: expected a number or a share"),
        ({"T1.leak.size": 1.5}, r"simulate.faults.T1.leak.size: expected a size from 0 to 1, got 1.5"),
        ({"T9.area": "3 cm^2"}, "simulate.faults.T9.area: expected a parameter .* the nearest are 'T1.area', 'T2"),
    ],
)
def test_impossible_faults_are_refused(faults: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        parameter_values(faults, network_constants(run()), run().plant)


def planned(**simulate: Any) -> Any:
    wanted = run(simulate={"inputs": {"Q1": "50 cm^3/s", "Q2": "50 cm^3/s"}, **simulate}).config.simulate
    assert wanted is not None
    return planned_recording(wanted, run().plant)


def test_planned_inputs_step_and_ramp_where_they_should() -> None:
    steps = {"Q1": {"steps": [["0 s", "10 cm^3/s"], ["2 s", "30 cm^3/s"]]}, "Q2": "50 cm^3/s"}
    held = planned(inputs=steps, duration="4 s")
    assert held.time.tolist() == [0, 1, 2, 3, 4]
    assert (held.inputs[:, 0] * 1e6).tolist() == pytest.approx([10, 10, 30, 30, 30])
    ramp = planned(inputs=steps, duration="4 s", hold="linear")
    assert (ramp.inputs[:, 0] * 1e6).tolist() == pytest.approx([10, 20, 30, 30, 30])
    assert not held.mask.any()


@pytest.mark.parametrize(
    ("simulate", "sentence"),
    [
        ({"inputs": {"Q1": "5 cm^3/s"}}, "simulate.inputs: expected every channel of the plant, got none for Q2"),
        ({"inputs": {"Q3": "5 cm^3/s"}}, "simulate.inputs.Q3: expected a channel of the plant"),
        ({"inputs": {"Q1": "5 V", "Q2": "5 V"}}, "simulate.inputs.Q1: expected a quantity in m\\^3/s .* got '5 V'"),
        ({"inputs": {"Q1": {}, "Q2": "5 cm^3/s"}}, "simulate.inputs.Q1: expected either value or steps, got neither"),
        ({"duration": "1.5 s"}, "simulate.duration: expected a multiple of sample_time \\(1 s\\), got 1.5 s"),
        (
            {"inputs": {"Q1": {"steps": [["1 s", "5 cm^3/s"]]}, "Q2": "5 cm^3/s"}},
            "times that start at 0 s and increase, got 1 s first$",
        ),
        (
            {"inputs": {"Q1": {"steps": [[f"{t} s", "5 cm^3/s"] for t in (0, 2, 2, 3)]}, "Q2": "5 cm^3/s"}},
            "times that start at 0 s and increase, got 2 s after 2 s$",
        ),
        (
            {"inputs": {"Q1": {"steps": [["0 s", "5 cm^3/s"], ["1.5 s", "5 cm^3/s"]]}, "Q2": "5 cm^3/s"}},
            "expected times at samples \\(every 1 s\\), got 1.5 s$",
        ),
    ],
)
def test_impossible_simulations_are_refused(simulate: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        planned(**simulate)


def test_noise_has_the_asked_share_of_variance_or_of_mean_square() -> None:
    clean = torch.tensor([[1.0, 0.0, 2.0], [3.0, 4.0, 8.0]], dtype=torch.float64)
    plant = run().plant
    by_variance = noise_std(NoiseConfig(snr_db=20.0), plant, clean)
    torch.testing.assert_close(by_variance, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / 10)
    by_power = noise_std(NoiseConfig(snr_db=20.0, definition="power"), plant, clean)
    torch.testing.assert_close(by_power, torch.tensor([5.0, 8.0, 34.0], dtype=torch.float64).sqrt() / 10)
    assert noise_std(NoiseConfig(std={"h2": "1 mm"}), plant, clean).tolist() == [0.0, 0.001, 0.0]


def test_noise_that_cannot_be_is_refused() -> None:
    clean = torch.ones(5, 3, dtype=torch.float64)
    with pytest.raises(ConfigError, match="expected outputs that vary, got a constant h1; give std"):
        noise_std(NoiseConfig(snr_db=20.0), run().plant, clean)
    with pytest.raises(ConfigError, match=r"simulate.noise.std.h9: expected an output of the plant"):
        noise_std(NoiseConfig(std={"h9": "1 mm"}), run().plant, clean)
    with pytest.raises(ConfigError, match=r"simulate.noise.std.h1: expected a quantity in m"):
        noise_std(NoiseConfig(std={"h1": "1 V"}), run().plant, clean)


@pytest.mark.parametrize("first", [0.0, -600.0, 1.7e9])
def test_an_onset_is_sought_within_the_recording_wherever_its_clock_begins(first: float) -> None:
    wanted = run(estimate={"parameters": ["T1.leak", "T1.leak.onset"]})
    recording = replace(simulate_recording(run()).every(10), trusted=True)
    loaded = [LoadedRecording(replace(recording, time=recording.time + first), {"T1": 0.5, "T2": 0.5, "T3": 0.5})]
    space = fitting_of(wanted, requested_space(wanted), loaded).space
    assert (space["T1.leak.onset"].low, space["T1.leak.onset"].high) == (0.0, 1000.0)


def test_an_output_that_varies_by_rounding_errors_only_is_constant() -> None:
    """Two separate tanks, one of them at rest: its noise was 30 dB below the errors of the simulation, 1e-12 m."""
    tank, drain = {"area": "200 cm^2", "height": "60 cm"}, {"area": "0.5 cm^2", "discharge_coefficient": 0.6}
    plant = {
        "tanks": {"A": tank, "B": tank},
        "pipes": {f"out{t}": {"source": t, "target": "outside", **drain} for t in "AB"},
        "pumps": {f"Q{t}": {"target": t, "max_flow": "6 l/min"} for t in "AB"},
        "sensors": {f"h{t}": {"tank": t} for t in "AB"},
    }
    inputs = {"QA": {"steps": [["0 s", "3 l/min"], ["200 s", "4 l/min"]]}, "QB": "3 l/min"}
    simulate = {"inputs": inputs, "duration": "600 s", "noise": {"snr_db": 30}}
    with pytest.raises(ConfigError, match="expected outputs that vary, got a constant hB; give std"):
        simulate_recording(run(plant=plant, simulate=simulate))
    simulate["noise"] = {"snr_db": 30, "definition": "power"}
    assert float(simulate_recording(run(plant=plant, simulate=simulate)).outputs[:, 1].std()) > 1e-3


@pytest.mark.parametrize("inside", [True, False])
def test_a_limited_sensor_reads_no_more_than_its_limit_and_no_noise_far_beyond(inside: bool) -> None:
    tank = {"area": "200 cm^2", "height": "60 cm"}
    sensor = {"tank": "A"} | ({} if inside else {"low": "0 cm", "high": "15 cm"})
    plant = {
        "tanks": {"A": tank},
        "pipes": {"out": {"source": "A", "target": "outside", "area": "0.5 cm^2", "discharge_coefficient": 0.6}},
        "pumps": {"Q": {"target": "A", "max_flow": "6 l/min"}},
        "sensors": {"h": sensor},
    }
    inputs = {"Q": {"steps": [["0 s", "4 l/min"], ["300 s", "0 l/min"]]}}
    simulate = {"inputs": inputs, "duration": "900 s", "noise": {"std": {"h": "2 mm"}}}
    simulate["faults"] = {"h.sensor_quantization": "5 mm"}
    readings = simulate_recording(run(plant=plant, simulate=simulate)).outputs[:, 0]
    steps = readings / 0.005
    assert torch.allclose(steps, steps.round(), atol=1e-9), "the simulated fault rounds as one of the plant file"
    if inside:
        assert float(readings.max()) > 0.2 and float(readings.min()) < 0.0
    else:
        assert (float(readings.max()), float(readings.min())) == (0.15, 0.0)
        assert readings[:200].unique().tolist() == [0.15], "0.25 m are far beyond the limit"


CSV = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm\n" + "".join(
    f"{t},50,{'' if t == 5 else 50},{t},{t},{t}\n" for t in range(10)
)


def real(folder: Path, **recording: Any) -> Run:
    (folder / "rig.csv").write_text(CSV)
    data = {"recordings": [{"file": "rig.csv", **recording}], "estimate": {"parameters": ["T1.leak"]}}
    return build_run(data, folder, Source("run.yaml"))


def test_a_recording_is_cut_where_an_input_is_unknown(tmp_path: Path) -> None:
    wanted = real(tmp_path, start="1 s", mask=[["2 s", "3 s"]], start_levels={"T1": "50 cm", "T2": "equilibrium"})
    parts = load_recordings(wanted.config.recordings, wanted.plant, wanted.base)
    assert [part.recording.time.tolist() for part in parts] == [[1, 2, 3, 4], [6, 7, 8, 9]]
    assert parts[0].recording.mask[:, 0].tolist() == [True, False, False, True]
    assert parts[0].start_levels == {"T1": 0.5, "T2": "equilibrium", "T3": "free"}
    assert parts[1].start_levels == dict.fromkeys(("T1", "T2", "T3"), "free")


def test_columns_by_mapping_constants_and_missing_sensors(tmp_path: Path) -> None:
    columns = {"Q2": {"constant": "20 cm^3/s"}, "h1": {"column": "h3_cm"}, "h2": {"recorded": False}}
    wanted = real(tmp_path, columns=columns, every=3)
    recording = read_recording(wanted.config.recordings[0], wanted.plant, wanted.base)
    assert recording.time.tolist() == [0, 3, 6, 9]
    assert recording.inputs[:, 1].tolist() == pytest.approx([20e-6] * 4)
    assert torch.equal(recording.outputs[:, 0], recording.outputs[:, 2])
    assert not recording.mask[:, 1].any()


@pytest.mark.parametrize(
    ("recording", "sentence"),
    [
        ({"columns": {"h4": {"column": "x"}}}, "rig.csv: columns.h4: expected a channel of the plant or t"),
        ({"columns": {"Q1": {"constant": "5 V"}}}, "rig.csv: columns.Q1.constant: expected a quantity in m\\^3/s"),
        ({"columns": {"Q1": {"column": "h1_cm"}}}, "Q1: expected a unit of flow such as l/min .* got a unit of level;"),
        ({"columns": {"Q1": {"column": "Q1_cm3_s", "unit": "%"}}}, r"\(a command in %: gain: 90 cm\^3/s"),
        ({"columns": {"h1": {"column": "h1_cm", "unit": "%"}}}, r"\(a level in %: gain: 100 %/m\)"),
        ({"start": "50 s"}, "expected at least two samples after start 50 s, got"),
        ({"start_levels": {"T9": "free"}}, "rig.csv: start_levels.T9: expected a tank .* got 'T9'"),
        (
            {"start": "5 s", "stop": "6 s"},
            "a segment with all inputs known, got none: unknown are Q2 at 1 of 2 samples;",
        ),
        ({"file": "rigg.csv"}, "rigg.csv: file not found .* the nearest is 'rig.csv'"),
    ],
)
def test_recordings_that_do_not_fit_are_refused(tmp_path: Path, recording: dict[str, Any], sentence: str) -> None:
    wanted = real(tmp_path, **recording)
    with pytest.raises(ConfigError, match=sentence):
        load_recordings(wanted.config.recordings, wanted.plant, wanted.base)


def test_recordings_are_found_below_the_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = real(tmp_path)
    monkeypatch.delenv("FDI_TORCH_DATA", raising=False)
    with pytest.raises(ConfigError, match="to look in a further folder, set FDI_TORCH_DATA to it"):
        load_recordings(wanted.config.recordings, wanted.plant, Path("/"))
    monkeypatch.setenv("FDI_TORCH_DATA", str(tmp_path))
    assert load_recordings(wanted.config.recordings, wanted.plant, Path("/"))


@pytest.mark.data
def test_shipped_runs_on_real_data_read_their_recordings(real_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FDI_TORCH_DATA", str(real_data))
    for path in REAL_RUNS:
        wanted = load_run(path)
        for part in load_recordings(wanted.config.recordings, wanted.plant, wanted.base):
            assert torch.isfinite(part.recording.inputs).all() and len(part.recording) > 20


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("parameters: [T1.leak]", "got 'parameters'; there is estimate.parameters"),
        ("estimate: {seed: 3}", "got 'seed'.*; there is seed and simulate.seed"),
        ("recordings: [{file:run.csv}]", "got 'file:run.csv'.*; separate key and value by a colon and a space"),
        ("estimate: {step: 0,5 s}", "got '5 s'; a comma ends a value: write 10.5 for decimals, and 10000 "),
        ("simulate: {inputs: {Q1: 1,5 l/min}}", "inputs.5 l/min: .* got nothing; a comma ends a value: write 10.5"),
        ("simulate: {inputs: {Q1: {steps: [[0 s, 1,5 l/min]]}}}", "steps.0: expected 2 values, got .*; a comma ends"),
        ("simulate: {inputs: {Q1: }}", "inputs.Q1: expected a value such as .*, got nothing$"),
        ("simulate: {duration: }", "duration: expected a quantity in s, got nothing$"),
        ("simulate: {noise: {std: 1 mm}}", "noise.std: expected keys with values, as in {NAME: 1 mm}, got '1 mm'"),
        ("estimate: {step: 10 s}", r"estimate.step: expected keys with values \(search, refine\), got '10 s'"),
        ("estimate: {search: de}", r"estimate.search: expected keys with values \(strategy, .*\), got 'de'"),
        ("recordings: run.csv", r"recordings: expected a list, as in \[run.csv\]"),
        ("plant: {tanks: {T: {area: 1 m^2, height: 1 m}}, pipes: {P: {source: T, area: 1 cm^2, "
         "discharge_coefficient: 60}}}\nrecordings: [run.csv]", "discharge_coefficient: expected less than or equal"),
    ],
)  # fmt: skip
def test_what_stands_in_the_wrong_place_is_shown_the_right_one(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_run(tmp_path / "run.yaml")


def test_a_recording_may_be_its_file_s_name_alone(tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text("recordings: [run.csv]")
    assert load_run(tmp_path / "run.yaml").config.recordings[0].file == "run.csv"


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("faults", ["T1.leek"], "m.yaml: faults: expected a parameter .* got 'T1.leek'; the nearest is 'T1.leak'"),
        ("faults", ["T1.plugging"], "m.yaml: faults: T1.plugging: expected a place of kind pipe or outlet"),
        ("calibrate", ["P13.cd"], "m.yaml: calibrate: expected a parameter .* got 'P13.cd'"),
        ("ranges", {"T1.leek": [0, 2]}, "m.yaml: ranges: expected a parameter .* got 'T1.leek'"),
    ],
)
def test_a_monitor_file_that_names_what_the_plant_lacks_is_refused(
    tmp_path: Path, field: str, value: Any, sentence: str
) -> None:
    given = {"recording": "run.csv", "fault_free": ["0 s", "1 h"], field: value}
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(given))
    with pytest.raises(ConfigError, match=sentence):
        load_monitor(tmp_path / "m.yaml")


@pytest.mark.parametrize(("name", "there"), [("Q1.leak", r"tank \(T1, T2, T3\), got pump Q1"), ("T1.plugging", "P13")])
def test_an_effect_at_a_place_of_another_kind_is_refused(name: str, there: str) -> None:
    run = load_run(overrides=[f"estimate.parameters=[{name}]"])
    with pytest.raises(ConfigError, match=f"--set .* estimate.parameters: {name}: expected .*{there}"):
        requested_space(run)
