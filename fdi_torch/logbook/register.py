"""The channel of each topic, which describes its messages, and how many of them there were.

A topic's channel is registered with its first message. A later message with further fields gets a further channel of
the same topic, so that every message is described by a schema.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import orjson

from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.payload import NON_FINITE, WALL
from fdi_torch.logbook.schemas import FORMAT_VERSION, Kind, Topic, json_schema, named_kinds, topic_definition


class Register:
    """One channel a topic at a time; sequence numbers count on over all of its channels."""

    def __init__(self) -> None:
        self._described: dict[str, tuple[frozenset[str], Channel]] = {}
        self._count: dict[str, int] = {}

    def __contains__(self, topic: str) -> bool:
        return topic in self._described

    def channel(
        self,
        topic: str,
        fields: Mapping[str, Any],
        message: Mapping[str, Any],
        told_units: Mapping[str, str] | None = None,
        about: Mapping[str, str] | None = None,
    ) -> Channel:
        """The topic's channel; a new one where the message has fields that it does not describe.

        fields: as given. message: the same as plain values. about: further metadata, heard at the first message.
        Raises ValueError for names that the topic does not take.
        """
        known, channel = self._described.get(topic, (frozenset(), None))
        if channel is not None and known.issuperset(fields):
            return channel
        present = [name for name, value in fields.items() if value is not None]
        if channel is not None and known.issuperset(present):
            return channel
        definition = topic_definition(topic)
        named = named_kinds(definition, channel.schema_data) if channel else {}
        named.update({name: _kind(message.get(name)) for name in present if name not in definition.fields})
        _check_names(topic, definition, named)
        units = {f"unit.{name}": unit for name, (_, unit, _) in definition.fields.items() if unit}
        previous = dict(channel.metadata) if channel else {}
        pairs = {
            "schema_version": FORMAT_VERSION,
            "unit.t": "s",
            **units,
            **previous,
            **units_of(told_units),
            **(about or {}),
        }
        schema = json_schema(definition, named)
        channel = Channel(topic, "json", definition.schema, "jsonschema", schema, tuple(pairs.items()))
        self._described[topic] = (frozenset({"t", *definition.fields, *named}), channel)
        return channel

    def count(self, topic: str) -> int:
        """Messages so far: the sequence number of the next one."""
        return self._count.get(topic, 0)

    def next_number(self, topic: str) -> int:
        """The sequence number of a further message."""
        number = self._count.get(topic, 0)
        self._count[topic] = number + 1
        return number

    def next_numbers(self, topics: Sequence[str], count: int) -> tuple[list[Channel], list[int]]:
        """The channels of so many further messages of each topic, and the sequence numbers of the first ones."""
        first = [self.count(topic) for topic in topics]
        self._count.update({topic: number + count for topic, number in zip(topics, first, strict=True)})
        return [self._described[topic][1] for topic in topics], first

    def follow_on(self, channel: Channel, sequence: int) -> None:
        """Describe and number what comes as if the message (channel, sequence) had just been written."""
        if self._described.get(channel.topic, (None, None))[1] != channel:
            properties = orjson.loads(channel.schema_data)["properties"]
            self._described[channel.topic] = (frozenset(properties), channel)
        self._count[channel.topic] = sequence + 1


def units_of(units: Mapping[str, str] | None) -> dict[str, str]:
    """Units as channel metadata: {"h1": "m"} -> {"unit.h1": "m"}."""
    return {f"unit.{name}": unit for name, unit in (units or {}).items()}


def _check_names(topic: str, definition: Topic, named: Mapping[str, Kind]) -> None:
    if named and not definition.named:
        raise ValueError(f"{topic}: expected only {', '.join(definition.fields)}, got {', '.join(named)}")
    for name in named:
        if name in (NON_FINITE, WALL):
            raise ValueError(f"{topic}: expected a name other than {NON_FINITE} and {WALL}, got {name}; rename it")


def _kind(value: Any) -> Kind:
    """JSON kind of a plain value; None stands for a number that was left out as non-finite."""
    if isinstance(value, list):
        first = value[0] if value else 0.0
        return "texts" if isinstance(first, str) else "integers" if type(first) is int else "numbers"
    if isinstance(value, bool):
        return "boolean"
    return "text" if isinstance(value, str) else "number"
