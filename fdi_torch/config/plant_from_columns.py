"""A first plant file from the columns of a recording: pumps and sensors as recorded, tanks and pipes as a guess."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from string import ascii_uppercase
from typing import NamedTuple

import torch

from fdi_torch.names import distinguishing_end
from fdi_torch.plant.components import COMMAND_UNITS
from fdi_torch.plant.description import OUTSIDE
from fdi_torch.quantities import rounded_up, significant, unit_factor
from fdi_torch.recordings.csv_binding import bind_clock
from fdi_torch.recordings.csv_files import read_csv, read_header
from fdi_torch.recordings.csv_text import HeaderlessError, header_unit
from fdi_torch.recordings.source import ClockSource
from fdi_torch.units import spelled

HEIGHT = 0.6  # m, of a tank that is still to be measured
AT_RIM = {"1": 1.0, "V": 10.0, "A": 0.02, "Pa": 9810.0 * HEIGHT}
"""Reading of a sensor at the rim, by the unit of its reading: 100 %, 10 V, 20 mA, water."""
READING = re.compile(r"[LHX]|P[DIRT]|.*(level|füllstand|niveau|pegel|pressure|druck)", re.IGNORECASE)
"""Names of readings: tags of levels and pressures by ISA-5.1 (LT, PT, PI, but not the pumps P-101 and PK), the letters
h and x, which are customary for levels, and words such as level."""
COMMAND = re.compile(
    r".*(pump|valve|ventil|pwm|duty|cmd|command|speed|drehzahl)|[A-Z]+C\W?\d+\W?(out|op)$", re.IGNORECASE
)
"""Names of commands: words such as pump, and tags of a controller's output (LIC-101.OUT)."""
PUMPS = "pumps:    # ! the tank that each fills, and its maximum flow; a flow out of a tank belongs under transfers"


class _Column(NamedTuple):
    """A column with a unit in its header: its header, name, unit, SI unit and highest value (SI)."""

    header: str
    name: str
    unit: str
    kind: str
    highest: float

    @property
    def own(self) -> str:
        """A name for the component: letters, digits and _."""
        return re.sub(r"\W+", "_", self.name).strip("_") or "x"

    @property
    def may_be_reading(self) -> bool:
        return self.kind in ("m", "Pa") or (self.kind in AT_RIM and not COMMAND.match(self.name))

    @property
    def is_reading(self) -> bool:
        return self.kind in ("m", "Pa") or (self.may_be_reading and bool(READING.match(self.name)))


def plant_from_recording(path: Path, name: str) -> str:
    """The text of a plant file: a pump for each flow or command, and a row of tanks, one for each level.

    A column is a reading if its unit is a length or a pressure, or if its name is that of a level or pressure. If no
    column is, every column counts as a reading whose unit a sensor can have and whose name is not that of a command.
    All other columns are commands. Raises ValueError if no column with a unit in its header can be a reading.
    """
    try:
        header = read_header(path)
    except HeaderlessError:
        raise ValueError(
            f"{path}: expected a header with names and units, got numbers; describe the plant with fdi new plant, then "
            f"let fdi new run --plant FILE --recording {path} number the columns"
        ) from None
    clock = bind_clock(path, header, ClockSource()).header
    named = [column for column in header if column != clock]
    columns = _columns(path, [column for column in named if header_unit(column)])
    sensors = [column for column in columns if column.is_reading] or [c for c in columns if c.may_be_reading]
    if not sensors:
        raise ValueError(
            f"{path}: expected a column of a level with its unit in the header, such as LT-101 (cm), got "
            f"{', '.join(named)}; add units to the header, or describe the plant with fdi new plant, then let "
            f"fdi check --plant FILE --recording {path} print the lines that map the columns"
        )
    tank_of = dict(zip(sensors, _tanks(sensors), strict=True))
    by_tank = sorted(sensors, key=lambda column: (len(tank_of[column]), tank_of[column]))
    tanks = [tank_of[column] for column in by_tank]
    pipes = [(f"{a}_{b}", a, b) for a, b in pairwise(tanks)] + [("outlet", tanks[-1], OUTSIDE)]
    commands = [column for column in columns if column not in sensors and column.kind in COMMAND_UNITS.values()]
    pumps = [_pump(column, tanks[0]) for column in commands]
    used = {column.header for column in (*sensors, *commands)}
    without = [column for column in named if column not in used]
    lines = [
        f"# From the columns of {path.name}. Correct what follows a ! and delete the !, then check the file.",
        *([f"# Left out, as their header has no unit of a level or command: {', '.join(without)}"] if without else []),
        f"name: {name}",
        "",
        "tanks:    # ! cross-section, and height from the floor to the rim",
        *(f"  {tank_of[column]}: {{area: 200 cm^2, height: {_height(column)}}}" for column in by_tank),
        "",
        "pipes:    # ! which there are, and the area of each orifice; target outside: an outlet",
        *(
            f"  {pipe}: {{source: {a}, target: {b}, area: 0.5 cm^2, discharge_coefficient: 0.6}}"
            for pipe, a, b in pipes
        ),
        "",
        *([PUMPS, *pumps, ""] if pumps else []),
        "sensors:  # ! the tank of each, and its gain: reading at the rim divided by height; commands go to pumps",
        *(_sensor(column, tank) for column, tank in tank_of.items()),
        "",
        "tolerances:    # one standard deviation; constants without one count as exact",
        "               # generous for a first calibration, which replaces them: fdi refit --adopt --narrow",
        '  "*.discharge_coefficient": 30 %',
        *(f"  {column.own}.gain: 30 %" for column in commands),
    ]
    return "\n".join(lines) + "\n"


