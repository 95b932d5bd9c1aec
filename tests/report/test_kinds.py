"""One frame for every kind of run: each page says and draws what that kind of log holds."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_runs import (
    GAP_ANSWER,
    GAP_ANSWER_2,
    NASTY,
    material_of,
    write_challenge,
    write_gap,
    write_monitor,
    write_rehearsal,
    write_study,
    write_train,
)

from fdi_torch.blind.kinds import KINDS
from fdi_torch.config.plant_file import load_plant
from fdi_torch.logbook import RunLog, read_run
from fdi_torch.plant.description import PlantDescription
from fdi_torch.report.chart import draw
from fdi_torch.report.diagnosed_effects import diagnosed_effects
from fdi_torch.report.html import unbroken
from fdi_torch.report.material import gather
from fdi_torch.report.page import RunReport, page, report_of
from fdi_torch.report.sections.signals import profile_section
from fdi_torch.report.sections.study import summary_section
from fdi_torch.report.verdict import _latest, headline

DATA = Path(__file__).parents[1] / "data"


def report(write: Callable[[Path], Path], folder: Path) -> RunReport:
    return report_of(material_of(write(folder / "run.mcap"), load_plant("three_tank")))


def titles(made: RunReport) -> list[str]:
    return [section.title for section in made.sections]


def names(made: RunReport) -> set[str]:
    return {picture.name for picture in made.pictures}


@pytest.fixture(scope="module")
def gap_report(tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    return report(write_gap, tmp_path_factory.mktemp("gap"))


@pytest.fixture(scope="module")
def gap_page(gap_report: RunReport) -> str:
    return page([gap_report])


def test_a_gap_page_says_where_which_how_far_and_what_next(gap_report: RunReport, gap_page: str) -> None:
    made, text = gap_report, gap_page
    assert headline(made.material) == (
        "The gap comes from pump lag at Q1 (8.10 ± 0.20 s), or equivalently pump delay at Q1, probability 90.0 %"
    )
    assert titles(made)[:10] == [
        "The rig",
        "What causes it",
        "Where the gap lies",
        "How far it closes",
        "The discrepancy",
        "Errors on data not used for fitting",
        "Before and after",
        "Calibration constants",
        "What the gap depends on",
        "Next experiment",
    ]
    assert {
        "gap_where",
        "gap_posterior",
        "gap_closure",
        "holdout_3",
        "gap_curve_2",
        "gap_by_8",
        "gap_next_input_1",
    } <= names(made)
    assert "99.8 % of the gap closes on data not used for fitting (95 % interval 99.0 to 100.0 %)." in text
    assert re.search(">8.10</td><td[^>]*>0.20</td>", text) and ">91.0 %<" in text
    assert "cannot be shown" not in text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"verdict": "no_gap", "causes": []},
            "No gap: the plant file explains the recording within noise and tolerances",
        ),
        (
            {"verdict": "ambiguous"},
            "There is a gap; 2 explanations are plausible at 95 %, the likeliest is pump lag at Q1 (8.10 ± 0.20 s)"
            ", or equivalently pump delay at Q1, probability 90.0 %",
        ),
        (
            {
                "verdict": "unknown",
                "causes": [],
                "ambiguity_set": [[{"effect": "unknown", "location": "Q1"}]],
                "posterior": [{"causes": [], "probability": 0.9, "unknown_at": "Q1"}],
            },
            "The gap comes from something unknown at Q1, probability 90.0 %; no effect of the library describes the "
            "unknown part",
        ),
        (
            {"verdict": "unknown", "causes": [], "posterior": [{"causes": [], "probability": 1.0}]},
            "Readings of Q1 are outliers or stuck; apart from these, the plant file explains the recording",
        ),
    ],
)
def test_every_verdict_has_its_words(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "gap", env={}, git={}) as log:
        log.gap_verdict({**GAP_ANSWER, **changes})
    assert headline(material_of(tmp_path / "run.mcap")) == words


def test_without_a_gap_nothing_is_said_of_causes(tmp_path: Path, gap_page: str) -> None:
    nothing = {"verdict": "no_gap", "causes": [], "posterior": [{"causes": [], "probability": 1.0}]}
    made = report(lambda path: write_gap(path, **nothing), tmp_path)
    text = page([made])
    assert "with the cause" not in text and "fitted curve" not in text
    assert not {"How far it closes", "Where the gap lies"} & set(titles(made))
    assert {"Hold-out", "Errors on data not used for fitting"} <= set(titles(made))
    models = re.findall("<td[^>]*>(nominal model|recalibrated|noise)</td>", text)
    assert models == ["nominal model", "recalibrated", "noise"]
    assert "with the causes" in gap_page


def test_an_undefined_closed_share_is_called_so(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "gap", env={}, git={}) as log:
        log.gap_verdict({**GAP_ANSWER, "closure": {**GAP_ANSWER["closure"], "closed": None}})
    made = report_of(material_of(tmp_path / "run.mcap"))
    assert "After recalibration, too little of the hold-out&#x27;s gap is left" in page([made])


def test_a_page_of_the_second_format_shows_what_the_first_could_not_say(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "gap", env={}, git={}) as log:
        for place in GAP_ANSWER_2["where"]:
            log.gap_where(place["location"], place["share"])
        log.gap_verdict(GAP_ANSWER_2)
    material = material_of(tmp_path / "run.mcap", load_plant("three_tank"))
    text = page([report_of(material)])
    assert headline(material) == (
        "The gap comes from leak at T1 (size 0.200 ± 0.010) and something unknown at Q1, probability 90.0 %; no effect "
        "of the library describes the unknown part"
    )
    assert "With 95 % probability, whichever explanation is true: leak at T1." in text
    assert "Probability that something is wrong there." in text and "share of the gap" not in text
    assert "leak at T1 and something unknown at T1" in text and "not examined" in text
    assert "All contain leak at T1." in text and ">something unknown at T1<" in text and ">nothing else<" in text
    assert "<td>2.5</td><td>cm³/s</td><td>15 s</td>" in re.sub(r"<td[^>]*>", "<td>", text)
    assert "cannot be shown" not in text
    (message,) = material.of("/gap/verdict")
    assert (message["unexamined"], message["certain"]) == (0.02, ["leak@T1"])
    assert message["explanations"][0] == "leak@T1 + unknown@Q1"


def test_a_page_of_the_first_format_says_what_its_shares_are(gap_page: str) -> None:
    text = gap_page
    assert "Share of the gap that a free discrepancy there alone closes." in text
    assert "something is wrong there" not in text and "Random flows" not in text
    assert "something unknown at Q1" in text, "which the first format says in a field of its own"
    assert "at the end of its range (−0.5 1/s)" in text


def test_a_monitor_page_shows_residuals_thresholds_and_events(tmp_path: Path) -> None:
    made = report(write_monitor, tmp_path)
    assert headline(made.material) == "Single fault: leak at T1 (size 0.200 ± 0.010)"
    assert titles(made)[1:3] == ["Detection", "Events"] and titles(made)[3] == "Residuals"
    assert {"observer_residual_3", "observer_statistic_1"} <= names(made)
    assert "the residual leaves its fault-free range" in page([made])


def test_a_study_page_shows_settings_and_trials(tmp_path: Path) -> None:
    made = report(write_study, tmp_path)
    assert headline(made.material) == "40 trials in 2 settings"
    assert titles(made)[:3] == ["Settings", "Isolation", "Errors"] and titles(made)[4] == "The rig"
    text = page([made])
    assert {"trials_1", "errors_2", "isolation"} <= names(made) and ">T1.leak<" in text
    assert "cost, no unit" in text or ">cost<" in text
    assert ">iterations<" not in text, "the same in all trials"
    assert "Estimator: free, maximum likelihood without bounds on the parameters." in text
    assert "38 of 40 modes stated correctly; 2 faults missed" in text and "none (10 %)" in text


def test_a_challenge_page_shows_scores_confusion_and_misses(tmp_path: Path) -> None:
    made = report(write_challenge, tmp_path)
    assert headline(made.material) == "45 of 60 hidden causes diagnosed correctly, 13 named wrongly"
    assert titles(made)[:4] == ["Right answers", "Confusion of causes", "Wrong answers", "The rig"]
    assert "Trials" not in titles(made)
    assert {"challenge_1_right", "challenge_1_sure", "challenge_1_seconds", "challenge_4_seconds"} <= names(made)
    assert {"challenge_confusion_1", "challenge_unknown", "challenge_left_out"} <= names(made)
    text = page([made])
    assert "cannot be shown" not in text and NASTY not in text and "three_tank, effect left out" in text
    assert KINDS["pair"].meaning in text and KINDS["poor"].meaning not in text


def test_a_rehearsal_page_shows_the_tables_of_the_command(tmp_path: Path) -> None:
    made = report(write_rehearsal, tmp_path)
    text = page([made])
    assert headline(made.material) == "0 of 2 faults missed, 1 of 1 named right"
    assert titles(made)[:3] == ["Validation of the monitor", "The rig", "Configuration"]
    assert "1 of 1 (21 .. 100 %)" in text and "too short" not in text.partition("<h3>Provenance")[0]
    assert NASTY not in text
    del made.material.run.metadata["fdi_torch.result"]
    assert headline(made.material) == "Faults found and naming, without a result yet"


def test_a_page_of_windows_shows_when_each_fault_was_there() -> None:
    made = report_of(material_of(DATA / "log_format_1_windows.mcap", load_plant("three_tank")))
    assert headline(made.material) == "Leak at T1 from 200 to 400 s"
    assert titles(made)[:2] == ["The rig", "Window by window"] and "windows" in names(made)
    text = page([made])
    assert all(words in text for words in ("0.29948 ± 0.00064", "26.5 cm³/s", "leak at T3"))


def test_windows_that_make_no_sense_are_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    good = {"start": 0.0, "stop": 9.0, "misfit": 1.0, "T1.leak.size": {"size": 2.0, "std": None, "state": "present"}}
    beyond = {"name": "T1.leak.size", "start": 0.0, "stop": 9.0, "size": 2.0, "std": None, "flow": None, "unit": "1"}
    with RunLog(path, "train") as log:
        log.result({"windows": [good, {"start": NASTY}, 7], "stretches": [beyond, {"name": NASTY}]})
    made = report_of(material_of(path, load_plant("three_tank")))
    text = page([made]).partition("<h3>Provenance")[0]
    assert "1 windows, each" not in text and "One window" in text and "&gt; 2" in text and NASTY not in text


def test_several_runs_share_a_page(tmp_path: Path) -> None:
    text = page(
        [report_of(material_of(write(tmp_path / f"{write.__name__}.mcap"))) for write in (write_monitor, write_study)]
    )
    assert text.count("<article ") == 2


def test_a_cause_shows_its_size_in_whatever_order_its_parameters_were_logged() -> None:
    log = read_run(Path(__file__).parents[1] / "data/log_format_1_gap.mcap")
    (found,) = diagnosed_effects(gather(log, load_plant("three_tank")))
    assert (found.words, round(found.size, 3), found.unit) == ("leak at T1", 0.295, "1")


def test_a_study_says_how_its_errors_compare_with_the_bound() -> None:
    material = material_of(DATA / "log_format_1_study.mcap", load_plant("three_tank"))
    assert headline(material) == "5 trials in 1 setting: errors 1.02 times the Cramér-Rao bound"
    section = summary_section(material)
    assert section is not None
    assert "constants with a tolerance count as exact here; estimate.calibrate: [" in str(section.blocks[-1])


def test_an_axis_by_decades_has_plain_numbers() -> None:
    made = report_of(material_of(DATA / "log_format_1_study.mcap", load_plant("three_tank")))
    assert any(axes.get_yscale() == "log" for picture in made.pictures for axes in picture.figure.axes)
    assert "mathdefault" not in page([made])


def test_a_variable_that_stands_still_has_no_panel() -> None:
    material = material_of(DATA / "log_format_1_gap.mcap", load_plant("three_tank"))
    recording = material.recordings[0]
    before = profile_section(material)
    material.recordings[0] = replace(recording, inputs=recording.inputs * np.array([0.0, 1.0]))
    after = profile_section(material)
    assert before is not None and after is not None
    assert [len(section.pictures) for section in (before, after)] == [8, 7]


@pytest.mark.parametrize(("ratio", "kind"), [(3.0, "linear"), (100.0, "log")])
def test_a_residual_of_a_hundred_times_the_noise_leaves_the_noise_visible(ratio: float, kind: str) -> None:
    material = material_of(DATA / "log_format_1_gap.mcap", load_plant("three_tank"))
    recording = material.recordings[0]
    noise = np.where(np.arange(len(recording.time)) % 2, 1e-3, -1e-3)[:, None]
    for model, wrong in (("nominal", ratio), ("recalibrated", ratio), ("augmented", 1.0)):
        material.arrays[model] = recording.outputs - wrong * noise
    material.answer["noise"] = {name: {"std": 1e-3} for name in recording.output_names}
    section = profile_section(material)
    assert section is not None
    charts = [picture.chart for picture in section.pictures if picture.chart is not None]
    assert charts and {chart.scale[0] for chart in charts} == {kind}
    axes = draw(charts[0]).axes[0]
    assert axes.get_yscale() == kind and (axes.get_ylim()[0] == 0.0) == (kind == "linear")


def test_the_result_stands_beside_the_rig_and_the_index_lists_every_section(gap_page: str) -> None:
    text = gap_page
    lead = text.partition('<div class="lead">')[2].partition("The discrepancy</h3>")[0]
    assert re.findall("<h3>([^<]*)</h3>", lead) == [
        "The rig",
        "What causes it",
        "Where the gap lies",
        "How far it closes",
    ]
    index = re.findall('<a href="#([^"]*)">([^<]*)</a>', text.partition("<nav")[2].partition("</nav>")[0])
    assert index == re.findall('<section id="([^"]*)"><h3>([^<]*)</h3>', text) and len(index) > 10


def test_inputs_and_readings_say_of_which_recording_they_are(tmp_path: Path) -> None:
    time = np.arange(50.0)
    with RunLog(tmp_path / "run.mcap", "gap", env={}, git={}) as log:
        for group, level in (("", 1e-5), ("holdout", 3e-5), ("recording_2", 2e-5)):
            varied = level * (1 + (time > 20))
            inputs = np.stack([varied, np.full(50, level)], 1)
            log.recording(time, inputs, inputs, ("Q1", "Q2"), ("h1", "h2"), ("m^3/s",) * 2, ("m",) * 2, group=group)
    text = page([report_of(material_of(tmp_path / "run.mcap"))])
    assert re.findall("<h4>([^<]*)</h4>", text) == ["Diagnosed recording", "Hold-out", "Recording 2"]
    assert {"Q1, diagnosed recording", "Q1, hold-out", "Q1, recording 2"} <= set(
        re.findall("&quot;title&quot;:&quot;([^&]*)&quot;", text)
    )
    assert "Hold-out, constant: Q2 at 30 cm³/s." in text


def test_a_headline_of_many_alarms_counts_them() -> None:
    assert _latest("open alarms", ["a", "b"]) == "a and b"
    assert _latest("open alarms", ["a", "b", "c"]) == "3 open alarms, the latest: c"


def test_provenance_has_no_arrays(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.mcap", "train", env={}, git={}) as log:
        log.result({"status": "converged", "covariance": [[1.25, 2.25], [2.25, 3.25]], "names": ["a", "b"]})
    text = page([report_of(material_of(tmp_path / "run.mcap"))])
    assert "converged" in text and "2.25" not in text and "covariance" not in text


def test_numbers_with_error_and_unit_are_not_broken_into_two_lines() -> None:
    assert unbroken("pump lag at Q (7.36 ± 0.25 s), probability 99.2 %") == (
        "pump lag at Q (7.36\u00a0±\u00a00.25\u00a0s), probability 99.2\u00a0%"
    )
    assert unbroken("3 faults: leak at T1") == "3 faults: leak at T1"


def with_names_of_its_own() -> PlantDescription:
    """The plant three_tank whose sensors and pumps have other names than their channels."""
    plant = load_plant("three_tank")
    sensors = tuple(replace(s, name=f"level {k}", channel=s.column) for k, s in enumerate(plant.sensors, 1))
    return replace(
        plant, sensors=sensors, pumps=tuple(replace(p, name=f"P{p.name}", command=p.name) for p in plant.pumps)
    )


@pytest.mark.parametrize("write", [write_gap, write_train, write_monitor])
def test_a_page_names_sensors_and_pumps_as_their_plant_file_does(write: Callable[[Path], Path], tmp_path: Path) -> None:
    """With the channel behind it, by which the recording knows them."""
    material = material_of(write(tmp_path / "run.mcap"), with_names_of_its_own())
    charts = [picture.chart for picture in report_of(material).pictures if picture.chart is not None]
    named = {title for title in (chart.title for chart in charts) if re.search(r"\b[hQ][123]\b", title)}
    assert len(named) > 2
    assert not [title for title in named if not re.search(r"level (\d) \(h\1\)|PQ(\d) \(Q\2\)", title)]


@pytest.mark.parametrize("plant", [load_plant("three_tank"), with_names_of_its_own()], ids=["channels", "names"])
def test_residuals_are_divided_by_the_noise_of_the_diagnosis_also_where_readings_are_rounded(
    plant: PlantDescription,
) -> None:
    material = material_of(DATA / "log_format_1_gap.mcap", plant)
    recording = material.recordings[0]
    step = 0.01
    predicted = material.arrays["augmented"]
    material.recordings[0] = replace(recording, outputs=np.round(predicted / step) * step)
    material.answer["noise"] = {sensor.name: {"std": step / np.sqrt(12.0)} for sensor in plant.sensors}
    section = profile_section(material)
    assert section is not None
    charts = [block for block in section.pictures if block.chart is not None]
    line = next(line for line in charts[0].chart.lines if line.name == "with the causes")
    assert np.sqrt(np.nanmean(np.square(line.y))) == pytest.approx(1.0, abs=0.3)
