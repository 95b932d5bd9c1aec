"""CSV files of loggers, spreadsheets and historians: each is read, or refused in a sentence with a remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv, read_csv_files
from fdi_torch.recordings.csv_growing import GrowingCsv
from fdi_torch.recordings.source import ChannelSource, ClockSource, FileSource

PLAIN = "t_s,Q1_cm3_s,h1_cm\n0,50.5,10\n5,50.5,11\n10,20,12.5\n"
DATED = "Datum;Uhrzeit;Q1_cm3_s;h1_cm\n{};08:30:00;50,5;10\n{};08:30:05;50,5;11\n{};08:30:10;20;12,5\n"
STAMPED = "time;Q1_cm3_s;h1_cm\n{};50,5;10\n{};50,5;11\n{};20;12,5\n"


def read(folder: Path, text: str | bytes, encoding: str = "utf-8", **mapping: ChannelSource) -> Recording:
    path = folder / "run.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return read_csv(path, ["Q1"], ["h1"], mapping)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (PLAIN, "utf-8-sig"),
        (PLAIN, "utf-16"),
        ("# Zulauf für Behälter 1\n" + PLAIN, "cp1252"),
        (PLAIN.replace(",", "\t"), "utf-8"),
        (PLAIN.replace("\n", "\r\n"), "utf-8"),
        (PLAIN.replace(",", ";").replace(".", ","), "utf-8"),
        ("sep=;\n" + PLAIN.replace(",", ";"), "utf-8"),
        (PLAIN.replace("t_s,Q1_cm3_s,h1_cm", "t,Q1,h1\ns,cm3/s,cm"), "utf-8"),
        (PLAIN.replace("t_s,Q1_cm3_s,h1_cm", "Zeit in s,Q1 in cm3/s,h1 / cm"), "utf-8"),
        (PLAIN.replace("t_s,Q1_cm3_s,h1_cm", "t / s,Q1 / cm³/s,h1 in cm"), "utf-8"),
        ("Logger 7\nRun 12 of 2026,,\n\n" + PLAIN, "utf-8"),
        (PLAIN.replace("t_s,Q1_cm3_s,h1_cm", "n,Time [s],Q1 (cm3/s),h1 [cm]").replace("\n", "\n1,")[:-2], "utf-8"),
        ("time_ms,Q1_cm3_s,h1_cm\n1790000000500,50.5,10\n1790000005500,50.5,11\n1790000010500,20,12.5\n", "utf-8"),
        (STAMPED.format("2026-03-29 00:30:00", "2026-03-29 00:30:05", "2026-03-29T00:30:10.000"), "utf-8"),
        ("Datum/Uhrzeit" + STAMPED[4:].format("29.3.2026 8:30:00", "29.3.2026 8:30:05", "29.3.2026 8:30:10"), "utf-8"),
        (DATED.format("29.03.2026", "29.03.2026", "29.03.2026"), "utf-8"),
        (DATED.format('"2026-03-29 00:00:00"', "2026-03-29", "2026-03-29T00:00:00"), "utf-8"),
        (STAMPED.format("2026-03-29T00:59:55Z", "2026-03-29T03:00:00+02:00", "2026-03-29 03:00:05+0200"), "utf-8"),
    ],
)
def test_each_says_the_same(tmp_path: Path, text: str, encoding: str) -> None:
    recording = read(tmp_path, text, encoding)
    torch.testing.assert_close(recording.time, torch.tensor([0.0, 5.0, 10.0], dtype=torch.float64), rtol=0, atol=0)
    torch.testing.assert_close(recording.inputs[:, 0], torch.tensor([50.5e-6, 50.5e-6, 20e-6], dtype=torch.float64))
    torch.testing.assert_close(recording.outputs[:, 0], torch.tensor([0.10, 0.11, 0.125], dtype=torch.float64))


def test_windows_letters_far_from_the_beginning_are_read(tmp_path: Path) -> None:
    rows = [f"{k},50,10,{'x' * 60}" for k in range(2000)]
    text = "\n".join(["t_s,Q1_cm3_s,h1_cm,Bemerkung µ", *rows, "2000,50,11,geöffnet 20 °C", "2001,50,12,"])
    plain = read(tmp_path, text)
    for late in (text.replace("µ", "u"), text):
        recording = read(tmp_path, late, "cp1252")
        assert torch.equal(recording.outputs, plain.outputs) and recording.notes == ()
    growing = GrowingCsv(tmp_path / "run.csv", ["Q1"], ["h1"])
    assert growing.new()[2][-1].tolist() == [0.11]  # the last line is not complete yet


def test_as_many_commas_in_the_names_as_semicolons_separate_no_columns(tmp_path: Path) -> None:
    text = "Zeit_s;Q, soll [cm3/s];h, ist [cm]\n0;50,5;10\n5;50,5;11\n"
    mapping = {"Q1": ChannelSource("Q, soll"), "h1": ChannelSource("h, ist")}
    assert read(tmp_path, text, **mapping).inputs[:, 0].tolist() == pytest.approx([50.5e-6, 50.5e-6])


@pytest.mark.parametrize("word", ["#N/A", "#DIV/0!", "Bad Input", "NaN", ""])
def test_words_for_nothing_read_are_missing_readings(tmp_path: Path, word: str) -> None:
    assert read(tmp_path, PLAIN.replace("12.5", word)).mask.flatten().tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (PLAIN.replace("50.5", '"50,5"'), "got '50,5'; write it with a point"),
        (PLAIN.replace("t_s", "t"), r"row 2, column t: expected a time stamp, got the number 0; .* t: \{unit: ms\}"),
        (
            PLAIN.replace("t_s", "t").replace("\n0,", "\n29/03/2026,"),
            r"row 2, column t: expected a time stamp such as .* t: \{stamps: '%d/%m/%Y %H:%M:%S'\}",
        ),
        (
            PLAIN.replace("h1_cm", "h1_cm,h1_mm").replace("\n", ",1\n"),
            "expected one column for h1, got h1_cm and h1_mm",
        ),
        (PLAIN.replace("Q1_cm3_s", "h1_cm"), "expected a column for Q1"),
        (PLAIN.replace(",", "|"), r"expected a header line .* got 't_s\|Q1_cm3_s\|h1_cm'; separate columns by"),
        (
            STAMPED.format("2026-10-25 02:59:55", "2026-10-25 02:00:00", "2026-10-25 02:00:05"),
            r"say in which zone this is: columns: \{t: \{zone: Europe/Berlin\}\}",
        ),
        (b"PK\x03\x04\x00\x00", "expected an Excel workbook that is whole, got one that cannot be read"),
        (b"FEA1\x00\x00", "got a Feather file of version 1; write it as version 2"),
        (b"t_s\x00\x00", "expected a CSV, MCAP, Parquet, .* or HDF5 file, got something that is not text"),
    ],
)
def test_what_cannot_be_read_is_refused_with_a_fix(tmp_path: Path, text: str | bytes, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read(tmp_path, text)


def test_a_column_without_unit_is_asked_for_by_the_channel_s_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"columns: \{h1: \{column: level, unit: \.\.\.\}\}"):
        read(tmp_path, PLAIN.replace("h1_cm", "level"), h1=ChannelSource("level"))


def test_stamps_are_followed_from_the_first_on(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("time,Q1_cm3_s,h1_cm\n2026-03-29T08:00:00Z,50,10\n2026-03-29T08:00:05Z,50,11\n")
    growing = GrowingCsv(path, ["Q1"], ["h1"])
    assert growing.new()[0].tolist() == [0.0, 5.0]
    with path.open("a") as file:
        file.write("2026-03-29T08:01:00.5Z,50,12\nsoon,50,12\n,50,12\n")
    seconds, _, readings, troubles = growing.new()
    assert (seconds.tolist(), readings.tolist()) == ([60.5], [[0.12]])
    [(rows_before, trouble)] = troubles
    assert rows_before == 1 and "row 5, column time: expected a time stamp" in trouble


def test_a_date_beside_a_time_of_day_is_followed_and_takes_a_format(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("Q1_cm3_s,Date,Time,h1_cm\n50,3/29/2026,11:59:59 PM,10\n50,3/30/2026,12:00:00 AM,11\n")
    mapping = {"t": ClockSource(stamps="%m/%d/%Y %I:%M:%S %p")}
    assert read_csv(path, ["Q1"], ["h1"], mapping).time.tolist() == [0.0, 1.0]
    growing = GrowingCsv(path, ["Q1"], ["h1"], mapping)
    assert growing.new()[0].tolist() == [0.0, 1.0]
    with path.open("a") as file:
        file.write("50,3/30/2026,12:01:00 AM,12\n50,3/30/2026\n")
    seconds, _, readings, troubles = growing.new()
    assert (seconds.tolist(), readings.tolist()) == ([61.0], [[0.12]]) and "expected 3 cells" in troubles[0][1]


def test_a_last_line_without_its_last_cell_is_left_out(tmp_path: Path) -> None:
    recording = read(tmp_path, PLAIN + "15,20")
    assert len(recording) == 3 and recording.notes == ("run.csv: the last line is cut off and left out: '15,20'",)


def test_rows_that_share_a_time_are_told_from_rows_in_disorder(tmp_path: Path) -> None:
    stamps = ("2026-03-29 00:30:00", "2026-03-29 00:30:00", "2026-03-29 00:30:01")
    with pytest.raises(ValueError, match=r"1 such row\); keep the last row of each time by .*period: 50 ms"):
        read(tmp_path, STAMPED.replace("10\n", "9\n").format(*stamps))
    with pytest.raises(ValueError, match=r"1 such row\); correct the clock, or let rows be sorted"):
        read(tmp_path, STAMPED.format(*stamps[::2], stamps[1]))


@pytest.mark.parametrize("cell", ["५०.५", "٥٠", "５０", "1_000"])
def test_numbers_have_ascii_digits_and_no_underscores(tmp_path: Path, cell: str) -> None:
    """An empty cell elsewhere sends a file to the slow parser; that must not change what is a number."""
    for other in ("10", ""):
        with pytest.raises(ValueError, match=f"row 2, column Q1_cm3_s: expected a number .* got '{cell}'; .*0 to 9"):
            read(tmp_path, PLAIN.replace("0,50.5,10", f"0,{cell},{other}", 1))


def test_stamps_have_ascii_digits(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="row 2, column time: expected a time stamp"):
        read(tmp_path, STAMPED.format("२९.3.2026 00:30:00", "29.3.2026 00:30:05", "29.3.2026 00:30:10"))


@pytest.mark.parametrize("row", ["0,0\t1,5\t294,17", "0;1.5;2e-3", "2026-11-23 12:00:00,1.5,2"])
def test_a_file_without_a_header_is_told_how_to_be_read(tmp_path: Path, row: str) -> None:
    path = tmp_path / "lab.txt"
    path.write_text(f"{row}\n{row}\n")
    with pytest.raises(ValueError, match=r"row 1: expected a header line .* got numbers; .* write header: false"):
        read_csv(path, ("Q1",), ("h1",))


@pytest.mark.parametrize(
    "above", ["", "t [s] || flow [ml.s^-1] || level [cm]\r\n", "Zeit\tFluss\tStand\n", "Lab\t24.11.2026\n"]
)
def test_titles_above_a_file_without_a_header_are_skipped(tmp_path: Path, above: str) -> None:
    path = tmp_path / "lab.txt"
    path.write_text(above + "0,0E+0\t1,5\t294\n5,0E+0\t1,5\t295\n")
    columns = {"t": ChannelSource("1", "s"), "Q1": ChannelSource("2", "cm^3/s"), "h1": ChannelSource("3", "mm")}
    recording = read_csv_files([FileSource(path, columns, header=False)], ("Q1",), ("h1",))
    assert recording.time.tolist() == [0.0, 5.0]
    assert recording.outputs.flatten().tolist() == pytest.approx([0.294, 0.295])


def test_a_file_of_words_has_no_row_of_numbers(tmp_path: Path) -> None:
    path = tmp_path / "lab.txt"
    path.write_text("idle\nidle\n")
    with pytest.raises(ValueError, match="expected a row of numbers, got 'idle'"):
        read_csv_files([FileSource(path, header=False)], ("Q1",), ("h1",))