def _columns(path: Path, headers: list[str]) -> list[_Column]:
    """The columns with a unit, in their order."""
    split = [(header, *pair) for header in headers if (pair := header_unit(header))]
    if not split:
        return []
    recording = read_csv(path, [], [name for _, name, _ in split])
    highest = torch.nan_to_num(recording.outputs, nan=0.0).amax(dim=0).tolist()
    kinds = recording.output_units
    return [
        _Column(header, name, spelled(unit), kind, high)
        for (header, name, unit), kind, high in zip(split, kinds, highest, strict=True)
    ]


def _tanks(sensors: list[_Column]) -> list[str]:
    """Name the tank of each sensor by the letter at the end of the sensor's name ('level D'), if these letters differ;
    otherwise A, B, C in the order of the columns, or T1, T2, T3 for more than 26 sensors.
    """
    letters = [distinguishing_end(column.name) for column in sensors]
    taken = {column.own for column in sensors}
    if len({*letters}) == len(letters) and all(letter.isalpha() and letter not in taken for letter in letters):
        return letters
    return [f"T{k + 1}" for k in range(len(sensors))] if len(sensors) > 26 else list(ascii_uppercase[: len(sensors)])


def _height(column: _Column) -> str:
    """A height a tenth above the highest level of a column, in its unit."""
    if column.kind != "m" or column.highest <= 0.0:
        return f"{100.0 * HEIGHT:g} cm"
    return f"{rounded_up(1.1 * column.highest / unit_factor(column.unit, 'm')):.10g} {column.unit}"


def _pump(column: _Column, tank: str) -> str:
    per_unit = unit_factor(column.unit, column.kind)
    flow = "6 l/min"
    if column.kind == "m^3/s":
        flow = f"{significant(max(column.highest, per_unit) / per_unit, 3)} {column.unit}"
    fields = [f"target: {tank}", f"max_flow: {flow}"]
    if column.kind == "1":
        fields.append(f"gain: {significant(6.0 * per_unit, 3)} l/min" + (f"/{column.unit}" if per_unit < 1.0 else ""))
    elif column.kind != "m^3/s":
        largest = 5.9 * per_unit / (column.highest or 1.0)  # rounded, the highest command stays below the maximum flow
        fields.append(f"gain: {significant(largest, 3)} l/min/{column.unit}")
    return _line(column, fields, "command")


def _sensor(column: _Column, tank: str) -> str:
    fields = [f"tank: {tank}"]
    if column.kind != "m":
        gain = AT_RIM[column.kind] / HEIGHT / unit_factor(column.unit, column.kind)
        fields.append(f"gain: {significant(gain, 4)} {column.unit}/m")
    return _line(column, fields, "channel")


def _line(column: _Column, fields: list[str], key: str) -> str:
    named = [] if column.own == column.name else [f'{key}: "{column.name}"']
    return f"  {column.own}: {{{', '.join([*fields, *named])}}}"
