"""Plant recordings: channels with different sampling, in one or several files, with clock errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from fdi_torch.config.loaded_recordings import load_recordings, read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import check_recording, data_warnings
from fdi_torch.recordings.csv_growing import GrowingCsv
from fdi_torch.recordings.source import ChannelSource, ClockSource

PLANT = """
tanks: {T: {area: 0.5 m^2, height: 2 m}}
pipes: {OUT: {source: T, target: outside, area: 5 cm^2, discharge_coefficient: 0.6, valve: V}}
pumps: {Q: {target: T, max_flow: 100 l/min}}
sensors: {h: {tank: T}}
"""
PLAIN = "t_s,Q_l_min,V_pct,h_mm\n0,60,50,500\n1,60,50,501\n2,60,50,502\n3,30,50,503\n4,30,80,504\n5,30,80,505\n"
MIXED = "t_s,Q_l_min,V_pct,h_mm\n0,60,50,500\n1,,,501\n2,,,502\n3,30,,503\n4,,80,504\n5,,,505\n"
HELD = {"Q": {"held": "3 s"}, "V": {"held": "always"}}


@pytest.fixture
def plant(tmp_path: Path) -> PlantDescription:
    (tmp_path / "rig.yaml").write_text(PLANT)
    return load_plant(str(tmp_path / "rig.yaml"))


def read(plant: PlantDescription, folder: Path, text: str, **keys: object) -> Recording:
    (folder / "run.csv").write_text(text)
    return read_recording(RecordingConfig.model_validate({"file": "run.csv", **keys}), plant, folder)


def same(a: Recording, b: Recording) -> bool:
    def equal(x: Tensor, y: Tensor) -> bool:
        return torch.equal(torch.nan_to_num(x, nan=-1.0), torch.nan_to_num(y, nan=-1.0))

    return equal(a.time, b.time) and equal(a.inputs, b.inputs) and equal(a.outputs, b.outputs)


def test_a_value_marked_as_bad_ends_the_one_before_it(plant: PlantDescription, tmp_path: Path) -> None:
    """The command is unknown from the bad value to the next good one; an empty cell alone would hold the first."""
    text = "t_s,Q_l_min,ok,V_pct,h_mm\n0,60,192,50,500\n1,90,0,50,501\n2,,192,50,502\n3,30,192,50,503\n"
    found = read(plant, tmp_path, text, columns={"Q": {"column": "Q_l_min", "held": "always", "quality": "ok"}})
    assert torch.isfinite(found.inputs[:, 0]).tolist() == [True, False, False, True]


def test_a_held_input_is_what_a_file_with_every_cell_says(plant: PlantDescription, tmp_path: Path) -> None:
    assert same(read(plant, tmp_path, MIXED, columns=HELD), read(plant, tmp_path, PLAIN))


def test_an_input_stands_no_longer_than_was_said(plant: PlantDescription, tmp_path: Path) -> None:
    short = read(plant, tmp_path, MIXED, columns=HELD | {"Q": {"held": "1 s"}})
    assert torch.isnan(short.inputs[:, 0]).tolist() == [False, False, True, False, False, True]


def test_an_input_is_not_held_over_rows_that_are_missing(plant: PlantDescription, tmp_path: Path) -> None:
    """Nobody knows when the command changed between 2 s and 9 s; the recording is cut there."""
    text = PLAIN.replace("3,30,50,503", "9,30,50,503").replace("4,30,80", "10,30,80").replace("5,30,80", "11,30,80")
    whole = read(plant, tmp_path, text)
    assert len(whole.known_segments()) == 1
    (warning,) = data_warnings(whole, plant)
    assert warning.startswith("Q: changes in the gap after 2 s, at an unknown time")
    assert warning.endswith(
        "unless the recording is cut there: by columns: {Q: {held: 3 s}} if it is recorded "
        "at every sample, by stop and start of two entries if it is recorded on change"
    )
    (tmp_path / "flow.csv").write_text("t_s,Q_l_min\n0,60\n5,30\n11,30\n")
    levels = "\n".join(",".join(cell for k, cell in enumerate(row.split(",")) if k != 1) for row in text.split())
    assert not data_warnings(read(plant, tmp_path, levels, also=["flow.csv"]), plant)  # it says when
    cut = read(plant, tmp_path, text, columns={"Q": {"held": "3 s"}})
    assert [part.time.tolist() for part in cut.known_segments()] == [[0.0, 1.0], [9.0, 10.0, 11.0]]
    assert len(read(plant, tmp_path, text, columns={"Q": {"held": "7 s"}}).known_segments()) == 1


def test_a_bad_value_ends_the_one_before(plant: PlantDescription, tmp_path: Path) -> None:
    recording = read(plant, tmp_path, MIXED.replace("1,,,501", "1,I/O Timeout,,501"), columns=HELD)
    assert torch.isnan(recording.inputs[:, 0]).tolist() == [False, True, True, False, False, False]


def test_under_a_linear_hold_the_line_to_the_next_value_counts(plant: PlantDescription, tmp_path: Path) -> None:
    recording = read(plant, tmp_path, MIXED, columns=HELD, hold="linear")
    torch.testing.assert_close(60e3 * recording.inputs[:4, 0], torch.tensor([60.0, 50.0, 40.0, 30.0]).double())
    assert torch.isnan(recording.inputs[4:, 0]).all()  # no value follows


def test_channels_in_files_of_their_own_are_one_recording(plant: PlantDescription, tmp_path: Path) -> None:
    (tmp_path / "flow.csv").write_text("time;F\n;l/min\n2026-03-29T08:29:23+02:00;60,0\n2026-03-29T08:29:26+02:00;30\n")
    (tmp_path / "valve.csv").write_text("epoch_ms,V (%)\n1774765799000,50\n1774765804000,80\n1774765990000,10\n")
    levels = "Time,h [mm]\n" + "".join(f"2026-03-29T06:30:0{k}.000Z,{500 + k}\n" for k in range(6))
    flow = {"file": "flow.csv", "columns": {"t": {"shift": "37 s"}, "Q": {"column": "F", "held": "3 s"}}}
    valve = {"file": "valve.csv", "columns": {"V": {"held": "always"}}}
    assert same(read(plant, tmp_path, levels, also=[flow, valve]), read(plant, tmp_path, PLAIN))
    late = {"file": "flow.csv", "columns": {"t": {"shift": "2 h"}, "Q": {"column": "F", "held": "3 s"}}}
    with pytest.raises(ConfigError, match=r"flow.csv: expected time in common with .* columns: \{t: \{shift: 37 s\}\}"):
        read(plant, tmp_path, levels, also=[late, valve | {"columns": {"V": {"held": "always"}, "t": {}}}])


def test_an_input_that_moves_between_readings_has_a_row_of_its_own(plant: PlantDescription, tmp_path: Path) -> None:
    (tmp_path / "valve.csv").write_text("t_s,V_pct\n-7,50\n1.5,50\n3.25,80\n4,80\n")
    levels = "t_s,Q_l_min,h_mm\n0,60,500\n3,60,501\n6,30,502\n"
    always = [{"file": "valve.csv", "columns": {"V": {"held": "always"}}}]
    recording = read(plant, tmp_path, levels, also=always)
    assert recording.time.tolist() == [0.0, 3.0, 3.25, 6.0]
    assert (60e3 * recording.inputs[:, 0]).tolist() == pytest.approx([60.0, 60.0, 60.0, 30.0])
    assert recording.inputs[:, 1].tolist() == pytest.approx([0.5, 0.5, 0.8, 0.8])
    assert recording.mask[:, 0].tolist() == [True, True, False, True]
    ended = read(plant, tmp_path, levels, also=["valve.csv"])
    assert torch.isnan(ended.inputs[:, 1]).tolist() == [False, False, False, True]
    linear = read(plant, tmp_path, levels, also=always, hold="linear")
    assert linear.time.tolist() == [0.0, 1.5, 3.0, 3.25, 4.0, 6.0]
    assert (60e3 * linear.inputs[:, 0]).tolist() == pytest.approx([60.0, 60.0, 60.0, 57.5, 50.0, 30.0])
    assert linear.inputs[2, 1].item() == pytest.approx(0.5 + 0.3 * 1.5 / 1.75)


LONG = "Tag,Time,Value,Quality\n" + "".join(
    f"{tag},2026-03-29 08:30:0{k},{value},Good\n"
    for k, tag, value in [(0, "F1", 60), (3, "F1", 30), (0, "GV", 50), (4, "GV", 80)]
    + [(k, "LI", 500 + k) for k in range(6)]
)
TAGS = {"tag": "Tag", "value": "Value", "quality": "Quality"}
LONG_COLUMNS = {
    "Q": {"column": "F1", "unit": "l/min", "held": "3 s"},
    "V": {"column": "GV", "unit": "%", "held": "always"},
    "h": {"column": "LI", "unit": "mm"},
}


def test_a_row_for_each_value(plant: PlantDescription, tmp_path: Path) -> None:
    assert same(read(plant, tmp_path, LONG, tags=TAGS, columns=LONG_COLUMNS), read(plant, tmp_path, PLAIN))
    bad = read(plant, tmp_path, LONG.replace("502,Good", "502,Uncertain"), tags=TAGS, columns=LONG_COLUMNS)
    assert bad.time.tolist() == [0.0, 1.0, 3.0, 4.0, 5.0]
    with pytest.raises(ConfigError, match=r"expected rows of the tag F for Q, got F1.*; name it under columns"):
        columns = LONG_COLUMNS | {"Q": {"column": "F", "unit": "l/min"}}
        read(plant, tmp_path, LONG, tags=TAGS, columns=columns)
    with pytest.raises(ConfigError, match=r"h: expected the unit of LI, got none; give it under columns: \{h: \{unit"):
        read(plant, tmp_path, LONG, tags=TAGS, columns=LONG_COLUMNS | {"h": {"column": "LI"}})
    with pytest.raises(ConfigError, match="expected a column 'Wert', got Tag, Time, Value, Quality"):
        read(plant, tmp_path, LONG, tags=TAGS | {"value": "Wert"}, columns=LONG_COLUMNS)


def test_quality_and_words_say_what_a_cell_means(plant: PlantDescription, tmp_path: Path) -> None:
    text = "t_s,Q_l_min,V,h_mm,h.Q\n0,60,OPEN,500,192\n1,60,OPEN,501,0\n2,-9999.0,CLOSED,502,good\n3,60,OPEN,503,GOOD\n"
    columns = {
        "Q": {"words": {-9999: None}},
        "V": {"column": "V", "unit": "%", "words": {"open": 100, "CLOSED": 0}},
        "h": {"quality": "h.Q"},
    }
    recording = read(plant, tmp_path, text, columns=columns)
    assert recording.mask[:, 0].tolist() == [True, False, True, True]
    assert torch.isnan(recording.inputs[:, 0]).tolist() == [False, False, True, False]
    assert recording.inputs[:, 1].tolist() == [1.0, 1.0, 0.0, 1.0]
    chosen = read(plant, tmp_path, text, columns=columns | {"h": {"quality": "h.Q", "good": [0]}})
    assert chosen.mask[:, 0].tolist() == [False, True, False, False]


def test_rows_in_any_order_are_sorted_where_that_is_said(plant: PlantDescription, tmp_path: Path) -> None:
    head, *rows = PLAIN.splitlines()
    mixed = "\n".join([head, rows[0], rows[0], rows[2], rows[1], *rows[3:], "4,,,504", "3,30,50,503"])
    with pytest.raises(ConfigError, match=r"row 5, column t_s: expected time that increases.*\{t: \{sort: true\}\}"):
        read(plant, tmp_path, mixed)
    recording = read(plant, tmp_path, mixed, columns={"t": {"sort": True}})
    assert same(recording, read(plant, tmp_path, PLAIN))
    found = {f.text for f in check_recording(recording, plant).findings if f.kind == "read"}
    assert found == {
        "run.csv: 1 row repeating the one before left out",
        "run.csv: rows sorted by time: 3 came late, 2 had the time of another",
    }


@pytest.mark.parametrize("first", ["2026-03-29 00:59:58", "2026-10-25 00:59:58", "2026-07-01 00:00:00"])
@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p"])
def test_local_time_goes_on_where_clocks_are_changed(
    plant: PlantDescription, tmp_path: Path, first: str, form: str
) -> None:
    from datetime import UTC, datetime, timedelta
    from zoneinfo import ZoneInfo

    start, berlin = datetime.fromisoformat(first).replace(tzinfo=UTC), ZoneInfo("Europe/Berlin")
    stamps = [(start + timedelta(seconds=k)).astimezone(berlin).strftime(form) for k in range(6)]
    rows = PLAIN.replace("t_s", "Zeit").splitlines()
    text = "\n".join([rows[0], *(s + row[1:] for s, row in zip(stamps, rows[1:], strict=True))])
    clock = {"zone": "Europe/Berlin"} | ({"stamps": form} if "/" in form else {})
    assert same(read(plant, tmp_path, text, columns={"t": clock}), read(plant, tmp_path, PLAIN))


def test_a_last_line_that_is_cut_off_is_left_out_with_a_word(plant: PlantDescription, tmp_path: Path) -> None:
    recording = read(plant, tmp_path, PLAIN + "6,3")
    assert same(recording, read(plant, tmp_path, PLAIN))
    assert recording.notes == ("run.csv: the last line is cut off and left out: '6,3'",)


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ({"h": {"held": "3 s"}}, r"run.csv: columns.h.held: expected this key of an input only; leave it out"),
        ({"Q": {"zone": "Europe/Berlin"}}, r"columns.Q.zone: expected this key of t only"),
        ({"t": {"held": "3 s"}}, r"columns.t.held: expected this key of an input only"),
        ({"V": {"words": {"OPEN": "100 %"}}}, r"columns.V.words.OPEN: expected a number in the unit of the column"),
        ({"h": {"quality": "h.Q"}}, r"expected a column 'h.Q', got t_s, Q_l_min, V_pct, h_mm"),
    ],
)
def test_what_says_nothing_is_refused(
    plant: PlantDescription, tmp_path: Path, columns: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        read(plant, tmp_path, PLAIN, columns=columns)


def test_empty_cells_of_inputs_without_held_are_told_once_with_the_fix(plant: PlantDescription, tmp_path: Path) -> None:
    rows = "".join(f"{k},{60 if k % 2 == 0 else ''},50,{500 + k}\n" for k in range(40))
    recording = read(plant, tmp_path, "t_s,Q_l_min,V_pct,h_mm\n" + rows)
    [found] = [f for f in check_recording(recording, plant).findings if f.kind == "unknown"]
    assert "unknown at 20 of 40 samples, in 20 stretches" in found.text
    assert "columns: {Q: {held: 6 s}}" in found.text
    with pytest.raises(
        ConfigError, match=r"unknown are Q at 20 of 40 samples; .* columns: \{Q: \{held: 10 s\}\}, or held: always"
    ):
        load_recordings([RecordingConfig(file="run.csv")], plant, tmp_path)


@pytest.mark.parametrize("sort", [False, True])
def test_a_column_that_is_no_clock_is_not_sorted(plant: PlantDescription, tmp_path: Path, sort: bool) -> None:
    """A level for example; times that were rounded, and a file that was exported twice, are sorted as before."""
    head = "t_s,Q_l_min,V_pct,h_mm\n"
    level = head + "".join(f"{500 + (7 * k) % 30},60,50,{k}\n" for k in range(200))
    with pytest.raises(ConfigError, match=r"it is no clock; name the column of time: .* \{t: \{period: 50 ms\}\}"):
        read(plant, tmp_path, level, columns={"t": {"sort": sort}})
    twice = head + 2 * "".join(f"{k},60,50,{500 + k}\n" for k in range(100))
    rounded = head + "".join(f"{k // 20},60,50,{500 + k}\n" for k in range(200))
    for rows, samples in ((twice, 100), (rounded, 10)):
        assert len(read(plant, tmp_path, rows, columns={"t": {"sort": True}})) == samples


def test_an_empty_input_is_told_with_its_own_name_and_unit(plant: PlantDescription, tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t_s,Q_l_min,V_pct,h_mm\n" + "".join(f"{k},,50,{k}\n" for k in range(40)))
    fix = r"give it a constant, as in columns: \{Q: \{constant: 0 l/min\}\}$"
    with pytest.raises(ConfigError, match=rf"unknown are Q at 40 of 40 samples; {fix}"):
        load_recordings([RecordingConfig(file="run.csv")], plant, tmp_path)
    mended = RecordingConfig(file="run.csv", columns={"Q": {"constant": "0 l/min"}})
    assert load_recordings([mended], plant, tmp_path)
    (tmp_path / "run.csv").write_text("t_s,Q_l_min,V_pct,h_mm\n" + "".join(f"{k},60,,{k}\n" for k in range(40)))
    with pytest.raises(ConfigError, match=r"columns: \{V: \{constant: 0 %\}\}$"):
        load_recordings([RecordingConfig(file="run.csv")], plant, tmp_path)


def test_a_command_recorded_on_change_is_proposed_to_hold_until_the_next(
    plant: PlantDescription, tmp_path: Path
) -> None:
    """Not for a time, which would cut the recording wherever the command rests longer. The proposal cuts nothing."""
    changes = {0: 60, 3: 30, 4: 60, 15: 50, 17: 20, 30: 40, 31: 60, 60: 30}
    text = "t_s,Q_l_min,V_pct,h_mm\n" + "".join(f"{k},{changes.get(k, '')},50,{500 + k % 7}\n" for k in range(80))
    [found] = [f for f in check_recording(read(plant, tmp_path, text), plant).findings if f.kind == "unknown"]
    assert found.text.endswith(
        "as of a command that is recorded on change; if it is, each holds until the next: columns: {Q: {held: always}}"
    )
    assert len(read(plant, tmp_path, text, columns={"Q": {"held": "always"}}).known_segments()) == 1


def test_held_inputs_are_followed_as_rows_come(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("\n".join(MIXED.splitlines()[:2]) + "\n")
    mapping = {"Q": ChannelSource(held=3.0), "V": ChannelSource(held=float("inf"))}
    growing = GrowingCsv(path, ["Q", "V"], ["h"], mapping)
    found = []
    for line in ["", *MIXED.splitlines()[2:], "9,,,509"]:
        with path.open("a") as file:
            file.write(line + "\n" if line else "")
        found += growing.new()[1].tolist()
    assert [row[0] for row in found[:6]] == pytest.approx([1e-3] * 3 + [5e-4] * 3)
    assert [row[1] for row in found] == pytest.approx([0.5] * 4 + [0.8] * 3)
    assert found[6][0] != found[6][0]  # 6 s after the last value


def test_stretches_may_be_named_by_stamps(plant: PlantDescription, tmp_path: Path) -> None:
    text = "Zeit" + PLAIN.replace("t_s", "").replace("\n", "\n2026-03-29 03:00:0")[: -len("2026-03-29 03:00:0")]
    zone = {"t": {"zone": "Europe/Berlin"}}
    cut = read(plant, tmp_path, text, columns=zone, start="2026-03-29 03:00:02", mask=[["2026-03-29T01:00:03Z", "4 s"]])
    assert cut.time.tolist() == [2.0, 3.0, 4.0, 5.0]
    assert cut.mask[:, 0].tolist() == [True, False, False, True]
    with pytest.raises(ConfigError, match=r"expected a time in s as in '300 s', .* its clock has no date"):
        read(plant, tmp_path, PLAIN, start="2026-03-29 03:00:02")


@pytest.mark.parametrize("offset", ["", "+01:00"])
def test_stamps_without_an_offset_are_in_the_zone_of_the_file(
    plant: PlantDescription, tmp_path: Path, offset: str
) -> None:
    head, *rows = PLAIN.replace("t_s", "Zeit").splitlines()
    text = "\n".join([head, *(f"2026-03-01 08:00:0{row[0]}{offset}{row[1:]}" for row in rows)])
    cut = read(plant, tmp_path, text, start="2026-03-01 08:00:02", mask=[["2026-03-01 08:00:03", "4 s"]])
    assert cut.time.tolist() == [2.0, 3.0, 4.0, 5.0]
    assert cut.mask[:, 0].tolist() == [True, False, False, True]


def test_rows_with_tags_have_the_zone_of_their_stamps(plant: PlantDescription, tmp_path: Path) -> None:
    long = LONG.replace("2026-03-29 08:30:0", "2026-03-29T08:30:0")
    zoned = "\n".join(
        ",".join(cell + ("+05:30" if k == 1 and n else "") for k, cell in enumerate(row.split(",")))
        for n, row in enumerate(long.splitlines())
    )
    recording = read(plant, tmp_path, zoned, tags=TAGS, columns=LONG_COLUMNS)
    assert recording.zone == 19800.0
    local = read(plant, tmp_path, long, tags=TAGS, columns=LONG_COLUMNS)
    assert recording.clock_zero == local.clock_zero
    berlin = LONG_COLUMNS | {"t": {"zone": "Europe/Berlin"}}
    assert read(plant, tmp_path, long, tags=TAGS, columns=berlin).clock_zero == local.clock_zero


def test_local_time_goes_on_where_clocks_are_set_back_in_two_years(plant: PlantDescription, tmp_path: Path) -> None:
    stamps = ["2025-10-26 02:59:00", "2025-10-26 02:00:00", "2026-10-25 01:30:00"]
    stamps += ["2026-10-25 02:30:00", "2026-10-25 02:10:00", "2026-10-25 03:00:00"]
    rows = PLAIN.replace("t_s", "Zeit").splitlines()
    text = "\n".join([rows[0], *(s + row[1:] for s, row in zip(stamps, rows[1:], strict=True))])
    recording = read(plant, tmp_path, text, columns={"t": {"zone": "Europe/Berlin"}})
    assert torch.diff(recording.time).tolist() == [60.0, 31444200.0, 3600.0, 2400.0, 3000.0]


def test_a_clock_without_dates_that_passes_midnight_is_not_to_be_sorted(
    plant: PlantDescription, tmp_path: Path
) -> None:
    rows = PLAIN.replace("t_s", "Zeit").splitlines()
    stamps = ["23:59:58", "23:59:59", "00:00:00", "00:00:01", "00:00:02", "00:00:03"]
    text = "\n".join([rows[0], *(s + row[1:] for s, row in zip(stamps, rows[1:], strict=True))])
    with pytest.raises(ConfigError, match=r"row 4, .* got -86398 s after 1 s .*midnight.*; add the date") as error:
        read(plant, tmp_path, text, columns={"t": {"stamps": "%H:%M:%S"}})
    assert "sort" not in str(error.value)


def test_the_shift_of_a_clock_is_followed(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(PLAIN)
    growing = GrowingCsv(tmp_path / "run.csv", ["Q"], ["h"], {"t": ClockSource(shift=37.0)})
    assert growing.new()[0].tolist() == [37.0, 38.0, 39.0, 40.0, 41.0, 42.0]
