"""The headline of a comparison: the better run, by how much, and what differs, in words."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from sample_runs import write_train

from fdi_torch import cli
from fdi_torch.jobs.report import report
from fdi_torch.logbook import Comparison, RunLog, compare, read_run
from fdi_torch.logbook.compare import Result
from fdi_torch.report.comparison import in_words, result_table
from fdi_torch.report.comparison_headline import comparison_headline, plain_text, setting_differences
from fdi_torch.report.material import gather
from fdi_torch.report.predictions import residual_size

SAMPLES = 100


def write_fit(
    path: Path,
    error: float,
    *,
    level: float = 0.3,
    config: dict[str, str] | None = None,
    explained: bool = True,
    flow: float = 4e-5,
    held_out: float | None = None,
    kind: str = "train",
) -> Path:
    """A fit of two sensors whose residuals alternate between + and - `error`, m, of readings that vary with `level`.

    held_out: error on a hold-out, if there is one.
    """
    time = np.arange(float(SAMPLES))
    read = level + 0.01 * np.sin(time)[:, None] * np.ones(2)
    model = read - error * np.where(np.arange(SAMPLES) % 2, 1.0, -1.0)[:, None]
    with RunLog(path, kind, config_text="plant: three_tank\n", config=config or {}, env={}, git={}) as log:
        log.recording(time, np.full((SAMPLES, 1), flow), read, ("Q1",), ("h1", "h2"), ("m^3/s",), ("m", "m"))
        if held_out is None:
            log.result_arrays(predicted=model)
        else:
            channels = ("Q1",), ("h1", "h2"), ("m^3/s",), ("m", "m")
            log.recording(time, np.full((SAMPLES, 1), flow), read, *channels, group="holdout")
            log.result_arrays(augmented=model, holdout_augmented=read - held_out)
        log.result({"explained": explained})
    return path


def sentences(*logs: Path) -> list[str]:
    return comparison_headline(compare(logs), [gather(read_run(log)) for log in logs])


def settings_of(*logs: Path) -> tuple[dict[str, tuple[str, ...]], int]:
    return setting_differences(compare(logs), [gather(read_run(log)) for log in logs])


def test_the_run_with_the_smaller_residuals_is_better_by_their_ratio(tmp_path: Path) -> None:
    a, b = write_fit(tmp_path / "a.mcap", 0.004, explained=False), write_fit(tmp_path / "b.mcap", 0.001)
    better, unreliable, same = sentences(a, b)
    assert better == (
        "b explains the recording best: its residuals are 75 % smaller than those of a (h1 0.1 cm against 0.4 cm and "
        "h2 0.1 cm against 0.4 cm)."
    )
    assert unreliable == "Unreliable: a (the model does not explain the recording)."
    assert same == "Recording, settings and versions are the same."
    third = write_fit(tmp_path / "c.mcap", 0.002)
    assert "50 % smaller than those of c" in sentences(a, b, third)[0]


def test_the_error_of_a_run_is_that_of_what_it_was_fitted_to_and_not_of_its_hold_out(tmp_path: Path) -> None:
    tested, plain = write_fit(tmp_path / "tested.mcap", 0.001, held_out=0.05), write_fit(tmp_path / "plain.mcap", 0.004)
    assert residual_size(gather(read_run(tested)))[0] == pytest.approx(0.001, rel=1e-9)
    assert sentences(plain, tested)[0].startswith("tested explains the recording best: its residuals are 75 % smaller")


def test_a_recording_with_other_inputs_is_not_called_the_same(tmp_path: Path) -> None:
    a, b = write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, flow=0.0)
    better, differ = sentences(a, b)
    assert "75 % smaller" in better and differ == "They differ in the inputs of the recording."


@pytest.mark.parametrize(("share", "equal"), [(0.1, True), (0.18, False)])
def test_a_difference_that_chance_explains_is_none(tmp_path: Path, share: float, equal: bool) -> None:
    """200 readings: 1.96 / sqrt(200) = 14 %."""
    a = write_fit(tmp_path / "a.mcap", 0.001, config={"seed": 3})
    b = write_fit(tmp_path / "b.mcap", 0.001 * (1.0 - share))
    assert ("explain the recording equally well" in sentences(a, b)[0]) is equal
    c = write_fit(tmp_path / "c.mcap", 0.001)
    all_three = "b, a and c explain the recording equally well: residuals differ by at most 10 %"
    assert (all_three in sentences(a, b, c)[0]) is equal


def test_runs_of_different_recordings_are_not_ranked(tmp_path: Path) -> None:
    a, b = write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, level=0.2)
    verdicts, differ = sentences(a, b)
    assert verdicts.startswith("a: ") and verdicts.endswith(
        "They read different recordings, so their residuals do not rank them."
    )
    assert differ == "They differ in the recording (simulated: other readings)."


def test_a_monitor_and_a_fit_are_not_ranked(tmp_path: Path) -> None:
    fit, followed = write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, kind="monitor")
    assert sentences(fit, followed)[0].endswith("follows the readings, so residuals do not rank them.")


def test_a_live_source_is_not_called_simulated(tmp_path: Path) -> None:
    live = {"recording.file": "mqtt://broker/rig"}
    a = write_fit(tmp_path / "a.mcap", 0.004, config=live)
    b = write_fit(tmp_path / "b.mcap", 0.001, level=0.2)
    assert sentences(a, b)[-1].startswith("They differ in the recording (a: mqtt://broker/rig; b: simulated)")


def test_settings_are_told_in_words(tmp_path: Path) -> None:
    ours = {"plant.effects": [{"effect": "leak", "location": "T1"}], "seed": 1, "step": None, "sha256": "abc"}
    a = write_fit(tmp_path / "a.mcap", 0.001, config={"seed": 2})
    b = write_fit(tmp_path / "b.mcap", 0.001, config=ours)
    assert settings_of(a, b)[0] == {"seed": ("2", "1"), "plant.effects": ("none", "leak at T1")}
    assert sentences(a, b)[-1] == ("They differ in seed (a: 2; b: 1) and plant.effects (a: none; b: leak at T1).")
    assert plain_text('[{"name":"T1.leak","low":null}]') == "T1.leak" and plain_text("[broken") == "[broken"


def test_of_nested_settings_the_keys_and_entries_that_differ_are_named(tmp_path: Path) -> None:
    """Where a run's list holds nothing of its own, the lists are whole; long ones without what all runs have."""
    recording = {"file": "run.xlsx", "header": True, "columns": {"t": "t", "Q": "Q"}}
    other = recording | {"file": "run_de.txt", "columns": {"t": "column 1", "Q": "Q"}}
    a = write_fit(tmp_path / "a.mcap", 0.001, config={"recordings": [recording], "faults": ["A.leak", "B.leak"]})
    b = write_fit(tmp_path / "b.mcap", 0.001, config={"recordings": [other], "faults": ["A.leak"]})
    c = write_fit(tmp_path / "c.mcap", 0.001, config={"recordings": [recording], "faults": ["A.leak", "B.leak"]})
    assert settings_of(a, b, c)[0] == {
        "recordings.file": ("run.xlsx", "run_de.txt", "run.xlsx"),
        "recordings.columns.t": ("t", "column 1", "t"),
        "faults": ("A.leak, B.leak", "A.leak", "A.leak, B.leak"),
    }
    assert "recordings.file (a and c: run.xlsx; b: run_de.txt)" in sentences(a, b, c)[-1]
    long = [f"T{k}.leak" for k in range(12)]
    d = write_fit(tmp_path / "d.mcap", 0.001, config={"faults": long})
    e = write_fit(tmp_path / "e.mcap", 0.001, config={"faults": [*long, "P.plugging"]})
    assert settings_of(d, e)[0] == {"faults": ("none", "P.plugging")}


