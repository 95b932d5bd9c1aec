"""The entry of a live source in a monitor file, and the rows that it delivers."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from typing import Literal

from pydantic import Field, field_validator

from fdi_torch.config.channels import expect_units
from fdi_torch.config.problems import naming
from fdi_torch.config.recording_config import StartLevels
from fdi_torch.config.strict import Amount, HeldFor, Seconds, Strict, quantity
from fdi_torch.live.row_buffer import LiveChannel, Row, RowBuffer, RowSource
from fdi_torch.live.values import Address, Connection, address_of
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recording import Hold

POLL = 0.1
"""Longest time between two looks at the row buffer, s."""


class TagConfig(Strict):
    tag: str | None = Field(
        None,
        description="address of the value: TOPIC or TOPIC:FIELD (MQTT), node such as ns=2;s=Rig.h1 (OPC UA), or "
        "holding:100:float32 (Modbus: coil, discrete, input or holding; address from 0; type, by default uint16)",
    )
    unit: str | None = Field(None, description="unit of its numbers, as in cm")
    factor: float = Field(1.0, description="the number is multiplied by this")
    offset: float = Field(0.0, description="added after that, in `unit`")
    constant: Amount | None = Field(None, description="the value of an input that is not delivered")
    held: HeldFor | None = Field(
        None, description="time for which a value is kept until the next; by default inputs always, readings never"
    )


class LiveClockConfig(Strict):
    tag: str = Field(description="MQTT: field of each message with the time; Modbus: register with the time")
    unit: str | None = Field(None, description="unit of the time if it is a number; without it, ISO 8601 stamps")
    unix: bool = Field(False, description="whether its numbers count from 1970")


class SourceConfig(Strict):
    url: str = Field(description="mqtt://HOST[:PORT][/TOPIC], opcua://HOST[:PORT][/PATH] or modbus://HOST[:PORT]")
    tags: dict[str, TagConfig] = Field(description="address and unit of each input and sensor of the plant")
    clock: LiveClockConfig | None = Field(
        None, description="time of the samples; by default stamps of the server (OPC UA) or the time of arrival"
    )
    period: Seconds = Field(1.0, gt=0, description="interval of polling and sampling, s")
    align: Seconds | None = Field(
        None,
        ge=0,
        description="times are rounded to its multiples, so that values form rows, s; by default the period where each "
        "value has a time of its own, and 0 s (no rounding) elsewhere",
    )
    reorder: Seconds = Field(0.5, ge=0, description="time for which a row waits for values and earlier rows, s")
    device: int = Field(1, ge=0, le=255, description="Modbus: unit identifier of the device")
    word_order: Literal["big", "little"] = Field("big", description="Modbus: register that comes first in longer types")
    session: str = Field("", description="MQTT: name under which the broker keeps messages for this monitor")
    hold: Hold = Field("zero_order", description="course of inputs between samples")
    start_levels: StartLevels = Field("free", description="free, equilibrium, or a mapping such as {T1: 50 cm}")

    @field_validator("url")
    @classmethod
    def _url(cls, value: str) -> str:
        address_of(value)
        return value


def live_rows(
    config: SourceConfig,
    plant: PlantDescription,
    idle: float = math.inf,
    origin: float | None = None,
    earlier: Iterable[Row] = (),
) -> RowSource:
    """Rows of a live source, and a sentence for each event of the connection.

    Ends when no new row has arrived for `idle` s. earlier: rows of an earlier run that is resumed; origin: the time
    origin of that run.
    Raises ConfigError for an unusable mapping, and if the source cannot be reached at first.
    """
    with naming("source"):
        address = address_of(config.url)
        inputs, outputs = _channels(config, plant, address)
        tags = list(dict.fromkeys(c.tag for c in (*inputs, *outputs) if c.tag is not None))
        connection = _connection(config, address, tags)
    own_stamps = address.scheme == "opcua" or (config.clock is None and address.scheme.startswith("mqtt"))
    align = config.align if config.align is not None else config.period if own_stamps else 0.0
    buffer = RowBuffer(inputs, outputs, config.reorder, align, connection.dated, origin, earlier)
    return RowSource(_until_idle(connection, buffer, idle), lambda: buffer.origin if connection.dated else None)


def _until_idle(connection: Connection, buffer: RowBuffer, idle: float) -> Iterator[Row | str]:
    quiet_since = time.monotonic()
    try:
        while time.monotonic() - quiet_since <= idle:
            for item in connection.read(POLL):
                now = time.monotonic()
                if isinstance(item, str):
                    yield item
                else:
                    buffer.put(item, now)
            rows = buffer.rows(time.monotonic())
            if any(not isinstance(row, str) for row in rows):  # values that are repeated make no row
                quiet_since = time.monotonic()
            yield from rows
        yield from buffer.rows(time.monotonic(), all_of_them=True)
    finally:
        connection.close()


def _channels(
    config: SourceConfig, plant: PlantDescription, address: Address
) -> tuple[list[LiveChannel], list[LiveChannel]]:
    """The plant's inputs and outputs. Raises ValueError for an unknown or unmapped channel, and for a wrong unit."""
    inputs, outputs = plant.channels(), plant.outputs()
    openings = {p.valve: p.unrecorded for p in plant.pipes if p.valve and p.unrecorded is not None}
    for name in config.tags:
        if name not in (*inputs, *outputs):
            raise ValueError(f"tags.{name}: {unknown('a channel of the plant', name, [*inputs, *outputs])}")

    if unfinished := [name for name, tag in config.tags.items() if tag.tag is None and tag.constant is None]:
        raise ValueError(
            f"tags: expected either tag or constant of each channel, got none of {', '.join(unfinished)}; write the "
            "address of each value"
        )

    def channel(name: str, held: float) -> LiveChannel:
        if name not in config.tags and name in openings:
            return LiveChannel(name, None, constant=float(openings[name]))
        if name not in config.tags:
            raise ValueError(f"tags: expected a tag for each channel, got none for {name}; add {name}: {{tag, unit}}")
        return _channel(name, config.tags[name], plant, address, held)

    return [channel(name, math.inf) for name in inputs], [channel(name, 0.0) for name in outputs]


