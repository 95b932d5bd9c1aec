"""The reference of a configuration's keys with defaults and meanings, for help texts and documentation."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from fdi_torch.config.strict import Strict, is_scaled

Key = tuple[str, str, str]
"""Path of the key, its default in YAML notation ('required' if it has none), its meaning."""


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[Key]:
    """The keys of a model and of its nested models. In a path, `N` is the index of a list and `NAME` any name."""
    for name, field in model.model_fields.items():
        path = f"{prefix}{name}"
        inner, step = _inner(field.annotation)
        if inner is None:
            default = "required" if field.is_required() else _shown(field.get_default(call_default_factory=True))
            default += " on three_tank" if is_scaled(field) else ""
            yield path, default, field.description or ""
        elif field.description:
            yield path, "", field.description
        if isinstance(inner, type) and issubclass(inner, Strict):
            yield from keys(inner, f"{path}.{step}")
        elif inner is not None and dataclasses.is_dataclass(inner):
            yield from ((f"{path}.{f.name}", _shown(f.default), "") for f in dataclasses.fields(inner))


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The meaning of each key of a model by its path."""
    return {path: meaning for path, _, meaning in keys(model)}


def config_reference(model: type[BaseModel]) -> str:
    """The keys as aligned lines."""
    rows = [(path, f"[{default}]" if default else "", meaning) for path, default, meaning in keys(model)]
    widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
    return "\n".join(f"{p:<{widths[0]}}  {d:<{widths[1]}}  {m}".rstrip() for p, d, m in rows)


def _inner(annotation: Any) -> tuple[Any, str]:
    """The model or settings class inside an annotation, and the step of the path that leads to it."""
    if isinstance(annotation, type) and (issubclass(annotation, Strict) or dataclasses.is_dataclass(annotation)):
        return annotation, ""
    origin: Any = get_origin(annotation)
    step = {list: "N.", dict: "NAME."}.get(origin, "")
    for argument in get_args(annotation):
        inner, further = _inner(argument)
        if inner is not None:
            return inner, step + further
    return None, ""


def _shown(value: Any) -> str:
    if value is None or value == "":
        return "none"
    return str(value).replace("'", "")
