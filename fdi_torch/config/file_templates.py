"""New files: commented minimal runs, monitors, rehearsals and studies of any plant, and a first plant file from the
columns of a recording (pumps and sensors as recorded, tanks and pipes as a guess).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from string import Template, ascii_uppercase
from typing import NamedTuple
from urllib.parse import urlsplit

import torch

from fdi_torch.config.channels import mapped
from fdi_torch.config.yaml_files import find_data, parse_yaml
from fdi_torch.live.values import PORTS
from fdi_torch.plant.components import COMMAND_UNITS
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import display_unit, quantity_text, significant, unit_factor
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_binding import bind_clock
from fdi_torch.recordings.csv_files import read_csv, read_header
from fdi_torch.recordings.csv_text import HeaderlessError, header_unit
from fdi_torch.recordings.csv_writing import header_of
from fdi_torch.recordings.database import is_query
from fdi_torch.recordings.source import ClockSource
from fdi_torch.units import spelled

FALSE_ALARMS_EVERY, LEARNING = 20000.0, 1000.0
"""Of a plant with the time scale of three_tank, s. A fault-free part of unknown sampling lasts LEARNING."""


def template(kind: str, plant: PlantDescription, plant_file: str, name: str, recording: str | None = None) -> str:
    """The text of a new run, monitor, rehearsal or study.

    plant: the plant of the file; plant_file: its entry under the key `plant`; name: of the run. recording: the file
    that it reads, of a monitor also the URL of a live source; None for one of the name of the run, with a comment that
    shows its header. Raises ValueError for a recording that cannot be read.
    """
    if recording is not None and urlsplit(recording).scheme in PORTS:
        if kind != "monitor":
            raise ValueError(
                f"--recording: expected a file for a {kind}, got {recording}; only a monitor reads a source"
            )
        reading = _live_source(recording, plant)
    else:
        reading = _recording(kind, plant, name, recording)
    every, sampling = (_rounded_up(time * time_scale(plant)) for time in (FALSE_ALARMS_EVERY, 1.0))
    pipe = plant.pipes[0].name if plant.pipes else plant.tanks[0].name
    plugging = f"{pipe}.plugging" if plant.pipes else f"{pipe}.evaporation"
    constant = f"{pipe}.discharge_coefficient" if plant.pipes else f"{pipe}.area"
    return Template(
        files("fdi_torch.config").joinpath("templates", f"{kind}.yaml").read_text(encoding="utf-8")
    ).substitute(
        plant=plant_file,
        name=name,
        reading="\n".join(reading),
        every=f"{every:.10g}",
        sampling=f"{sampling:.10g}",
        duration=f"{600 * sampling:.10g}",
        fault_free=_fault_free(plant, "\n".join(reading), every) if recording else _usual_part(plant),
        leak=f"{plant.tanks[0].name}.leak",
        plugging=plugging,
        constant=constant,
        inputs=_inputs(plant, sampling),
        simulated="\n".join(f"# {line}" for line in _inputs(plant, sampling).splitlines()),
        noise=", ".join(f"{s.column}: {quantity_text(1e-3 * abs(s.gain), s.unit, 3, s.column)}" for s in plant.sensors),
        channels=", ".join(plant.channels()),
        commands=", ".join(_shares(plant, channel, (0.4,))[0] for channel in plant.channels()),
    )


def _recording(kind: str, plant: PlantDescription, name: str, recording: str | None) -> list[str]:
    """The entry of a recording in a run or monitor, with lines for the channels without a column of their name."""
    header = header_of(plant.channel_units(), plant.output_units())
    file = f"{name}.csv             # with the header {header}" if recording is None else f'"{recording}"'
    to_complete = [] if recording is None or is_query(recording) else mapped(find_data(recording, Path.cwd()), plant)
    columns = to_complete or [
        "# columns:                # for headers of other names",
        f"#   {(s := plant.sensors[0]).column}: {{column: LT-101, unit: {display_unit(s.unit, s.column)[0] or 1}}}",
    ]
    if kind == "run":
        crop = ["# start: 60 s             # the first time that is used; stop: the last"]
        crop += ["# mask: [[120 s, 130 s]]  # readings in between do not count"]
        return ["recordings:", f"  - file: {file}", *(f"    {line}" for line in [*crop, *columns])]
    return ["recording:", f"  file: {file}", *(f"  {line}" for line in columns)]


def _live_source(url: str, plant: PlantDescription) -> list[str]:
    """The entry of a live source, with a tag to be written for each channel."""
    units = plant.channel_units() | plant.output_units()
    tags = [f"    {name}: {{tag: null, unit: {display_unit(unit, name)[0] or 1}}}" for name, unit in units.items()]
    return [
        "source:",
        f"  url: {url}",
        "  tags:                       # the address of each value, and its unit",
        *tags,
    ]


def _usual_part(plant: PlantDescription) -> str:
    """A fault-free part for a recording of unknown sampling."""
    until = _rounded_up(LEARNING * time_scale(plant))
    return f"[0 s, {until:.10g} s]    # the noise is learnt from it; the first event says how long it must be"


def _fault_free(plant: PlantDescription, reading: str, every: float) -> str:
    """The fault-free part for the entry of a recording: by its sampling, and at most half of it."""
    entry = parse_yaml(reading.encode(), "recording").get("recording")
    if entry is None or " ..." in reading:  # a live source, or columns that the user must write
        return _usual_part(plant)
    from fdi_torch.config.loaded_recordings import read_recording

    read = read_recording(entry, plant)
    first, last = float(read.time[0]), float(read.time[-1])
    enough = _rounded_up(_learning_time(read, every))
    until = first + min(enough, 0.5 * (last - first))
    return f"[{first:.10g} s, {until:.10g} s]    # the noise is learnt from it; white noise needs some {enough:.10g} s"


def _learning_time(recording: Recording, false_alarms_every: float) -> float:
    """Time from which white noise determines the false-alarm rate within a factor of RATE_FACTOR (95 %), s.

    The recording gives the sampling interval and the number of sensors; correlated noise and random flows need longer.
    false_alarms_every: mean time between false alarms, s. Raises ValueError if it is less than 20 samples.
    """
    # Only this needs the monitor, which takes a while to load.
    from fdi_torch.monitor.detection import make_detector
    from fdi_torch.monitor.fault_free_checks import RATE_FACTOR
    from fdi_torch.monitor.samples import usual_interval
    from fdi_torch.monitor.whitening import FEWEST_SAMPLES, Whitening

    interval, sensors = usual_interval(recording.time), len(recording.output_names)
    zero, one = torch.zeros(sensors, dtype=torch.float64), torch.eye(sensors, dtype=torch.float64)
    error = torch.full_like(zero, (2.0 * FEWEST_SAMPLES) ** -0.5)  # of ln of a standard deviation
    white = Whitening(zero, zero.new_zeros(0, sensors, sensors), one, FEWEST_SAMPLES, error)
    draws = torch.Generator().manual_seed(0)
    design = make_detector("cusum", false_alarms_every, interval, sensors, draws, learnt=white).design
    return interval * FEWEST_SAMPLES * max(design.learning_factor(RATE_FACTOR), 1.0)


def _rounded_up(value: float) -> float:
    """The value rounded up to two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit


