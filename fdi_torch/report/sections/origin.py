"""What the run was asked to do, where it comes from, and whether its log is sound."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi_torch.report.html import folded, pairs, table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number
from fdi_torch.report.section import Section

MOST_TEXT = 40_000
RECORDS = {"run": "Run", "data": "Data", "seeds": "Seeds", "env": "Versions", "git": "Code", "result": "Result"}
_LEVELS = {3: "warning", 4: "error", 5: "fatal"}


def configuration_section(material: Material) -> Section | None:
    """The configuration exactly as it was given."""
    raw = material.run.attachment("config.yaml") if "config.yaml" in material.run.attachments else b""
    text = raw.decode(errors="replace")
    if not text:
        return None
    cut = [tag("p", "The rest is in the log.", class_="note")] if len(text) > MOST_TEXT else []
    return Section("Configuration", [folded("as it was given (YAML)", tag("pre", text[:MOST_TEXT]), *cut)])


def provenance_section(material: Material) -> Section | None:
    """Versions, seeds, the data's fingerprints and the log's own path."""
    blocks = [pairs([("log", material.run.path.name), ("written by", material.run.library)])]
    for record, title in RECORDS.items():
        values = material.about(record)
        if values:
            blocks.append(folded(f"{title} ({len(values)})", pairs(list(values.items()))))
    return Section("Provenance", blocks)


def health_section(material: Material) -> Section | None:
    """CRCs, indices, completeness, what was said, and how many messages each topic has."""
    found = material.inspection
    problems = [*found.health.problems, *material.trouble]
    state = tag("span", "not sound", class_="bad") if problems else tag("span", "sound", class_="good")
    chunks = "chunk" if found.health.chunks == 1 else "chunks"
    counted = (
        f"{found.messages} messages on {len(found.topics)} topics in {found.health.chunks} {chunks}, {found.size} bytes"
    )
    rows = [[info.topic, str(info.messages), number(info.first), number(info.last)] for info in found.topics.values()]
    said = [_spoken(message) for message in material.of("/log")]
    return Section(
        "Health of the log",
        [
            tag("p", "The file is ", state, f": {counted}."),
            *([tag("ul", *(tag("li", problem) for problem in problems))] if problems else []),
            *([found.advice] if found.advice else []),
            *([folded(f"What was said ({len(said)})", tag("ul", *said))] if said else []),
            folded("Topics", table(("topic", "messages", "from, s", "to, s"), rows)),
        ],
    )


def _spoken(message: Mapping[str, Any]) -> str:
    level = _LEVELS.get(message.get("level", 0), "")
    return tag("li", f"{level}: " if level else "", message.get("message", ""))
