"""The main job from a run file to log, picture and words."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from fdi_torch.cli import DONE, MISUSE, NOT_CONVERGED, NOT_EXPLAINED, main
from fdi_torch.config.run_file import Run, load_run
from fdi_torch.jobs.train import TrainResult, train
from fdi_torch.logbook import content_hash, read_run
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline

QUICK = ("simulate.duration=400 s", "estimate.search.evaluations=1500", "estimate.step.refine=0.5 s")


def quick_run(folder: Path, *changes: str) -> Run:
    return load_run(None, [*QUICK, f"output.folder={folder}", *changes])


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    """The quick run, once for all tests that only read what it found."""
    return train(quick_run(tmp_path_factory.mktemp("quick")))


def test_the_built_in_fault_is_found(done: TrainResult) -> None:
    truth = torch.tensor([done.truth[p.name] for p in done.fitting.space], dtype=torch.float64)
    error = (done.result.estimate.value - truth).abs() / done.result.estimate.std
    assert bool((error < 4.0).all())
    assert {f.name for f in done.result.diagnosis.present} >= {"T1.leak.size", "T3.leak.size", "OUT2.net_outlet.size"}
    assert done.result.diagnosis.misfit.explained
    assert all(picture.stat().st_size > 10_000 for picture in done.pictures)


@pytest.mark.slow
def test_the_reference_engine_finds_the_same(tmp_path: Path) -> None:
    """In Python steps are dear: it searches more roughly and refines adaptively, to the same end."""
    short = ["simulate.duration=100 s", "estimate.parameters=[T1.leak, T3.leak, P13.openness]"]
    short += ["simulate.faults={T1.leak: 0.3, T3.leak: 0.5, P13.openness: 0.6}"]
    ends = []
    for engine in ("compiled", "reference"):
        run = load_run(None, [*short, f"engine={engine}", f"output.folder={tmp_path / engine}"])
        ends.append(train(run).result.estimate)
    assert bool(((ends[1].value - ends[0].value).abs() < 0.02 * ends[0].std).all())
    assert bool(((ends[1].std / ends[0].std - 1.0).abs() < 0.01).all())


def test_without_refinement_the_estimate_is_the_searchs_best_and_says_so(tmp_path: Path) -> None:
    done = train(quick_run(tmp_path, "estimate.refine.method=none"))
    assert torch.equal(done.result.estimate.value, done.result.search.best[0])
    assert done.result.estimate.status == "not refined"


def test_the_log_tells_how_it_was_found(done: TrainResult) -> None:
    run = read_run(done.log)
    topics = {m.topic for m in run.messages()}
    assert {"/plant/input", "/plant/output", "/plant/truth", "/estimate/final", "/diagnosis/fault"} <= topics
    assert {"/estimator/de/generation", "/estimator/de/population", "/estimator/refine/iteration"} <= topics
    final = next(iter(run.messages(["/estimate/final"]))).payload
    assert final["values"] == done.result.estimate.value.tolist()
    assert run.config_text == done_text(done.log)


def done_text(log: Path) -> str:
    return load_run(None, [*QUICK, f"output.folder={log.parent}"]).text


def test_it_repeats_bit_for_bit(done: TrainResult) -> None:
    again = train(quick_run(done.log.parent))
    assert again.log != done.log
    assert torch.equal(again.result.estimate.value, done.result.estimate.value)
    assert content_hash(read_run(again.log).messages()) == content_hash(read_run(done.log).messages())


@pytest.mark.parametrize(
    ("suspect", "said"),
    [("P32.openness", "none of the suspected faults explains the recording"), ("T3.leak", "leak at T3")],
)
def test_a_model_without_the_fault_is_called_unreliable_and_establishes_nothing(
    suspect: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = [word for change in (*QUICK, f"estimate.parameters=[{suspect}]") for word in ("--set", change)]
    assert main(["train", "--quiet", "--out", str(tmp_path), *changes]) == NOT_EXPLAINED
    warning = "Unreliable: the model does not explain the recording"
    shown = capsys.readouterr().out
    assert shown.startswith(warning)
    assert ("estimate its onset" in shown) == (suspect == "T3.leak")  # an openness has none
    assert f"not established: {said}" in shown and "no fault" not in shown and "single fault" not in shown
    assert main(["report", "--quiet", str(tmp_path / "default.mcap")]) == DONE
    headline = rf"default\.mcap: {warning} \(residuals [\d.]+ times the sensors' noise\)\. Not established: {said}"
    assert re.search(headline, capsys.readouterr().out)
    page = (tmp_path / "default.html").read_text()
    assert ">not established<" in page and ">present<" not in page and ">not found<" not in page
    assert "changes the flow" not in page


def test_interrupted_it_keeps_what_it_has(tmp_path: Path) -> None:
    def stop(share: float, text: str) -> None:
        if "generation 4" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(quick_run(tmp_path), stop)
    run = read_run(tmp_path / "default.mcap")
    assert run.complete
    assert run.metadata["fdi_torch.status"]["status"] == "interrupted"
    assert [m.payload["generation"] for m in run.messages(["/estimator/de/generation"])][-1] == 4


def test_the_command_prints_json_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes = [word for change in QUICK for word in ("--set", change)]
    assert main(["train", "--json", "--quiet", "--out", str(tmp_path), *changes]) == DONE
    answer = json.loads(capsys.readouterr().out)
    assert answer["format"] == "fdi_torch.train/1"
    assert Path(answer["log"]).is_file()


def test_the_command_prints_a_table_with_units_as_do_inspect_and_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = [word for change in QUICK for word in ("--set", change)]
    assert main(["train", "--out", str(tmp_path), *changes]) == DONE
    shown = capsys.readouterr()
    assert "T1.leak.size" in shown.out and "log: " in shown.out
    assert " instead of 0 (capacity of the hole relative to that of P13), changes the flow by " in shown.out
    assert " instead of 1 (share of the nominal flow that passes), changes the flow by " in shown.out
    assert "built-in example: a recording of the plant three_tank" in shown.err and "default 100% done" in shown.err
    rows = [re.split(r"  +", line.strip())[:4] for line in shown.out.splitlines() if " ± " in line]
    assert len(rows) == 5 and all(re.fullmatch(r"\S+ … \S+", row[3]) for row in rows)
    log = str(tmp_path / "default.mcap")
    assert main(["inspect", log]) == main(["report", "--quiet", log]) == DONE
    page = re.sub(r"\s*<[^>]*>\s*", "|", Path(log).with_suffix(".html").read_text(encoding="utf-8"))
    inspected = [re.split(r"  +", line.strip()) for line in capsys.readouterr().out.splitlines()]
    assert all(row in inspected and "|".join(row[2:]).replace("||", "|") in page.replace("||", "|") for row in rows)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("simulate.duration=1 s", "expected more readings than parameters, got 6 readings for 8 parameters"),
        ("device=cuda:99", "device: expected one that torch can use here, got 'cuda:99'; write device: cpu"),
        ("estimate.parameters=[]", "estimate.parameters: expected at least one, got none"),
        ("estimate.parameters=[T1.leek]", "the nearest is 'T1.leak'"),
        ("estimate.parameters=[T1.leek, T9.leak]", "got 'T1.leek'; the nearest is 'T1.leak'\n"),
        ("estimate.parameters=[T1.leek, T9.leak]", "h3 or a pair of tanks such as T1-T2, got T9"),
        ("output.name=off", "got False, as YAML reads yes, no, on and off; quote it, as in 'off'"),
        ("output.name=3", "output.name: expected text, got 3; quote it, as in '3'"),
        ("estimate.parameters=[T9.leak]", "T9.leak: plant three_tank: expected one of T1, T2"),
    ],
)
def test_misuse_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, sentence: str) -> None:
    changes = ["--set", change, "--set", "simulate.start_levels={T1: 50 cm, T2: 40 cm, T3: 45 cm}"]
    if "duration" in change:
        more = "[T1.leak, T2.leak, T3.leak, P13.openness, P32.openness, OUT2.net_outlet, T1.area, T2.area]"
        changes += ["--set", f"estimate.parameters={more}"]
    assert main(["train", "--out", str(tmp_path), "--quiet", *changes]) == MISUSE
    complaint = capsys.readouterr().err
    assert sentence in complaint and "Traceback" not in complaint


def test_what_computes_on_the_cpu_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    on_gpu = ["--out", str(tmp_path), "--set", "device=cuda"]
    assert main(["simulate", *on_gpu]) == DONE
    assert "one simulation is computed on the CPU" in capsys.readouterr().err
    assert main(["train", *on_gpu, "--set", "estimate.windows=100 s"]) == MISUSE
    assert "device: expected cpu with estimate.windows, got cuda" in capsys.readouterr().err


def test_an_unwritable_folder_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert main(["train", "--quiet", "--out", str(blocked)]) == MISUSE
    assert str(blocked) in capsys.readouterr().err


def test_a_simulated_command_beyond_the_pump_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ["simulate.inputs.Q1=150 cm^3/s", "simulate.duration=20 s", "output.name=much"]
    assert main(["simulate", "--out", str(tmp_path), *(word for each in wish for word in ("--set", each))]) == 0
    assert "Q1 asks for up to 150 cm^3/s of Q1, which delivers 90 cm^3/s at most" in capsys.readouterr().err


def test_simulate_writes_a_recording_that_train_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--quiet", "--out", str(tmp_path), "--set", "simulate.duration=400 s"]) == DONE
    assert "401 samples" in capsys.readouterr().out
    text = (
        "plant: three_tank\nrecordings: [{file: default.csv, start_levels: equilibrium}]\n"
        "estimate: {parameters: [T1.leak, OUT2.net_outlet, T3.leak, P13.openness, P32.openness], calibrate: []}\n"
    )
    (tmp_path / "own.yaml").write_text(text)
    changes = [f"output.folder={tmp_path}", *QUICK[1:]]
    done = train(load_run(tmp_path / "own.yaml", changes))
    assert float(done.result.estimate.value[0]) == pytest.approx(0.3, abs=0.02)


OWN = """
plant: three_tank
recordings: [{file: default.csv}]
estimate:
  parameters: [T1.leak, P13.plugging]
  search: {population: 40, evaluations: 400}
  step: {search: 10 s, refine: 2 s}
