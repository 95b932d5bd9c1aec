"""The fields of each topic's messages, as flat JSON schemas that viewers can read, and the channels with these schemas.

Viewers reject or ignore references, unions, nullable types, arrays of arrays and arrays without item type. Matrices are
therefore flat with their shape beside them, and quantities for plots are named numbers at the top level. Every message
has `t`, the plant's time in s since its start. All numbers are SI.

A topic's channel is registered with its first message. A later message with further fields gets a further channel of
the same topic, so that a schema describes every message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import orjson

from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.payload import NON_FINITE, WALL
from fdi_torch.logbook.topic_definitions import FORMAT_VERSION, TOPICS, Channel, Kind, Topic, topic_definition

_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_JSON: dict[Kind, dict[str, Any]] = {
    "number": {"type": "number"},
    "integer": {"type": "integer"},
    "boolean": {"type": "boolean"},
    "text": {"type": "string"},
    "numbers": {"type": "array", "items": {"type": "number"}},
    "integers": {"type": "array", "items": {"type": "integer"}},
    "texts": {"type": "array", "items": {"type": "string"}},
    "time": _TIME,
}


class Fields(dict[str, Any]):
    """The fields of a message; a missing field raises LogError with a sentence."""

    def __init__(self, topic: str, fields: Mapping[str, Any]) -> None:
        super().__init__(fields)
        self.topic = topic

    def __missing__(self, name: str) -> Any:
        raise LogError(f"{self.topic}: expected a field {name} in every message, got one without it")


def conforming(topic: str, schema: str, fields: Mapping[str, Any]) -> Fields:
    """The fields of a message that have the types of its topic; a log may come from anywhere.

    Fields of the topic must have their kind, and `t` must be a number; others must be numbers, texts or lists of these.
    Messages with other schemas are unchanged.
    """
    if kinds := _kinds(topic, schema):
        fields = {k: v for k, v in fields.items() if (_is_of(kinds[k], v) if k in kinds else _is_plain(v))}
    return Fields(topic, fields)


@lru_cache(maxsize=256)
def _kinds(topic: str, schema: str) -> dict[str, str]:
    """Kinds of a topic's own fields; empty for a message with another schema."""
    definition = TOPICS.get(f"/plant/{topic.rpartition('/')[2]}" if topic.startswith("/plant/") else topic)
    if definition is None or definition.schema != schema:
        return {}
    return {"wall": "time", "t": "number"} | {name: kind for name, (kind, _, _) in definition.fields.items()}


_PYTHON: dict[str, tuple[type, ...]] = {
    "number": (float, int), "integer": (int,), "boolean": (bool,), "text": (str,), "time": (dict,),
    "numbers": (float, int), "integers": (int,), "texts": (str,),
}  # fmt: skip


def _is_of(kind: str, value: Any) -> bool:
    types = _PYTHON[kind]
    if kind.endswith("s"):
        return isinstance(value, list) and all(isinstance(item, types) for item in value)
    return isinstance(value, types)


def _is_plain(value: Any) -> bool:
    if type(value) is float or type(value) is int:
        return True
    plain = (bool, float, int, str)
    return isinstance(value, plain) or (isinstance(value, list) and all(isinstance(v, plain) for v in value))


def json_schema(definition: Topic, named: Mapping[str, Kind]) -> bytes:
    """The JSON schema of a topic whose messages have further fields of the given kinds."""
    properties: dict[str, Any] = {"t": {"type": "number", "description": "time since start, s"}}
    for name, (kind, unit, meaning) in definition.fields.items():
        properties[name] = {**_JSON[kind], "description": f"{meaning}, {unit}" if unit else meaning}
    properties.update({name: dict(_JSON[kind]) for name, kind in named.items()})
    properties["non_finite"] = {**_JSON["texts"], "description": "numbers JSON cannot hold, as name=nan"}
    properties["wall"] = {**_TIME, "description": "wall-clock time, if requested"}
    about = {"title": definition.schema, "description": definition.meaning, "type": "object"}
    return orjson.dumps({**about, "properties": properties, "required": ["t"]})


def named_kinds(definition: Topic, schema: bytes) -> dict[str, Kind]:
    """The kinds of the fields that a schema has beyond the topic's own: the inverse of `json_schema`."""
    reserved = {"t", "non_finite", "wall", *definition.fields}
    kinds = {orjson.dumps(json): kind for kind, json in _JSON.items()}
    properties = orjson.loads(schema)["properties"]
    return {name: kinds[orjson.dumps(part)] for name, part in properties.items() if name not in reserved}


class Register:
    """The current channel of each topic; sequence numbers continue over all channels of a topic."""

    def __init__(self) -> None:
        self._described: dict[str, tuple[frozenset[str], Channel]] = {}
        self._count: Counter[str] = Counter()

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
        if named and not definition.named:
            raise ValueError(f"{topic}: expected only {', '.join(definition.fields)}, got {', '.join(named)}")
        for name in named.keys() & {NON_FINITE, WALL}:
            raise ValueError(f"{topic}: expected a name other than {NON_FINITE} and {WALL}, got {name}; rename it")
        units = {f"unit.{name}": unit for name, (_, unit, _) in definition.fields.items() if unit}
        previous = dict(channel.metadata) if channel else {}
        further = {f"unit.{name}": unit for name, unit in (named_units or {}).items()} | dict(about or {})
        pairs = {"schema_version": FORMAT_VERSION, "unit.t": "s"} | units | previous | further
        schema = json_schema(definition, named)
        channel = Channel(topic, "json", definition.schema, "jsonschema", schema, tuple(pairs.items()))
        self._described[topic] = (frozenset({"t", *definition.fields, *named}), channel)
        return channel

    def take_numbers(self, topic: str, count: int = 1) -> int:
        """Take the next sequence numbers of the topic; returns the first."""
        first = self._count[topic]
        self._count[topic] += count
        return first

    def follow_on(self, channel: Channel, sequence: int) -> None:
        """Continue description and numbering as if the message (channel, sequence) had just been written."""
        if self._described.get(channel.topic, (None, None))[1] != channel:
            properties = orjson.loads(channel.schema_data)["properties"]
            self._described[channel.topic] = (frozenset(properties), channel)
        self._count[channel.topic] = sequence + 1


def _kind(value: Any) -> Kind:
    """JSON kind of a plain value; None is a number that was omitted as non-finite."""
    if isinstance(value, list):
        first = value[0] if value else 0.0
        return "texts" if isinstance(first, str) else "integers" if type(first) is int else "numbers"
    if isinstance(value, bool):
        return "boolean"
    return "text" if isinstance(value, str) else "number"
