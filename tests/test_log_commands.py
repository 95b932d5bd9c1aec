"""fdi inspect, compare, recover and replay: what they say, their exit codes and their files."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fdi_torch import cli
from fdi_torch.cli.options import inspect
from fdi_torch.config.run_file import load_run
from fdi_torch.config.study_file import load_study
from fdi_torch.jobs.replay import repeat_run
from fdi_torch.jobs.study import run_study
from fdi_torch.jobs.train import train
from fdi_torch.logbook import LogError, Message, RunLog, read_run, replay
from fdi_torch.logbook.export import FORMATS
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline

QUICK = [
    "simulate.duration=200 s",
    "simulate.sample_time=2 s",
    "estimate.parameters=[T1.leak, P13.openness]",
    "simulate.faults={T1.leak: 0.3}",
    "estimate.search.evaluations=300",
    "estimate.step={search: 10 s, refine: 2 s}",
]


def _with(message: Message, old: bytes, new: bytes) -> Message:
    """The message with a piece of its payload replaced."""
    assert old in message.data
    return replace(message, data=message.data.replace(old, new))


def write_estimate(path: Path, value: float, seed: int = 0) -> Path:
    """A short run with one estimated parameter of standard error 0.01. seed: that of the noise of its recording."""
    with RunLog(path, "train", seeds={"seed": seed}, config={"a": 1, "b": seed}, env={}, git={}) as log:
        readings = np.full((3, 1), 1.0 + 1e-6 * seed)
        log.recording(np.arange(3.0), np.ones((3, 1)), readings, ("Q1",), ("h1",), ("m^3/s",), ("m",))
        for g in range(3):
            fields = {"problem": 0, "generation": g, "best_cost": 1.0 / (g + 1 + seed), "T1.leak.size": 0.1}
            log.write("/estimator/de/generation", fields, g)
        log.estimate(["T1.leak.size"], [value], [0.01], [[1e-4]], "converged", units=["1"])
        log.result_arrays(predicted=np.full((3, 1), 0.99))
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real, quick run of the main job."""
    folder = tmp_path_factory.mktemp("logs")
    return train(load_run(None, [*QUICK, f"output.folder={folder}"])).log


def test_inspect_fits_on_a_screen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    assert cli.main(["inspect", str(log)]) == cli.DONE
    shown = capsys.readouterr().out
    assert "a log of fdi train" in shown and "intact: all CRCs, indices and counts agree" in shown
    assert "/estimator/de/generation" in shown and shown.count("\n") < 40


