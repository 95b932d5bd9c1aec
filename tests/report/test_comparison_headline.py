"""The headline of a comparison: the better run, by how much, and what differs, in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdi_torch import cli
from fdi_torch.jobs.report import report
from fdi_torch.logbook import RunLog, compare, read_run
from fdi_torch.report.comparison_headline import comparison_headline, plain_text, setting_differences
from fdi_torch.report.material import gather

SAMPLES = 100


def write_fit(
    path: Path,
    error: float,
    *,
    level: float = 0.3,
    config: dict[str, str] | None = None,
    explained: bool = True,
    flow: float = 4e-5,
) -> Path:
    """A fit of two sensors whose residuals alternate between + and - `error`, m, of readings that vary with `level`."""
    time = np.arange(float(SAMPLES))
    read = level + 0.01 * np.sin(time)[:, None] * np.ones(2)
    model = read - error * np.where(np.arange(SAMPLES) % 2, 1.0, -1.0)[:, None]
    with RunLog(path, "train", config_text="plant: three_tank\n", config=config or {}, env={}, git={}) as log:
        log.recording(time, np.full((SAMPLES, 1), flow), read, ("Q1",), ("h1", "h2"), ("m^3/s",), ("m", "m"))
        log.result_arrays(predicted=model)
        log.result({"explained": explained})
    return path


def sentences(*logs: Path) -> list[str]:
    return comparison_headline(compare(logs), [gather(read_run(log)) for log in logs])


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


def test_runs_of_different_recordings_are_not_ranked(tmp_path: Path) -> None:
    a, b = write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, level=0.2)
    verdicts, differ = sentences(a, b)
    assert verdicts.startswith("a: ") and verdicts.endswith(
        "They read different recordings, so their residuals do not rank them."
    )
    assert differ == "They differ in the recording (simulated: other readings)."


def test_settings_are_told_in_words(tmp_path: Path) -> None:
    ours = {"plant.effects": [{"effect": "leak", "location": "T1"}], "seed": 1, "step": None, "sha256": "abc"}
    a = write_fit(tmp_path / "a.mcap", 0.001, config={"seed": 2})
    b = write_fit(tmp_path / "b.mcap", 0.001, config=ours)
    assert setting_differences(compare([a, b])) == {"seed": ("2", "1"), "plant.effects": ("none", "leak at T1")}
    assert sentences(a, b)[-1] == "They differ in seed (2; 1) and plant.effects (none; leak at T1)."
    assert plain_text('[{"name":"T1.leak","low":null}]') == "T1.leak" and plain_text("[broken") == "[broken"


def test_every_difference_that_is_not_listed_is_counted(tmp_path: Path) -> None:
    a = write_fit(tmp_path / "a.mcap", 0.001, config={f"key{k}": 1 for k in range(9)})
    b = write_fit(tmp_path / "b.mcap", 0.001, level=0.2, config={f"key{k}": 2 for k in range(9)})
    listed = "the recording (simulated: other readings), key0 (1; 2), key1 (1; 2), key2 (1; 2)"
    assert sentences(a, b)[-1] == f"They differ in {listed} and 6 more."


def test_settings_that_differ_by_rounding_do_not_differ(tmp_path: Path) -> None:
    percent = write_fit(tmp_path / "a.mcap", 0.001, config={"confidence": 95 * 0.01, "duration": 1000.0})
    share = write_fit(tmp_path / "b.mcap", 0.001, config={"confidence": 0.95, "duration": 600.5})
    assert setting_differences(compare([percent, share])) == {"duration": ("1000", "600.5")}


def test_terminal_and_page_lead_with_the_headline(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [write_fit(tmp_path / "a.mcap", 0.004), write_fit(tmp_path / "b.mcap", 0.001, config={"seed": 3})]
    assert cli.main(["compare", *map(str, logs)]) == cli.DONE
    said = capsys.readouterr().out
    assert said.startswith("b explains the recording best") and "sha256" not in said
    page = report(logs).page.read_text()
    assert page.index("b explains the recording best") < page.index("<svg")
