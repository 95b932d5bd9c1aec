"""Viewers can read every schema."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson
import pytest

from fdi_torch.logbook import read_run
from fdi_torch.logbook.schemas import json_schema
from fdi_torch.logbook.topic_definitions import TOPICS, topic_definition


@pytest.mark.parametrize("topic", TOPICS)
def test_viewers_read_the_schema(topic: str) -> None:
    schema = orjson.loads(json_schema(TOPICS[topic], {"h1": "number"}))
    assert viewer_problems(schema) == []
    assert schema["required"] == ["t"]


@pytest.mark.parametrize(
    ("schema", "problem"),
    [
        ({"$ref": "#/x", "type": "object"}, "$ref"),
        ({"type": ["number", "null"]}, "one plain type"),
        ({"anyOf": [], "type": "object"}, "anyOf"),
        ({"type": "array"}, "without item type"),
        ({"type": "array", "items": {"type": "array", "items": {"type": "number"}}}, "array of arrays"),
        ({"type": "object", "properties": {"a": {"type": "array"}}}, "schema.a"),
        ([], "expected an object"),
    ],
)
def test_the_check_finds_what_viewers_cannot_read(schema: object, problem: str) -> None:
    assert any(problem in found for found in viewer_problems(schema))


def test_every_message_of_a_full_log_fits_its_schema(finished: Path) -> None:
    kinds = {"number": (int, float), "integer": int, "boolean": bool, "string": str, "array": list, "object": dict}
    topics = set()
    for message in read_run(finished).messages():
        topics.add(message.topic)
        schema = orjson.loads(message.channel.schema_data)
        assert viewer_problems(schema) == []
        for name, value in orjson.loads(message.data).items():
            declared = schema["properties"][name]
            assert isinstance(value, kinds[declared["type"]]), (message.topic, name)
            items = value if isinstance(value, list) else []
            assert all(isinstance(item, kinds[declared["items"]["type"]]) for item in items)
    assert topics == set(TOPICS)


def test_an_unknown_topic_is_refused() -> None:
    assert topic_definition("/plant/first/input") is TOPICS["/plant/input"]
    with pytest.raises(ValueError, match="expected one of the topics /plant/input"):
        topic_definition("/plants/input")


def viewer_problems(schema: Any, place: str = "schema") -> list[str]:
    """The parts of a JSON schema that common viewers cannot read."""
    if not isinstance(schema, dict):
        return [f"{place}: expected an object, got {type(schema).__name__}"]
    banned = ("$ref", "anyOf", "oneOf", "allOf", "not", "if", "$defs", "definitions", "nullable")
    problems = [f"{place}: {word}" for word in banned if word in schema]
    kind = schema.get("type")
    if kind not in ("object", "array", "number", "integer", "boolean", "string"):
        problems.append(f"{place}: expected one plain type, got {kind}")
    if kind == "array":
        problems += _array_problems(schema.get("items"), place)
    return problems + _property_problems(schema.get("properties", {}), place)


def _array_problems(items: Any, place: str) -> list[str]:
    if not isinstance(items, dict):
        return [f"{place}: array without item type"]
    if items.get("type") in ("array", "object"):
        return [f"{place}: array of {items['type']}s"]
    return viewer_problems(items, f"{place}[]")


def _property_problems(properties: Mapping[str, Any], place: str) -> list[str]:
    return [problem for name, part in properties.items() for problem in viewer_problems(part, f"{place}.{name}")]