def test_inspect_shows_estimates_and_correlations_as_tables_with_units(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Standard errors of 0.01 and 2 mm, correlated by -0.5; the last parameter is not determined."""
    result = {
        "names": ["T1.leak.size", "T1.start_level", "link.plugging.size"],
        "units": ["1", "m", "1"],
        "value": [0.3, 0.4, 0.0],
        "std": [0.01, 0.002, None],
        "covariance": [1e-4, -1e-5, None, -1e-5, 4e-6, None, None, None, None],
        "covariance_shape": [3, 3],
        "noise_std": [0.001015312616463551, 0.0010142879370500788],
        "undetermined": [],
        "status": "converged",
    }
    with RunLog(tmp_path / "run.mcap", "train", env={}, git={}) as log:
        log.result(result)
    assert cli.main(["inspect", str(log.path)]) == cli.DONE
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.splitlines()]
    assert ["T1.leak.size", "1", "0.300", "±", "0.010", "0.280", "…", "0.320"] in rows
    assert ["T1.start_level", "cm", "40.00", "±", "0.20", "39.61", "…", "40.39"] in rows
    assert ["link.plugging.size", "1", "not", "determined", "–"] in rows
    assert ["2", "T1.start_level", "-0.50", "1.00"] in rows
    assert ["result", "noise_std,", "SI", "0.001015,", "0.001014"] in rows and ["result", "status", "converged"] in rows
    assert "covariance" not in shown and "[" not in shown and "undetermined" not in shown


@pytest.mark.parametrize("damaged", ["[0.3", "{}", "null", '[{"a": 1}]', "[0.3, 0.4]"])
def test_inspect_shows_an_unreadable_estimate_as_it_stands(
    damaged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunLog(tmp_path / "run.mcap", "train", env={}, git={}) as log:
        log.result({"names": ["T1.leak.size"], "units": ["1"], "value": damaged, "std": [0.01]})
    assert cli.main(["inspect", str(log.path)]) == cli.DONE
    shown = capsys.readouterr().out
    assert ("value 0.3, 0.4" if damaged == "[0.3, 0.4]" else f"value {damaged}") in shown


def test_a_log_is_found_by_its_name_while_its_run_lasts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    log.rename(f"{log}.partial")
    assert cli.main(["inspect", str(log)]) == cli.main(["report", "--quiet", str(log)]) == cli.DONE
    assert capsys.readouterr().out.startswith(f"{log}.partial: a log of fdi train")
    assert (tmp_path / "run.html").exists()


def test_inspect_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    assert cli.main(["inspect", str(log), "--json"]) == cli.DONE
    found = json.loads(capsys.readouterr().out)
    assert found["sound"] and {t["topic"]: t["messages"] for t in found["topics"]}["/plant/output"] == 3


def test_each_export_format_can_be_chosen() -> None:
    assert tuple(FORMATS) == inspect.FORMATS


@pytest.mark.parametrize("form", inspect.FORMATS)
def test_inspect_exports_a_topic_once(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = write_estimate(tmp_path / "run.mcap", 0.3), tmp_path / "out"
    words = ["inspect", str(log), "--topic", "/plant/output", "--format", form, "--out", str(out)]
    assert cli.main(words) == cli.DONE
    assert out.stat().st_size > 0
    assert cli.main(words) == cli.MISUSE
    assert "exists" in capsys.readouterr().err


def test_a_single_message_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunLog(tmp_path / "run.mcap", "train", env={}, git={}) as log:
        log.write("/plant/truth", {"T1.leak.size": 0.1}, 0.0, units={"T1.leak.size": "1"})
    words = ["inspect", str(tmp_path / "run.mcap")]
    assert cli.main(words) == cli.main([*words, "--topic", "/plant/truth", "--out", str(tmp_path / "a")]) == cli.DONE
    shown = capsys.readouterr()
    assert (
        re.search(r"1 message on 1 topic in 1 chunk, \d+ bytes; intact", shown.out)
        and "1 message of /plant/truth" in shown.err
    )


def test_inspect_of_an_unknown_topic_leaves_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = write_estimate(tmp_path / "run.mcap", 0.3), tmp_path / "out"
    assert cli.main(["inspect", str(log), "--topic", "/nothing", "--out", str(out)]) == cli.MISUSE
    assert "expected one of the topics" in capsys.readouterr().err and not out.exists()


def test_inspect_gives_each_topic_its_own_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    assert cli.main(["inspect", str(log)]) == cli.DONE
    shown = capsys.readouterr().out
    rows = {line.split()[0]: line for line in shown.splitlines() if line.startswith("/")}
    assert re.search(r"generation \d+ +generation \d+", rows["/estimator/de/generation"])
    assert re.search(r" 0 s +\S+ s ", rows["/plant/output"]) and " s " not in rows["/estimate/final"]
    assert not re.search(r"T\d\d:\d\d:\d\d\.\d", shown)


def test_inspect_writes_an_attachment(tmp_path: Path) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    assert cli.main(["inspect", str(log), "--attachment", "results.npz", "--out", str(tmp_path / "a")]) == cli.DONE
    assert (tmp_path / "a" / "results.npz").read_bytes().startswith(b"PK")


def test_compare_says_what_differs_and_whether_results_agree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [write_estimate(tmp_path / f"{k}.mcap", v, k) for k, v in enumerate((0.30, 0.31, 0.40))]
    table, pictures = tmp_path / "c.csv", tmp_path / "pictures"
    words = ["compare", *map(str, logs), "--csv", str(table), "--pictures", str(pictures)]
    assert cli.main(words) == cli.DONE
    shown = capsys.readouterr().out
    assert "at 95 % these differ: T1.leak.size." in shown and "0.300 ± 0.010" in shown
    with table.open(newline="") as file:
        rows = {(row[0], row[1]): row[2:5] for row in csv.reader(file)}
    assert rows["config", "b"] == ["0", "1", "2"] and ("config", "a") not in rows
    assert {p.name for p in pictures.iterdir()} >= {"compare_cost_1.png", "compare_residual_1.svg"}


def test_runs_of_different_kinds_are_compared_without_their_settings(
    trained: Path, study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["compare", str(trained), str(study)]) == cli.DONE
    shown = capsys.readouterr().out
    assert "the kind of run (default: Fault diagnosis; table3_noise: Study)" in shown and "settings\n" not in shown
    assert "estimates\n" in shown and "agree" not in shown


def test_a_page_of_several_runs_compares_them(tmp_path: Path) -> None:
    logs = [write_estimate(tmp_path / f"{k}.mcap", v) for k, v in enumerate((0.30, 0.31))]
    assert cli.main(["report", *map(str, logs), "--quiet", "--out", str(tmp_path / "both.html")]) == cli.DONE
    text = (tmp_path / "both.html").read_text(encoding="utf-8")
    assert "differ by at most 1 of the smaller standard error" in text and text.index("Comparison") < text.index(
        "<article"
    )


def test_equal_logs_are_said_to_be_equal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [write_estimate(tmp_path / f"{k}.mcap", 0.3) for k in range(2)]
    assert cli.main(["compare", *map(str, logs)]) == cli.DONE
    assert "All logs have the same content, message by message." in capsys.readouterr().out
    assert cli.main(["compare", str(logs[0])]) == cli.MISUSE
    assert "expected at least two logs to compare, got 1" in capsys.readouterr().err


def test_recover_has_an_exit_code_of_its_own_for_losses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_estimate(tmp_path / "run.mcap", 0.3)
    assert cli.main(["recover", str(log), "--out", str(tmp_path / "same.mcap")]) == cli.DONE
    torn = tmp_path / "torn.mcap.partial"
    torn.write_bytes(log.read_bytes()[:-800])
    assert cli.main(["recover", str(torn), "--json"]) == 3
    answer = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert Path(answer["target"]).exists() and not answer["ended"]


def test_a_replay_is_bit_equal(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(trained), "--quiet"]) == cli.DONE
    assert "bit-equal: " in capsys.readouterr().out


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_the_number_of_threads_changes_no_bit(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(trained), "--json"]) == cli.DONE
    done = json.loads(capsys.readouterr().out)["replay"]
    assert done["outcome"] == "bit-equal" and list(done["versions"]) == ["threads"]


@pytest.mark.slow
def test_a_whole_run_of_the_paper_replays(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    log = train(load_run("configs/paper/table3_snr30.yaml", [f"output.folder={tmp_path}"])).log
    assert replay(log, lambda run: repeat_run(run, tmp_path / "same.mcap")).outcome == "bit-equal"
    request.getfixturevalue("two_threads")
    again = replay(log, lambda run: repeat_run(run, tmp_path / "threads.mcap"))
    assert again.outcome == "bit-equal" and list(again.versions) == ["threads"]


STUDY = ["study.steps=[1 s]", "study.data_step=0.2 s", "study.evaluations=600", "study.population=24"]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven trials at each of two noise levels, in blocks of three."""
    changes = [*STUDY, "study.trials=7", "study.block=3", "study.snr_db=[30, 20]"]
    folder = tmp_path_factory.mktemp("studies")
    return run_study(load_study("configs/studies/table3_noise.yaml", [*changes, f"output.folder={folder}"])).log


def test_a_study_replays_whole_and_trial_by_trial(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(study), "--quiet"]) == cli.DONE
    assert "bit-equal: 16 events compared" in capsys.readouterr().out
    assert cli.main(["replay", str(study), "--quiet", "--trial", "12", "--trial", "5"]) == cli.DONE
    assert "bit-equal: 2 events compared" in capsys.readouterr().out


