"""What pages say of numbers and names: digits, alignment, runs of one name, parameters of an unfinished study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sample_runs import material_of, write_study

from fdi_torch.config.plant_file import load_plant
from fdi_torch.logbook import RunLog, compare
from fdi_torch.report.comparison import result_table
from fdi_torch.report.page import page, report_of
from fdi_torch.report.sections.monitor import adoptions
from fdi_torch.report.verdict import headline
from fdi_torch.tables import Table


def test_numbers_of_a_monitor_have_the_digits_that_their_standard_errors_justify(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "monitor", env={}, git={}) as log:
        told = "pump offset at Q (-1.072 ± 0.087 l/min), by hA-hB of 2026-11-24"
        log.alarm(764.0, "explained", "Q.pump_offset", told, onset=700.4754, onset_std=0.31)
    text = page([report_of(material_of(tmp_path / "run.mcap"))])
    assert ">700.48<" in text and "700.475" not in text
    text = text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{WORD JOINER}", "")
    assert "(−1.072 ± 0.087 l/min), by hA-hB of 2026-11-24" in text


def test_an_interval_has_the_digits_of_its_estimate(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "train", env={}, git={}) as log:
        log.estimate(["T1.area"], [0.015441], [0.0002], [[0.0002**2]], "converged", units=["m^2"])
    text = page([report_of(material_of(tmp_path / "run.mcap"))])
    assert "154.4 ± 2.0" in text and ">150.5 … 158.3<" in text


def test_an_estimate_at_an_end_of_its_range_has_a_one_sided_interval(tmp_path: Path) -> None:
    for name, end in (("a", "low"), ("b", "high")):
        with RunLog(tmp_path / f"{name}.mcap", "train", env={}, git={}) as log:
            value = 0.0 if end == "low" else 1.0
            names = ["B.leak.size"]
            log.estimate(names, [value], [0.026], [[0.026**2]], "converged", units=["1"], at_bound=names)
            log.result({"at_bounds": {"B.leak.size": end}})
    text = page([report_of(material_of(tmp_path / "a.mcap"))])
    assert ">0.000<" in text and ">below 0.051<" in text and "0.000 ±" not in text
    assert "B.leak.size lies at the low end of its range" in text
    compared = result_table(compare([tmp_path / "a.mcap", tmp_path / "b.mcap"]))
    assert compared.rows[0][2:4] == ["below 0.051", "above 0.949"]


def test_the_headline_of_a_monitor_is_set_as_the_rest_of_its_page(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "monitor", env={}, git={}) as log:
        held = "pump offset at Q (-11.07 ± 0.87 cm^3/s), by hA-hB"
        log.alarm(764.0, "isolated", "Q.pump_offset", held, alarm=1, state="isolated", headline=held)
    material = material_of(tmp_path / "run.mcap")
    assert headline(material) == "Pump offset at Q (-11.07 ± 0.87 cm^3/s), by hA-hB (isolated)"
    assert "Pump offset at Q (−11.07 ± 0.87 cm³/s), by hA-hB" in page([report_of(material)]).replace("\u00a0", " ")


def test_a_page_of_a_monitor_marks_when_its_model_took_a_fault_in(tmp_path: Path) -> None:
    """From the mark on, residuals are those of the model with the fault; the readings have both models' predictions."""
    time = np.arange(10.0)
    with RunLog(tmp_path / "run.mcap", "monitor", config_text="plant: three_tank\n", env={}, git={}) as log:
        log.recording(time, np.full((10, 1), 4e-5), np.full((10, 1), 0.3), ("Q1",), ("h1",), ("m^3/s",), ("m",))
        for t in time[1:]:
            log.write("/observer/residual", {"h1": 0.01 * t, "h1_statistic": t}, t, units={"h1": "m"})
        for t, believed in ((4.0, []), (6.0, [["A.leak.size", 0.2]]), (7.0, [["A.leak.size", 0.21]]), (8.0, [])):
            log.alarm(t, "explained", "", "", details=json.dumps({"believed": believed}))
    material = material_of(tmp_path / "run.mcap")
    assert adoptions(material) == [(6.0, "leak at A adopted"), (8.0, "leak at A dropped")]
    report = report_of(material)
    charts = {p.name: p.chart for p in report.pictures if p.chart is not None}
    for name in ("observer_residual_1", "observer_statistic_1", "output_1"):
        assert charts[name].marks == adoptions(material)
    measured, predicted = charts["output_1"].lines
    np.testing.assert_allclose(measured.y - predicted.y, [np.nan, *time[1:]], atol=1e-12)
    assert "from there on the residuals are those of the model with the fault named" in page([report])


