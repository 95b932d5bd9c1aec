"""File templates, and the catalogue of effects."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import fdi_torch
from fdi_torch import cli
from fdi_torch.config.channels import mapped
from fdi_torch.config.estimation import parameter_values, placements_of
from fdi_torch.config.file_templates import template
from fdi_torch.config.loaded_recordings import listed_recordings, named_recordings, read_recording
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_from_columns import plant_from_recording
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.rehearsal_file import load_rehearsal
from fdi_torch.config.run_file import load_run
from fdi_torch.config.study_file import load_study
from fdi_torch.config.yaml_files import read_yaml, shipped_plants
from fdi_torch.effects import EFFECTS, build_network
from fdi_torch.effects.catalogue import effects
from fdi_torch.jobs.run_setup import simulate_recording
from fdi_torch.plant.scales import time_scale
from fdi_torch.recordings.csv_files import read_header
from tests.rigs import draining_tanks


def fdi(*words: str) -> None:
    assert cli.main([*words]) == cli.DONE


def correct(plant: str | Path) -> None:
    """Delete the marks of a new plant file, as if its placeholders were those of the rig."""
    Path(plant).write_text(Path(plant).read_text().replace("# !", "#"))


def test_all_commands_refuse_a_plant_file_with_placeholders_in_the_words_of_check(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fdi("new", "plant", "--out", "rig.yaml")
    Path("run.yaml").write_text("plant: rig.yaml\nrecordings: [{file: run.csv}]\nestimate: {parameters: [A.leak]}\n")
    Path("watch.yaml").write_text("plant: rig.yaml\nrecording: {file: run.csv}\nfault_free: [0 s, 9 s]\n")
    assert cli.main(["check", "--plant", "rig.yaml"]) == cli.NOT_EXPLAINED
    sentence, *lines = capsys.readouterr().out.partition("rig.yaml: ")[2].splitlines()[:5]
    assert sentence == "these entries are still placeholders; correct each, and delete its !"
    named = "; ".join(line.removeprefix("- ") for line in lines)
    data = ["--plant", "rig.yaml", "--recording", "run.csv"]
    for words in (
        ["gap", *data],
        ["predict", *data],
        ["refit", *data],
        ["plan", *data],
        ["new", "run", "--plant", "rig.yaml"],
        ["train", "--config", "run.yaml"],
        ["check", "--config", "run.yaml"],
        ["monitor", "--config", "watch.yaml"],
    ):
        assert cli.main(words) == cli.MISUSE, words
        assert f"rig.yaml: {sentence}: {named}\n" in capsys.readouterr().err, words


def test_from_nothing_to_a_diagnosis_with_new_files_alone(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fdi("new", "plant", "--out", "rig.yaml")
    assert cli.main(["check", "--plant", "rig.yaml"]) == cli.NOT_EXPLAINED
    said = capsys.readouterr().out
    assert [f", {part}: " in said for part in ("tanks", "pipes", "pumps", "sensors")] == [True] * 4
    assert "- line 5, tanks: which there are; cross-section, and height from the floor to the rim" in said
    correct("rig.yaml")
    fdi("check", "--plant", "rig.yaml")
    assert "placeholders" not in capsys.readouterr().out
    for kind in ("run", "monitor", "study"):
        fdi("new", kind, "--plant", "rig.yaml")
    assert "run.yaml; next: fdi train --config run.yaml" in capsys.readouterr().out
    Path("simulated.yaml").write_text(Path("study.yaml").read_text().partition("\nstudy:")[0])
    fdi("simulate", "--config", "simulated.yaml", "--out", ".", "--set", "output.name=run")
    header = Path("run.yaml").read_text().partition("with the header ")[2].split()[0]
    assert ",".join(read_header(Path("run.csv"))) == header
    fdi("train", "--config", "run.yaml")
    assert "single fault: leak at A" in capsys.readouterr().out


@pytest.mark.parametrize("name", shipped_plants())
def test_every_template_is_a_file_of_its_kind_for_every_shipped_plant(name: str, tmp_path: Path) -> None:
    plant = load_plant(name)
    paths = {kind: tmp_path / f"{kind}.yaml" for kind in ("plant", "run", "monitor", "rehearsal", "study")}
    for kind, path in paths.items():
        path.write_text(template(kind, plant, name, kind))
        assert "${" not in path.read_text()
    assert load_plant(paths["plant"], unfinished=True).name == "rig"
    assert load_run(paths["run"]).plant == plant and load_monitor(paths["monitor"]).plant == plant
    head, _, rest = paths["run"].read_text().partition("recordings:")
    _, _, described = rest.partition("# simulate:")
    block, _, estimate = described.partition("\nestimate:")
    paths["run"].write_text(head + "simulate:" + block.replace("\n# ", "\n") + "\nestimate:" + estimate)
    assert len(simulate_recording(load_run(paths["run"]))) == 601
    study = load_study(paths["study"])
    assert study.plan.trials == 600 and study.run.config.simulate is not None
    assert study.run.config.simulate.duration == pytest.approx(600 * time_scale(plant), rel=0.1)
    assert len(load_rehearsal(paths["rehearsal"]).plans) == 2


def test_the_templates_of_a_plant_without_inputs_are_files_of_their_kind(tmp_path: Path) -> None:
    for kind, load in {"study": load_study, "rehearsal": load_rehearsal}.items():
        path = tmp_path / f"{kind}.yaml"
        (tmp_path / "drain.yaml").write_text(yaml.safe_dump(plant_mapping(draining_tanks())))
        path.write_text(template(kind, draining_tanks(), str(tmp_path / "drain.yaml"), kind))
        load(path)
    assert "#   inputs: {}\n" in template("run", draining_tanks(), "drain.yaml", "run")


LOADERS = {
    "plant": load_plant,
    "run": load_run,
    "monitor": load_monitor,
    "study": load_study,
    "rehearsal": load_rehearsal,
}


@pytest.mark.parametrize("given", LOADERS)
def test_a_file_of_another_kind_is_called_what_it_is(given: str, tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(template(given, load_plant("three_tank"), "three_tank", "run.csv"))
    for kind, load in LOADERS.items():
        if kind == given or (given, kind) == ("run", "study"):
            continue
        with pytest.raises(ConfigError, match=f"expected a {kind} file, got a {given} file; ") as told:
            load(path)
        words = f"fdi new {kind} --plant file.yaml writes one" if given == "plant" else "fdi "
        assert words in str(told.value)
    if given != "run":
        with pytest.raises(ConfigError, match=f"expected a recording or a file .*, got a {given} file"):
            listed_recordings(str(path), load_plant("three_tank"), tmp_path)


def test_a_yaml_file_in_place_of_a_recording_is_no_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "runs.yaml").write_text("recordings: [{file: run.csv}]")
    with pytest.raises(
        ConfigError, match=r"runs\.yaml: expected a recording, got a YAML file; take the entries of its"
    ):
        read_recording("runs.yaml", load_plant("three_tank"), tmp_path)
    assert (
        cli.main(["new", "plant", "--recording", str(tmp_path / "runs.yaml"), "--out", str(tmp_path / "a.yaml")]) == 2
    )
    assert "runs.yaml: expected a recording, got a YAML file" in capsys.readouterr().err


def test_a_spreadsheet_in_place_of_a_yaml_file_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "trend.xlsx").write_bytes(b"PK\x03\x04\x8c\x00")
    with pytest.raises(ConfigError, match=r"expected a YAML file \(text in UTF-8\), got other bytes"):
        load_run(tmp_path / "trend.xlsx")


def test_a_tank_of_a_new_plant_holds_the_levels_of_its_column_in_their_unit(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("Zeit (s);Zulauf (L/min);LI-101 (mm);PI-102 (mbar)\n0;20;832,5;40\n1;20;700;41\n")
    text = plant_from_recording(path, "rig")
    assert "A: {area: 200 cm^2, height: 920 mm}" in text and "B: {area: 200 cm^2, height: 60 cm}" in text
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    assert load_plant(tmp_path / "rig.yaml", unfinished=True).tolerances["Zulauf.gain"] == pytest.approx(0.3)


def test_an_effect_of_the_catalogue_is_shown_with_its_parameters() -> None:
    shown = repr(effects()["pump_lag"])
    assert shown.startswith("Entry: pump_lag, at a pump or a transfer: A pump ") and "time_constant" in shown


def test_a_parameter_is_listed_in_the_unit_of_each_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "tanks: {A: {area: 200 cm^2, height: 60 cm}}\n"
        "sensors: {h: {tank: A}, p: {tank: A, gain: 98.1 mbar/m}, y: {tank: A, gain: 1 %/cm}, z: {tank: A}}\n"
    )
    assert cli.main(["effects", "sensor_bias", "--plant", str(path)]) == 0
    bias = fdi_torch.effects(path)["sensor_bias"].table().columns
    assert bias["parameter"][:3] == ["bias at h, z", "bias at p", "bias at y"] and bias["unit"][:3] == [
        "cm",
        "mbar",
        "%",
    ]
    listed = [line.split()[:7] for line in capsys.readouterr().out.splitlines() if line.startswith("bias at")]
    assert listed == [
        ["bias", "at", "h,", "z", "cm", "0", "-30"],
        ["bias", "at", "p", "mbar", "0", "-29.43", "29.43"],
        ["bias", "at", "y", "%", "0", "-30", "30"],
    ]


def test_the_columns_of_a_new_run_are_in_the_unit_of_the_sensor() -> None:
    pressure = build_plant(
        {"tanks": {"A": {"area": "1 m^2", "height": "2 m"}}, "sensors": {"p": {"tank": "A", "gain": "98.1 mbar/m"}}}, ""
    )
    for kind in ("run", "monitor"):
        assert "p: {column: LT-101, unit: mbar}" in template(kind, pressure, "rig.yaml", "rig")


def test_a_new_plant_file_does_not_wait_for_the_library_of_units(tmp_path: Path) -> None:
    words = ["-X", "importtime", "-m", "fdi_torch", "new", "plant", "--out", str(tmp_path / "rig.yaml")]
    imported = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stderr
    assert "fdi_torch.cli.screen" in imported and "fdi_torch.units" not in imported
    assert load_plant(tmp_path / "rig.yaml", unfinished=True).name == "rig"


LOGS = Path(__file__).parent / "data"
WITHOUT_TORCH = [
    *("new plant --out rig.yaml", "new run --out run.yaml", "new monitor --out watch.yaml", "new study --out st.yaml"),
    *("effects", "effects leak pump_lag", "effects --plant quadruple_tank --json", "completion bash"),
    *("check --plant three_tank", f"view {LOGS} --list"),
    f"compare {LOGS}/log_format_1_train.mcap {LOGS}/log_format_1_gap.mcap",
    *(f"inspect {LOGS}/log_format_1_{kind}.mcap" for kind in ("train", "gap", "monitor", "study")),
    "check --keys",
]


def test_a_command_that_computes_nothing_does_not_load_torch(tmp_path: Path) -> None:
    """A file of `effects` or `plant` writes `torch.Tensor`: `from torch import Tensor` would load torch.

    All in one process, in which a command that loads torch is the first after which it is there.
    """
    commands = [words for words in WITHOUT_TORCH if not words.startswith("completion") or find_spec("shtab")]
    code = """