def _channel(name: str, tag: TagConfig, plant: PlantDescription, address: Address, held: float) -> LiveChannel:
    place = f"tags.{name}"
    if tag.tag is not None and tag.constant is not None:
        raise ValueError(f"{place}: expected either tag or constant, got both; drop one")
    if tag.constant is not None:
        if name not in plant.channels():
            raise ValueError(f"{place}.constant: expected this key of an input only; leave it out")
        return LiveChannel(name, None, constant=quantity(tag.constant, plant.channel_units()[name]))
    if tag.unit is None:
        raise ValueError(f"{place}: expected a unit, got none; add unit: cm or another")
    si_unit = si_unit_of(tag.unit)
    expect_units("source", (name,), (si_unit,), plant)
    unit = unit_factor(tag.unit, si_unit)
    held = held if tag.held is None else tag.held
    return LiveChannel(name, _full_tag(str(tag.tag), address), tag.factor * unit, tag.offset * unit, held=held)


def _full_tag(tag: str, address: Address) -> str:
    """The tag; below the topic of the URL for MQTT."""
    if not address.scheme.startswith("mqtt") or not address.path:
        return tag
    return address.path.rstrip("/") + (tag if tag.startswith(":") else f"/{tag}")


def _connection(config: SourceConfig, address: Address, tags: list[str]) -> Connection:
    clock = config.clock
    name = None if clock is None else clock.tag
    second = unit_factor(clock.unit, "s") if clock is not None and clock.unit else None
    dated = clock is not None and clock.unix
    if address.scheme.startswith("mqtt"):
        if any(mark in text for text in (config.url, *tags) for mark in "#+"):
            raise ValueError(f"url: expected a topic without the wildcards # and +, got '{config.url}'; give each tag")
        if name is not None and any(mark in name for mark in ":/"):
            field = name.rpartition(":")[2].rpartition("/")[2]
            raise ValueError(f"clock.tag: expected a field of the same JSON object, got '{name}'; write '{field}'")
        from fdi_torch.live.mqtt import MqttSource

        return MqttSource(address, tags, name, second, dated, config.session)
    if config.session:
        raise ValueError("session: expected this key of an MQTT source only; leave it out")
    if address.scheme == "opcua":
        if config.clock is not None:
            raise ValueError("clock: expected none for OPC UA, whose values have times of their own; leave it out")
        from fdi_torch.live.opcua import OpcUaSource

        # A row is complete before `reorder` ends if all its values come with one notification.
        return OpcUaSource(address, tags, config.period, min(config.period, 0.5 * config.reorder))
    from fdi_torch.live.modbus import ModbusSource

    if name is not None and second is None:
        raise ValueError("clock: expected a unit of the register's number, got none; add unit: s")
    order = config.word_order
    return ModbusSource(address, tags, config.period, name, second or 1.0, dated, config.device, order)
