"""The channels of all topics, which describe their messages, and the number of messages of each.

A topic's channel is registered with its first message. A later message with further fields gets a further channel of
the same topic, so that a schema describes every message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import orjson

from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.payload import NON_FINITE, WALL
from fdi_torch.logbook.schemas import json_schema, named_kinds
from fdi_torch.logbook.topic_definitions import FORMAT_VERSION, Kind, Topic, topic_definition


class Register:
    """The current channel of each topic; sequence numbers continue over all channels of a topic."""

    def __init__(self) -> None:
        self._described: dict[str, tuple[frozenset[str], Channel]] = {}
        self._count: dict[str, int] = {}

    def channel(
        self,
        topic: str,
        fields: Mapping[str, Any],
        message: Mapping[str, Any],
        named_units: Mapping[str, str] | None = None,
        about: Mapping[str, str] | None = None,
    ) -> Channel:
        """The topic's channel; a new one if the message has fields that the current one does not describe.

        fields: as given. message: the same as plain values. named_units: of fields beyond the topic's own. about:
        further metadata, used with the first message.
        Raises ValueError for field names that the topic does not allow.
        """
        described, channel = self._described.get(topic, (frozenset(), None))
        if channel is not None and described.issuperset(fields):
            return channel
        present = [name for name, value in fields.items() if value is not None]
        if channel is not None and described.issuperset(present):
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
            **{f"unit.{name}": unit for name, unit in (named_units or {}).items()},
            **(about or {}),
        }
        schema = json_schema(definition, named)
        channel = Channel(topic, "json", definition.schema, "jsonschema", schema, tuple(pairs.items()))
        self._described[topic] = (frozenset({"t", *definition.fields, *named}), channel)
        return channel

    def count(self, topic: str) -> int:
        """The number of messages so far, which is the next sequence number."""
        return self._count.get(topic, 0)

    def next_number(self, topic: str) -> int:
        """Take the next sequence number of the topic."""
        number = self._count.get(topic, 0)
        self._count[topic] = number + 1
        return number

    def next_numbers(self, topics: Sequence[str], count: int) -> tuple[list[Channel], list[int]]:
        """The channels of `count` further messages of each topic, and their first sequence numbers."""
        first = [self.count(topic) for topic in topics]
        self._count.update({topic: number + count for topic, number in zip(topics, first, strict=True)})
        return [self._described[topic][1] for topic in topics], first

    def follow_on(self, channel: Channel, sequence: int) -> None:
        """Continue description and numbering as if the message (channel, sequence) had just been written."""
        if self._described.get(channel.topic, (None, None))[1] != channel:
            properties = orjson.loads(channel.schema_data)["properties"]
            self._described[channel.topic] = (frozenset(properties), channel)
        self._count[channel.topic] = sequence + 1


def _check_names(topic: str, definition: Topic, named: Mapping[str, Kind]) -> None:
    if named and not definition.named:
        raise ValueError(f"{topic}: expected only {', '.join(definition.fields)}, got {', '.join(named)}")
    for name in named:
        if name in (NON_FINITE, WALL):
            raise ValueError(f"{topic}: expected a name other than {NON_FINITE} and {WALL}, got {name}; rename it")


def _kind(value: Any) -> Kind:
    """JSON kind of a plain value; None is a number that was omitted as non-finite."""
    if isinstance(value, list):
        first = value[0] if value else 0.0
        return "texts" if isinstance(first, str) else "integers" if type(first) is int else "numbers"
    if isinstance(value, bool):
        return "boolean"
    return "text" if isinstance(value, str) else "number"
