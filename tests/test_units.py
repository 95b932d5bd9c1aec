"""Units in files: products, quotients and small powers of known units are parsed, and text is never evaluated."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fdi_torch.quantities import parse_level_deviation, parse_quantity, si_unit_of, unit_factor
from fdi_torch.recordings.csv_text import header_unit

GOOD = [
    ("160 cm^2", "m^2", 0.016),
    ("50e-6 m^3/s", "m^3/s", 5e-5),
    ("1 l/min/V", "m^3/s/V", 1e-3 / 60),
    ("2 l/(min mA)", "m^3/s/A", 2 / 60),
    ("3 cm²", "m^2", 3e-4),
    ("3.6 m³·h⁻¹", "m^3/s", 1e-3),
    ("5/s", "1/s", 5.0),
    ("9.81 m s**-2", "m/s^2", 9.81),
    ("3 %", "1", 0.03),
    ("-.5 mm", "m", -5e-4),
    ("0.25", "1", 0.25),
    ("7 cm3_s", "m^3/s", 7e-6),
    ("2.5 mbar/cm", "Pa/m", 25000.0),
    ("60 lph", "m^3/s", 60e-3 / 3600),
    ("2 day", "s", 172800.0),
    ("3000 rpm", "1/s", 50.0),
    ("50 rps", "1/s", 50.0),
    ("2 ml/revolution", "m^3", 2e-6),
]
BAD = [
    *("9**9**9 cm^2", "1 cm**9**9", "1 cm^99", "1 cm^(2)", "1 cm^0.5", "(1 cm", "1 cm)", "1 ()", "1 2 m", "1 m 2"),
    *("nan m", "inf m", "1e999 m", "1_0 m", "0x1f m", "1,5 m", "m", "", " ", "1 m/", "1 m//s", "1 m**", "--1 m"),
    *("1 m; import os", "1 __import__('os')", "1 [m]", "1 \x1b[31mm", "1 m\0", "٣ m", "1 m + 1 m", "1 m if m else m"),
    *("1 " + "m " * 40, "1 " + "(" * 3000 + "m" + ")" * 3000, "9" * 5000 + " m", "1 " + "m_" * 3000, "1 quettaquettam"),
    *("1 ym^9/Qm^9*m^9*Ym^9", "1 degC", "1 m^3", "1 m^१", "1 m**１"),
]


@pytest.mark.parametrize(("text", "unit", "value"), GOOD)
def test_products_quotients_and_small_powers_are_units(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_whatever_else_is_no_quantity_and_is_said_in_one_short_sentence(text: str) -> None:
    with pytest.raises(ValueError, match="expected a quantity in m such as '1 m', got '") as error:
        parse_quantity(text, "m")
    assert len(str(error.value)) < 200
    if text.startswith("1 "):
        with pytest.raises(ValueError, match="expected a unit that converts to m"):
            unit_factor(text.removeprefix("1 "), "m")
    with pytest.raises(ValueError, match="expected a unit of level"):
        si_unit_of(f"{text}^^")


def test_a_unit_beyond_all_numbers_is_none() -> None:
    assert si_unit_of("(Qm/m)^9") == "1"
    with pytest.raises(ValueError, match="expected a unit of level"):
        si_unit_of("((Qm/m)^9)^9")


def test_no_unit_text_takes_long() -> None:
    """In a process of its own: what hangs, hangs in C, where no signal ends it."""
    texts = ["h1 [9**9**9]", "h_" + "_" * 3000, "h_" + "m_" * 3000, "h (" + "m*" * 10**6 + "m)", "_" * 10**6]
    code = (
        f"from fdi_torch.recordings.csv_text import header_unit\nfor t in {texts!r}:\n    assert header_unit(t) is None"
    )
    subprocess.run([sys.executable, "-"], input=code, text=True, timeout=60, check=True)


@pytest.mark.parametrize(
    ("header", "split"),
    [
        ("Q1_cm3_s", ("Q1", "cm3_s")),
        ("h1 [cm]", ("h1", "cm")),
        ("qL_cmd_lps", ("qL_cmd", "lps")),
        ("x" * 5000 + "_cm", ("x" * 5000, "cm")),
        ("tank_A", None),
        ("h1 [9 cm]", None),
        ("h1 [2**3]", None),
    ],
)
def test_headers_hold_a_name_and_a_unit(header: str, split: tuple[str, str] | None) -> None:
    assert header_unit(header) == split


def test_a_deviation_of_levels_is_a_length() -> None:
    assert parse_level_deviation("0.5 mm", "--noise") == pytest.approx(5e-4)


@pytest.mark.parametrize("text", ["2 mbar", "0 mm", "-1 mm", "much", "1"])
def test_a_wrong_deviation_of_levels_names_the_option(text: str) -> None:
    with pytest.raises(ValueError, match="--noise: expected"):
        parse_level_deviation(text, "--noise")