import contextlib, io, sys
from fdi_torch.cli import main
for words in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.suppress(SystemExit):
        main(words.split())
    if "torch._C" in sys.modules or not printed.getvalue():
        sys.exit(words)
"""
    done = subprocess.run([sys.executable, "-c", code, *commands], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_quick_command_loads_torch_where_it_needs_it(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t_s,Q_l/min,h_cm\n" + "".join(f"{k},{1 + k % 2},{10 + k}\n" for k in range(30)))
    code = "import sys; from fdi_torch.cli import main; main(sys.argv[1:]); sys.exit('torch._C' not in sys.modules)"
    words = ["new", "plant", "--recording", "run.csv", "--out", "rig.yaml"]
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "h:" in (tmp_path / "rig.yaml").read_text()


def test_what_is_commented_out_in_a_new_file_holds_too(tmp_path: Path) -> None:
    """A user takes the # away and expects it to work."""
    text = template("plant", load_plant("three_tank"), "", "")
    valve, pump, sensor, offset = "# valve: v1", "# Q: {target", "# pB: {tank", "# hA.offset"
    for commented in (valve, "# elevation", sensor, offset):
        assert commented in text
        text = text.replace(commented, commented[2:])
    text = text.replace("  Q: {target: A, max_flow: 6 l/min}\n", "").replace(pump, pump[2:])
    before, _, after = text.partition("# effects:")
    text = f"{before}effects:{after}".replace("#   - {effect", "  - {effect")
    (tmp_path / "rig.yaml").write_text(text)
    plant = build_plant(read_yaml(tmp_path / "rig.yaml"), "rig.yaml")
    assert plant.channel_units() == {"Q": "V", "v1": "1"} and plant.sensors[-1].unit == "Pa" and plant.effects


