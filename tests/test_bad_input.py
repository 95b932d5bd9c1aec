"""User errors in the main command: exit code 2 and one sentence that names file and field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fdi_torch import cli
from fdi_torch.config.yaml_files import SHIPPED
from fdi_torch.logbook import read_run
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline

HEADER = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm"
ROWS = [f"{t},{50 + 10 * (t // 20)},50,{40 + t % 11},{30 + t % 5},{35 + t % 3}" for t in range(60)]
RUN = """\
plant: PLANT
recordings: [{file: rig.csv}]
estimate: {parameters: [T1.leak], search: {evaluations: 60, population: 20}}
output: {folder: logs}
"""
PLANT = (SHIPPED / "plants" / "three_tank.yaml").read_text()
Edit = Callable[[str], str]


def replaced(old: str, new: str) -> Edit:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


@pytest.fixture
def outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs the main job on files after an edit of each; returns the exit code and what was said."""
    monkeypatch.chdir(tmp_path)

    def run(data: Edit = str, plant: Edit = str, job: Edit = str) -> tuple[int, str, str]:
        (tmp_path / "rig.csv").write_text(data("\n".join([HEADER, *ROWS]) + "\n"))
        (tmp_path / "tanks.yaml").write_text(plant(PLANT))
        (tmp_path / "run.yaml").write_text(job(RUN.replace("PLANT", str(tmp_path / "tanks.yaml"))))
        code = cli.main(["train", "--config", str(tmp_path / "run.yaml"), "--quiet"])
        shown = capsys.readouterr()
        return code, shown.err.strip(), shown.out

    return run


def cut(text: str) -> str:
    """The first two samples only: six readings for one fault, three discharge coefficients and three start levels."""
    return "\n".join(text.splitlines()[:3]) + "\n"


WRONG_RUN = {
    "unknown key": ("recordings:", "recording:", "run.yaml: ", "'recording'; the nearest is 'recordings'"),
    "nested key": ("evaluations", "evaluatons", "run.yaml: estimate.search: ", "the nearest is 'evaluations'"),
    "fault": ("T1.leak", "T1.leek", "run.yaml: estimate.parameters.0: ", "the nearest is 'T1.leak'"),
    "plant": ("plant: ", "plant: three_tanks #", "run.yaml: plant: ", "the nearest is 'three_tank'"),
    "no YAML": ("[T1.leak]", "[T1.leak", "run.yaml: line 3: ", "not valid YAML"),
    "recording": ("rig.csv", "rigs.csv", "rigs.csv: ", "file not found"),
    "log folder": ("folder: logs", "folder: rig.csv", "rig.csv/run.mcap: ", "is a file, not a folder"),
}
WRONG_PLANT = {
    "area": ("160 cm^2, height: 100 cm, leak_reference: P13", "-1 cm^2, height: 1 cm", "tanks.T1.area", "positive"),
    "unit": ("160 cm^2", "160 cm", "tanks.T1.area", "expected a quantity in m^2"),
    "pipe to nowhere": ("target: T3", "target: T7", "pipes.P13.target", "got 'T7'"),
    "pump without tank": ("Q1: {target: T1, ", "Q1: {", "pumps.Q1.target", "expected a value, got nothing"),
    "key": ("height", "hieght", "tanks.T1", "the nearest is 'height'"),
}
WRONG_DATA = {
    "repeated time": ("\n21,", "\n20,", "row 23, column t_s", "expected time that increases, got 20 s after 20 s"),
    "backward time": ("\n21,", "\n2,", "row 23, column t_s", "expected time that increases, got 2 s after 20 s"),
    "missing column": (",h3_cm", ",x3_cm", "expected a column for h3", "map it under columns"),
    "unit": ("Q1_cm3_s", "Q1_cm", "Q1", "expected a unit of flow such as l/min"),
    "per cent of a level": ("h1_cm", "h1_pct", "h1", "(a level in %: gain: 100 %/m)"),
    "per cent of a pump": ("Q1_cm3_s", "Q1_pct", "Q1", "(a command in %: gain: "),
    "no number": ("\n5,50,50,45,", "\n5,50,50,five,", "row 7, column h1_cm", "got 'five'"),
    "fewer cells": ("\n5,50,50,45,", "\n5,50,", "row 7", "expected 6 cells"),
}


@pytest.mark.parametrize("case", WRONG_RUN)
def test_a_wrong_run_file_is_named_with_its_field(case: str, outcome) -> None:
    old, new, where, what = WRONG_RUN[case]
    code, said, _ = outcome(job=replaced(old, new))
    assert code == cli.MISUSE and said.count("\n") == 0
    assert where in said and what in said


@pytest.mark.parametrize("case", WRONG_PLANT)
def test_an_impossible_plant_is_named_with_its_field(case: str, outcome) -> None:
    old, new, where, what = WRONG_PLANT[case]
    code, said, _ = outcome(plant=replaced(old, new))
    assert code == cli.MISUSE and said.count("\n") == 0
    assert "tanks.yaml: " in said and where in said and what in said


@pytest.mark.parametrize("case", WRONG_DATA)
def test_a_wrong_recording_is_named_with_its_place(case: str, outcome) -> None:
    old, new, where, what = WRONG_DATA[case]
    code, said, _ = outcome(data=replaced(old, new))
    assert code == cli.MISUSE and said.count("\n") == 0
    assert "rig.csv: " in said and where in said and what in said


def test_a_channel_that_stands_still_has_no_correlation(outcome) -> None:
    still = [",".join([*row.split(",")[:4], "30", row.split(",")[5]]) for row in ROWS]
    code, said, _ = outcome(data=lambda text: "\n".join([HEADER, *still]) + "\n")
    assert code == cli.MISUSE
    assert "rig.csv: expected readings that vary, but h2" in said and "leave the sensor out of the plant file" in said


def test_fewer_readings_than_parameters_are_refused(outcome) -> None:
    code, said, _ = outcome(data=cut)
    assert code == cli.MISUSE
    assert "rig.csv: expected more readings than parameters, got 6 readings for 7 parameters" in said


def test_missing_readings_are_counted_and_unknown_inputs_cut_out(outcome, tmp_path: Path) -> None:
    def holes(text: str) -> str:
        return replaced("\n5,50,50,45,", "\n5,50,50,NaN,")(replaced("\n30,60,50,", "\n30,,50,")(text))

    code, said, shown = outcome(data=holes)
    assert code in (cli.DONE, cli.NOT_CONVERGED, cli.NOT_EXPLAINED) and not said
    assert f"{tmp_path / 'rig.csv'}: 1 of 177 readings are missing or masked and do not count" in shown
    assert f"{tmp_path / 'rig.csv'}: an input is sometimes unknown; fitted as 2 segments with known inputs" in shown


def test_a_fit_that_has_not_converged_says_so_first(outcome, tmp_path: Path) -> None:
    once = replaced("estimate: {", "estimate: {refine: {iterations: 1}, ")
    code, _, shown = outcome(job=once)
    assert code == cli.NOT_CONVERGED
    warning = "Not converged (max iterations): sizes may be off by more than their standard errors"
    assert f"{warning}.\n- next: estimate fewer parameters" in shown.partition("parameter ")[0]
    (log,) = (tmp_path / "logs").glob("*.mcap")
    assert headline(gather(read_run(log))).startswith(warning)
