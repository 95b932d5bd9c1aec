"""The command line: exit codes, one sentence for what is wrong, JSON alone where asked for."""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import fdi_torch
from fdi_torch import cli
from fdi_torch.cli.options import LIVE, access_text, overrides
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import DiskError, write_text
from fdi_torch.jobs.gap import library_entries

CSV = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm\n" + "".join(
    f"{t},{50 + t % 7},50,{40 + t % 11},{30 + t % 5},{35 + t % 3}\n" for t in range(50)
)
LOG = Path(__file__).parent / "data/log_format_1_train.mcap"


@pytest.fixture
def rig(tmp_path: Path) -> str:
    path = tmp_path / "rig.csv"
    path.write_text(CSV)
    return str(path)


def test_without_a_command_it_says_which_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == cli.MISUSE
    assert cli.main(["--help"]) == cli.DONE
    shown = capsys.readouterr().out
    assert all(f"  {command} " in shown for command in cli.COMMANDS)


def test_an_unknown_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["chekc"]) == cli.MISUSE
    assert "got 'chekc'; the nearest is 'check'" in capsys.readouterr().err


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == cli.DONE
    assert f"usage: fdi {command}" in capsys.readouterr().out


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_help_of_every_command_ends_in_an_example_of_it(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    text = capsys.readouterr().out
    examples = text.partition("\nexamples:\n")[2].splitlines()
    assert examples and all(line.startswith(f"  fdi {command}") for line in examples if line.strip())


HELP_OF_ALL = """
import contextlib, io, sys
import fdi_torch
from fdi_torch import cli
for words in [[], *([name] for name in cli.COMMANDS)]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
cli.main(["--version"])
print(sorted({"torch", "numpy", "pydantic", "pint", "rich", "matplotlib", "mcap"} & sys.modules.keys()))
"""


def test_no_help_waits_for_a_library() -> None:
    done = subprocess.run([sys.executable, "-c", HELP_OF_ALL], capture_output=True, text=True, check=True)
    version, loaded = done.stdout.splitlines()
    assert version == f"fdi_torch {fdi_torch.__version__}" and loaded == "[]"


def test_what_help_says_by_itself_is_what_the_jobs_do() -> None:
    """Help is shown without the jobs' modules, so that it repeats a few of their constants."""
    from fdi_torch.blind.networks import FEWEST, MOST
    from fdi_torch.blind.plants import RIGS
    from fdi_torch.cli import options
    from fdi_torch.cli.challenge import CASES
    from fdi_torch.cli.options import challenge, gap
    from fdi_torch.gap.free_runs.prediction import START_SAMPLES
    from fdi_torch.gap.structure_search import MAX_EFFECTS
    from fdi_torch.jobs.blind_results import LOG

    assert (gap.MOST_CAUSES, options.START_SAMPLES) == (MAX_EFFECTS, START_SAMPLES)
    assert sorted(RIGS) == sorted(challenge.RIGS)
    parser = argparse.ArgumentParser()
    options.add_arguments(parser, "challenge")
    assert f"({FEWEST}..{MOST})" in parser.format_help() and f"({CASES})" in parser.format_help()
    assert LOG in (challenge.__doc__ or "") + challenge.EXAMPLES


def test_a_plant_is_checked_alone_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "--plant", "three_tank", "--picture", str(tmp_path / "rig.svg")]) == cli.DONE
    shown = capsys.readouterr().out
    assert "plant three_tank: 3 tanks, 3 pipes, 2 pumps, 3 sensors" in shown
    assert (tmp_path / "rig.svg").read_text().count("T1") >= 1


