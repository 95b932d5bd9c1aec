"""What a file says about a topic."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Channel:
    """Encoding, schema and metadata of a topic (pairs, so that channels can be compared and counted)."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = b""
    metadata: tuple[tuple[str, str], ...] = ()
