"""What is wrong with a configuration, in sentences: file, field, what was expected, what was found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError


class ConfigError(ValueError):
    """A configuration that cannot be used. problems: one sentence each; the message is these sentences, one a line."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


def explain(error: ValidationError, source: str) -> ConfigError:
    """Pydantic's findings as sentences."""
    sentences = [f"{source}: {_path(e['loc'])}{_sentence(e)}" for e in error.errors(include_url=False)]
    return ConfigError(list(dict.fromkeys(sentences)))


def _path(location: tuple[int | str, ...]) -> str:
    return ".".join(str(part) for part in location) + ": " if location else ""


def _sentence(found: Any) -> str:
    if found["type"] == "missing":
        return "expected a value, got nothing; add it"
    if "error" in found.get("ctx", {}):
        return str(found["ctx"]["error"])
    expected = found["msg"].replace("Input should be", "expected").replace("Input should have", "expected")
    return f"{expected}, got {_shown(found['input'])}"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else text[:57] + "..."
