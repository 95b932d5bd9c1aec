"""A hash of a log's content independent of chunks and wall time: topic, time and payload of every message."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable

import orjson

from fdi_torch.logbook.payload import WALL
from fdi_torch.logbook.reader import Message


def content_hash(messages: Iterable[Message]) -> str:
    """SHA-256 over the messages in their order, as hexadecimal text."""
    digest = hashlib.sha256()
    for message in messages:
        topic, data = message.topic.encode(), canonical(message)
        digest.update(struct.pack("<qqq", len(topic), message.log_time, len(data)) + topic + data)
    return digest.hexdigest()


def canonical(message: Message) -> bytes:
    """The payload in canonical form: JSON with sorted keys and without wall time; other encodings unchanged."""
    if message.channel.encoding != "json":
        return message.data
    try:
        fields = orjson.loads(message.data)
    except ValueError:
        return message.data
    if isinstance(fields, dict):
        fields.pop(WALL, None)
    return orjson.dumps(fields, option=orjson.OPT_SORT_KEYS)
