"""New files: commented minimal runs, monitors, rehearsals and studies of any plant."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from urllib.parse import urlsplit

from fdi_torch.config.channels import mapped
from fdi_torch.config.yaml_files import find_data, parse_yaml
from fdi_torch.effects.usual_faults import usual_faults
from fdi_torch.live.values import PORTS
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import display_unit, quantity_text, rounded_up
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_writing import header_of
from fdi_torch.recordings.database import is_query

FALSE_ALARMS_EVERY, LEARNING = 20000.0, 1000.0
"""Mean time between false alarms, and length of a fault-free part of unknown sampling; s, for three_tank."""
FEWEST, MARGIN = 200, 1.5
"""Samples of a fault-free part at least, and its length as a multiple of what the monitor asks for after too few: from
another part it learns another noise, and asks for up to a third more."""


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
    every, sampling = (rounded_up(time * time_scale(plant)) for time in (FALSE_ALARMS_EVERY, 1.0))
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
        suspected="\n".join(_suspected(plant)),
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
    until = rounded_up(LEARNING * time_scale(plant))
    return f"[0 s, {until:.10g} s]    # the noise is learnt from it; the first event says how long it must be"


def _fault_free(plant: PlantDescription, reading: str, every: float) -> str:
    """The fault-free part for the entry of a recording: as long as the monitor needs, but at most half of it, and only
    as long as the plant explains it.
    """
    entry = parse_yaml(reading.encode(), "recording").get("recording")
    if entry is None or " ..." in reading:  # a live source, or columns that the user must write
        return _usual_part(plant)
    from fdi_torch.config.loaded_recordings import read_recording

    read = read_recording(entry, plant)
    first, last = float(read.time[0]), float(read.time[-1])
    half = until = 0.5 * (last - first)
    remark = "the noise is learnt from it"
    try:
        explained = _explained_time(plant, read, half)
        until, needed = _learning_time(plant, read, every, min(half, explained))
        if explained < half and until == explained:
            remark = "what follows deviates from the plant file: a fault, or constants to calibrate"
            if needed > until:
                remark += f"; too short: the noise needs some {needed:.10g} s, and the threshold is higher"
        elif needed > until:
            remark = f"half of the recording; the noise needs some {needed:.10g} s; until then the threshold is higher"
    except ValueError as error:
        remark = f"half of the recording, which the monitor will refuse: {str(error).partition(chr(10))[0]}"
    return f"[{first:.10g} s, {first + until:.10g} s]    # {remark}"


def _explained_time(plant: PlantDescription, recording: Recording, longest: float) -> float:
    """How long the plant explains the recording from its beginning, s, of its first `longest` seconds.

    Raises ValueError for a recording that cannot be monitored.
    """
    from fdi_torch.monitor.monitor_setup import explained_until  # takes a while to load

    first, learnt = float(recording.time[0]), FEWEST * recording.interval
    if learnt >= longest:
        return longest
    return explained_until(plant, recording.window(first, first + longest), first + learnt) - first


def _learning_time(
    plant: PlantDescription, recording: Recording, false_alarms_every: float, longest: float
) -> tuple[float, float]:
    """Length of a fault-free part at the beginning of the recording, at most `longest`, and the length that a monitor
    which learns from its first samples asks for, s.

    false_alarms_every: mean time between false alarms, s. Raises ValueError for a recording that cannot be monitored.
    """
    # Only this needs the monitor, which takes a while to load.
    from fdi_torch.monitor.fault_free_checks import learning_times
    from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor

    first, usual = float(recording.time[0]), 2.0 * LEARNING * time_scale(plant)
    length = min(rounded_up(max(usual, FEWEST * recording.interval)), longest)
    part = fault_free_part(recording, first, first + length)
    monitor = prepare_monitor(plant, part, time_between_false_alarms=false_alarms_every).monitor
    learnt, asked = learning_times(monitor.noise, monitor.detector)
    needed = asked + length - learnt
    wanted = rounded_up(MARGIN * needed) if asked > learnt else length
    return min(wanted, longest), rounded_up(needed)


def _suspected(plant: PlantDescription) -> list[str]:
    """Entries of a run file for the usual faults other than leaks, as a monitor watches for: those of pipes and weirs
    for all of a kind, and the others commented out, because few recordings determine all of them at once.
    """
    full = [name for name in usual_faults(plant) if not name.endswith(".leak.size")]
    effects = list(dict.fromkeys(ParameterName.parse(name).effect for name in full))
    metered = {c.name for c in plant.metered_flows()}
    places = {e: [n.place for n in map(ParameterName.parse, full) if n.effect == e] for e in effects}
    usual = [e for e in effects if not (metered | {s.name for s in plant.sensors}) & {*places[e]}]
    lines = [f'    - "*.{effect}"' for effect in usual]
    lines += [f"    # - {place}.{effect}" for effect in effects if effect not in usual for place in places[effect]]
    return [*lines, f"    # - {plant.tanks[0].name}.leak.onset     # when it begins, if that is within the recording"]


def _inputs(plant: PlantDescription, sampling: float) -> str:
    """The key `inputs`: for each pump and transfer a step up and one down about half of its range; valves are open."""
    lines = ["  inputs:" if plant.channels() else "  inputs: {}"]
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