def test_check_shows_channels_and_findings(rig: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", rig, "--plant", "three_tank"]) == cli.DONE
    assert cli.main(["check", "--plant", "three_tank", "--recording", rig, "--quiet"]) == cli.DONE
    shown = capsys.readouterr().out
    assert "50 samples, 49 s, one every 1 s" in shown
    assert "h1       output  cm          40" in shown


@pytest.mark.parametrize(
    ("override", "told"),
    [
        (
            "simulate.faults.T1.leek=0.3",
            "simulate.faults.T1.leek: expected a parameter of the plant or its faults, got 'T1.leek'",
        ),
        ("simulate.faults.T1.leak=30", "simulate.faults.T1.leak: expected a size from 0 to 1, got 30"),
        ("simulate.duration=600", "simulate.duration: expected a quantity in s, got the bare number 600"),
        ("foo=1", "expected a known key (plant, output, seed, recordings, "),
        ("estimate.search={population: 2}", "estimate.search: expected a population of at least 4"),
        ("simulate.noise.std.hh1=1 mm", "simulate.noise.std.hh1: expected an output of the plant (h1, h2, h3)"),
        ("estimate.search.populaton=40", "estimate.search: expected a known key (strategy, population"),
        ("plant=three_tnak", "plant: expected a plant file (.yaml) or a shipped plant"),
    ],
)
def test_a_wrong_value_of_the_option_set_is_not_blamed_on_the_file(
    capsys: pytest.CaptureFixture[str], override: str, told: str
) -> None:
    assert cli.main(["simulate", "--quiet", "--set", "seed=3", "--set", override]) == cli.MISUSE
    assert f"fdi simulate: --set {override}: {told}" in capsys.readouterr().err


def test_an_override_within_what_is_wrong_is_named_beside_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    """The file gives the keys around it, and the two may be wrong only together."""
    assert cli.main(["simulate", "--quiet", "--set", "seed=3", "--set", "estimate.search.population=2"]) == cli.MISUSE
    said = capsys.readouterr().err
    assert "default.yaml with --set estimate.search.population=2: estimate.search: expected a population" in said


def test_a_mistake_in_the_file_is_blamed_on_it_beside_the_option_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.yaml").write_text("simulate: {duration: 5, sample_tme: 1 s}")
    words = ["--config", str(tmp_path / "run.yaml"), "--set", "seed=1", "--set", "simulate.sample_time=1 s"]
    assert cli.main(["simulate", "--quiet", *words]) == cli.MISUSE
    assert all(
        f"fdi simulate: {tmp_path / 'run.yaml'}: simulate" in line for line in capsys.readouterr().err.splitlines()
    )


def test_check_speaks_in_the_units_of_the_columns_and_of_too_few_readings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The plant file has cm and cm^3/s."""
    rows = [f"{k},{50 + k % 2},3,{500 + k},500,500" for k in range(20)]
    (tmp_path / "run.csv").write_text("t_s,Q1_l/min,Q2_l/min,h1_mm,h2_mm,h3_mm\n" + "\n".join(rows))
    cli.main(["check", "--plant", "three_tank", "--recording", str(tmp_path / "run.csv"), "--quiet"])
    said = capsys.readouterr().out
    assert "Q1: up to 51 l/min, 9.44 times Q1's maximum of 5.4 l/min; if its unit is cm^3/s, write" in said
    assert "- h1, h2, h3: 20 readings: fdi gap and fdi refit expect at least 60" in said
    assert "record longer or more often; until then fdi gap and fdi refit refuse the recording" in said


def test_a_misspelt_list_of_recordings_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "runs.yaml").write_text("plant: three_tank\nrecordigns: [{file: run.csv}]")
    assert cli.main(["predict", "--plant", "three_tank", "--recording", str(tmp_path / "runs.yaml")]) == cli.MISUSE
    assert (
        "expected at least one, got none; list files under it; the nearest is 'recordigns'" in capsys.readouterr().err
    )


def test_a_command_without_its_file_says_what_writes_one(capsys: pytest.CaptureFixture[str]) -> None:
    for command, kind in (("monitor", "monitor"), ("rehearse", "rehearsal"), ("study", "study")):
        with pytest.raises(SystemExit):
            cli.main([command])
        assert f"required: --config; fdi new {kind} writes such a file" in capsys.readouterr().err


def test_check_says_first_that_readings_lie_beyond_a_tank(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A plant file whose sizes are still those of the example, 60 cm of height, for levels up to 2 m."""
    rows = [f"{10 * k},{4 + k % 2},{1200 + 8 * (k % 90)},{800 + 3 * (k % 90)}" for k in range(300)]
    (tmp_path / "run.csv").write_text("t_s,Q_m3_h,hA_mm,hB_mm\n" + "\n".join(rows) + "\n")
    plant = tmp_path / "rig.yaml"
    assert cli.main(["new", "plant", "--out", str(plant), "--quiet"]) == cli.DONE
    plant.write_text(plant.read_text().replace("# !", "#"))
    words = ["--plant", str(plant), "--recording", str(tmp_path / "run.csv")]
    assert cli.main(["check", *words]) == cli.NOT_EXPLAINED
    findings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("- ")]
    told = "readings lie above the rim of A, up to 1912 mm of 600 mm, which neither noise nor tolerances explain"
    assert told in findings[0] and "correct tanks.A.height, or gain" in findings[0]
    assert sum("above the rim of A" in line for line in findings) == 1