def test_lists_of_several_recordings_and_of_named_entries_are_told_apart(tmp_path: Path) -> None:
    leak, lag = {"effect": "leak", "location": "T1"}, {"effect": "pump_lag", "location": "Q1"}
    first = {"recordings": [{"file": "1.csv"}, {"file": "2.csv"}], "plant.effects": [leak, lag]}
    second = {"recordings": [{"file": "1.csv"}, {"file": "3.csv"}], "plant.effects": [leak]}
    a, b = (
        write_fit(tmp_path / f"{name}.mcap", 0.001, config=config) for name, config in (("a", first), ("b", second))
    )
    assert settings_of(a, b)[0] == {
        "recordings.2.file": ("2.csv", "3.csv"),
        "plant.effects": ("leak at T1, pump lag at Q1", "leak at T1"),
    }


def write_leak(path: Path, *, place: str = "T1", explained: bool = True) -> Path:
    """An estimate of one parameter that all runs share and of one that only this run has, with a fault."""
    with RunLog(path, "train", config_text="", config={}, env={}, git={}) as log:
        names = ["T1.leak.size", f"{path.stem}.area"]
        log.estimate(names, [0.3, 1.0], [0.01, 0.1], np.eye(2), "converged", units=["1", "m^2"])
        log.fault("leak.size" if place == "T1" else "leak", place, True)
        log.result({"explained": explained})
    return path


