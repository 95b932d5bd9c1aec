"""Units that are wrong for a whole kind of number: all areas, flows, levels, pressures or times, or the area of a tank.

A correction divides these numbers by the ratio of the unit in which they were written to another usual unit. By Bayes'
theorem, the likelihoods of the unchanged plant file and of each correction, which follow from the volume balance of the
tanks (`volume_balance.py`), give their probabilities. The corrections that together have the probability CONFIDENCE are
named, unless the unchanged file is among them. A recording without metered flows has no absolute scale: a valve that
hardly opens looks like tanks that are too small.

An unusual plant is not mistaken for a wrong unit: a leak or a plugged pipe changes a coefficient of the balance by some
factor, but rarely by one that is close to the ratio of two units. The unit of one sensor alone, and a misplaced decimal
point in the area of its tank, are doubts only (`doubtful_units`), because a sensor that follows the level badly looks
the same: whether its recording is refused is left to `gap.preprocess.recording_faults`, where effects of the plant
compete. A command of many times its pump's maximum needs no balance: no effect of the plant changes what is asked for
(`excessive_flows`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.quantities import display_unit, quantity_text, unit_factor
from fdi_torch.recording import Recording
from fdi_torch.recordings.volume_balance import DEVIATION, UNRELATED, Balance, balance_along
from fdi_torch.units import same_kind

UNITS = {
    "m": ("mm", "cm", "in", "dm", "ft", "m"),
    "Pa": ("Pa", "mbar", "kPa", "psi", "bar"),
    "m^2": ("mm^2", "cm^2", "dm^2", "m^2"),
    "m^3/s": ("ml/min", "cm^3/s", "l/h", "l/min", "gal/min", "l/s", "m^3/h", "m^3/s"),
    "s": ("ms", "s", "min", "h"),
}
"""The usual units of each kind of number."""
DECIMAL_SLIPS = (0.1, 10.0)
"""Ratios of the area of a tank to the right one where its decimal point is misplaced. Both flows of a tank change by
this ratio, which an effect of the plant seldom does; areas of usual units differ by 100."""
PRIOR = 0.01
"""Probability that a unit is wrong before the recording is seen, shared equally by all corrections."""
CONFIDENCE = 0.95
"""Probability of the corrections that are named, together."""
EXCESSIVE = math.sqrt(60.0)
"""A command of more than this share of its pump's maximum has a wrong unit, or the maximum is wrong. A unit per second
in place of one per minute, or per minute in place of one per hour, is a factor of 60: its square root lies, in ratio,
as far from a right command of the whole maximum as from one in a wrong unit. A controller may ask for somewhat more
than its pump delivers; of one that asks for more than this, the recording must be declared `trusted`."""


@dataclass(frozen=True)
class Correction:
    """A probable mistake of units. names: the numbers concerned. written, right: the unit they have, and the one they
    should have. ratio: of these units. balance: of the plant with the numbers in the right unit. columns: of sensors
    concerned."""

    names: str
    written: str
    right: str
    ratio: float
    balance: Balance
    columns: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        size = f"{float(f'{max(self.ratio, 1.0 / self.ratio):.3g}'):.7g}"
        direction = "large" if self.ratio > 1.0 else "small"
        return f"{self.names} {size} times too {direction} (write {self.right} in place of {self.written})"


def wrong_units(plant: PlantDescription, recording: Recording) -> str:
    """A sentence on numbers that are probably in a wrong unit, and the unit to write; empty if there are none."""
    as_is = balance_along(plant, recording) if plant.metered_flows() else Balance(())
    corrections = list(_corrections(plant, recording, as_is)) if as_is.is_metered else []
    credible = _credible(as_is, corrections, UNRELATED)
    return f"units: by the volume balance of the tanks, {_alternatives(credible)}" if credible else ""


def excessive_flows(plant: PlantDescription, recording: Recording) -> list[tuple[str, str]]:
    """Channels that ask for EXCESSIVE times what their pump delivers, in more than a single sample, and a sentence."""
    excessive = []
    for pump in plant.metered_flows():
        if pump.channel not in recording.input_names:
            continue
        command = recording.inputs[:, recording.input_names.index(pump.channel)]
        highest = pump.gain * command[torch.isfinite(command)].sort(descending=True).values[:2]
        if len(highest) == 2 and float(highest[1]) > EXCESSIVE * pump.max_flow:
            high, most = float(highest[0]), pump.max_flow
            texts = [quantity_text(flow, "m^3/s", name=pump.channel) for flow in (high, most)]
            unit = _unit_within(high / most, _written("m^3/s", pump.channel, recording))
            named = pump.command_unit == "m^3/s" and unit
            fix = f"if its unit is {unit}, write" if named else "if its unit is another, state it under"
            text = (
                f"{pump.channel}: up to {texts[0]}, {high / most:.3g} times {pump.name}'s maximum of {texts[1]}; {fix} "
                f"columns: {{{pump.channel}: {{unit: {unit if named else '...'}}}}}; otherwise correct max_flow of "
                f"{pump.name}"
            )
            excessive.append((pump.channel, text))
    return excessive


def _unit_within(excess: float, written: str) -> str:
    """The usual unit of flow in which a flow of `excess` times a maximum comes closest to it from below; '' if none."""
    shares = {unit: excess / ratio for unit, ratio in _other_units("m^3/s", written)}
    within = {unit: share for unit, share in shares.items() if 1.0 / EXCESSIVE < share <= 1.0}
    unit = max(within, key=lambda each: within[each], default="")
    return unit.replace("l/", "L/") if "L" in written else unit


def doubtful_units(plant: PlantDescription, recording: Recording) -> list[tuple[str, str]]:
    """Sensors whose unit alone, or whose tank's area, is probably wrong, if their readings depend on the flows: columns
    and a sentence.

    Where all levels rest, readings that do not depend on the flows explain the balance as well as a wrong unit does:
    those of a stuck sensor, for example. A unit that explains the balance less well than these is left out.
    """
    recorded = set(plant.channels()) <= set(recording.input_names)
    as_is = balance_along(plant, recording) if plant.metered_flows() and recorded else Balance(())
    sensors = [(s,) for s in plant.sensors if s.column in recording.output_names]
    corrections = list(_reading_corrections(plant, recording, sensors)) if as_is.is_metered else []
    corrections += _decimal_slips(plant, recording, as_is) if as_is.is_metered else []
    credible = _credible(as_is, corrections, 0.0)
    worse = math.log(1.0 / CONFIDENCE - 1.0)
    if not credible or any(_lead(each, as_is, UNRELATED) < worse for each in credible) or wrong_units(plant, recording):
        return []
    columns = ", ".join(dict.fromkeys(column for each in credible for column in each.columns))
    unless = f"unless {columns} does not follow the level"
    return [(columns, f"by the volume balance of the tanks, {_alternatives(credible)}, {unless}")]


def _credible(as_is: Balance, corrections: list[Correction], unrelated: float) -> list[Correction]:
    """The likeliest corrections with the probability CONFIDENCE together; none if the unchanged file is among them.

    unrelated: probability that readings do not depend on the flows.
    """
    evidence = torch.tensor([0.0, *(_lead(each, as_is, unrelated) for each in corrections)], dtype=torch.float64)
    prior = torch.tensor([1.0 - PRIOR, *(PRIOR / len(corrections) for _ in corrections)], dtype=torch.float64)
    probability, order = torch.softmax(evidence + prior.log(), dim=0).sort(descending=True)
    credible = order[probability.cumsum(0) - probability < CONFIDENCE].tolist()
    return [] if 0 in credible else [corrections[i - 1] for i in credible]


def _lead(correction: Correction, as_is: Balance, unrelated: float) -> float:
    """Gain in log evidence by a correction.

    A correction that puts a level above a pump's cut-out leaves a tank without a balance, which counts as no gain.
    """
    return float((correction.balance.log_evidence(unrelated) - as_is.log_evidence(unrelated)).nansum())


def _alternatives(corrections: list[Correction]) -> str:
    return " or ".join(each.text for each in corrections)


def expect_right_units(plant: PlantDescription, recording: Recording) -> None:
    """Raises ValueError if units are wrong, unless the recording is trusted."""
    excessive = "; ".join(text for _, text in excessive_flows(plant, recording))
    if not recording.trusted and (wrong := excessive or wrong_units(plant, recording)):
        raise ValueError(refusal(recording, wrong))


def refusal(recording: Recording, problem: str) -> str:
    """Why a recording is refused, and what to do if it is right after all."""
    return f"{recording.source}: {problem}; if the recording is right, state trusted: true beside the file"


def _corrections(plant: PlantDescription, recording: Recording, as_is: Balance) -> Iterator[Correction]:
    area = display_unit("m^2")[0]
    all_tanks = torch.ones(len(plant.tanks), dtype=torch.float64)
    areas = [(f"tanks.{t.name}.area is", one, 0.0) for t, one in zip(plant.tanks, all_tanks.diag(), strict=True)]
    areas += [("the areas of all tanks are", all_tanks, 0.0)] if len(plant.tanks) > 1 else []
    if plant.pipes:
        areas += [("the areas of all pipes are", 0.0 * all_tanks, 1.0)]
        areas += [("the areas of all tanks and pipes are", all_tanks, 1.0)]
    for right, ratio in _other_units("m^2", area):
        for names, tanks, pipes in areas:
            smaller = as_is.scaled(metered=ratio**tanks, by_laws=ratio ** (tanks - pipes))
            yield Correction(names, area, right, ratio, smaller)
    channels = [component.channel for component in plant.metered_flows()]
    written = _written("m^3/s", channels[0], recording)
    for right, ratio in _other_units("m^3/s", written):
        slower = as_is.scaled(metered=all_tanks / ratio, by_laws=all_tanks)
        yield Correction(f"the flows of {', '.join(channels)} are", written, right, ratio, slower)
    kinds = [[s for s in plant.sensors if s.unit == kind] for kind in ("m", "Pa")]
    yield from _reading_corrections(plant, recording, [sensors for sensors in kinds if sensors])
    written = recording.written.get("t", "")  # none: the clock has dates, or is that of a simulation
    for right, ratio in _other_units("s", written) if written else ():
        yield Correction("the times are", written, right, ratio, as_is.scaled(all_tanks / ratio, all_tanks / ratio))


def _decimal_slips(plant: PlantDescription, recording: Recording, as_is: Balance) -> Iterator[Correction]:
    """Corrections of the area of one tank whose level is read."""
    each_tank = torch.eye(len(plant.tanks), dtype=torch.float64)
    for tank, one in zip(plant.tanks, each_tank, strict=True):
        columns = tuple(s.column for s in plant.sensors if s.tank == tank.name and s.column in recording.output_names)
        for ratio in DECIMAL_SLIPS if columns else ():
            written, right = (quantity_text(area, "m^2") for area in (tank.area, tank.area / ratio))
            smaller = as_is.scaled(metered=ratio**one, by_laws=ratio**one)
            yield Correction(f"tanks.{tank.name}.area is", written, right, ratio, smaller, columns)


def _reading_corrections(
    plant: PlantDescription, recording: Recording, groups: Iterable[Sequence[Sensor]]
) -> Iterator[Correction]:
    """Corrections of the readings of each group of sensors, which have one unit; m or Pa."""
    for sensors in groups:
        kind, columns = sensors[0].unit, tuple(sensor.column for sensor in sensors)
        number = {"m": "level", "Pa": "pressure"}.get(kind)
        written = _written(kind, columns[0], recording) if number else ""
        names = f"the {number} {columns[0]} is" if len(columns) == 1 else f"the {number}s {', '.join(columns)} are"
        alone = len(sensors) < sum(s.unit == kind for s in plant.sensors)
        for right, ratio in _other_units(kind, written) if number else ():
            # Of a sensor alone, a factor such as that of inches is rather due to swapped sensors or an effect.
            if alone and not _is_power_of_ten(ratio):
                continue
            if balance := _with_readings(plant, recording, columns, ratio):
                yield Correction(names, written, right, ratio, balance, columns)


def _with_readings(
    plant: PlantDescription, recording: Recording, columns: Collection[str], ratio: float
) -> Balance | None:
    """The balance with readings `ratio` times too large, or None if the corrected ones lie above a rim."""
    sensors = (
        replace(s, gain=ratio * s.gain, offset=ratio * s.offset) if s.column in columns else s for s in plant.sensors
    )
    corrected = replace(plant, sensors=tuple(sensors))
    if any(exceeds_limits(corrected, column, recording.valid_readings(column)) for column in columns):
        return None
    first = {s.tank: s.column for s in reversed(plant.sensors) if s.column in recording.output_names}  # gives the level
    units = {tank: 1.0 / ratio for tank, column in first.items() if column in columns}
    return balance_along(corrected, recording, units)


def exceeds_limits(plant: PlantDescription, channel: str, values: Tensor) -> bool:
    """Whether more than one of the values (T,) of a channel is impossible: a level above the rim, whose height may
    deviate as other constants do, a flow of EXCESSIVE times its pump's maximum, or a valve that is more than open.
    """
    shares = [
        (values - s.offset) / s.gain / plant.tank(s.tank).height / (1.0 + DEVIATION)
        for s in plant.sensors
        if s.column == channel
    ]
    shares += [values * p.gain / p.max_flow / EXCESSIVE for p in plant.metered_flows() if p.channel == channel]
    shares += [values / (1.0 + DEVIATION) for pipe in plant.pipes if pipe.valve == channel]
    return any(int((share > 1.0).sum()) > 1 for share in shares)


def _other_units(kind: str, written: str) -> list[tuple[str, float]]:
    """The usual units of this kind other than the written one, and the ratio of the written one to them."""
    ratios = {unit: unit_factor(written, kind) / unit_factor(unit, kind) for unit in UNITS[kind]}
    return [(unit, ratio) for unit, ratio in ratios.items() if abs(ratio - 1.0) > 1e-6]


def _is_power_of_ten(ratio: float) -> bool:
    decade = math.log10(ratio)
    return abs(decade - round(decade)) < 1e-6


def _written(kind: str, channel: str, recording: Recording) -> str:
    """The unit of this kind in which the channel was recorded, or else the usual one."""
    written = recording.written.get(channel, "")
    return written if same_kind(written, (kind,)) else display_unit(kind)[0]
