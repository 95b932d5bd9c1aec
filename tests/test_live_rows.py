"""The order of samples from a live source: late, repeated and missing values, and a clock that goes back."""

from __future__ import annotations

import math

import pytest

from fdi_torch.live.row_buffer import JUMP, LiveChannel, Row, RowBuffer
from fdi_torch.live.values import Inbox, Value

NAN = math.nan


def buffer(reorder: float = 1.0, align: float = 0.0, dated: bool = False, held: float = 0.0) -> RowBuffer:
    inputs = [LiveChannel("Q", "q", scale=2.0, shift=1.0, held=math.inf)]
    return RowBuffer(inputs, [LiveChannel("h", "h", held=held)], reorder, align, dated)


def times(rows: list[Row | str]) -> list[float]:
    return [row[0] for row in rows if not isinstance(row, str)]


def notices(rows: list[Row | str]) -> list[str]:
    return [row for row in rows if isinstance(row, str)]


def equal(got: list[Row | str], expected: list[Row]) -> bool:
    return repr(got) == repr(expected)


def test_a_row_waits_for_its_values_and_for_earlier_rows() -> None:
    rows = buffer()
    rows.put(Value("h", 2.0, 20.0), now=0.0)
    assert rows.rows(now=0.9) == []
    rows.put(Value("h", 1.0, 10.0), now=0.9)
    rows.put(Value("q", 1.0, 5.0), now=0.95)
    assert equal(rows.rows(now=1.0), [(1.0, [11.0], [10.0]), (2.0, [11.0], [20.0])])


def test_inputs_are_kept_and_readings_only_while_they_are_held() -> None:
    rows = buffer(held=1.5)
    for value in (Value("q", 0.0, 1.0), Value("h", 0.0, 7.0), Value("q", 1.0, 1.0), Value("q", 2.0, 2.0)):
        rows.put(value, now=0.0)
    assert equal(rows.rows(now=5.0), [(0.0, [3.0], [7.0]), (1.0, [3.0], [7.0]), (2.0, [5.0], [NAN])])


def test_repeated_samples_make_no_row_and_late_ones_are_counted() -> None:
    rows = buffer()
    for k in range(5):
        rows.put(Value("h", float(2 * k), 1.0), now=0.0)
    assert times(rows.rows(now=1.0)) == [0.0, 2.0, 4.0, 6.0, 8.0]
    rows.put(Value("h", 4.0, 1.0), now=2.0)
    rows.put(Value("h", 3.0, 1.0), now=2.0)
    rows.put(Value("h", 10.0, 1.0), now=2.0)
    got = rows.rows(now=3.0)
    assert times(got) == [10.0] and "samples more than 1 s late were left out, 1 so far" in notices(got)[0]


def test_a_clock_that_goes_back_is_followed() -> None:
    rows = buffer()
    rows.put(Value("h", 1000.0, 1.0), now=0.0)
    assert times(rows.rows(now=1.0)) == [1000.0]
    for k in range(JUMP - 1):
        rows.put(Value("h", float(k), 1.0), now=2.0)
    assert rows.rows(now=10.0) == []
    rows.put(Value("h", float(JUMP), 1.0), now=11.0)
    got = rows.rows(now=20.0)
    assert notices(got) == ["the clock of the source went back"] and len(times(got)) == JUMP
    rows.put(Value("h", 50.0, 1.0), now=21.0)
    assert times(rows.rows(now=30.0)) == [50.0]


def test_a_clock_that_goes_back_onto_known_times_is_followed_and_keeps_what_is_held() -> None:
    """An hour of winter time has the stamps of the hour before, with other values. The input is sent on change only."""
    rows = buffer()
    rows.put(Value("q", 1000.0, 1.0), now=0.0)
    for k in range(40):
        rows.put(Value("h", 1000.0 + k, float(k)), now=0.0)
    assert len(times(rows.rows(now=1.0))) == 40
    for k in range(15):
        rows.put(Value("h", 1010.0 + k, float(10 + k)), now=2.0)  # as a broker repeats them
    assert rows.rows(now=9.0) == []
    for k in range(15):
        rows.put(Value("h", 1010.0 + k, -1.0), now=10.0)
    got = rows.rows(now=20.0)
    assert notices(got) == ["the clock of the source went back"]
    assert equal(got[1:], [(1010.0 + k, [3.0], [-1.0]) for k in range(15)])


def test_a_resumed_source_knows_held_inputs_and_where_its_clock_went_back() -> None:
    earlier: list[Row] = [(float(k), [3.0], [float(k)]) for k in [*range(50), *range(20)]]
    rows = RowBuffer([LiveChannel("Q", "q", held=math.inf)], [LiveChannel("h", "h")], 1.0, earlier=earlier)
    for k in (18, 19, 20, 21):
        rows.put(Value("h", float(k), float(k)), now=0.0)
    assert equal(rows.rows(now=1.0), [(20.0, [3.0], [20.0]), (21.0, [3.0], [21.0])])


def test_dates_count_from_the_first_row_to_the_microsecond() -> None:
    rows = buffer(align=0.1, dated=True)
    for stamp in (1.7e9 + 0.101, 1.7e9 + 0.199, 1.7e9 + 0.302):
        rows.put(Value("h", stamp, 1.0), now=0.0)
    assert times(rows.rows(now=1.0)) == [0.0, 0.1, 0.2] and rows.origin == pytest.approx(1.7e9 + 0.1, abs=1e-6)


def test_too_many_values_push_the_oldest_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdi_torch.live.values.MOST_WAITING", 3)
    inbox = Inbox()
    inbox.put([Value("h", float(k), 0.0) for k in range(5)])
    notice, *values = inbox.take(0.0)
    assert "2 values came faster" in str(notice)
    assert [v.stamp for v in values if isinstance(v, Value)] == [
        2.0,
        3.0,
        4.0,
    ]
    assert inbox.take(0.0) == []


def test_time_0_is_the_first_reading_and_an_input_that_was_set_long_before_holds() -> None:
    rows = buffer(dated=True)
    for value in (Value("q", 1e9 - 3600.0, 5.0), Value("h", 1e9, 10.0), Value("h", 1e9 + 1.0, 11.0)):
        rows.put(value, now=0.0)
    assert equal(rows.rows(now=2.0), [(0.0, [11.0], [10.0]), (1.0, [11.0], [11.0])]) and rows.origin == 1e9