def test_a_file_with_other_names_is_refused_with_the_lines_that_map_it(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("rig.csv").write_text(CSV.replace("Q1_cm3_s", "FIC-1 (cm^3/s)").replace("h2_cm", "LT-2"))
    assert cli.main(["check", "rig.csv", "--plant", "three_tank"]) == cli.MISUSE
    refused = capsys.readouterr().err
    assert "expected a column for Q1, h2, got t_s, FIC-1 (cm^3/s), " in refused
    lines = refused[refused.index("recordings:") :]
    assert 'Q1: {column: "FIC-1 (cm^3/s)"}' in lines
    Path("runs.yaml").write_text(lines.replace("h2: {column: ..., unit: ...}", "h2: {column: LT-2, unit: cm}"))
    assert cli.main(["check", "runs.yaml", "--plant", "three_tank"]) == cli.DONE
    assert "50 samples, 49 s" in capsys.readouterr().out


def test_a_file_with_a_title_and_no_header_is_refused_with_lines_that_number_its_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run7.txt"
    path.write_text("Versuch 7, 20.11.2026\n" + "".join(f"{k}\t50,5\t40\t30,1\t20\t20\n" for k in range(9)))
    assert cli.main(["check", str(path), "--plant", "three_tank"]) == cli.MISUSE
    lines = capsys.readouterr().err
    numbered = "by number, 1 to 6; first row: 0 | 50,5 | 40 | 30,1 | 20 | 20"
    clock = "{column: 1, unit: ...}    # it increases as a clock does"
    assert f"    header: false\n    columns:    # {numbered}\n      t: {clock}\n      Q1: {{" in lines


@pytest.mark.parametrize(
    ("row", "clock"),
    [
        ("{k} 40 20 20 20 20", "{column: 1, unit: ...}    # it increases as a clock does"),
        ("{a} {k} 20 20 20 20", "{column: 2, unit: ...}    # it increases as a clock does"),
        ("2026-11-20T08:30:{k:02d} {a} 20 20 20 20", "{column: 1}"),
        ("{a} {b} 20 20 20 20", "{period: ...}    # no column increases as a clock does; "),
    ],
)
def test_a_clock_is_proposed_only_for_a_column_that_increases(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], row: str, clock: str
) -> None:
    path = tmp_path / "run7.txt"
    rows = (row.format(k=k, a=40 + k % 3, b=k // 20).replace(" ", "\t") for k in range(40))
    path.write_text("Versuch 7, 20.11.2026\n" + "\n".join(rows) + "\n")
    assert cli.main(["check", str(path), "--plant", "three_tank"]) == cli.MISUSE
    assert f"\n      t: {clock}" in capsys.readouterr().err


def test_a_file_without_its_option_is_told_the_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "leak.yaml"])
    assert "unrecognized argument: leak.yaml; name a file by its option: --config leak.yaml" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["train", "run.csv"])
    assert "run.csv; name it in the file for --config" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            "gap --plant three_tank --recordng a.csv",
            "unrecognized argument: --recordng; the nearest is '--recording'",
        ),
        ("predict --plant rig.yaml --recording a.csv --from 3072 s", "s; quote a time with its unit: --from '3072 s'"),
        ("train --confg=a.yaml", "unrecognized argument: --confg; the nearest is '--config'"),
        ("train --plant a.yaml", "--plant; name it in the file for --config, which fdi new run --plant ... writes"),
        (
            "monitor --recording a.csv",
            "--recording; name it in the file for --config, which fdi new monitor --recording",
        ),
        ("gap --config a.yaml", "--config; name --plant and --recording, whose YAML file may list several"),
        ("train --seed one", "argument --seed: expected a whole number, got 'one'"),
    ],
)
def test_a_mistaken_option_is_answered_with_what_was_expected(
    words: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(words.split())
    assert ended.value.code == cli.MISUSE and told in capsys.readouterr().err


def test_an_effect_at_one_place_is_called_as_in_files() -> None:
    named = ("pump_lag", "T1.leak", "leak@T2", "T1-T2.cross_flow")
    assert library_entries(named) == ("pump_lag", "leak@T1", "leak@T2", "cross_flow@T1-T2")


def test_check_states_the_volume_and_the_emptying_time_of_each_tank(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "--plant", "three_tank"]) == cli.DONE
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    # Torricelli: 2 A sqrt(H) / (C_d a sqrt(2 g)) = 2 * 0.016 / (0.6 * 0.6e-4 * sqrt(2 * 9.81)) = 200.7 s
    assert ["T1", "160", "100", "16", "201"] in rows


