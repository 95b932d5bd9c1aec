"""Numbers as people read them; long signals that keep their look."""

from __future__ import annotations

import numpy as np
import pytest

from fdi_torch.amounts import probability_words, with_error
from fdi_torch.report.chart import corner_points, thinned
from fdi_torch.report.html import MOST_ROWS, short, table, tag, typeset
from fdi_torch.report.numbers import number, percent, shown_unit


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (0.30043, 0.00197, "0.3004 ± 0.0020"),
        (-12.3456, 0.5, "−12.35 ± 0.50"),
        (1234.5, 99.0, "1234 ± 99"),
        (2.444e-7, 2.4e-8, "(2.44 ± 0.24)·10⁻⁷"),
        (-8.9e-6, 7e-8, "(−8.900 ± 0.070)·10⁻⁶"),
        (0.3, float("inf"), "not determined"),
        (0.3, float("nan"), "0.3"),
    ],
)
def test_the_error_says_how_many_digits_count(value: float, std: float, shown: str) -> None:
    assert typeset(with_error(value, std)) == shown


def test_units_and_odd_numbers() -> None:
    assert shown_unit("m^3/s") == ("cm³/s", pytest.approx(1e6))
    assert shown_unit("bananas") == ("bananas", 1.0)
    assert (
        typeset("m^-2 s^10") == "m⁻² s¹⁰"
        and typeset("2026-11-24, hA-hB, 1e-05, x^y") == "2026-11-24, hA-hB, 1e-05, x^y"
    )
    values = float("nan"), float("inf"), float("-inf"), -1.5
    assert [typeset(number(v)) for v in values] == ["–", "∞", "−∞", "−1.5"]
    assert percent(0.1234) == "12.3 %"
    assert [probability_words(p) for p in (0.9979, 0.00202, 2.06e-59)] == ["99.8 %", "0.2 %", "under 0.1 %"]


def test_a_spike_and_a_hole_survive_thinning() -> None:
    time, values = np.arange(1e5), np.zeros(100_000)
    values[54_321], values[20_000:30_000] = 7.0, np.nan
    x, y = thinned(time, values)
    assert len(x) <= 800 and np.all(np.diff(x) > 0)
    assert np.nanmax(y) == 7.0 and x[np.nanargmax(y)] == 54_321
    assert np.isnan(y[(x > 21_000) & (x < 29_000)]).all()


def test_held_signals_keep_their_corners() -> None:
    x, y = corner_points(np.arange(6.0), np.array([1.0, 1, 2, 2, 2, 2]))
    assert x.tolist() == [0, 2, 5] and y.tolist() == [1, 2, 2]


def test_text_is_escaped_once_and_tables_say_what_they_leave_out() -> None:
    assert tag("p", "<b>", tag("i", "&"), title='"') == '<p title="&quot;">&lt;b&gt;<i>&amp;</i></p>'
    assert "and 5 more rows" in table(["a"], [["x"]] * (MOST_ROWS + 5))
    assert short("a" * 50, 10) == "a" * 9 + "…"
