"""A result has the same rows on the terminal, on a page and in a notebook."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from sample_runs import GAP_ANSWER_2, material_of, write_gap, write_study, write_train

from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import load_plant
from fdi_torch.report.gap_tables import cause_table, constant_table, error_tables, flow_table
from fdi_torch.report.html import typeset
from fdi_torch.report.page import page, report_of
from fdi_torch.report.sections.estimate import last_estimate
from fdi_torch.report.setting_tables import setting_tables
from fdi_torch.tables import Table


def rows_of(markup: str) -> list[list[str]]:
    """The cells of every row of every table, without those that are empty."""
    rows = re.findall(r"<tr>(.*?)</tr>", markup, flags=re.S)
    cells = ([html.unescape(re.sub("<[^>]+>", "", c)) for c in re.findall(r"<td.*?</td>", row, re.S)] for row in rows)
    return [[cell for cell in row if cell] for row in cells]


def check(tables: Sequence[Table], page_text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every row of the tables is on the page, as it is typeset there, on the terminal and in the notebook."""
    Screen().show(*tables)
    terminal = [re.split(r" {2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]
    on_page, in_notebook = rows_of(page_text), rows_of("".join(table.html() for table in tables))
    assert sum(map(len, tables)) > 0
    for row in (row for table in tables for row in table.cells()):
        cells = [cell for cell in row if cell]
        assert [typeset(cell) for cell in cells] in on_page
        assert cells in terminal and cells in in_notebook


def test_the_tables_of_a_gap_are_the_same_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = load_plant("three_tank")
    material = material_of(write_gap(tmp_path / "run.mcap", **GAP_ANSWER_2), plant)
    answer = material.answer
    tables = [cause_table(answer), flow_table(answer, plant), *error_tables(answer), constant_table(answer)]
    assert [len(table) for table in tables] == [2, 2, 6, 2, 3]
    with material.in_its_units():
        check(tables, page([report_of(material)]), capsys)


def test_the_settings_of_a_study_are_the_same_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    material = material_of(write_study(tmp_path / "run.mcap"))
    settings = [(m["group"], m["trials"], m) for m in material.of("/study/summary")]
    tables = setting_tables(settings, dict.fromkeys(("T1.leak", "P13.openness"), "SI"))
    assert [table.title for table in tables] == [f"SNR {snr}: 20 trials, 19 converged" for snr in (50, 30)]
    check(tables, page([report_of(material)]), capsys)
    many = setting_tables([(str(k), 20, {"free.failures": k, "free.worst": 0.5}) for k in range(11)], {})
    assert len(many) == 1 and many[0].cells()[3] == ["3", "20", "3", "0.5"]


def test_a_short_table_has_the_worst_parameter_of_each_further_estimator() -> None:
    names, numbers = ("T1.leak.size", "T2.leak.size"), {"free.failures": 0}
    for estimator, ratios in (("free", (1.01, 1.02)), ("correlation", (1.6, 3.5))):
        for name, ratio in zip(names, ratios, strict=True):
            numbers |= {f"{estimator}.{name}.{key}": 0.001 for key in ("bias", "bias_error", "rmse")}
            numbers[f"{estimator}.{name}.over_bound"] = ratio
    settings, units = [("SNR 30", 20, numbers)], dict.fromkeys(names, "1")
    assert len(setting_tables(settings, units)[0]) == 4
    rows = setting_tables(settings, units, brief=True)[0].rows
    assert [row[:2] for row in rows] == [("free", "T1.leak"), ("free", "T2.leak"), ("correlation", "T2.leak")]


def test_a_page_adds_the_finding_to_the_estimates_of_the_terminal(tmp_path: Path) -> None:
    material = material_of(write_train(tmp_path / "run.mcap"))
    final = last_estimate(material)
    assert final is not None
    (row,) = [row for row in rows_of(page([report_of(material)])) if row[:2] == ["T1.leak.size", "present"]]
    assert row[2:4] == ["1", "0.3004 ± 0.0020"]


def test_numbers_of_a_table_have_its_digits_or_those_of_their_error() -> None:
    table = Table(("name", "value", "std error", "of"), [("a", 0.123456, 0.0123, 1234.5678)], digits=3)
    assert table.cells() == [["a", "0.123", "0.012", "1230"]]
    odd = Table(("name", "x"), [("nan", float("nan")), ("none", None), ("inf", float("inf")), ("list", [0.5, "a"])])
    assert odd.cells() == [["nan", ""], ["none", ""], ["inf", "–"], ["list", "0.5, a"]]