def test_check_of_a_plant_alone_names_the_columns_that_a_recording_has(
    rig: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["check", "--plant", "quadruple_tank"]) == cli.DONE
    assert capsys.readouterr().out.splitlines()[-1] == "columns of a recording: t_s,v1_V,v2_V,y1_V,y2_V"
    assert cli.main(["check", "--plant", "three_tank", rig]) == cli.DONE
    assert "columns of a recording" not in capsys.readouterr().out


def test_check_as_json_prints_nothing_else(rig: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", rig, "--plant", "three_tank", "--json"]) == cli.DONE
    answer = json.loads(capsys.readouterr().out)
    assert answer["format"] == "fdi_torch.check/1"
    assert answer["recordings"][0]["interval"] == 1.0


def test_check_of_a_run_file_says_what_is_usable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.csv").write_text(CSV.replace("20,56,50", "20,,50"))
    (tmp_path / "run.yaml").write_text("recordings: [{file: rig.csv}]")
    assert cli.main(["check", "--config", str(tmp_path / "run.yaml"), "--set", "recordings.0.start=5 s"]) == cli.DONE
    assert "usable with all inputs known: 5 to 19 s, 21 to 49 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["RIG"],
            "fdi check: expected --plant, --plant and --recording, or --config; without a plant file, "
            "fdi new plant --recording FILE writes one from the columns of a recording",
        ),
        (["RIG", "--plant", "three_tonk"], "got 'three_tonk'; the nearest is 'three_tank'"),
        (["gone.csv", "--plant", "three_tank"], "fdi check: gone.csv: file not found"),
        (["--config", "gone.yaml"], "fdi check: gone.yaml: file not found"),
        (["--config", "CONFIG"], "fdi check: expected recordings in the run file, got a simulation"),
    ],
)
def test_misuse_is_one_sentence_without_traceback(
    rig: str, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"RIG": rig, "CONFIG": "configs/default.yaml"}
    assert cli.main(["check", *(places.get(word, word) for word in words)]) == cli.MISUSE
    shown = capsys.readouterr()
    assert sentence in shown.err and shown.err.count("\n") == 1 and "Traceback" not in shown.err + shown.out


