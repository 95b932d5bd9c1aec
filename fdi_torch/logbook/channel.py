"""What a file says about a topic."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Channel:
    """Encoding, schema and metadata of a topic (pairs, so that channels can be compared and counted)."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = field(default=b"", hash=False)  # long, and looked up for each message
    metadata: tuple[tuple[str, str], ...] = field(default=(), hash=False)
