"""Configuration errors as sentences: file, field, expected and given value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from fdi_torch.quantities import NO_COMMAS

Model = TypeVar("Model", bound=BaseModel)


class ConfigError(ValueError):
    """A configuration that cannot be used. problems: one sentence each; the message has one sentence per line.

    place: the path of the key that the problems are about, with which each begins.
    """

    def __init__(self, problems: Sequence[str], place: str = "") -> None:
        self.place, self.sentences = place, tuple(problems)
        self.problems = tuple(f"{place}: {problem}" if place else problem for problem in problems)
        super().__init__("\n".join(self.problems))


@dataclass(frozen=True)
class Source:
    """Where a configuration comes from: its file, or other words for it, and overrides 'KEY=VALUE' of its values.

    within: a key around all that was given, which messages leave out.
    """

    file: str
    overrides: tuple[str, ...] = ()
    within: str = ""

    def __str__(self) -> str:
        return self.file

    def of(self, place: str) -> str:
        """Where the value of a key comes from: an override, the file, or the file with overrides of values within."""
        keys = {override: override.partition("=")[0] for override in self.overrides}
        whole = [override for override, key in keys.items() if f"{place}.".startswith(f"{key}.")]
        if whole:
            return f"--set {whole[-1]}"
        within = [f"--set {override}" for override, key in keys.items() if place and key.startswith(f"{place}.")]
        return " with ".join([self.file, *within])

    def at(self, place: str) -> str:
        """The beginning of a message about a key."""
        inside = place.removeprefix(self.within).removeprefix(".")
        return f"{self.of(place)}: {inside}" if inside else self.of(place)


class UnknownKeyError(ValueError):
    def __init__(self, sentence: str, key: str) -> None:
        super().__init__(sentence)
        self.key = key


def validated(
    model: type[Model], data: Any, source: Source, known: Mapping[str, str] | None = None, within: tuple[str, ...] = ()
) -> Model:
    """The model of the data. Raises ConfigError with a sentence per problem; arguments as of `explain`."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise explain(error, source, known, within) from None


def explain(
    error: ValidationError, source: Source, known: Mapping[str, str] | None = None, within: tuple[str, ...] = ()
) -> ConfigError:
    """Pydantic's findings as sentences.

    known: the meaning of each key by its path, see `meanings`. within: the keys around what was validated.
    """
    findings = [finding | {"loc": (*within, *finding["loc"])} for finding in error.errors(include_url=False)]
    return ConfigError(list(dict.fromkeys(_explained(finding, source, known or {}) for finding in findings)))


def _explained(finding: Mapping[str, Any], source: Source, known: Mapping[str, str]) -> str:
    place = ".".join(map(str, finding["loc"]))
    unknown_key = getattr(finding.get("ctx", {}).get("error"), "key", "")
    origin = source.of(".".join(filter(None, (place, unknown_key))))
    return f"{origin}{source.at(place).removeprefix(source.of(place))}: {_sentence(finding, known)}"


@contextmanager
def naming(place: str) -> Iterator[None]:
    """A context in which ValueErrors become ConfigErrors that begin with the place that they are about."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(getattr(error, "problems", (str(error),)), place) from None


@contextmanager
def naming_source(source: Source) -> Iterator[None]:
    """A context in which ConfigErrors about a key begin with the file or the override that it comes from."""
    try:
        yield
    except ConfigError as error:
        if not error.place:
            raise
        raise ConfigError([f"{source.at(error.place)}: {sentence}" for sentence in error.sentences]) from None


def _sentence(finding: Any, known: Mapping[str, str]) -> str:
    if finding["type"] == "missing":
        meaning = known.get(".".join(map(str, finding["loc"])))
        return "expected a value, got nothing; add it" + (f" ({meaning})" if meaning else "")
    if "error" in finding.get("ctx", {}):
        hint = _comma(finding["loc"][-1:]) if finding["input"] is None else ""
        return f"{finding['ctx']['error']}{hint}{_elsewhere(finding['ctx']['error'], known)}"
    if finding["type"] in ("list_type", "tuple_type"):
        given = finding["input"]
        values = ", ".join(map(str, given.values())) if isinstance(given, dict) else str(given).partition("\n")[0]
        meaning = known.get(".".join(map(str, finding["loc"])), "")
        example = "" if "as in [" in meaning else f", as in [{values}]"
        return f"expected a list{example}, got {shown(given)}" + (f" ({meaning})" if meaning else "")
    if finding["type"] in ("dict_type", "model_type", "dataclass_type"):
        given = finding["input"]
        example = f", as in {{NAME: {given}}}" if finding["type"] == "dict_type" and isinstance(given, str) else ""
        inside = ".".join([*map(str, finding["loc"]), ""])
        keys = [path.removeprefix(inside) for path in known if path.startswith(inside) and "NAME." not in path]
        example = example or (f" ({', '.join(k for k in keys if '.' not in k)})" if keys else "")
        return f"expected keys with values{example}, got {shown(given)}"
    if finding["type"] == "string_type" and isinstance(finding["input"], bool | int | float | date):
        value = finding["input"]
        read, example = f"{value}", f"{value}"
        if isinstance(value, bool):
            read, example = f"{value}, as YAML reads yes, no, on and off", "on" if value else "off"
        return f"expected text, got {read}; quote it, as in '{example}'"
    if finding["type"] == "too_long":
        return (
            f"expected {finding['ctx']['max_length']} values, got {shown(finding['input'])}{_comma(finding['input'])}"
        )
    expected = finding["msg"].replace("Input should be", "expected").replace("Input should have", "expected")
    return f"{expected}, got {shown(finding['input'])}"


def _elsewhere(error: Exception, known: Mapping[str, str]) -> str:
    if not isinstance(error, UnknownKeyError):
        return ""
    if ":" in error.key:
        return "; separate key and value by a colon and a space"
    if comma := _comma([error.key]):
        return comma
    places = [path for path in known if path.rpartition(".")[2] == error.key and "NAME." not in path]
    return f"; there is {' and '.join(places)}" if places else ""


def _comma(parts: Sequence[Any]) -> str:
    """A hint if the last of some parts of YAML, as '5 l/min' of '1,5 l/min', follows a comma within a number."""
    last = parts[-1] if parts else ""
    return f"; a comma ends a value: {NO_COMMAS}" if isinstance(last, str) and last[:1].isdigit() else ""


def shown(value: Any) -> str:
    """A given value in a message, on one line."""
    text = "nothing" if value is None else repr(value).partition("\n")[0]
    return text if len(text) < 60 else text[:57] + "..."
