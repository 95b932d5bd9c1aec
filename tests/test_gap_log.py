"""The log of a gap diagnosis contains the whole answer, and replays to the same one."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fdi_torch import cli
from fdi_torch.config.logged_config import logged_gap_settings, logged_plant
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.gap.answer import Amount, Answer, Cause, adopted
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.stage_progress import StageProgress
from fdi_torch.jobs.gap import run_gap
from fdi_torch.logbook import own_signals, read_run, series
from fdi_torch.plant.constants import leak_pipe, nominal_capacity
from fdi_torch.recordings.csv_writing import write_csv
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline
from tests.test_gap import nominal_plant, recorded

GAIN = {"Q2.pump_gain.factor": 1.12}
LIBRARY = ("pump_gain", "sensor_bias@h1")


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A diagnosis with one hold-out."""
    path = tmp_path_factory.mktemp("logs") / "gap.mcap"
    holdout = replace(recorded(GAIN, 5, samples=300), source="other.csv")
    run_gap(path, nominal_plant(), recorded(GAIN, 3, samples=400), [holdout], Settings(LIBRARY))
    return path


def test_a_gap_log_contains_the_whole_answer(logged: Path) -> None:
    log = read_run(logged)
    assert logged_plant(log) == nominal_plant()
    recording, holdout = recorded(GAIN, 3, samples=400), recorded(GAIN, 5, samples=300)
    assert torch.equal(torch.as_tensor(own_signals(log).outputs), recording.outputs)
    assert torch.equal(torch.as_tensor(own_signals(log, "holdout").outputs), holdout.outputs)
    found = gather(log, nominal_plant())
    said = r"The gap comes from pump gain at Q2 \(factor 1\.1\d+ ± 0\.0\d+\), probability (over )?99\.[89] %"
    assert re.fullmatch(said, headline(found))
    assert found.of("/gap/where")[0]["location"] == found.answer["where"][0]["location"]
    assert found.arrays["holdout_augmented"].shape == (300, 3)
    for root, array in (("/estimate", "augmented"), ("/estimate/holdout", "holdout_augmented")):
        predicted = series(log, f"{root}/output")
        assert np.array_equal(np.stack([predicted[name] for name in ("h1", "h2", "h3")], 1), found.arrays[array])


def test_the_log_tells_the_likeliest_causes_while_they_are_searched(logged: Path) -> None:
    said = [message.payload["message"] for message in read_run(logged).messages("/log")]
    assert "which effects, so far pump gain at Q2" in said
    assert "where, so far pump gain at Q2" in said


def test_the_share_done_follows_the_steps_and_never_falls() -> None:
    """The steps known so far grow with what is found."""
    told: list[tuple[float, str]] = []
    progress = StageProgress(lambda share, text: told.append((share, text)), "where", 0.6, 0.8)
    progress.remaining(4)
    progress.step()
    progress.so_far({("leak", "T1")})
    progress.remaining(8)
    for _ in range(10):
        progress.step()
    shares = [share for share, _ in told]
    assert shares[:3] == pytest.approx([0.65] * 3) and shares[3] == pytest.approx(0.6 + 0.2 * 3 / 9)
    assert shares == sorted(shares) and shares[-1] == 0.8
    assert [text for _, text in told[:2]] == ["where", "where, so far leak at T1"]


def test_the_progress_of_a_diagnosis_moves_on_within_its_stages() -> None:
    told: list[tuple[float, str]] = []
    recording = recorded(GAIN, 3, samples=400)
    library = Settings(library=("leak", "pump_gain"))
    diagnose(nominal_plant(), recording, settings=library, progress=lambda share, text: told.append((share, text)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares) and shares[-1] <= 1.0
    for begin, end in ((0.2, 0.6), (0.6, 0.8)):
        assert len({share for share in shares if begin < share < end}) > 2


def test_a_verdict_replays_from_its_log_to_the_last_bit(logged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(logged), "--json", "--quiet"]) == cli.DONE
    done = json.loads(capsys.readouterr().out)["replay"]
    assert done["outcome"] == "bit-equal" and done["events"] > 1400 and done["largest"] == 0.0


