"""Recordings with dates: clock times beside the seconds, in the zone of the file."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fdi_torch.cli import main
from fdi_torch.clock import clock_text, clock_unit, show_clock
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.jobs.report import report
from fdi_torch.quantities import displayed_in
from fdi_torch.report.numbers import estimate_cells

PLANT = """name: rig
tanks: {A: {area: 200 cm^2, height: 60 cm}}
pipes: {drain: {source: A, target: outside, area: 0.5 cm^2, discharge_coefficient: 0.6}}
pumps: {Q: {target: A, max_flow: 6 l/min}}
sensors: {hA: {tank: A}}
"""
RUN = """plant: plant.yaml
simulate:
  inputs: {Q: 3 l/min}
  duration: 900 s
  faults: {A.leak: 0.3, A.leak.onset: 500 s}
  noise: {std: {hA: 1 mm}}
output: {name: run}
"""
BEGAN = datetime(2026, 11, 20, 8, 30)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dated")
    (folder / "plant.yaml").write_text(PLANT)
    (folder / "run.yaml").write_text(RUN)
    assert main(["simulate", "--config", str(folder / "run.yaml"), "--out", str(folder), "--quiet"]) == 0
    header, *rows = (folder / "run.csv").read_text().splitlines()
    for name, offset in (("plain", ""), ("offset", "+01:00")):
        lines = [
            f"{(BEGAN + timedelta(seconds=float(t))).isoformat()}{offset},{rest}"
            for t, _, rest in (row.partition(",") for row in rows)
        ]
        (folder / f"{name}.csv").write_text("\n".join([header.replace("t_s", "time"), *lines]) + "\n")
    return folder


@pytest.mark.parametrize(
    ("file", "columns", "zone"),
    [
        ("plain.csv", {}, 0.0),
        ("offset.csv", {}, 3600.0),
        ("plain.csv", {"t": {"column": "time", "zone": "Europe/Berlin"}}, 3600.0),
    ],
)
def test_the_clock_is_that_of_the_file(folder: Path, file: str, columns: dict[str, object], zone: float) -> None:
    recording = read_recording({"file": file, "columns": columns}, load_plant(folder / "plant.yaml"), folder)
    assert recording.zone == zone
    show_clock([recording.clock_zero])
    assert clock_text(90.4) == "2026-11-20 08:31:30"
    assert clock_unit("s", "onset", 60.0) == "s (2026-11-20 08:31:00)" and clock_unit("s", "ramp", 60.0) == "s"


def test_recordings_of_different_days_and_without_dates_show_seconds_only() -> None:
    for zeros in ([0.0, 86400.0], [None], [], [1e30]):
        show_clock(zeros)
        assert clock_text(1.0) == ""


@pytest.mark.parametrize("follow", [[], ["--follow", "--idle", "0.3 s"]])
def test_events_of_a_monitor_and_its_page_show_the_clock_time(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], follow: list[str]
) -> None:
    watch = "plant: plant.yaml\nrecording: {file: plain.csv}\nfault_free: [0 s, 400 s]\n"
    (folder / "watch.yaml").write_text(watch)
    assert main(["monitor", "--config", str(folder / "watch.yaml"), "--out", str(tmp_path), *follow]) == 0
    events = capsys.readouterr().out.splitlines()
    explained = next(line for line in events if " explained " in line or " isolated " in line)
    seconds = float(explained.split()[0])
    assert f"{BEGAN + timedelta(seconds=round(seconds))}" in explained
    assert "(onset 2026-11-20 08:38:" in explained
    (path,) = tmp_path.glob("*.mcap")
    page = Path(report([path]).page).read_text()
    assert "2026-11-20 08:38:" in page and "after 2026-11-20 08:30:00" in page


def test_a_moment_counts_from_the_first_sample_and_is_in_seconds_whatever_is_displayed() -> None:
    show_clock([BEGAN.replace(tzinfo=UTC).timestamp()], [300.0])
    assert clock_unit("s", "onset", 200.0) == "s (2026-11-20 08:38:20)" and clock_text(500.0) == "2026-11-20 08:38:20"
    with displayed_in({"s": "min"}):
        assert estimate_cells("A.leak.onset", "s", 180.0, 6.0)[:2] == ["min (2026-11-20 08:38:00)", "3.00 ± 0.10"]
    show_clock([None], [300.0])
    assert (clock_unit("s", "onset", 200.0), clock_unit("s", "ramp", 200.0)) == ("s (at 500 s)", "s")
    show_clock([0.0], [0.0, 300.0])
    assert clock_unit("s", "onset", 200.0) == "s"  # two parts of one file, each with its own onset
    show_clock([None])
    assert clock_unit("s", "onset", 200.0) == "s"


def test_the_onset_in_a_part_of_a_recording_has_its_date_on_terminal_and_page(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "part.yaml").write_text(
        "plant: plant.yaml\nrecordings: [{file: offset.csv, start: 300 s}]\n"
        "estimate: {parameters: [A.leak, A.leak.onset], calibrate: [], search: {evaluations: 2000}}\n"
    )
    main(["train", "--config", str(folder / "part.yaml"), "--out", str(tmp_path), "--quiet"])
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("A.leak.onset"))
    assert "s (2026-11-20 08:38:2" in row or "s (2026-11-20 08:38:1" in row
    (path,) = tmp_path.glob("*.mcap")
    assert "(2026-11-20 08:38:" in Path(report([path]).page).read_text()