"""


@pytest.fixture(scope="module")
def own_recording(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Lines of a short recording as a CSV file."""
    folder = tmp_path_factory.mktemp("own")
    changes = ["simulate.duration=200 s", "simulate.faults={T1.leak: 0.3}"]
    main(["simulate", "--quiet", "--out", str(folder), *(word for c in changes for word in ("--set", c))])
    return (folder / "default.csv").read_text().splitlines()


def train_on(lines: list[str], folder: Path, *changes: str) -> TrainResult:
    (folder / "default.csv").write_text("\n".join(lines))
    (folder / "own.yaml").write_text(OWN)
    return train(load_run(folder / "own.yaml", [f"output.folder={folder}", *changes]))


def test_a_recording_with_an_unknown_input_is_cut_there(own_recording: list[str], tmp_path: Path) -> None:
    """Two stretches with start levels of their own: one leak, found from both."""
    header, *rows = own_recording
    cells = [row.split(",") for row in rows]
    for row in cells[90:110]:
        row[1] = ""
    done = train_on([header, *map(",".join, cells)], tmp_path)
    assert len(done.fitting.recordings) == 2 and "T1.start_level@1" in done.fitting.space
    leak = done.result.diagnosis.faults[0]
    assert leak.present and leak.flow is not None and leak.value == pytest.approx(0.3, abs=0.05)