def test_traceback_on_request(rig: str) -> None:
    with pytest.raises(ValueError, match="three_tonk"):
        cli.main(["check", rig, "--plant", "three_tonk", "--traceback"])


def command(run: Any) -> Any:
    return SimpleNamespace(__doc__="", run=run)


def test_interruption_has_its_own_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(arguments: Any, screen: Screen) -> int:
        raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "fdi_torch.cli.check", command(interrupted))
    assert cli.main(["check"]) == cli.INTERRUPTED
    assert "interrupted" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_is_misuse(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unwritable(arguments: Any, screen: Screen) -> int:
        raise PermissionError(13, "Permission denied", "/logs/run.mcap")

    monkeypatch.setitem(sys.modules, "fdi_torch.cli.check", command(unwritable))
    assert cli.main(["check"]) == cli.MISUSE
    assert capsys.readouterr().err == "fdi check: [Errno 13] Permission denied: '/logs/run.mcap'\n"


def test_gap_asks_whether_the_adopted_file_can_be_written_before_it_searches(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, rig: str
) -> None:
    monkeypatch.setattr("fdi_torch.cli.gap.run_gap", lambda *given: pytest.fail("searched"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    for target, reason in (("file/better.yaml", "a part of the path is a file"), (".", "it is a folder; name a file")):
        words = ["gap", "--plant", "three_tank", "--recording", rig, "--adopt", target]
        assert cli.main(words) == cli.MISUSE
        assert f"fdi gap: {target}: {reason}" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["gap", "refit"])
def test_adopt_overwrites_a_file_only_where_it_is_told_to(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, rig: str, command: str
) -> None:
    monkeypatch.setattr("fdi_torch.cli.gap.run_gap", lambda *given: pytest.fail("searched"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "better.yaml").write_text("mine")
    words = [command, "--plant", "three_tank", "--recording", rig, "--adopt", "better.yaml"]
    assert cli.main(words) == cli.MISUSE
    assert "better.yaml: expected a new file for --adopt, but it exists" in capsys.readouterr().err
    assert (tmp_path / "better.yaml").read_text() == "mine"


def test_short_options_become_overrides_and_win() -> None:
    arguments = SimpleNamespace(set=["seed=1"], out="here", device=None, seed=2)
    assert overrides(arguments) == ["seed=1", "output.folder=here", "seed=2"]  # type: ignore[arg-type]


def test_progress_is_plain_lines_on_standard_error_when_nobody_watches(capsys: pytest.CaptureFixture[str]) -> None:
    with Screen(json=True).progress("searching") as advance:
        advance(0.5, "best 1.0")
        advance(0.6, "best 0.6")
        advance(1.0, "best 0.5")
    shown = capsys.readouterr()
    assert shown.err.splitlines() == ["searching ...", "searching  50% best 1.0", "searching 100% best 0.5"]
    assert shown.out == ""


def test_progress_that_does_not_move_is_not_repeated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 1000, 3))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    with Screen().progress("gap") as advance:
        for _ in range(8):
            advance(0.591, "which effects, so far Q.pump_lag")
        advance(0.594, "which effects, so far Q.pump_lag")
        advance(0.6, "which effects, so far Q.pump_lag")
    line = "gap  59% which effects, so far Q.pump_lag"
    assert capsys.readouterr().err.splitlines() == ["gap ...", line, line.replace("59", "60")]


def test_quiet_shows_no_progress_but_complaints(capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen(quiet=True)
    with screen.progress("searching") as advance:
        advance(1.0, "done")
    screen.note("half way")
    screen.complain("stuck")
    assert capsys.readouterr().err == "stuck\n"


def test_a_long_line_is_folded_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the lines of a monitor: further lines begin below the text, and no word is cut."""
    line = "   400.0 s  notice  watches for leak at A and B, plugging at link and drain, pump gain at Q"
    Screen().say(line, indent=20)
    assert capsys.readouterr().out == f"{line}\n"
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    Screen().say(line, indent=20)
    first, second = capsys.readouterr().out.splitlines()
    assert first == "   400.0 s  notice  watches for leak at A and B, plugging at"
    assert second == f"{'':20}link and drain, pump gain at Q"
    Screen().say(
        "   400.0 s  explained leak at A, 60 %, or leak at B, 40 %, since 380.0 s; A overflows in 90 s", indent=20
    )
    assert capsys.readouterr().out.splitlines() == [
        "   400.0 s  explained leak at A, 60 %,",
        f"{'':20}or leak at B, 40 %, since 380.0 s;",
        f"{'':20}A overflows in 90 s",
    ]


def test_json_has_null_where_a_number_is_not_finite(capsys: pytest.CaptureFixture[str]) -> None:
    Screen(json=True).result({"a": float("nan"), "b": float("inf")})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": None}


@pytest.mark.parametrize(("more", "said"), [([], "fdi train: loading\n"), (["--quiet"], "")])
def test_a_job_shows_life_before_its_libraries_are_loaded(
    more: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it has said when it asks for the module that loads them; in a new process torch is not there yet."""
    before: dict[str, str] = {}

    def load(name: str) -> ModuleType:
        before[name] = capsys.readouterr().err
        return importlib.import_module(name)

    monkeypatch.setattr(cli, "importlib", SimpleNamespace(import_module=load))
    monkeypatch.setattr(cli, "sys", SimpleNamespace(modules={}, stderr=sys.stderr))
    assert cli.main(["train", "--config", "nowhere.yaml", *more]) == cli.MISUSE
    assert before["fdi_torch.cli.train"] == said
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_kept_memory_is_not_asked_of_the_system_again() -> None:
    program = """
import resource
from fdi_torch.cli.gap import keep_memory

def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        bytearray(b"x") * (1 << 22)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(keep_memory(), pages())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    able, pages = done.stdout.split()
    if able == "False":
        pytest.skip("not the GNU C library")
    assert int(pages) < 4 * (1 << 22) / 4096  # mapped anew each time: twenty times the array's


@pytest.mark.parametrize(
    ("command", "key"),
    [
        ("check", "tanks.NAME.area"),
        ("train", "recordings.N.file"),
        ("monitor", "fault_free"),
        ("study", "study.trials"),
    ],
)
def test_keys_of_a_file_are_listed(command: str, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--keys"])
    assert stopped.value.code == 0
    assert key in {line.split()[0] for line in capsys.readouterr().out.splitlines()}


def test_who_reads_may_stop_reading() -> None:
    done = with_streams("check --keys", "| head -1")
    assert (done.returncode, done.stdout.split()[0], done.stderr) == (cli.DONE, "name", "")


def test_a_job_that_is_interrupted_before_it_logs_promises_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also while its libraries load, which is most of a short command."""

    def interrupted(name: str) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    for name in ("train", "report"):
        assert cli.main([name, "--quiet"]) == cli.INTERRUPTED
        assert capsys.readouterr().err == f"fdi {name}: interrupted; the same command starts again from the beginning\n"


@pytest.mark.parametrize(
    ("host", "alone"), [("127.0.0.1", True), ("localhost", True), ("[::1]", True), ("0.0.0.0", False)]
)
def test_access_to_a_live_job_is_stated(host: str, alone: bool) -> None:
    assert LIVE.startswith("127.0.0.1:")
    assert ("only users of this machine" in access_text(host)) is alone


def test_training_is_also_a_module() -> None:
    """`python -m fdi_torch.train` is the main job of the project, with the options of `fdi train`."""
    line = [sys.executable, "-m", "fdi_torch.train", "--help"]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == cli.DONE and done.stdout.startswith("usage: fdi train") and "--config" in done.stdout


def with_streams(words: str, redirections: str) -> subprocess.CompletedProcess[str]:
    line = f"set -o pipefail; {sys.executable} -m fdi_torch {words} {redirections}"
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize(
    ("redirections", "code", "complaint"),
    [
        (">&-", cli.DONE, ""),
        (">&- 2>&-", cli.DONE, ""),
        ("> /dev/full", cli.MISUSE, "fdi inspect: standard output: the disk is full; free some space\n"),
        ("--json > /dev/full", cli.MISUSE, "fdi inspect: standard output: the disk is full; free some space\n"),
    ],
)
def test_standard_output_that_cannot_be_written(redirections: str, code: int, complaint: str) -> None:
    """A command that loads no torch: all commands write in the same way."""
    done = with_streams(f"inspect {LOG}", redirections)
    assert (done.returncode, done.stderr) == (code, complaint)


def test_a_job_goes_on_though_nobody_reads_of_its_progress(tmp_path: Path) -> None:
    done = with_streams(f"simulate --out {tmp_path}", "2>&1 >/dev/null | true")
    assert (tmp_path / "default.csv").exists() and (done.returncode, done.stderr) == (cli.DONE, "")


def test_a_file_that_a_full_disk_cuts_short_is_named_and_the_old_one_stays(tmp_path: Path) -> None:
    """A limit on file size stands in for a full disk: both are an OSError at some write."""
    path = tmp_path / "old.txt"
    write_text(path, "old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[0][1]))
    try:
        with pytest.raises(DiskError, match=r"old.txt: the limit on file size is reached; raise it"):
            write_text(path, "new" * 1000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before[0])
        signal.signal(signal.SIGXFSZ, before[1])
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_second_recording_keeps_the_first_unless_it_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = [
        "simulate",
        "--out",
        str(tmp_path),
        "--quiet",
        "--set",
        "simulate.duration=30 s",
        "--set",
        "output.name=run",
    ]
    assert cli.main(short) == 0 and capsys.readouterr().out.endswith("run.csv\n")
    first = (tmp_path / "run.csv").read_bytes()
    assert cli.main([*short, "--seed", "2"]) == 0
    said = capsys.readouterr().out
    assert (
        "run_2.csv\n" in said and f"{tmp_path}/run.csv existed and was kept; with --replace it is overwritten" in said
    )
    assert (tmp_path / "run.csv").read_bytes() == first
    assert cli.main([*short, "--seed", "2", "--replace"]) == 0 and "kept" not in capsys.readouterr().out
    assert (tmp_path / "run.csv").read_bytes() == (tmp_path / "run_2.csv").read_bytes() != first


@pytest.mark.parametrize(("words", "expected"), [("fdi diagnos", "diagnosability"), ("fdi gap --hold", "--holdout")])
def test_a_shell_completes_commands_and_options(
    words: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["completion", "bash"]) == 0
    (tmp_path / "fdi").write_text(capsys.readouterr().out)
    *before, last = words.split()
    script = f"""
        source {tmp_path}/fdi
        COMP_WORDS=({words}) COMP_CWORD={len(before)}
        $(complete -p fdi | grep -o "_[a-z_]*") fdi {last} {before[-1]}
        echo "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected]


def test_a_warning_of_torch_about_itself_is_not_shown() -> None:
    """Newer versions of torch warn of their own use of it when a derivative is first taken."""
    code = (
        "import warnings, fdi_torch.cli as cli; "
        "cli.main = lambda: warnings.warn('`torch.jit.script` is deprecated.', FutureWarning) or "
        "warnings.warn('of ours', FutureWarning) or 0; cli.command_line()"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr
    assert "of ours" in shown and "torch.jit" not in shown
