"""What people type and read: noise and times with their units, tables whole, numbers in plant files round."""

from __future__ import annotations

import argparse
from dataclasses import replace

import pytest

from fdi_torch.cli.options import seconds
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import build_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.simulation import reading_noise
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.tables import Table


def tower() -> PlantDescription:
    """Feet, gallons, milliamperes and per cent."""
    return build_plant(
        {
            "name": "tower",
            "tanks": {"A": {"area": "50.27 ft^2", "height": "14 ft"}},
            "pipes": {"out": {"source": "A", "area": "30 mm^2", "discharge_coefficient": 0.6}},
            "pumps": {"feed": {"target": "A", "max_flow": "80 m^3/h"}},
            "sensors": {
                "LT1": {"tank": "A", "gain": "2.66667 mA/m", "offset": "4 mA"},
                "LT2": {"tank": "A", "gain": "16.6667 %/m"},
            },
        },
        "tower.yaml",
    )


def test_noise_of_the_level_goes_through_each_sensor() -> None:
    assert reading_noise("2 mm", tower()) == pytest.approx([2e-3 * 2.66667e-3, 2e-3 * 0.166667])


def test_noise_of_a_sensor_that_looks_down_is_positive() -> None:
    down = replace(tower(), sensors=(Sensor("LT", "A", unit="V", gain=-20.0, offset=9.0),))
    assert reading_noise("2 mm", down) == pytest.approx([0.04])


def test_noise_by_sensor_is_in_its_own_unit() -> None:
    assert reading_noise("LT2 = 0.1 %, LT1=0.02 mA", tower()) == pytest.approx([2e-5, 1e-3])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1 kg", "noise of LT1: expected a standard deviation of the reading .A. or of the level, with a unit"),
        ("LT1 = 1 mA", "got none for LT2"),
        ("LT3 = 1 mA, LT1 = 1 mA, LT2 = 1 %", "LT3"),
        ("0 mm", "expected a positive standard deviation"),
    ],
)
def test_noise_that_makes_no_sense_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        reading_noise(text, tower())


@pytest.mark.parametrize(("text", "value"), [("90", 90.0), ("1.5 h", 5400.0), ("2 day", 172800.0)])
def test_times_are_seconds_or_have_a_unit(text: str, value: float) -> None:
    assert seconds(text) == pytest.approx(value)


def test_what_is_no_time_is_refused() -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected a time such as 90"):
        seconds("1 kg")


def test_written_plant_files_keep_round_numbers() -> None:
    written = dump_plant(tower())
    for quantity in ("50.27 ft^2", "14 ft", "30 mm^2", "80 m^3/h", "2.66667 mA/m", "4 mA", "16.6667 %/m"):
        assert quantity in written, quantity


def test_a_table_in_a_pipe_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    words = "one cause and " * 40
    Screen().show(Table(("which", "probability"), [[words, "93.6 %"]], "causes"))
    title, header, row = capsys.readouterr().out.splitlines()
    assert (title, header.split()) == ("causes", ["which", "probability"])
    assert row.startswith(words) and row.endswith("93.6 %")