def test_a_fit_that_has_not_converged_says_so_first_and_then_which_rows_do_not_count(
    own_recording: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = [row.split(",") for row in own_recording]
    cells[30][1], cells[100][3] = "", "NaN"
    (tmp_path / "default.csv").write_text("\n".join(map(",".join, cells)))
    (tmp_path / "own.yaml").write_text(OWN)
    words = ["--config", str(tmp_path / "own.yaml"), "--out", str(tmp_path), "--set", "estimate.refine.iterations=1"]
    assert main(["train", "--quiet", *words]) == NOT_CONVERGED
    shown, file = capsys.readouterr().out, tmp_path / "default.csv"
    warning = "Not converged (max iterations): sizes may be off by more than their standard errors"
    assert f"{warning}.\n- next: estimate fewer parameters" in shown.partition("parameter ")[0]
    assert f"{file}: 1 of 600 readings are missing or masked and do not count" in shown
    assert f"{file}: an input is sometimes unknown; fitted as 2 segments with known inputs" in shown
    assert headline(gather(read_run(tmp_path / "own.mcap"))).startswith(warning)


def test_a_sensor_that_stands_still_is_named(own_recording: list[str], tmp_path: Path) -> None:
    header, *rows = own_recording
    stuck = [",".join([*row.split(",")[:-1], "50"]) for row in rows]
    with pytest.raises(ValueError, match=r"default.csv: expected readings that vary, but h3 is stuck at 50 cm"):
        train_on([header, *stuck], tmp_path)


def test_a_sensor_without_readings_is_named(own_recording: list[str], tmp_path: Path) -> None:
    header, *rows = own_recording
    blank = [",".join([*row.split(",")[:-1], ""]) for row in rows]
    with pytest.raises(ValueError, match=r"default.csv: h3: expected valid readings, got none; leave the sensor out"):
        train_on([header, *blank], tmp_path)


def test_two_samples_are_fewer_than_faults_and_start_levels(own_recording: list[str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected more readings than parameters, got 6 readings for 8 parameters"):
        train_on(own_recording[:3], tmp_path)


def killed_in_generation(number: int, run: Run, folder: Path) -> None:
    """Leaves in the folder what kill -9 leaves: a .partial that was never finished."""
    done = subprocess.run([sys.executable, "-c", KILLED, run.text, str(number)], check=False, cwd=folder)
    assert done.returncode == -signal.SIGKILL


KILLED = """
import os, signal, sys, time
import yaml
from pathlib import Path
from fdi_torch.config.problems import Source
from fdi_torch.config.run_file import build_run
from fdi_torch.jobs.train import TrainResult, train
def tell(share, text):
    if f"generation {sys.argv[2]}," in text:
        time.sleep(1.2)
        os.kill(os.getpid(), signal.SIGKILL)
train(build_run(yaml.safe_load(sys.argv[1]), Path.cwd(), Source("default.yaml")), tell)
"""


def test_a_killed_run_resumes_to_the_same_end(done: TrainResult, tmp_path: Path) -> None:
    run = quick_run(tmp_path / "killed")
    killed_in_generation(9, run, tmp_path)
    assert list((tmp_path / "killed").glob("*.partial"))
    resumed = train(run, resume=True)
    assert torch.equal(resumed.result.estimate.value, done.result.estimate.value)
    assert torch.equal(resumed.result.estimate.covariance, done.result.estimate.covariance)
    assert content_hash(read_run(resumed.log).messages()) == content_hash(read_run(done.log).messages())


def test_nothing_to_resume_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected an unfinished log default.mcap, got none"):
        train(quick_run(tmp_path), resume=True)
