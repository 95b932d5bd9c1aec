"""Recordings in Parquet, Feather, Excel, MATLAB and HDF5 files give the result or error of the equivalent CSV file."""

from __future__ import annotations

import math
import sys
import zipfile
from collections.abc import Callable
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch

from fdi_torch import cli
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.recording import Recording
from fdi_torch.recordings import arrow, table_files
from fdi_torch.recordings.csv_files import read_csv
from fdi_torch.recordings.source import ChannelSource

Columns = dict[str, list[Any]]
CHANNELS = (["Q1"], ["h1"])


def as_csv(path: Path, columns: Columns) -> None:
    rows = zip(*columns.values(), strict=True)
    cells = (["" if v is None else str(v) for v in row] for row in rows)
    path.write_text("\n".join([",".join(columns), *(",".join(row) for row in cells)]) + "\n")


def as_parquet(path: Path, columns: Columns) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns), path)


def as_feather(path: Path, columns: Columns) -> None:
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    feather.write_feather(pyarrow.table(columns), path, compression="zstd")


def as_excel(path: Path, columns: Columns) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    pytest.importorskip("defusedxml")
    book = openpyxl.Workbook()
    book.active.append(list(columns))
    for row in zip(*columns.values(), strict=True):
        book.active.append([v.replace(tzinfo=None) if isinstance(v, datetime) else v for v in row])
    other = book.create_sheet("second run")
    other.append(["t_s", "Q1_cm3_s", "h1_cm"])
    for t in range(3):
        other.append([t, 10, 20 + t])
    book.save(path)


def as_matlab(path: Path, columns: Columns) -> None:
    numbers = {name: np.array([math.nan if v is None else v for v in column]) for name, column in columns.items()}
    scipy.io.savemat(path, {**numbers, "note": "run 7", "one": 3.0}, do_compression=True)


def as_hdf5(path: Path, columns: Columns) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        run = file.create_group("run")
        for name, column in columns.items():
            run[name] = np.array([math.nan if v is None else v for v in column], dtype=np.float64)
        file["note"] = "run 7"
        file["one"] = 3.0


FORMATS: dict[str, Callable[[Path, Columns], None]] = {
    "parquet": as_parquet,
    "feather": as_feather,
    "xlsx": as_excel,
    "mat": as_matlab,
    "h5": as_hdf5,
}
NUMBERS: Columns = {
    "t_s": [0.0, 0.1, 0.3, 1e3],
    "Q1_cm3_s": [50.0, 50.25, 49.9, 0.7],
    "h1_cm": [10.12345678901234, None, -0.5, 12.0],
}


def test_each_format_has_a_writer_here(tmp_path: Path) -> None:
    modules = set()
    for ending, write in FORMATS.items():
        write(path := tmp_path / f"run.{ending}", NUMBERS)
        known = table_files.format_of(path.read_bytes()[:16])
        assert known
        modules.add(known.module)
    assert modules == {known.module for known in table_files.FORMATS}


@pytest.mark.parametrize("ending", FORMATS)
def test_the_same_table_is_the_same_recording(ending: str, tmp_path: Path) -> None:
    paths = tmp_path / "run.csv", tmp_path / f"run.{ending}"
    as_csv(paths[0], NUMBERS)
    FORMATS[ending](paths[1], NUMBERS)
    wanted, found = (read_csv(path, *CHANNELS) for path in paths)
    assert torch.equal(found.time, wanted.time) and torch.equal(found.inputs, wanted.inputs)
    assert torch.equal(found.mask, wanted.mask) and torch.equal(found.outputs[found.mask], wanted.outputs[wanted.mask])
    assert found.sha256 != wanted.sha256 and found.source == str(paths[1])