def _inputs(plant: PlantDescription, sampling: float) -> str:
    """For each pump and transfer a step up and a step down about half of its range; valves are open."""
    lines = []
    for channel in plant.channels():
        steps = zip((0, 200, 400), _shares(plant, channel, (0.4, 0.5, 0.3)), strict=False)
        listed = [f"[{sampling * k:.10g} s, {level}]" for k, level in steps]
        lines.append(f"    {channel}: " + ("1" if len(listed) == 1 else f"{{steps: [{', '.join(listed)}]}}"))
    return "\n".join(lines)


def _shares(plant: PlantDescription, channel: str, shares: Sequence[float]) -> list[str]:
    """Commands that are these shares of a pump's or transfer's range; of a valve, fully open."""
    full = {c.channel: (c.full_command, c.command_unit) for c in plant.metered_flows()}
    return (
        [quantity_text(share * full[channel][0], full[channel][1], 3, channel) for share in shares]
        if channel in full
        else ["1"]
    )


HEIGHT = 0.6  # m, of a tank that is still to be measured
AT_RIM = {"1": 1.0, "V": 10.0, "A": 0.02, "Pa": 9810.0 * HEIGHT}
"""What a sensor reads at the rim, by the unit of its reading: 100 %, 10 V, 20 mA, water."""
READING = re.compile(r"[LHX]|P[A-Z]|.*(level|füllstand|niveau|pegel|pressure|druck)", re.IGNORECASE)
"""Tags of levels and pressures (ISA-5.1: PT, PI; P-101 is a pump), letters of levels by custom, and words."""
COMMAND = re.compile(
    r".*(pump|valve|ventil|pwm|duty|cmd|command|speed|drehzahl)|[A-Z]+C\W?\d+\W?(out|op)$", re.IGNORECASE
)
"""Words, and tags of a controller's output (LIC-101.OUT)."""
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

    A column is a reading if its unit is a length or a pressure, or if its name says so; if none is, each that may be.
    Others are commands. Raises ValueError if no column with a unit in its header can be a reading.
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
    tanks = [f"T{k + 1}" for k in range(len(sensors))] if len(sensors) > 26 else list(ascii_uppercase[: len(sensors)])
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
        *(f"  {tank}: {{area: 200 cm^2, height: {_height(c)}}}" for tank, c in zip(tanks, sensors, strict=True)),
        "",
        "pipes:    # ! which there are, and the area of each orifice; target outside: an outlet",
        *(
            f"  {pipe}: {{source: {a}, target: {b}, area: 0.5 cm^2, discharge_coefficient: 0.6}}"
            for pipe, a, b in pipes
        ),
        "",
        *([PUMPS, *pumps, ""] if pumps else []),
        "sensors:  # ! the tank of each, and its gain: reading at the rim divided by height; commands go to pumps",
        *(_sensor(column, tank) for column, tank in zip(sensors, tanks, strict=True)),
        "",
        "tolerances:    # one standard deviation; constants without one count as exact",
        '  "*.discharge_coefficient": 30 %',
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


def _height(column: _Column) -> str:
    """A height a tenth above the highest level of a column, in its unit."""
    if column.kind != "m" or column.highest <= 0.0:
        return f"{100.0 * HEIGHT:g} cm"
    return f"{_rounded_up(1.1 * column.highest / unit_factor(column.unit, 'm')):.10g} {column.unit}"


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
