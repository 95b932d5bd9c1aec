"""Every schema is one that viewers read."""

from __future__ import annotations

from pathlib import Path

import orjson
import pytest

from fdi_torch.logbook import read_run
from fdi_torch.logbook.schemas import TOPICS, json_schema, topic_definition, viewer_problems


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
