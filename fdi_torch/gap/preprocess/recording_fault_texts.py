"""A fault of a recording, and the sentence that says what to do about each kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fdi_torch.plant.description import Sensor


@dataclass(frozen=True)
class RecordingFault:
    """A fault of the recording: its channels, and a sentence that says what to do.

    silent: the channels are sensors whose readings do not depend on their levels. physical: the sensor
    itself, such as one that lags or leads, would look the same, so that the gap diagnosis must accept the recording.
    swapped: the channels have each other's values.
    """

    channels: tuple[str, ...]
    text: str
    silent: bool = False
    physical: bool = False
    swapped: bool = False


def wrong_unit(channel: str, decade: int) -> RecordingFault:
    """The values of a channel are 10^decade times the true ones."""
    times = f"{10 ** abs(decade)} times too {'large' if decade > 0 else 'small'}"
    fix = f"columns: {{{channel}: {{unit: ...}}}}"
    text = f"its unit seems wrong: its values are {times}; state the unit under {fix}"
    return RecordingFault((channel,), f"{channel}: {text}, or correct its gain in the plant file")


def swapped(a: str, b: str) -> RecordingFault:
    """Two channels have each other's values."""
    fix = f"columns: {{{a}: {{column: {b}}}, {b}: {{column: {a}}}}}"
    return RecordingFault((a, b), f"{a} and {b} seem to be swapped; assign the columns, as in {fix}", swapped=True)


def clock_offset(columns: tuple[str, ...], delay: float, everything: bool) -> RecordingFault:
    """Time stamps of readings that are `delay` seconds late. everything: all readings are, relative to the inputs."""
    what = "the readings" if everything else ", ".join(columns)
    reference = "the inputs" if everything else "the other channels"
    fix = ", ".join([f"t: {{shift: {-delay:.3g} s}}", *(f"{column}: {{column: {column}}}" for column in columns)])
    text = (
        f"{what}: time stamps are {abs(delay):.3g} s too {'late' if delay > 0 else 'early'} compared with {reference}; "
        f"if their clock is wrong, read these columns from the file a second time with a shifted clock: also: "
        f"[{{file: ..., columns: {{{fix}}}}}]"
    )
    return RecordingFault(("all",) if everything else columns, text, physical=not everything)


def not_held(channels: Sequence[str], interval: float) -> RecordingFault:
    """Commands whose values between samples, `interval` seconds apart, are unknown."""
    text = (
        f"{', '.join(channels)}: the flow between samples, one every {interval:g} s, is unknown: levels change before "
        "the command that changes them is read; log commands faster, or their mean over each interval"
    )
    return RecordingFault(tuple(channels), text)


def unrelated(sensor: Sensor) -> RecordingFault:
    """The readings of a sensor scatter about a mean and do not depend on the level."""
    text = (
        f"{sensor.column}: its readings do not follow the level of {sensor.tank}: they scatter by more than the level "
        "moves; check its wiring, or leave the sensor out of the plant file"
    )
    return RecordingFault((sensor.column,), text, True)


def stuck(columns: Sequence[str]) -> RecordingFault:
    """Sensors that never move."""
    return RecordingFault(tuple(columns), f"{', '.join(columns)}: stuck throughout", True)