def agreement(*logs: Path) -> list[str]:
    return in_words(compare(logs), [gather(read_run(log)) for log in logs])


def test_runs_agree_only_if_each_is_reliable_and_they_name_the_same_faults(tmp_path: Path) -> None:
    a, b = (write_leak(tmp_path / f"{name}.mcap") for name in "ab")
    other, bad = write_leak(tmp_path / "c.mcap", place="T2"), write_leak(tmp_path / "bad.mcap", explained=False)
    assert agreement(a, b) == ["Of 3 parameters 1 is in both runs; there they agree at 95 %."]
    assert agreement(a, other) == [
        "Of 4 parameters 1 is in both runs; none of these differs at 95 %, but the runs name different faults."
    ]
    assert agreement(a, bad, b) == [
        "Of 4 parameters 1 is in both reliable runs; none of these differs at 95 %, but bad is unreliable."
    ]
    assert agreement(a, bad) == ["The estimates are not compared, as bad is unreliable."]


def test_runs_on_one_recording_differ_by_shares_of_one_standard_error(tmp_path: Path) -> None:
    data = [{"path": "run.csv", "sha256": "1f"}]
    logs = []
    for name, size in (("a", 0.300), ("b", 0.305)):
        with RunLog(tmp_path / f"{name}.mcap", "train", config_text="", config={}, env={}, git={}, data=data) as log:
            log.estimate(["T1.leak.size"], [size], [0.01], np.eye(1), "converged", units=["1"])
            log.fault("leak.size", "T1", True)
            log.result({"explained": True})
        logs.append(tmp_path / f"{name}.mcap")
    assert agreement(*logs) == [
        "Both runs have the same parameter.",
        "All runs read the same recording: their errors are not independent, so that standard errors do not add and no "
        "test of agreement applies; the estimates differ by at most 0.5 of the smaller standard error (T1.leak.size).",
    ]
    table = result_table(compare(logs))
    assert table.header[-1] == "difference, std errors" and table.rows[0][-1] == "0.5"


def test_every_difference_that_is_not_listed_is_counted(tmp_path: Path) -> None:
    a = write_fit(tmp_path / "a.mcap", 0.001, config={f"key{k}": 1 for k in range(9)})
    b = write_fit(tmp_path / "b.mcap", 0.001, level=0.2, config={f"key{k}": 2 for k in range(9)})
    listed = "the recording (simulated: other readings), key0 (a: 1; b: 2), key1 (a: 1; b: 2), key2 (a: 1; b: 2)"
    assert sentences(a, b)[-1] == f"They differ in {listed} and 6 more."


def test_settings_that_differ_by_rounding_do_not_differ(tmp_path: Path) -> None:
    percent = write_fit(tmp_path / "a.mcap", 0.001, config={"confidence": 95 * 0.01, "duration": 1000.0})
    share = write_fit(tmp_path / "b.mcap", 0.001, config={"confidence": 0.95, "duration": 600.5})
    assert settings_of(percent, share)[0] == {"duration": ("1000", "600.5")}


ONE_TANK = {
    "plant.gravity": "9.81 m/s^2",
    "plant.tanks.A.area": "200 cm^2",
    "plant.tanks.A.height": "60 cm",
    "plant.tolerances.A.area": "3 %",
    "estimate.parameters": ["A.leak"],
    "estimate.search.population": None,
}
TWO_TANKS = {
    "plant.gravity": "981 cm/s^2",
    "plant.tanks.T1.area": "160 cm^2",
    "plant.tanks.T1.height": "100 cm",
    "plant.tanks.T2.area": "160 cm^2",
    "plant.tanks.T2.height": "100 cm",
    "estimate.parameters": ["T1.leak"],
    "estimate.search.population": 8,
    "simulate.duration": "160 s",
    "simulate.inputs.Q1.value": "50 cm^3/s",
}


