"""Sections about configuration, provenance and integrity of the log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi_torch.names import counted
from fdi_torch.report.html import folded, pairs, table, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number
from fdi_torch.report.section import Section

MOST_TEXT = 40_000
RECORDS = {"run": "Run", "data": "Data", "seeds": "Seeds", "env": "Versions", "git": "Code", "result": "Result"}
_LEVELS = {3: "warning", 4: "error", 5: "fatal"}


def configuration_section(material: Material) -> Section | None:
    """The original configuration file."""
    raw = material.run.attachment("config.yaml") if "config.yaml" in material.run.attachments else b""
    text = raw.decode(errors="replace")
    if not text:
        return None
    cut = [tag("p", "The remainder is in the log.", class_="note")] if len(text) > MOST_TEXT else []
    return Section("Configuration", [folded("original file (YAML)", tag("pre", text[:MOST_TEXT]), *cut)])


def provenance_section(material: Material) -> Section | None:
    """Versions, seeds, hashes of the data, and the log's name; lists and tables have sections of their own."""
    blocks = [pairs([("log", material.run.path.name), ("written by", material.run.library)])]
    for record, title in RECORDS.items():
        values = material.about(record)
        if values:
            known = [(name, value) for name, value in values.items() if value not in ("", "null")]
            plain = [(name, value) for name, value in known if not value.startswith(("[", "{"))]
            blocks += [folded(f"{title} ({len(plain)})", pairs(plain))] if plain else []
    return Section("Provenance", blocks)


def health_section(material: Material) -> Section | None:
    """CRCs, indices, completeness, log messages, and the number of messages per topic."""
    inspection = material.inspection
    problems = [*inspection.health.problems, *material.trouble]
    state = tag("span", "damaged", class_="bad") if problems else tag("span", "intact", class_="good")
    topics, chunks = inspection.topics.values(), counted(inspection.health.chunks, "chunk")
    content = f"{counted(inspection.messages, 'message')} on {counted(len(topics), 'topic')} in {chunks}"
    rows = [[info.topic, str(info.messages), number(info.first), number(info.last)] for info in topics]
    messages = [_log_message(message) for message in material.of("/log")]
    return Section(
        "Integrity of the log",
        [
            tag("p", "The file is ", state, f": {content}, {inspection.size} bytes."),
            *([tag("ul", *(tag("li", problem) for problem in problems))] if problems else []),
            *([inspection.advice] if inspection.advice else []),
            *([folded(f"Log messages ({len(messages)})", tag("ul", *messages))] if messages else []),
            folded("Topics", table(("topic", "messages", "from, s", "to, s"), rows)),
        ],
    )


def _log_message(message: Mapping[str, Any]) -> str:
    level = _LEVELS.get(message.get("level", 0), "")
    return tag("li", f"{level}: " if level else "", message.get("message", ""))