def test_an_unfinished_study_replays_what_it_has(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, part = read_run(study), tmp_path / "part.mcap"
    with RunLog(part, "study", config_text=source.config_text) as log:
        log.carry_over(m for m in source.messages(["/study/trial"]) if m.payload["trial"] in (9, 2, 1))
    assert cli.main(["replay", str(part), "--quiet"]) == cli.DONE
    assert "bit-equal: 3 events compared" in capsys.readouterr().out


def test_a_study_with_another_choice_is_a_new_log(study: Path, tmp_path: Path) -> None:
    words = ["--set", "study.searches=1", "--set", "study.snr_db=[30]", "--out", str(tmp_path / "other.mcap")]
    assert cli.main(["replay", str(study), "--quiet", *words]) == cli.DONE
    assert len(list(read_run(tmp_path / "other.mcap").messages(["/study/trial"]))) == 7


def test_trials_that_there_are_not(study: Path, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(study), "--quiet", "--trial", "14"]) == cli.MISUSE
    assert "expected trials from 0 to 13, got 14" in capsys.readouterr().err
    assert cli.main(["replay", str(trained), "--quiet", "--trial", "0"]) == cli.MISUSE
    assert "--trial: expected a study's log, got one of fdi train" in capsys.readouterr().err


def test_a_changed_log_does_not_replay(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forged = tmp_path / "forged.mcap"
    source = read_run(trained)
    with RunLog(forged, "train", config_text=source.config_text, seeds={"seed": 1}) as log:
        log.carry_over(
            [
                m if m.topic != "/estimate/final" else _with(m, b'"status":"converged"', b'"status":"stalled"')
                for m in source.messages()
            ]
        )
    assert cli.main(["replay", str(forged), "--quiet"]) == 3
    assert "first beyond the tolerance: event" in capsys.readouterr().out


def test_what_if_writes_a_new_log_with_its_parent(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(trained), "--set", "seed=5", "--quiet"]) == cli.DONE
    child = read_run(trained.with_name(f"{trained.stem}.what_if.mcap"))
    assert child.metadata["fdi_torch.run"]["parent_run_id"] == read_run(trained).metadata["fdi_torch.run"]["run_id"]
    text = capsys.readouterr().out
    assert "They differ in seed (" in text
    verdict = headline(gather(child, None))
    assert f"{trained.stem}.what_if: {verdict}.\n" in text and f"{trained.stem}: " in text


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--set", "simulate.duration=5 s"], "expected a key other than those of the data"),
        (["--set", "estimate.sarch=1"], "got 'sarch'; the nearest is 'search'"),
    ],
)
def test_a_replay_that_makes_no_sense_is_refused(
    trained: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["replay", str(trained), "--quiet", *words]) == cli.MISUSE
    assert sentence in capsys.readouterr().err


def test_a_log_of_another_command_cannot_be_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunLog(tmp_path / "m.mcap", "rehearsal", env={}, git={}):
        pass
    assert cli.main(["replay", str(tmp_path / "m.mcap"), "--quiet"]) == cli.MISUSE
    assert (
        "expected a log of fdi train, fdi study, fdi gap or fdi monitor, got one of rehearsal"
        in capsys.readouterr().err
    )


def test_a_fit_window_by_window_is_not_replayed_as_another(tmp_path: Path) -> None:
    source = Path(__file__).parent / "data" / "log_format_1_windows.mcap"
    with pytest.raises(LogError, match="got one window by window"):
        repeat_run(read_run(source), tmp_path / "again.mcap")
    assert not list(tmp_path.iterdir())