def test_parts_that_some_runs_lack_are_named_without_their_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = write_fit(tmp_path / "a.mcap", 0.001, config=ONE_TANK)
    b = write_fit(tmp_path / "b.mcap", 0.001, level=0.2, config=TWO_TANKS)
    settings, left_out = settings_of(a, b)
    assert settings == {
        "plant.tanks": ("A", "T1, T2"),
        "simulate": ("none", "given"),
        "plant.tolerances.A.area": ("3 %", "none"),
        "estimate.parameters": ("A.leak", "T1.leak"),
        "estimate.search.population": ("none", "8"),
    }, "the same gravity in another unit is no difference"
    assert left_out == 8
    assert cli.main(["compare", str(a), str(b), "--csv", str(tmp_path / "all.csv")]) == cli.DONE
    said = capsys.readouterr().out
    assert "plant.tanks.T1.area" not in said and "8 settings of parts that not every run has are left out" in said
    assert "plant.tanks.T1.area" in (tmp_path / "all.csv").read_text()
    page = report([a, b]).page.read_text()
    assert "plant.tanks.T1.area" not in page.split("Comparison", 1)[1].split("<article", 1)[0]
    assert "8 settings of parts that not every run has are left out" in page


def test_a_part_that_all_runs_have_shows_its_settings(tmp_path: Path) -> None:
    more = {**ONE_TANK, "plant.tanks.A.leak_reference": "OUT", "plant.tanks.A.height": "61 cm"}
    a, b, c = (
        write_fit(tmp_path / f"{name}.mcap", 0.001, config=config)
        for name, config in (("a", ONE_TANK), ("b", more), ("c", TWO_TANKS))
    )
    settings, left_out = settings_of(a, b)
    assert settings == {"plant.tanks.A.height": ("60 cm", "61 cm"), "plant.tanks.A.leak_reference": ("none", "OUT")}
    assert left_out == 0
    settings, _ = settings_of(a, b, c)
    assert settings["plant.tanks.A.height"] == ("60 cm", "61 cm", "none"), "of the runs that have it, two differ"
    assert settings["plant.tanks"] == ("A", "A", "T1, T2")


def test_a_long_setting_is_shown_whole_or_with_a_mark_of_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short, long = "A.leak, B.leak, A.leak.onset, B.leak.onset", ", ".join(f"T{k}.leak" for k in range(20))
    configs = {"a": short, "b": long}
    logs = [
        write_fit(tmp_path / f"{name}.mcap", 0.001, config={"estimate.parameters": text})
        for name, text in configs.items()
    ]
    assert cli.main(["compare", *map(str, logs)]) == cli.DONE
    settings = capsys.readouterr().out.partition("settings")[2]
    assert f"{short} " in settings and "T6.le…" in settings


def test_terminal_and_page_lead_with_the_headline(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, config={"seed": 3})]
    assert cli.main(["compare", *map(str, logs)]) == cli.DONE
    said = capsys.readouterr().out
    assert said.startswith("b explains the recording best") and "sha256" not in said
    page = report(logs).page.read_text()
    assert page.index("b explains the recording best") < page.index("<svg")


def test_units_on_the_terminal_are_written_as_in_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_train(tmp_path / "a.mcap")
    assert cli.main(["report", str(log)]) == cli.DONE
    assert "30 cm^3/s" in capsys.readouterr().out
    assert "30 cm³/s" in (tmp_path / "a.html").read_text()
    offset = Result("Q1.pump_offset.size", "m^3/s", (1e-6, 1.1e-6), (1e-8, 1e-8), 0.5)
    (row,) = result_table(Comparison(("a", "b"), {}, (offset,), False, True)).rows
    assert row[1] == "cm^3/s"


@pytest.mark.parametrize(
    ("setting", "name", "said"),
    [
        ("plant.pipes.P13.discharge_coefficient", "T1.leak.size", True),
        ("plant.pipes.P13.elevation", "T1.leak.size", False),
        ("plant.pipes.P13.discharge_coefficient", "P13.plugging.size", False),
    ],
)
def test_leaks_relative_to_another_capacity_are_not_compared_unsaid(
    tmp_path: Path, setting: str, name: str, said: bool
) -> None:
    result = Result(name, "1", (0.150, 0.155), (2e-4, 2e-4), math.nan, apart=25.0)
    compared = Comparison(("a", "b"), {"config": {setting: ("0.6", "0.62")}}, (result,), False, True, True)
    runs = [gather(read_run(write_fit(tmp_path / f"{label}.mcap", 0.001))) for label in compared.labels]
    _, *others = in_words(compared, runs)
    explained = f"{name}: relative to the capacity of a pipe in the plant file; {setting} differs."
    assert (explained in others) is said