@pytest.mark.parametrize("ending", FORMATS)
def test_what_is_wrong_is_said_as_of_csv(ending: str, tmp_path: Path) -> None:
    paths = tmp_path / "run.csv", tmp_path / f"run.{ending}"
    for wrong in ({"h1_cm": "level_cm"}, {"h1_cm": "h1"}, {"t_s": "moment_s"}):
        columns = {wrong.get(name, name): column for name, column in sorted(NUMBERS.items())}
        as_csv(paths[0], columns)
        FORMATS[ending](paths[1], columns)
        told = []
        for path in paths:
            with pytest.raises(ValueError) as error:
                read_csv(path, *CHANNELS)
            told.append(str(error.value).replace(str(path), "FILE").split(", got ")[0])
        assert told[0] == told[1]


@pytest.mark.parametrize("ending", ["parquet", "feather", "xlsx"])
def test_stamps_and_words_mean_what_they_mean_in_csv(ending: str, tmp_path: Path) -> None:
    first = datetime(2026, 3, 29, 8, 30, tzinfo=UTC)
    times = [first + timedelta(seconds=s) for s in (0, 0.25, 1, 2)]
    columns: Columns = {"time": times, "Q1_cm3_s": [50.0, 50.0, 51.0, 52.0], "h1_cm": ["10", "Bad", "#DIV/0!", "12,5"]}
    path = tmp_path / f"run.{ending}"
    FORMATS[ending](path, columns)
    found = read_csv(path, *CHANNELS)
    assert found.time.tolist() == [0.0, 0.25, 1.0, 2.0] and found.began == first.timestamp()
    assert found.mask[:, 0].tolist() == [True, False, False, True] and float(found.outputs[3, 0]) == 0.125
    FORMATS[ending](path, columns | {"h1_cm": ["10", "eleven", "11", "12"]})
    with pytest.raises(ValueError, match="row 3, column h1_cm: expected a number or an empty cell, got 'eleven'"):
        read_csv(path, *CHANNELS)


def test_columns_of_other_kinds_are_no_hindrance_where_they_are_not_asked_for(tmp_path: Path) -> None:
    columns = NUMBERS | {"tags": [[1, 2], [], None, [3]]}
    as_parquet(tmp_path / "run.parquet", columns)
    assert len(read_csv(tmp_path / "run.parquet", *CHANNELS)) == 4
    with pytest.raises(ValueError, match=r"row 2, column tags: expected a number or an empty cell, got '\(list"):
        read_csv(tmp_path / "run.parquet", ["Q1"], ["h1"], {"h1": ChannelSource("tags", "cm")})


def test_a_value_that_is_no_number_is_an_empty_cell(tmp_path: Path) -> None:
    """So that a command stands where nothing was logged."""
    as_matlab(tmp_path / "run.mat", NUMBERS | {"Q1_cm3_s": [50.0, None, None, 60.0]})
    found = read_csv(tmp_path / "run.mat", *CHANNELS, {"Q1": ChannelSource(held=math.inf)})
    assert found.inputs[:, 0].tolist() == pytest.approx([50e-6, 50e-6, 50e-6, 60e-6])


