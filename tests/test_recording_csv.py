"""CSV recordings: units, mapping, missing cells, and one sentence for each kind of error."""

from __future__ import annotations

import gzip
import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv
from fdi_torch.recordings.csv_text import header_unit
from fdi_torch.recordings.source import ChannelSource

GOOD = "t_s,Q1_cm3_s,h1_cm\n0,50,10\n1,50,11\n2,60,12\n"


def write(folder: Path, text: str, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def read(folder: Path, text: str, **mapping: ChannelSource) -> Recording:
    return read_csv(write(folder, text), ["Q1"], ["h1"], mapping)


def test_a_header_with_units_needs_no_mapping(tmp_path: Path) -> None:
    recording = read(tmp_path, GOOD)
    assert recording.time.tolist() == [0.0, 1.0, 2.0]
    torch.testing.assert_close(recording.inputs[:, 0], torch.tensor([50e-6, 50e-6, 60e-6], dtype=torch.float64))
    torch.testing.assert_close(recording.outputs[:, 0], torch.tensor([0.10, 0.11, 0.12], dtype=torch.float64))
    assert (recording.input_units, recording.output_units) == (("m^3/s",), ("m",))


@pytest.mark.parametrize(
    ("header", "name", "unit", "factor"),
    [
        ("h1 [mm]", "h1", "m", 1e-3),
        ("Level left (cm)", "Level left", "m", 1e-2),
        ("F3_gph", "F3", "m^3/s", 3.785411784e-3 / 3600),
        ("F_gpm", "F", "m^3/s", 3.785411784e-3 / 60),
        ("F_L_min", "F", "m^3/s", 1e-3 / 60),
        ("F [m3/h]", "F", "m^3/s", 1 / 3600),
        ("F_m3_h", "F", "m^3/s", 1 / 3600),
        ("L1_psi", "L1", "Pa", 6894.757293168361),
        ("L3_mbar", "L3", "Pa", 100.0),
        ("L_inch", "L", "m", 0.0254),
        ("y [mA]", "y", "A", 1e-3),
        ("pump_Hz", "pump", "1/s", 1.0),
        ("tank_A_cm", "tank_A", "m", 1e-2),
    ],
)
def test_headers_as_loggers_write_them(header: str, name: str, unit: str, factor: float) -> None:
    found = header_unit(header)
    assert found is not None and found[0] == name
    assert (si_unit_of(found[1]), unit_factor(found[1], unit)) == (unit, pytest.approx(factor))


@pytest.mark.parametrize("header", ["tank_A", "F3_xyz", "h1", "Level (left)"])
def test_a_header_may_have_no_unit(header: str) -> None:
    assert header_unit(header) is None


def test_sha256_is_that_of_the_file(tmp_path: Path) -> None:
    assert read(tmp_path, GOOD).sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


def test_compressed_equals_plain(tmp_path: Path) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(GOOD.encode()))
    assert torch.equal(read_csv(path, ["Q1"], ["h1"]).outputs, read(tmp_path, GOOD).outputs)


def test_time_in_minutes_millimetres_and_other_names_by_mapping(tmp_path: Path) -> None:
    text = "clock;flow;level left\n0;6;100\n0.5;6;110\n"
    recording = read(
        tmp_path,
        text,
        t=ChannelSource("clock", "minute"),
        Q1=ChannelSource("flow", "l/minute"),
        h1=ChannelSource("level left", "mm"),
    )
    assert recording.time.tolist() == [0.0, 30.0]
    assert recording.inputs[0, 0].item() == pytest.approx(1e-4)
    assert recording.outputs[:, 0].tolist() == pytest.approx([0.1, 0.11])


def test_a_constant_stands_in_for_a_column_never_recorded(tmp_path: Path) -> None:
    recording = read(tmp_path, GOOD, Q1=ChannelSource(constant=2e-5, unit="m^3/s"))
    assert recording.inputs[:, 0].tolist() == [2e-5] * 3


def test_missing_readings_are_masked_and_missing_commands_unknown(tmp_path: Path) -> None:
    recording = read(tmp_path, "t_s,Q1_cm3_s,h1_cm\n0,50,\n1,,11\n2,60,nan\n3,60,inf\n4,60,12\n")
    assert recording.mask.flatten().tolist() == [False, True, False, False, True]
    assert torch.isnan(recording.inputs.flatten()).tolist() == [False, True, False, False, False]