def test_a_replay_with_another_library_is_another_diagnosis(logged: Path, tmp_path: Path) -> None:
    target = tmp_path / "without.mcap"
    words = ["replay", str(logged), "--set", "library=sensor_bias@h1", "--out", str(target), "--quiet"]
    assert cli.main(words) == cli.DONE
    again = read_run(target)
    assert gather(again, nominal_plant()).answer["causes"] != gather(read_run(logged), nominal_plant()).answer["causes"]
    assert again.metadata["fdi_torch.run"]["parent_run_id"] == read_run(logged).metadata["fdi_torch.run"]["run_id"]


def test_a_key_that_a_gap_diagnosis_lacks_is_refused(
    logged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["replay", str(logged), "--set", "seed=3", "--out", str(tmp_path / "x.mcap"), "--quiet"]
    assert cli.main(words) == cli.MISUSE
    said = capsys.readouterr().err
    assert "expected a known key (library, leave_out, step, most, named_only, trusted), got 'seed'" in said


def test_every_setting_of_a_diagnosis_can_be_overridden(logged: Path) -> None:
    run = read_run(logged)
    assert logged_gap_settings(run) == Settings(LIBRARY)
    words = ("library=leak@T1,pump_lag", "leave_out=pump_gain", "step=0.5", "most=2", "named_only=true")
    assert logged_gap_settings(run, words) == Settings(("leak@T1", "pump_lag"), ("pump_gain",), 0.5, 2, True)
    assert logged_gap_settings(run, ["library=", "step=null"]) == Settings(None)
    for wrong in ("step=often", "step=-1", "most=1.5", "most=", "named_only=maybe"):
        with pytest.raises(ValueError, match=f"--set: {wrong.partition('=')[0]}: expected"):
            logged_gap_settings(run, [wrong])


def test_the_command_prints_the_verdict_and_writes_all_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, better = tmp_path / "rig.yaml", tmp_path / "new" / "better.yaml"
    plant.write_text(dump_plant(nominal_plant()))
    files = [str(write_csv(recorded(GAIN, k, samples=300), tmp_path / f"day{k}.csv")) for k in (3, 5, 7)]
    words = ["gap", "--plant", str(plant), "--recording", files[0], "--holdout", *files[1:], "--library"]
    words += [",".join(LIBRARY), "--out", str(tmp_path / "out"), "--adopt", str(better), "--with-constants", "--quiet"]
    assert cli.main(words) == cli.DONE
    shown = capsys.readouterr().out
    assert re.match(r"The gap comes from pump gain at Q2, probability (over )?99\.[89] %\.", shown)
    assert "error of free runs on day5.csv, day7.csv, cm" in shown and "of the gap closes on data not used" in shown
    for name in ("day5.csv", "day7.csv"):
        assert re.search(rf"^{name}( +[\d.]+){{4}} %$", shown, flags=re.M), "three errors and the share that closes"
    assert f"next: with {better} as their plant, train and monitor" in shown
    answer = json.loads((tmp_path / "out" / "gap.json").read_text())
    found = load_plant(better)
    factor, constant = answer["causes"][0]["parameters"]["factor"], answer["constants"]["P13.discharge_coefficient"]
    # written with two digits of the standard error
    assert found.effects[0].parameters["factor"] == pytest.approx(factor["value"], abs=0.05 * factor["std"])
    fitted, rounding = constant["augmented"], 0.05 * constant["std"]
    assert found.pipes[0].discharge_coefficient == pytest.approx(fitted, abs=rounding) and abs(fitted - 0.6) > 1e-5
    assert f"+++ {better}" in shown and "+  - {effect: pump_gain, location: Q2" in shown
    refitted_later = {"Q2.pump_gain.factor": found.tolerances["Q2.pump_gain.factor"]}
    assert found.tolerances == nominal_plant().tolerances | refitted_later


@pytest.mark.parametrize("stopped_at", ["which effects, so far", "noise"])
def test_an_interrupted_diagnosis_says_what_was_computed(tmp_path: Path, stopped_at: str) -> None:
    def stop(share: float | None, text: str) -> None:
        if text.startswith(stopped_at) or share == 0.0:
            raise KeyboardInterrupt

    path, recording = tmp_path / "gap.mcap", recorded(GAIN, 3, samples=400)
    with pytest.raises(KeyboardInterrupt) as interruption:
        run_gap(path, nominal_plant(), recording, (), Settings(LIBRARY), stop)
    note = interruption.value.__notes__[0]
    likeliest = ", the likeliest so far was pump gain at Q2" if "so far" in stopped_at else ""
    assert note == f"no answer was computed{likeliest}; recordings and progress messages are in {path}"


def test_the_files_of_a_second_diagnosis_are_named_after_its_log(tmp_path: Path) -> None:
    file = str(write_csv(recorded({"Q1.pump_lag.time_constant": 4.0}, 9, samples=400, std=2e-3), tmp_path / "run.csv"))
    words = ["gap", "--plant", "three_tank", "--recording", file, "--quiet", "--out", str(tmp_path / "out")]
    for library in ("pump_lag,pump_delay", "pump_lag", "pump_lag,pump_delay"):
        assert cli.main([*words, "--library", library]) == cli.DONE
    written = {path.name for path in (tmp_path / "out").iterdir()}
    logs = {f"{name}.{ending}" for name in ("gap", "gap_2", "gap_3") for ending in ("mcap", "json")}
    assert written == logs | {"next_input.csv", "next_input_3.csv"}
    for name in ("gap", "gap_2", "gap_3"):
        (verdict,) = read_run(tmp_path / "out" / f"{name}.mcap").messages(["/gap/verdict"])
        answer = json.loads((tmp_path / "out" / f"{name}.json").read_text())
        assert answer["verdict"] == verdict.payload["verdict"] == ("named" if name == "gap_2" else "ambiguous")


def test_an_ambiguous_answer_writes_the_next_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = recorded({"Q1.pump_lag.time_constant": 4.0}, 9, samples=400, std=2e-3)
    file = str(write_csv(recording, tmp_path / "run.csv"))
    words = ["gap", "--plant", "three_tank", "--recording", file, "--library", "pump_lag,pump_delay", "--quiet"]
    assert cli.main([*words, "--out", str(tmp_path)]) == cli.DONE
    shown = capsys.readouterr().out
    assert shown.startswith("There is a gap; ")
    assert "next_input.csv; it should distinguish the two likeliest explanations" in shown
    planned = (tmp_path / "next_input.csv").read_text().splitlines()
    assert planned[0] == "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm" and len(planned) == 1501
    capsys.readouterr()
    planned_words = ["--plant", "three_tank", "--recording", str(tmp_path / "next_input.csv"), "--json"]
    assert cli.main(["plan", *planned_words, "--library", "pump_lag,pump_delay"]) == cli.DONE
    limits = json.loads(capsys.readouterr().out)
    assert set(limits["shown"]) == {f"{q}.{e}" for q in ("Q1", "Q2") for e in ("pump_lag", "pump_delay")}
    assert cli.main(["plan", *planned_words, "--noise", "0 mm"]) == cli.MISUSE
    assert "noise of h1: expected a positive standard deviation, got '0 mm'" in capsys.readouterr().err


def test_planned_inputs_need_no_readings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"{10 * k},{50 + 20 * (k % 7 > 3)},50" for k in range(60)]
    planned, listing = tmp_path / "planned.csv", tmp_path / "runs.yaml"
    planned.write_text("t_s,Q1_cm3_s,Q2_cm3_s\n" + "\n".join(rows) + "\n")
    listing.write_text("recordings: [planned.csv]\n")
    words = ["--plant", "three_tank", "--recording", str(planned), "--library", "pump_lag,pump_gain@Q1"]
    assert cli.main(["plan", *words, "--noise", "5 mm", "--json"]) == cli.DONE
    hidden = [
        f"hidden: {name.replace('_', ' ')} at {place}" for name, place in json.loads(capsys.readouterr().out)["hidden"]
    ]
    assert cli.main(["plan", *words, "--noise", "5 mm"]) == cli.DONE
    counted = f"of 3 effects at a usual size, {len(hidden)} would be hidden by a noise of 5 mm; pairs"
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith(counted) and others[: len(hidden)] == hidden and hidden
    for source in map(str, (planned, listing)):
        words = ["--plant", "three_tank", "--recording", source, "--library", "leak@T1,pump_gain@Q1", "--json"]
        assert cli.main(["plan", *words]) == cli.DONE
        assert set(json.loads(capsys.readouterr().out)["shown"]) == {"T1.leak", "Q1.pump_gain"}
        words = ["--plant", "three_tank", "--input", source, "--faults", "T1.leak"]
        assert cli.main(["diagnosability", *words]) == cli.DONE
        assert "T1.leak.size" in capsys.readouterr().out
    for command in ("check", "predict"):
        assert cli.main([command, "--plant", "three_tank", "--recording", str(planned)]) == cli.MISUSE
        expected = "expected readings of h1, h2, h3, got inputs alone; fdi plan and fdi diagnosability show"
        assert expected in capsys.readouterr().err