def test_a_sheet_is_chosen_and_blank_rows_and_units_below_names_are_known(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    path = tmp_path / "run.xlsx"
    as_excel(path, NUMBERS)
    plant = load_plant("cascaded_tanks")
    levels = {sensor.column: {"column": "h1_cm", "unit": sensor.unit} for sensor in plant.sensors}
    columns = {"u_pump": {"column": "Q1_cm3_s", "unit": "V"}, **levels}
    config = {"file": str(path), "sheet": "second run", "columns": columns}
    assert len(read_recording(RecordingConfig.model_validate(config), plant)) == 3
    with pytest.raises(ConfigError, match=r"sheet: expected a sheet .*got 'second'; the nearest is 'second run'"):
        read_recording(RecordingConfig.model_validate(config | {"sheet": "second"}), plant)
    book = openpyxl.Workbook()
    for row in ([], ["# run 7"], ["t", "Q1", "h1", None], ["s", "cm3_s", "mm"], [0, 50, 100], [], [1, 50, 101.5]):
        book.active.append(row)
    book.save(path)
    assert read_csv(path, *CHANNELS).outputs[:, 0].tolist() == [0.1, 0.1015]


def test_dates_beside_times_of_day_in_a_sheet_are_its_clock(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Date", "Time", "Q1 [cm3/s]", "h1 [mm]"])
    for second in (0, 5):
        book.active.append([date(2026, 3, 29), time(8, 30, second), 50, 100])
    book.save(tmp_path / "run.xlsx")
    assert read_csv(tmp_path / "run.xlsx", *CHANNELS).time.tolist() == [0.0, 5.0]


def test_rows_beyond_the_size_that_a_sheet_claims_are_read(tmp_path: Path) -> None:
    """Programs that write a sheet row by row leave its size at a single cell."""
    as_excel(tmp_path / "whole.xlsx", NUMBERS)
    path = tmp_path / "run.xlsx"
    with zipfile.ZipFile(tmp_path / "whole.xlsx") as whole, zipfile.ZipFile(path, "w") as claimed:
        for name in whole.namelist():
            text = whole.read(name)
            assert name != "xl/worksheets/sheet1.xml" or b'<dimension ref="A1:C5"' in text
            claimed.writestr(name, text.replace(b'<dimension ref="A1:C5"', b'<dimension ref="A1:A1"'))
    assert len(read_csv(path, *CHANNELS)) == 4


def test_columns_of_a_matrix_go_by_number(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"run": np.array([[0.0, 50.0, 10.0], [1.0, 51.0, 11.0], [2.0, 52.0, 12.0]])})
    sources = {
        "t": ChannelSource("run:1", "s"),
        "Q1": ChannelSource("run:2", "cm3_s"),
        "h1": ChannelSource("run:3", "cm"),
    }
    assert read_csv(path, *CHANNELS, sources).outputs[:, 0].tolist() == pytest.approx([0.1, 0.11, 0.12])


def test_a_laboratory_s_file_without_a_header_with_two_commands_to_add(tmp_path: Path) -> None:
    """Tabs, decimal commas, columns by number, a pump's command in two columns."""
    path = tmp_path / "run.txt"
    path.write_text("".join(f"{t},5\t2{t % 3},25\t10,5\t4{t % 7},0\t30,0\t35,0\n" for t in range(20)))
    columns: dict[str, Any] = {
        "t": {"column": 1, "unit": "s"},
        "Q1": {"column": 2, "unit": "cm^3/s", "plus": [3]},
        "Q2": {"column": 3, "unit": "cm^3/s"},
        **{f"h{k}": {"column": 3 + k, "unit": "cm"} for k in (1, 2, 3)},
    }
    plant = load_plant("three_tank")
    config = {"file": str(path), "header": False, "columns": columns}
    found = read_recording(RecordingConfig.model_validate(config), plant)
    assert len(found) == 20 and found.time[:2].tolist() == [0.5, 1.5]
    assert found.inputs[1].tolist() == pytest.approx([31.75e-6, 10.5e-6]) and float(
        found.outputs[1, 0]
    ) == pytest.approx(0.41)
    clock_alone = config | {"columns": {"t": columns["t"]}}
    with pytest.raises(ConfigError, match=r"expected a column for Q1 .*got 1, 2, 3"):
        read_recording(RecordingConfig.model_validate(clock_alone), plant)


def test_a_file_without_a_column_of_time_is_read_by_the_time_between_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "run.txt"
    path.write_text("".join(f"2{k % 3},25\t10,5\t4{k % 7},0\t30,0\t35,0\n" for k in range(20)))
    columns: dict[str, Any] = {
        "t": {"period": "50 ms", "shift": "2 s"},
        **{f"Q{k}": {"column": k, "unit": "cm^3/s"} for k in (1, 2)},
        **{f"h{k}": {"column": 2 + k, "unit": "cm"} for k in (1, 2, 3)},
    }
    config, plant = {"file": str(path), "header": False}, load_plant("three_tank")

    def read(**clock: Any) -> Recording:
        every = config | {"columns": columns | ({"t": clock} if clock else {})}
        return read_recording(RecordingConfig.model_validate(every), plant)

    found = read()
    assert found.time.tolist() == pytest.approx([2.0 + 0.05 * k for k in range(20)])
    assert found.inputs[1].tolist() == pytest.approx([21.25e-6, 10.5e-6])
    assert found.outputs[1].tolist() == pytest.approx([0.41, 0.30, 0.35])
    with pytest.raises(ValueError, match=r"greater than 0"):
        read(period="0 s")
    with pytest.raises(ConfigError, match=r"t: expected a period or a column, got period and column, unit"):
        read(period="1 s", column=1, unit="s")
    with pytest.raises(ConfigError, match=r"expected a column for t .* or give the time between its rows: .*period"):
        read(column="seconds")


def test_a_period_needs_a_table_with_one_row_per_instant(tmp_path: Path) -> None:
    plant = load_plant("three_tank")
    (tmp_path / "tags.csv").write_text("Tag,Value\nLT1,3\nLT1,4\n")
    tagged = {"file": str(tmp_path / "tags.csv"), "tags": {"tag": "Tag", "value": "Value"}}
    for config in (tagged, {"file": str(tmp_path / "run.mcap")}):
        (tmp_path / "run.mcap").write_bytes(b"")
        config = RecordingConfig.model_validate(config | {"columns": {"t": {"period": "1 s"}}})
        with pytest.raises(ConfigError, match="one row per instant"):
            read_recording(config, plant)


def test_commands_are_added_each_by_its_own_unit_and_unknown_where_one_is(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t_s,a [l/min],b_cm3_s,h1_cm\n0,6,10,1\n1,,10,1\n2,6,20,1\n")
    found = read_csv(path, *CHANNELS, {"Q1": ChannelSource("a", plus=("b",))})
    assert found.inputs[:, 0].tolist() == pytest.approx([110e-6, math.nan, 120e-6], nan_ok=True)
    with pytest.raises(ValueError, match=r"expected a column for Q1 .*; the nearest is 'b_cm3_s'"):
        read_csv(path, *CHANNELS, {"Q1": ChannelSource("a", plus=("b_cm3",))})
    path.write_text("t_s,a_cm,b_cm3_s,h1_cm\n0,6,10,1\n1,6,10,1\n")
    with pytest.raises(ValueError, match=r"column b_cm3_s: expected a unit that converts to m, got 'cm3_s'"):
        read_csv(path, *CHANNELS, {"Q1": ChannelSource("a", plus=("b",))})


def test_from_a_workbook_to_a_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = [float(t) for t in range(30)]
    columns: Columns = {"t_s": times, "Q1_cm3_s": [50.0 + t % 7 for t in times], "Q2_cm3_s": [50.0] * 30}
    columns |= {f"h{k}_cm": [40.0 + (t * k) % 5 for t in times] for k in (1, 2, 3)}
    as_excel(tmp_path / "run.xlsx", columns)
    assert cli.main(["check", str(tmp_path / "run.xlsx"), "--plant", "three_tank"]) == cli.DONE
    assert "30 samples, 29 s, one every 1 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("ending", "library", "extra"),
    [
        ("parquet", "pyarrow", "parquet"),
        ("feather", "pyarrow", "parquet"),
        ("xlsx", "openpyxl", "excel"),
        ("h5", "h5py", "hdf5"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    ending: str, library: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"run.{ending}"
    FORMATS[ending](path, NUMBERS)
    monkeypatch.setitem(sys.modules, library, None)
    told = rf"expected the library {library}, got none; pip install 'fdi_torch\[{extra}\]'"
    with pytest.raises(ValueError, match=told):
        read_csv(path, *CHANNELS)


@pytest.mark.parametrize("ending", FORMATS)
def test_damaged_files_are_refused_in_a_sentence(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"run.{ending}"
    FORMATS[ending](path, NUMBERS)
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    for k in range(60):
        data = bytearray(whole[: int(rng.integers(16, len(whole)))] if k % 2 else whole)
        for place in rng.integers(8, len(data), 6):
            data[place] = rng.integers(0, 256)
        path.write_bytes(bytes(data))
        try:
            read_csv(path, *CHANNELS)
        except ValueError as error:
            assert str(path) in str(error)


def test_claims_beyond_the_file_s_size_are_refused_before_they_are_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "big.h5", "w") as file:
        file.create_dataset("t_s", shape=(10**11,), dtype="f8", chunks=(1 << 16,), compression="gzip")
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    zeros = pyarrow.array(np.zeros(4_000_000))
    parquet.write_table(pyarrow.table({"t_s": zeros, "h1_cm": zeros}), tmp_path / "big.parquet", compression="zstd")
    as_feather(tmp_path / "big.feather", {"t_s": zeros, "h1_cm": zeros})
    scipy.io.savemat(tmp_path / "big.mat", {"t_s": np.zeros(4_000_000)}, do_compression=True)
    with zipfile.ZipFile(tmp_path / "big.xlsx", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", "<a/>")
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * 40_000_000)
    for name in ("big.h5", "big.parquet", "big.feather", "big.mat", "big.xlsx"):
        with pytest.raises(ValueError, match=rf"{name}: expected at most .* bytes once unpacked"):
            read_csv(tmp_path / name, *CHANNELS)


def test_texts_in_parquet_that_unpack_to_too_much_are_refused_before_they_are_read(tmp_path: Path) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    note = pyarrow.array(["a" * 40_000_000, "b"])
    table = pyarrow.table({"t_s": [0.0, 1.0], "h1_cm": [1.0, 2.0], "note": note})
    parquet.write_table(table, tmp_path / "text.parquet", compression="zstd", use_dictionary=False)
    with pytest.raises(ValueError, match=r"text\.parquet: expected at most .* bytes once unpacked"):
        read_csv(tmp_path / "text.parquet", *CHANNELS)


def test_bytes_and_lists_in_parquet_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {"t_s": [0.0, 1.0], "picture": [b"a" * 100] * 2, "parts": [[1.0], [2.0]], "h1_cm": [1.0, 2.0]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "mixed.parquet")
    unpacked = set()
    iterate = parquet.ParquetFile.iter_batches

    def spied(self, *args, **options):
        for batch in iterate(self, *args, **options):
            unpacked.update(batch.schema.names)
            yield batch

    monkeypatch.setattr(parquet.ParquetFile, "iter_batches", spied)
    rows = list(arrow.rows(tmp_path / "mixed.parquet", None))
    assert rows[0] == list(columns)
    assert rows[1:] == [
        (0.0, "(binary)", "(list<element: double>)", 1.0),
        (1.0, "(binary)", "(list<element: double>)", 2.0),
    ]
    assert unpacked == {"t_s", "h1_cm"}


def test_a_sheet_with_a_cell_far_away_is_not_spelled_out(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    pytest.importorskip("defusedxml")
    book = openpyxl.Workbook()
    book.active.append(["t_s", "Q1_cm3_s", "h1_cm"])
    book.active.cell(1_000_000, 16_000, 1.0)
    book.save(tmp_path / "run.xlsx")
    with pytest.raises(ValueError, match="row 1000000: expected 3 cells as in the header, got 16000"):
        read_csv(tmp_path / "run.xlsx", *CHANNELS)


def test_datasets_that_lie_in_other_files_are_not_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.arange(4.0).tobytes())
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("h1_cm", shape=(4,), dtype="f8", external=[(str(secret), 0, 32)])
        file["t_s"] = np.arange(4.0)
        file["Q1_cm3_s"] = np.arange(4.0)
        file["far_cm"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/x")
    with pytest.raises(ValueError, match=r"expected a column for h1 .* got Q1_cm3_s, t_s"):
        read_csv(tmp_path / "run.h5", *CHANNELS)


def test_an_archive_that_is_no_workbook_is_told(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.writestr("run.csv", "t_s,h1_cm")
    with pytest.raises(ValueError, match="got another zip archive; unpack it"):
        read_csv(tmp_path / "run.zip", *CHANNELS)