def test_blank_lines_comments_and_quotes_are_passed_over(tmp_path: Path) -> None:
    text = '# a rig\n"t_s","Q1_cm3_s","h1_cm"\n0,50,10\n\n"1",50,11\n'
    assert read(tmp_path, text).outputs.flatten().tolist() == pytest.approx([0.10, 0.11])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "run.csv: expected a header line .* got an empty file"),
        ("t_s,Q1_cm3_s,h1_cm\n", "run.csv: expected at least two rows of numbers, got 0"),
        ("t_s,Q1_cm3_s,h_cm\n0,1,2\n", r"expected a column for h1 .* the nearest is 'h_cm'; map it under columns"),
        ("Q1_cm3_s,h1_cm\n0,1\n", r"expected a column for t \('t' or 't_UNIT'\), got Q1_cm3_s, h1_cm"),
        ("t_s,Q1_cm3_s,h1\n0,1,2\n", "column h1: expected a header of the form name_unit"),
        (GOOD + "3,fifty,13\n", "run.csv: row 5, column Q1_cm3_s: expected a number or an empty cell, got 'fifty'"),
        (GOOD + "3,50\n", "run.csv: row 5: expected 3 cells as in the header, got 2"),
        (GOOD + ",50,13\n", "run.csv: row 5, column t_s: expected a time in every row, got none"),
        (GOOD + "2,50,13\n", r"run.csv: row 5, column t_s: expected time that increases, got 2 s after 2 s \(1 such"),
        (GOOD + "1.5,50,13\n", "run.csv: row 5, column t_s: expected time that increases, got 1.5 s after 2 s"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_row_and_column(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read(tmp_path, text)


def test_a_mapped_unit_that_contradicts_the_header_is_used_and_reported(tmp_path: Path) -> None:
    recording = read(tmp_path, GOOD, h1=ChannelSource("h1_cm", "mm"))
    assert recording.notes == ("run.csv: h1_cm: read in mm as mapped, although its header says cm",)
    assert recording.outputs[0, 0] == pytest.approx(0.1 * float(read(tmp_path, GOOD).outputs[0, 0]))
    assert read(tmp_path, GOOD, h1=ChannelSource("h1_cm", "cm")).notes == ()


def test_a_unit_of_the_wrong_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"run.csv: column h1_cm: expected a unit of level.*got 'kg'"):
        read(tmp_path, GOOD, h1=ChannelSource("h1_cm", "kg"))
    with pytest.raises(ValueError, match=r"run.csv: column h1_cm: expected a unit that converts to s, got 'cm'"):
        read(tmp_path, GOOD, t=ChannelSource("h1_cm"))


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"gone.csv: file not found"):
        read_csv(tmp_path / "gone.csv", ["Q1"], ["h1"])


def test_something_else_than_csv(tmp_path: Path) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_text(GOOD)
    with pytest.raises(ValueError, match=r"expected a CSV file \(plain or .gz\), got something else"):
        read_csv(path, ["Q1"], ["h1"])
    whole = gzip.compress(GOOD.encode() * 1000)
    path.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match="expected a whole CSV file, got one that is cut off"):
        read_csv(path, ["Q1"], ["h1"])


# Read the files given; print the length of the last and by how much it raised the peak memory, in bytes. A process of
# its own: in one that had needed more before, the peak would not rise.
MEMORY_OF_READING = """
import resource, sys
from pathlib import Path
from fdi_torch.recordings.csv_files import read_csv

for file in sys.argv[1:]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    samples = len(read_csv(Path(file), ["Q1"], ["h1"]))
print(samples, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.slow
def test_a_million_samples_cost_a_few_copies_of_their_numbers(tmp_path: Path) -> None:
    samples = 1_000_000
    path = tmp_path / "long.csv"
    numbers = np.random.default_rng(0).uniform(0, 90, (samples, 3))
    numbers[:, 0] = np.arange(samples)
    np.savetxt(path, numbers, fmt="%.3f", delimiter=",", header="t_s,Q1_cm3_s,h1_cm", comments="")
    short = tmp_path / "short.csv"
    short.write_text("".join(path.read_text().splitlines(keepends=True)[:1000]))
    printed = subprocess.run(
        [sys.executable, "-c", MEMORY_OF_READING, short, path], capture_output=True, text=True, check=True
    ).stdout
    read, grown = map(int, printed.split())
    assert read == samples and grown < 6 * numbers.nbytes
