"""Description of a topic in an MCAP file."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Channel:
    """Encoding, schema and metadata of a topic; metadata are pairs, so that channels can be compared and hashed."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = field(default=b"", hash=False)  # too long to be hashed for each message
    metadata: tuple[tuple[str, str], ...] = field(default=(), hash=False)

    @property
    def units(self) -> dict[str, str]:
        """The SI unit of each field that has one."""
        return {key.removeprefix("unit."): unit for key, unit in self.metadata if key.startswith("unit.")}
