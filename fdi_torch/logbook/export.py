"""Export of a topic or an attachment from a log."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import orjson

from fdi_torch.logbook.errors import LogError, log_error
from fdi_torch.logbook.reader import Message, Run

_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def export(run: Run, topic: str, form: str, stream: BinaryIO) -> int:
    """Write a topic's messages as "csv", "ndjson" or "npz" to an open binary file; returns their number.

    csv: one row per message, units in the header (`h1_m`, `Q1_m3_s`), lists as JSON. ndjson: the messages unchanged.
    npz: one array per field of numbers or text. Raises LogError if the topic has no messages.
    """
    if form not in _FORMS:
        raise ValueError(f"expected one of the formats {', '.join(_FORMS)}, got {form}")
    messages = list(run.messages([topic]))
    if not messages:
        known = ", ".join(sorted({message.topic for message in run.messages()})) or "(none)"
        raise LogError(f"{run.path}: expected one of the topics {known}, got {topic}")
    _FORMS[form](run, messages, stream)
    return len(messages)


def export_attachment(run: Run, name: str, folder: str | Path) -> Path:
    """Write an attachment into `folder`, never outside it and never over a file. Returns its path."""
    content = run.attachment(name)
    target = Path(folder) / safe_name(name)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            raise LogError(f"{target}: exists already; choose another folder, or delete it")
        with target.open("xb") as file:
            file.write(content)
    except LogError:
        raise
    except OSError as error:
        raise log_error(target, error) from error
    return target


def safe_name(name: str) -> str:
    """A file name from the last part of `name`, with harmless characters only."""
    last = re.split(r"[/\\]", name)[-1]
    return _UNSAFE.sub("_", last).lstrip(".")[:100] or "attachment"


def _csv(_run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    columns, units = _columns(messages)
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    table = csv.writer(text)
    table.writerow([_header(name, units.get(name, "")) for name in columns])
    for message in messages:
        payload = message.payload
        table.writerow([_cell(payload.get(name)) for name in columns])
    text.detach()


def _ndjson(run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    for message in messages:
        stream.write(orjson.dumps(_loaded(run, message), option=orjson.OPT_APPEND_NEWLINE))


def _npz(_run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    columns, _ = _columns(messages)
    payloads = [message.payload for message in messages]
    arrays = {name: _array([payload.get(name) for payload in payloads]) for name in columns}
    usable = {name: array for name, array in arrays.items() if array is not None}
    np.savez_compressed(stream, **usable)  # type: ignore[arg-type]


_FORMS: dict[str, Callable[[Run, Sequence[Message], BinaryIO], None]] = {"csv": _csv, "ndjson": _ndjson, "npz": _npz}


def _columns(messages: Sequence[Message]) -> tuple[list[str], dict[str, str]]:
    """Fields of the messages, `t` first, and their units."""
    names: dict[str, None] = {}
    units: dict[str, str] = {}
    for message in messages:
        names.update(dict.fromkeys(message.payload))
        units |= message.channel.units
    return sorted(names, key=lambda name: name != "t"), units


def _loaded(run: Run, message: Message) -> Any:
    """The raw JSON, with its list of non-finite numbers."""
    if message.channel.encoding != "json":
        raise LogError(f"{run.path}: {message.topic} is in {message.channel.encoding}, only json can be exported")
    try:
        return orjson.loads(message.data)
    except ValueError as error:
        raise LogError(f"{run.path}: a message on {message.topic} is no JSON ({error})") from error


def _header(name: str, unit: str) -> str:
    suffix = unit.replace("^", "").replace("/", "_")
    return f"{name}_{suffix}" if suffix not in ("", "1") else name


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    return value if isinstance(value, str) else orjson.dumps(value).decode()


def _array(values: list[Any]) -> np.ndarray | None:
    """Numbers, NaN where missing, or texts; None for other values."""
    if all(isinstance(value, int | float | None) for value in values):
        return np.array([np.nan if value is None else float(value) for value in values])
    if all(isinstance(value, str | None) for value in values):
        return np.array([value or "" for value in values])
    return None
