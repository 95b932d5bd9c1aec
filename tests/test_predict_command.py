"""`fdi predict`: what strangers' files ask of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import fdi_torch
from fdi_torch.cli import DONE, NOT_EXPLAINED, main

PLANT = """
tanks: {T: {area: 100 cm^2, height: 50 cm}}
pipes: {OUT: {source: T, area: 0.5 cm^2, discharge_coefficient: 0.6, valve: v, unrecorded: 0}}
pumps: {Q: {target: T, max_flow: 100 cm^3/s}}
sensors: {h: {tank: T}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tank that is filled by 50 cm^3/s, in files of several kinds: columns in any order, cells missing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(PLANT)
    levels = [10.0 + 0.5 * k for k in range(40)]
    cells = [(f"{k}", f"{10 * h:.1f}" if k % 7 else "", "0.05") for k, h in enumerate(levels)]
    (tmp_path / "novalve.csv").write_text("h_mm,Q_lps,t_s\n" + "".join(f"{h},{q},{t}\n" for t, h, q in cells))
    (tmp_path / "nopump.csv").write_text("t_s,h_mm,v_pct\n" + "".join(f"{t},100,0\n" for t, _, _ in cells))
    unknown = [(t, h, "" if 15 <= int(t) < 20 else q) for t, h, q in cells]
    (tmp_path / "cut.csv").write_text("t_s,h_mm,Q_lps,v_pct\n" + "".join(f"{t},{h},{q},0\n" for t, h, q in unknown))
    (tmp_path / "runs.yaml").write_text("recordings: [{file: cut.csv, stop: 14 s}, {file: cut.csv, start: 20 s}]\n")
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """The JSON of a free run, whose exit code says whether the plant explains every recording."""
    code = main(["predict", "--plant", "rig.yaml", "--start-samples", "3", "--json", *words])
    out: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert code == (DONE if all(run["explained"] for run in out.get("runs", [out])) else NOT_EXPLAINED)
    return out


def test_a_valve_that_was_not_recorded_stands_as_the_plant_file_says_and_missing_readings_do_not_count(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said(capsys, "--recording", "novalve.csv")["rmse"] == {"h": pytest.approx(0.0, abs=2e-4)}


def test_a_valve_of_which_nothing_is_said_has_to_be_recorded(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "rig.yaml").write_text(PLANT.replace(", unrecorded: 0", ""))
    assert main(["predict", "--plant", "rig.yaml", "novalve.csv"]) == 2
    assert "expected a column for v" in capsys.readouterr().err


def test_a_pump_that_was_not_recorded_has_to_be_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", "--plant", "rig.yaml", "nopump.csv"]) == 2
    said_so = capsys.readouterr().err
    assert "expected a column for Q, got t_s, h_mm, v_pct" in said_so and "--constant Q=0" in said_so
    at_rest = said(capsys, "nopump.csv", "--constant", "Q=0")
    assert at_rest["rmse"] == {"h": pytest.approx(0.0, abs=1e-6)} and at_rest["explained"]
    with_unit, bare = (said(capsys, "nopump.csv", "--constant", f"Q={q}") for q in ("50 cm^3/s", "5e-5"))
    assert with_unit["rmse"] == bare["rmse"] and not bare["explained"]
    assert bare["rmse"]["h"] > 0.05  # 10 cm stood there, and 50 cm^3/s for 39 s are 19.5 cm
    assert main(["predict", "--plant", "rig.yaml", "nopump.csv", "--constant", "Q"]) == 2
    assert "INPUT=VALUE" in capsys.readouterr().err


def test_a_run_ends_where_a_command_is_unknown_and_begins_anew(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = said(capsys, "cut.csv")["runs"]
    assert isinstance(runs, list) and [(r["time"][0], r["time"][-1]) for r in runs] == [(0, 14), (20, 39)]
    listed = said(capsys, "runs.yaml")["runs"]
    assert isinstance(listed, list) and [r["rmse"] for r in listed] == [r["rmse"] for r in runs]


def test_table_and_picture_have_both_plants(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "before.yaml").write_text("name: cellar" + PLANT.replace("100 cm^2", "80 cm^2"))
    words = ["predict", "--plant", "rig.yaml", "novalve.csv", "--picture", "run.svg", "--beside", "before.yaml"]
    assert main(words) == DONE
    assert (folder / "run.svg").stat().st_size > 5000
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if " novalve.csv " in line]
    assert [row[0] for row in rows] == ["rig", "before"] and float(rows[0][4]) < 0.1 * float(rows[1][4])
    (folder / "today").mkdir()
    (folder / "today" / "rig.yaml").write_text(PLANT)
    assert main(["predict", "--plant", "rig.yaml", "novalve.csv", "--beside", "today/rig.yaml"]) == DONE
    shown = capsys.readouterr().out
    assert "\nrig.yaml  " in shown and "\ntoday/rig.yaml  " in shown, "files of one name have their folders"


def test_a_plant_that_does_not_explain_the_recording_is_said_first(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readings in steps of 5 mm count as noise of 5 mm / sqrt(12); a tank of 80 cm^2 fills 1.25 mm/s faster."""
    words = ["predict", "--plant", "rig.yaml", "--start-samples", "3", "novalve.csv"]
    assert main(words) == DONE
    assert "Unreliable" not in capsys.readouterr().out
    (folder / "rig.yaml").write_text(PLANT.replace("100 cm^2", "80 cm^2"))
    assert main([*words, "--picture", "run.svg"]) == NOT_EXPLAINED
    shown = capsys.readouterr().out
    warning = "Unreliable: the model does not explain the recording (residuals 19 times the sensors' noise)"
    assert (
        f"\n\n{warning}.\n- next: fdi gap distinguishes" in shown and warning[:40] in (folder / "run.svg").read_text()
    )
    assert "constants with a tolerance" not in shown
    (folder / "uncertain.yaml").write_text((folder / "rig.yaml").read_text() + 'tolerances: {"*.area": 10 %}\n')
    assert main([*words, "--plant", "uncertain.yaml"]) == NOT_EXPLAINED
    assert "have the values of the plant file here; fdi refit --adopt fits them" in capsys.readouterr().out
    leak = "{effect: leak, location: T, parameters: {size: 0.1, onset: 20 s}}"
    (folder / "adopted.yaml").write_text((folder / "rig.yaml").read_text() + f"effects: [{leak}]\n")
    assert main([*words, "--plant", "adopted.yaml"]) == NOT_EXPLAINED
    told = (
        "- leak at T has its onset at 20 s, a time of the recording that it was found in: if this one was made later, "
    )
    assert told + "delete the onset in the plant file\n" in capsys.readouterr().out
    run = fdi_torch.predict("rig.yaml", "novalve.csv", start_samples=3)
    doubt = "t: the sampling interval of 1 s varies by up to 1 s"
    assert shown.startswith(f"Doubts about the recording:\n- {doubt}\n\n") and run.doubts == (doubt,)
    assert run.headline == f"{warning}; free run of rig along {folder / 'novalve.csv'}; {doubt}"


def test_of_several_recordings_the_one_that_is_not_explained_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{100 + 10 * k},0.05,{k}\n" for k in range(40)]
    (folder / "fast.csv").write_text("h_mm,Q_lps,t_s\n" + "".join(rows))
    words = ["predict", "--plant", "rig.yaml", "--start-samples", "3"]
    assert main([*words, "fast.csv", "novalve.csv"]) == NOT_EXPLAINED
    lines = capsys.readouterr().out.splitlines()
    first = lines.index("") + 1
    assert (
        lines[first].startswith("Unreliable")
        and lines[first + 1] == "- of 2 free runs, that along fast.csv is the worst"
    )
    assert main([*words, "fast.csv"]) == NOT_EXPLAINED
    assert "the worst" not in capsys.readouterr().out


def test_a_recording_that_only_determines_its_initial_levels_is_said_to(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for samples, words in (("39", "the first 39 samples"), ("40", "all samples: a longer recording would test the")):
        rows = [f"{100 + 0.5 * k},0.05,{k}\n" for k in range(40)]
        (folder / "short.csv").write_text("h_mm,Q_lps,t_s\n" + "".join(rows))
        main(["predict", "--plant", "rig.yaml", "--start-samples", samples, "short.csv"])
        assert f"initial levels from {words}" in capsys.readouterr().out


def test_no_recording_is_misuse(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", "--plant", "rig.yaml"]) == 2
    assert "expected a recording" in capsys.readouterr().err


def test_what_a_run_has_of_its_own_is_taken_from_the_stretch_that_it_settles_in(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """50 cm^3/s are asked for; the plant file believes in 60, within a tenth, and in the tank's level."""
    (folder / "rig.yaml").write_text(
        PLANT.replace("100 cm^3/s", "100 cm^3/s, gain: 1.2") + "tolerances: {Q.gain: 0.2}\n"
    )
    before = said(capsys, "novalve.csv", "--settle", "10 s")
    after = said(capsys, "novalve.csv", "--settle", "10 s", "--vary", "Q.*")
    assert before["settle"] == 10.0 and before["own"] == {}
    assert after["own"] == {"Q.gain": pytest.approx(1.0, abs=5e-3)} and after["rmse"]["h"] < 1e-3  # type: ignore[index]
    assert before["rmse"]["h"] > 0.005  # type: ignore[index]
    assert main(["predict", "--plant", "rig.yaml", "novalve.csv", "--settle", "39"]) == 2
    assert "left" not in (told := capsys.readouterr().err) and "less than the 39 s" in told


HOSE = "effects: [{effect: pump_priming, location: Q, parameters: {volume: 200 cm^3}}]\n"


def test_a_hose_fills_once_and_is_full_where_a_run_was_cut_out_of_a_longer_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """50 cm^3/s for 10 s, rest for 10 s, 50 cm^3/s again: 200 cm^3, 2 cm of level, are missing once."""
    (folder / "rig.yaml").write_text(PLANT + HOSE)
    flows = [50.0 if t < 10 or t >= 20 else 0.0 for t in range(40)]
    pumped = [sum(flows[:t]) for t in range(40)]
    rows = [f"{t},{10 + max(v - 200.0, 0.0) / 100.0},{q}" for t, v, q in zip(range(40), pumped, flows, strict=True)]
    (folder / "rests.csv").write_text("t_s,h_cm,Q_cm3_s\n" + "".join(f"{t},10,0\n" for t in (-2, -1)) + "\n".join(rows))
    whole, later = (said(capsys, "rests.csv", *words)["rmse"] for words in ((), ("--from", "15")))
    assert whole == {"h": pytest.approx(0.0, abs=2e-4)} and later == {"h": pytest.approx(0.0, abs=2e-4)}


def test_a_plant_file_beside_that_is_not_there_is_said_before_any_result(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["predict", "--plant", "rig.yaml", "--start-samples", "3", "novalve.csv", "--beside", "before.yaml"]
    assert main(words) == 2
    told = capsys.readouterr()
    assert not told.out and "before.yaml: file not found" in told.err