def test_the_onset_in_the_headline_of_a_monitor_has_its_error(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "monitor", env={}, git={}) as log:
        told = {"alarm": 1, "state": "isolated", "headline": "leak at A", "onset": 700.1412, "onset_std": 0.21}
        log.alarm(764.0, "isolated", "A.leak.size", "leak at A", **told)
    assert headline(material_of(tmp_path / "run.mcap")) == "Leak at A, since 700.14 ± 0.21 s (isolated)"


def test_runs_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    both = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        both.append(report_of(material_of(write_study(tmp_path / name / "leak.mcap"))))
    index = page(both).split("</nav>")[0]
    assert ">first/leak<" in index and ">second/leak<" in index


def test_words_of_a_table_are_left_aligned() -> None:
    assert Table(("size", "detector", "runs"), [["5 %", "fixed", "20"], ["20 %", "cusum", "7"]]).left == 2
    assert Table(("noise", "alarms"), [["white", "24 (18 .. 40)"]]).left == 1 and Table(("noise",), []).left == 1
    assert Table(("fault", "unit", "size"), [["leak", "1", 0.3]]).left == 2, "a unit is a word, also the unit 1"


def test_an_unfinished_study_names_its_parameters(tmp_path: Path) -> None:
    asked = {"estimate": {"parameters": [{"name": "Q1.pump_offset"}]}}
    with RunLog(tmp_path / "run.mcap", "study", config=asked, env={}, git={}) as log:
        for k in range(4):
            numbers = {"truth": [2e-6], "free": [2e-6 + 1e-7 * (k + 1)], "bound": [1e-7]}
            log.trial(k, numbers, group="SNR 40 dB", seed=k, status="converged")
    made = report_of(material_of(tmp_path / "run.mcap", load_plant("three_tank")))
    axes = next(p for p in made.pictures if p.name == "errors_1").figure.axes[0]
    assert axes.get_title(loc="left") == "pump offset at Q1" and axes.get_ylabel() == "size of the error, cm³/s"
    bar = next(line for line in axes.lines if line.get_linestyle() == "-").get_ydata()
    assert bar == pytest.approx(0.1 * np.sqrt([7.5, 7.5])), "a bound limits the root mean square, not the median"


def test_the_rivals_of_an_alarm_are_a_list_and_each_statement_has_a_line(tmp_path: Path) -> None:
    names = [f"leak at {k} (size -0.2 ± 0.1)" for k in "ABCDE"]
    head = f"{names[0]}, 60 %, or {names[1]}, 20 %, or 3 more, 20 % (see the log)"
    told = f"{head}, since 700.1 ± 0.2 s; A runs dry in 80 s"
    with RunLog(tmp_path / "run.mcap", "monitor", env={}, git={}) as log:
        about = {"explanations": names, "masses": [0.6, 0.2, 0.1, 0.06, 0.04], "headline": head}
        log.alarm(764.0, "cannot tell", "A.leak.size", told, alarm=1, **about)
        log.alarm(800.0, "summary", "A.leak.size", f"alarm 1, explained: {told}", alarm=1, **about)
        log.alarm(
            900.0, "revised", "A.leak.size", f"{names[0]}; A runs dry", alarm=1, explanations=names[:1], masses=[1.0]
        )
    text = page([report_of(material_of(tmp_path / "run.mcap"))]).replace("\N{NO-BREAK SPACE}", " ")
    listed = "<li>leak at A (size −0.2 ± 0.1), 60 %</li>", "<li>leak at E (size −0.2 ± 0.1), 4 %</li>"
    assert all(text.count(item) == 2 for item in listed)
    assert (
        "<div>since 700.1 ± 0.2 s</div><div>A runs dry in 80 s</div>" in text
        and "3 more" not in text.split("<tbody>")[1]
    )
    assert "<div>leak at A (size −0.2 ± 0.1)</div><div>A runs dry</div>" in text
    assert ">alarm 1, explained: <ul>" in text