def test_the_fault_free_part_of_a_new_monitor_fits_the_recording(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It begins where the recording does, and lasts as long as the monitor asks, or half of a recording and says so."""
    for interval, lasts, start in ((1, 1000, 0), (1, 3000, 0), (10, 15000, 50000)):
        noise = "{std: {h1: 1 mm, h2: 1 mm, h3: 1 mm}}"
        changes = {"sample_time": f"{interval} s", "duration": f"{lasts} s", "faults": "{}", "noise": noise}
        words = [word for key, value in changes.items() for word in ("--set", f"simulate.{key}={value}")]
        fdi("simulate", "--out", ".", "--replace", *words, "--set", "output.name=run")
        header, *rows = Path("run.csv").read_text().splitlines()
        later = [f"{start + float(t):g},{rest}" for t, rest in (row.split(",", 1) for row in rows)]
        Path("run.csv").write_text("\n".join([header.replace("h1_cm", "level (cm)"), *later]))
        fdi("new", "monitor", "--recording", "run.csv", "--out", f"m{lasts}.yaml")
        first, last = load_monitor(f"m{lasts}.yaml").config.fault_free
        capsys.readouterr()
        fdi("monitor", "--config", f"m{lasts}.yaml", "--set", f"recording.stop={last + 10 * interval} s")
        said = capsys.readouterr().out
        (learnt, needed), *_ = re.findall(r"learnt from (\S+) s \(.* takes (\S+) s\)", said)
        assert first == start and float(learnt) == pytest.approx(last - first, abs=10 * interval)
        short = lasts == 1000
        assert (float(learnt) < float(needed)) is ("is short" in said) is short
        assert ("half of the recording" in Path(f"m{lasts}.yaml").read_text()) is short
        assert last - first == 500.0 if short else last - first <= 0.5 * lasts


def test_the_fault_free_part_of_a_new_monitor_ends_before_a_fault_begins(here: Path) -> None:
    """Otherwise the monitor would learn the fault as noise, and never raise an alarm."""
    faults = "{T1.leak: 0.3, T1.leak.onset: 500 s, P13.plugging: 0.25, P13.plugging.onset: 500 s}"
    changes = {"sample_time": "1 s", "duration": "1400 s", "noise": "{std: {h1: 1 mm, h2: 1 mm, h3: 1 mm}}"}
    words = [
        word for key, value in (changes | {"faults": faults}).items() for word in ("--set", f"simulate.{key}={value}")
    ]
    fdi("simulate", "--out", ".", *words, "--set", "output.name=run")
    fdi("new", "monitor", "--recording", "run.csv", "--out", "watch.yaml")
    first, last = load_monitor("watch.yaml").config.fault_free
    assert first == 0.0 and 400.0 < last < 505.0  # the first seconds of a leak do not show in the noise
    (line,) = (line for line in Path("watch.yaml").read_text().splitlines() if line.startswith("fault_free"))
    assert "# what follows deviates from the plant file: a fault, or constants to calibrate" in line


def test_a_new_monitor_of_a_live_source_has_a_tag_of_every_channel(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fdi("new", "monitor", "--recording", "mqtt://localhost/rig")
    assert "next: complete the tags, then fdi monitor" in capsys.readouterr().out
    source = load_monitor("monitor.yaml").config.source
    assert source is not None and source.url == "mqtt://localhost/rig"
    assert list(source.tags) == ["Q1", "Q2", "h1", "h2", "h3"] and source.tags["Q1"].unit == "cm^3/s"
    assert cli.main(["monitor", "--config", "monitor.yaml"]) == cli.MISUSE
    assert (
        "source: tags: expected either tag or constant of each channel, got none of Q1, Q2, h1, h2, h3;"
        in capsys.readouterr().err
    )
    assert cli.main(["new", "run", "--recording", "mqtt://localhost/rig"]) == cli.MISUSE
    assert "--recording: expected a file for a run, got mqtt://localhost/rig" in capsys.readouterr().err


def test_a_file_that_is_there_is_never_replaced(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("run.yaml").write_text("mine")
    assert cli.main(["new", "run"]) == cli.MISUSE
    assert "run.yaml: expected a new file, but it exists" in capsys.readouterr().err
    assert cli.main(["new", "run", "--out", "run.txt"]) == cli.MISUSE
    assert "expected a file that ends in .yaml, got run.txt" in capsys.readouterr().err
    assert Path("run.yaml").read_text() == "mine" and [p.name for p in here.iterdir()] == ["run.yaml"]


def test_the_catalogue_holds_every_effect_with_a_meaning_and_units() -> None:
    catalogue = effects()
    assert [entry.name for entry in catalogue.entries] == [each.name for each in EFFECTS]
    for entry in catalogue.entries:
        assert entry.meaning and entry.law and entry.at and all(p.unit and p.meaning for p in entry.parameters[:1])


@pytest.mark.parametrize("name", [each.name for each in EFFECTS])
def test_what_the_catalogue_says_can_be_written(name: str) -> None:
    """Into a plant file and into the faults of a simulation, at a plant that has such a place."""
    described = next(
        p for n in shipped_plants() if (p := load_plant(n)) and name in {e.name for e in effects(p).entries}
    )
    entry = effects(described)[name]

    data = plant_mapping(described) | {"effects": yaml.safe_load(entry.in_a_plant_file)}
    assert build_plant(data, "plant").effects[0].effect == name
    ((fault, value),) = yaml.safe_load(f"{{{entry.in_a_run_file}}}").items()
    network = build_network(described, placements_of([fault], described))
    (size,) = parameter_values({fault: value}, network.constants, described).values()
    assert size != entry.parameters[0].nominal, "an example shows the effect"


def test_effects_of_a_plant_are_told_with_places_and_in_full(capsys: pytest.CaptureFixture[str]) -> None:
    fdi("effects", "--plant", "three_tank")
    listed = capsys.readouterr().out
    assert "valve_lag" not in listed and "pump_lag" in listed and "Q1, Q2" in listed
    fdi("effects", "leak", "--plant", "three_tank")
    told = capsys.readouterr().out
    assert (
        re.search(r"\nheight +cm +0 +0 +95 ", told)
        and "at `onset` (0 s: from the start)" in told
        and "T1.leak.size: 0.1" in told
    )
    assert "height: 9.5 cm, onset: 0 s" in told, "the example has the units of the table above it"
    fdi("effects", "leak", "--json")
    (leak,) = json.loads(capsys.readouterr().out)["effects"]
    assert [p["unit"] for p in leak["parameters"]] == ["1", "m", "s", "s"]
    assert cli.main(["effects", "leek"]) == cli.MISUSE
    assert "got 'leek'; the nearest is 'leak'" in capsys.readouterr().err
    assert cli.main(["effects", "valve_lag", "--plant", "three_tank"]) == cli.MISUSE
    assert "valve_lag: expected a plant with a valve, got three_tank" in capsys.readouterr().err


def test_a_plant_from_the_columns_of_a_recording_reads_that_recording(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{k},{3 + k % 2},{40 + k / 10},{1 + k / 100},2,{4 + k / 50},0.{k}" for k in range(10)]
    header = "time_s,FIC-101 PV (l/min),LT-101 (%),PT 7 [kPa],operator,level_mA,valve (%)"
    Path("trend.csv").write_text("\n".join([header, *rows]) + "\n")
    fdi("new", "plant", "--recording", "trend.csv", "--out", "rig.yaml")
    assert (
        "rig.yaml; next: correct what follows a !, then fdi check --plant rig.yaml --recording trend.csv"
        in capsys.readouterr().out
    )
    assert "# Left out, as their header has no unit of a level or command: operator\n" in Path("rig.yaml").read_text()
    plant = load_plant(Path("rig.yaml"), unfinished=True)
    assert [sensor.column for sensor in plant.sensors] == ["LT-101", "PT 7", "level"]
    assert list(plant.channels()) == ["FIC-101 PV", "valve"] and [p.target for p in plant.pipes] == [
        "B",
        "C",
        "outside",
    ]
    assert plant.pumps[0].max_flow == pytest.approx(4e-3 / 60)
    assert cli.main(["check", "--plant", "rig.yaml", "--recording", "trend.csv"]) == cli.NOT_EXPLAINED
    correct("rig.yaml")
    fdi("new", "monitor", "--plant", "rig.yaml", "--recording", "trend.csv")
    fdi("new", "run", "--plant", "rig.yaml", "--recording", "trend.csv")
    assert load_monitor("monitor.yaml").config.recording.file == "trend.csv"
    run = load_run("run.yaml").config
    assert run.recordings[0].file == "trend.csv" and run.estimate is not None
    assert run.estimate.parameters[0].name == "*.leak"
    said = "then check again; record longer or more often; until then fdi gap and fdi refit refuse the recording"
    assert said in capsys.readouterr().out
    Path("german.csv").write_text(
        "Datum/Uhrzeit;Zulauf [l/h];Füllstand B1 [%]\n29.3.2026 08:30:00;3000;40,5\n29.3.2026 08:31:00;3000;41\n"
    )
    fdi("new", "plant", "--recording", "german.csv", "--out", "german.yaml")
    plant = load_plant(Path("german.yaml"), unfinished=True)
    assert [s.column for s in plant.sensors] == ["Füllstand B1"] and list(plant.channels()) == ["Zulauf"]
    Path("duty.csv").write_text("t_s,pwm_duty,u_pump_V,y_lower_V,pulses_per_s,mass (s)\n0,1,2,1,0,2\n1,1,2,1,0,2\n")
    fdi("new", "plant", "--recording", "duty.csv", "--out", "duty.yaml")
    assert "or command: pulses_per_s, mass (s)\n" in Path("duty.yaml").read_text()
    plant = load_plant(Path("duty.yaml"), unfinished=True)
    assert [s.column for s in plant.sensors] == ["y_lower"] and list(plant.channels()) == ["pwm", "u_pump"]
    Path("tags.csv").write_text("t_s,P101.OUT [V],PT-7 [V],LI101 [mm],PK [V]\n0,3.6,1,120,4\n1,3,1,121,5\n")
    fdi("new", "plant", "--recording", "tags.csv", "--out", "tags.yaml")
    assert cli.main(["check", "--plant", "tags.yaml", "--recording", "tags.csv"]) == cli.NOT_EXPLAINED
    assert "asks for up to" not in capsys.readouterr().out
    plant = load_plant(Path("tags.yaml"), unfinished=True)
    assert [s.column for s in plant.sensors] == ["PT-7", "LI101"] and list(plant.channels()) == ["P101.OUT", "PK"]
    Path("none.csv").write_text("t_s,a,b\n0,1,2\n1,1,2\n")
    assert cli.main(["new", "plant", "--recording", "none.csv", "--out", "none.yaml"]) != cli.DONE
    assert "expected a column of a level with its unit in the header" in capsys.readouterr().err
    assert cli.main(["new", "run", "--recording", "trend.csv"]) != cli.DONE


def test_a_recording_with_a_row_per_value_is_mapped_by_tags(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fdi("new", "plant", "--out", "rig.yaml", "--quiet")
    correct("rig.yaml")
    levels = {"FIC1": 20, "LI101": 155, "LI102": 153}
    rows = [f"{tag};{k};{value + k % 3};Good" for k in range(60) for tag, value in levels.items()]
    Path("long.csv").write_text("\n".join(["Tag Name;t_s;Value;Quality", *rows]) + "\n")
    assert cli.main(["new", "plant", "--recording", "long.csv", "--out", "b.yaml"]) == cli.MISUSE
    assert "let fdi check --plant FILE --recording" in capsys.readouterr().err
    assert cli.main(["check", "--plant", "rig.yaml", "--recording", "long.csv"]) == cli.MISUSE
    lines = capsys.readouterr().err.partition("recordings:\n")[2]
    assert "    tags: {tag: Tag Name, value: Value, quality: Quality}" in lines
    for name, column, unit in (("Q", "FIC1", "l/min"), ("hA", "LI101", "mm"), ("hB", "LI102", "mm")):
        lines = lines.replace(f"{name}: {{column: TAG, unit: ...}}", f"{name}: {{column: {column}, unit: {unit}}}")
    Path("runs.yaml").write_text("recordings:\n" + lines)
    assert cli.main(["check", "--plant", "rig.yaml", "--recording", "runs.yaml"]) == cli.NOT_EXPLAINED
    assert "long.csv: 60 samples" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("header", "tags"),
    [
        ("TagName,TimeStamp,DataValue,OPCQuality", "tag: TagName, value: DataValue, quality: OPCQuality"),
        ("_time,_field,_value", "tag: _field, value: _value"),
        ("Messstelle;Zeit;Messwert;Status", "tag: Messstelle, value: Messwert, quality: Status"),
        ("Point Name,t_s,Avg Value", "tag: Point Name, value: Avg Value"),
        ("t_s,Point,h_cm", ""),  # a table with a column that is called so
    ],
)
def test_columns_of_historians_are_recognised_by_their_usual_names(header: str, tags: str, tmp_path: Path) -> None:
    sign = ";" if ";" in header else ","
    path = tmp_path / "long.csv"
    path.write_text(header + "\n" + (sign.join(["1"] * len(header.split(sign))) + "\n") * 2)
    lines = mapped(path, load_plant("three_tank"))
    assert lines[0].startswith(f"tags: {{{tags}}} " if tags else "columns:")


def test_columns_of_the_right_names_without_units_are_mapped_to_themselves(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fdi("new", "plant", "--out", "rig.yaml", "--quiet")
    correct("rig.yaml")
    Path("run.csv").write_text(
        "t_s;Q;hA_inch.;hB_mm\n" + "".join(f"{k};3,1;{20 + k % 2};{155 + k % 3}\n" for k in range(60))
    )
    words = ["--plant", "rig.yaml", "--recording", "run.csv"]
    assert cli.main(["check", *words]) == cli.MISUSE
    message = capsys.readouterr().err
    assert (
        "expected a column for Q, hA, got t_s, Q, hA_inch., hB_mm; if columns have other names or no unit, " in message
    )
    lines = message.partition("recordings:\n")[2].replace('"Q", unit: ...', '"Q", unit: l/min')
    Path("runs.yaml").write_text("recordings:\n" + lines.replace('"hA_inch.", unit: ...', '"hA_inch.", unit: cm'))
    fdi("check", "--plant", "rig.yaml", "--recording", "runs.yaml")
    assert "run.csv: 60 samples" in capsys.readouterr().out
    fdi("new", "run", *words)
    assert "run.yaml; next: complete the columns, then fdi train" in capsys.readouterr().out


def test_the_output_of_a_controller_is_a_command(here: Path) -> None:
    Path("loop.csv").write_text("t_s,LIC-101.PV (%),LIC-101.OUT (%),PC 7 OP [%]\n0,40,36,10\n1,41,35,10\n")
    fdi("new", "plant", "--recording", "loop.csv", "--out", "loop.yaml")
    plant = load_plant(Path("loop.yaml"), unfinished=True)
    assert [s.column for s in plant.sensors] == ["LIC-101.PV"] and list(plant.channels()) == ["LIC-101.OUT", "PC 7 OP"]


def test_a_recording_without_a_header_is_mapped_by_numbers(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fdi("new", "plant", "--out", "rig.yaml", "--quiet")
    correct("rig.yaml")
    rows = [f"{k},0E+0\t3,{k % 2}\t20,1\t{15 + k % 3},5" for k in range(60)]
    Path("lab.txt").write_text("\r\n".join(rows) + "\r\n")
    assert cli.main(["new", "plant", "--recording", "lab.txt", "--out", "b.yaml"]) == cli.MISUSE
    assert "let fdi new run --plant FILE --recording" in capsys.readouterr().err
    words = ["--plant", "rig.yaml", "--recording", "lab.txt"]
    assert cli.main(["check", *words]) == cli.MISUSE
    refused = capsys.readouterr().err
    assert "got numbers without a header; save these lines" in refused
    assert "by number, 1 to 4; first row: 0,0E+0 | 3,0 | 20,1 | 15,5" in refused
    fdi("new", "run", *words)
    fdi("new", "monitor", *words, "--out", "watch.yaml")
    assert "run.yaml; next: complete the columns, then fdi train" in capsys.readouterr().out
    assert cli.main(["train", "--config", "run.yaml"]) == cli.MISUSE
    assert "got ... for t, Q, hA, hB; replace each ...\n" in capsys.readouterr().err
    numbers = {"Q": (2, "l/min"), "hA": (3, "cm"), "hB": (4, "cm")}
    for path in (Path("run.yaml"), Path("watch.yaml")):
        text = path.read_text().replace("t: {column: 1, unit: ...}", "t: {column: 1, unit: s}")
        for name, (column, unit) in numbers.items():
            text = text.replace(f"{name}: {{column: ..., unit: ...}}", f"{name}: {{column: {column}, unit: {unit}}}")
        path.write_text(text)
    fdi("check", "--config", "run.yaml")
    assert "60 samples, 59 s" in capsys.readouterr().out
    assert load_monitor(Path("watch.yaml")).plant.name == "rig"


def test_columns_are_offered_by_name_and_the_file_as_it_was_given(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ["Füllstand D [mm]", "Füllstand A [mm]", "Pumpe 2 [L/min]", "Füllstand B [mm]", "Pumpe 1 [L/min]"]
    rows = "".join(f"{k};20;30;{k % 3};40;{k % 2}\n" for k in range(20))
    Path("data").mkdir()
    Path("data/trend.csv").write_text(f"t [s];{';'.join(names)}\n{rows}", encoding="utf-8")
    fdi("new", "plant", "--recording", "data/trend.csv", "--out", "rig.yaml")
    plant = load_plant(Path("rig.yaml"), unfinished=True)
    assert [tank.name for tank in plant.tanks] == ["A", "B", "D"]
    assert {sensor.column: sensor.tank for sensor in plant.sensors} == {
        "Füllstand D": "D",
        "Füllstand A": "A",
        "Füllstand B": "B",
    }
    Path("own.yaml").write_text(
        "tanks: {A: {area: 1 dm^2, height: 5 cm}, B: {area: 1 dm^2, height: 5 cm}, C: {area: 1 dm^2, height: 5 cm}}\n"
        "pumps: {P1: {target: A, max_flow: 5 l/min}, P2: {target: B, max_flow: 5 l/min}}\n"
        "sensors: {LA: {tank: A}, LB: {tank: B}, LC: {tank: C}}\n"
    )
    capsys.readouterr()
    assert cli.main(["check", "--plant", "own.yaml", "--recording", "data/trend.csv"]) == cli.MISUSE
    offered = "recordings:" + capsys.readouterr().err.partition("recordings:")[2]
    assert "  - file: data/trend.csv\n" in offered
    assert '      P1: {column: "Pumpe 1 [L/min]"}\n      P2: {column: "Pumpe 2 [L/min]"}\n' in offered
    assert '      LA: {column: "Füllstand A [mm]"}\n      LB: {column: "Füllstand B [mm]"}\n' in offered
    assert '      LC: {column: ...}    # one of: "Füllstand D [mm]"' in offered
    Path("runs.yaml").write_text(offered.replace("...", '"Füllstand D [mm]"'), encoding="utf-8")
    (read,) = named_recordings("runs.yaml", load_plant(Path("own.yaml")), here)
    assert read.output_names == ("LA", "LB", "LC") and read.outputs[0].tolist() == pytest.approx([0.03, 0.04, 0.02])