def test_nothing_to_adopt_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(write_csv(recorded({"P13.discharge_coefficient": 0.6}, 3, samples=200), tmp_path / "run.csv"))
    words = ["gap", "--plant", "three_tank", "--recording", file, "--library", "pump_gain", "--out", str(tmp_path)]
    assert cli.main([*words, "--adopt", str(tmp_path / "better.yaml"), "--quiet"]) == cli.DONE
    told = capsys.readouterr()
    assert told.out.startswith("No gap: the plant file explains the recording within noise and tolerances.")
    assert "nothing to adopt: the verdict is no gap" in told.err and not (tmp_path / "better.yaml").exists()


def test_an_invalid_step_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(write_csv(recorded(GAIN, 3, samples=100), tmp_path / "run.csv"))
    words = ["gap", "--plant", "three_tank", "--recording", file, "--step", "0", "--out", str(tmp_path)]
    assert cli.main(words) == cli.MISUSE
    assert "step: expected a positive number of seconds, got 0" in capsys.readouterr().err


def test_what_cannot_be_diagnosed_leaves_no_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(write_csv(recorded(GAIN, 3, samples=30), tmp_path / "run.csv"))
    assert (
        cli.main(["gap", "--plant", "three_tank", "--recording", file, "--out", str(tmp_path / "logs")]) == cli.MISUSE
    )
    assert "expected at least 60 readings of every sensor, got 30 of h1" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["gap", "--help"])
    shown = capsys.readouterr().out
    assert "examples:" in shown and "--holdout other.csv" in shown and "The verdict is one of four" in shown


def test_an_adopted_leak_keeps_its_flow_if_its_reference_was_recalibrated() -> None:
    leak = Cause("leak", "T1", {"size": Amount(0.3, 0.01, "1")})
    constants = {"P13.discharge_coefficient": {"augmented": 0.5}}
    answer = Answer("named", 0.0, [], [leak], [], [], {}, {}, constants=constants)
    plant = adopted(nominal_plant(), answer, constants=True)
    flows = [
        p.effects[0].parameters["size"] * nominal_capacity(p, leak_pipe(p, "T1"))
        for p in (adopted(nominal_plant(), answer), plant)
    ]
    assert plant.pipes[0].discharge_coefficient == 0.5
    assert flows[0] == pytest.approx(flows[1], rel=1e-12)
