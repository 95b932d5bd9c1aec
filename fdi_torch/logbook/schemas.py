"""The fields of each topic's messages, as flat JSON schemas that viewers can read.

Viewers reject or ignore references, unions, nullable types, arrays of arrays and arrays without item type. Matrices are
therefore flat with their shape beside them, and quantities for plots are named numbers at the top level. Every message
has `t`, the plant's time in s since its start. All numbers are SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import orjson

from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.topic_definitions import TOPICS, Kind, Topic

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
    kinds = _kinds(topic, schema)
    if not kinds:
        return Fields(topic, fields)
    kept = {k: v for k, v in fields.items() if (_is_of(kinds[k], v) if k in kinds else _is_plain(v))}
    return Fields(topic, kept)


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
    schema = {
        "title": definition.schema,
        "description": definition.meaning,
        "type": "object",
        "properties": properties,
        "required": ["t"],
    }
    return orjson.dumps(schema)


def named_kinds(definition: Topic, schema: bytes) -> dict[str, Kind]:
    """The kinds of the fields that a schema has beyond the topic's own: the inverse of `json_schema`."""
    reserved = {"t", "non_finite", "wall", *definition.fields}
    kinds = {orjson.dumps(json): kind for kind, json in _JSON.items()}
    properties = orjson.loads(schema)["properties"]
    return {name: kinds[orjson.dumps(part)] for name, part in properties.items() if name not in reserved}
