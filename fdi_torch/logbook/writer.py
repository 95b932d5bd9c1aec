"""RunLog: the log of one run or study; a crash loses at most its last second.

The run is written to `NAME.mcap.partial`, which becomes `NAME.mcap` at its end. Waiting messages go to disk after 0.7 s
at the latest, by a small thread, also while the run computes without logging. Equal configuration, data and seed give
equal messages; how these are divided into chunks depends on the clock.
"""

from __future__ import annotations

import hashlib
import io
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import orjson

from fdi_torch.disk import named_errors
from fdi_torch.interruption import UNDISTURBED, Terminated
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.payload import as_array, plain
from fdi_torch.logbook.provenance import environment, git_state, version_of
from fdi_torch.logbook.reader import Message
from fdi_torch.logbook.sink import Sink, Timed
from fdi_torch.logbook.topic_definitions import FORMAT_VERSION, Channel
from fdi_torch.logbook.topics import Topics

Listener = Callable[[Channel, int, bytes], None]
"""Called with each logged message: its channel, its log time in ns and its payload."""
KEPT = "what was computed until now is"
"""What an interrupted run says of its log's content, before `in` and the log's path."""


class RunLog(Topics):
    """Context manager that logs a run. Messages are written by the methods of `Topics`.

    path: NAME.mcap, which must not exist. kind: the command, such as "train". config_text: the configuration exactly as
    given; config: the same, resolved, as plain nested values. seeds: name -> seed. data: one mapping per input file,
    with its "path" and "sha256". env, git: determined if not given. clock: wall time, ns. listener: called with every
    logged message. after_interruption: how to continue after Ctrl-C or SIGTERM, as a clause; it is added to the
    exception as a note, after one of what the log contains (`kept`) and its path. Raises LogError if the file cannot be
    written.
    """

    def __init__(
        self,
        path: str | Path,
        kind: str,
        *,
        config_text: str = "",
        config: Mapping[str, Any] | None = None,
        seeds: Mapping[str, int] | None = None,
        data: Sequence[Mapping[str, Any]] = (),
        parent_run_id: str | None = None,
        env: Mapping[str, str] | None = None,
        git: Mapping[str, str] | None = None,
        clock: Callable[[], int] = time.time_ns,
        flush_seconds: float = 0.7,
        listener: Listener | None = None,
        after_interruption: str = "",
    ) -> None:
        super().__init__()
        self.path = Path(path)
        self.partial_path = self.path.with_name(self.path.name + ".partial")
        self.status, self.reason = "completed", ""
        self.kept = KEPT
        self._clock, self._flush_seconds, self._listener = clock, flush_seconds, listener
        self._after_interruption = after_interruption
        self._start_records = {
            "config": {"sha256": _sha256(config_text), **flatten(config or {})},
            "env": dict(environment() if env is None else env),
            "git": dict(git_state() if git is None else git),
            "seeds": {name: str(seed) for name, seed in (seeds or {}).items()},
            "data": flatten({str(number): dict(source) for number, source in enumerate(data)}),
        }
        self._config_text = config_text
        self._run = {"format": FORMAT_VERSION, "kind": kind, "parent_run_id": parent_run_id or ""}
        self._results: dict[str, str] = {}
        self._arrays: dict[str, np.ndarray] = {}
        self._sink: Sink | None = None
        self._stop = threading.Event()

    def __enter__(self) -> RunLog:
        _expect_free(self.path)
        self._started = self._clock()
        self._run["started"] = _wall_text(self._started)
        self._run["run_id"] = _sha256(repr((self._run, self._start_records)))[:16]
        self._sink = Sink(self.partial_path, f"fdi_torch {version_of('fdi_torch')}")
        try:
            self._write_start(self._sink)
        except LogError:
            self._sink.abandon()
            raise
        self._thread = threading.Thread(target=self._flush_by_clock, daemon=True, name="log flush")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with UNDISTURBED:
            self._stop.set()
            self._thread.join()
            if error is not None:
                self.status, self.reason = _ending(error)
            try:
                self._end()
            except LogError:
                if error is None:
                    raise
            if self.status == "interrupted" and error is not None:
                kept = self.path if self.path.exists() else self.partial_path
                error.add_note(f"{self.kept} in {kept}")
                if self._after_interruption:
                    error.add_note(self._after_interruption)

    def _end(self) -> None:
        """Complete the log under its final name."""
        self._write_end(self._open_sink())
        with named_errors(self.path, LogError):
            os.replace(self.partial_path, self.path)

    def set_status(self, status: str, reason: str = "") -> None:
        """Set how the run ended, such as "not_converged"; the default is "completed"."""
        self.status, self.reason = status, reason

    def result(self, values: Mapping[str, Any]) -> None:
        """Add named results to the record `fdi_torch.result`, written at the end."""
        self._results.update(flatten(values))

    def result_arrays(self, **arrays: Any) -> None:
        """Add arrays to the attachment `results.npz`, written at the end."""
        self._arrays.update({name: as_array(array) for name, array in arrays.items()})

    def attach(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """Attach a file to the log."""
        with self._lock:
            self._open_sink().attachment(name, media_type, data)

    def flush(self) -> None:
        """Write everything logged so far to disk."""
        with self._lock:
            self._open_sink().flush()

    def put(self, messages: Iterable[Timed]) -> None:
        """Write encoded messages; all methods of `Topics` call it."""
        with self._lock:
            self._open_sink().messages(self._forwarding(messages, self._listener) if self._listener else messages)

    def carry_over(self, messages: Iterable[Message]) -> int:
        """Copy messages of an earlier log of the same run, to be continued; returns their number."""
        count = 0
        for message in messages:
            self.follow_on(message.channel, message.sequence, message.t)
            self.put([(message.channel, message.log_time, message.publish_time, message.sequence, message.data)])
            count += 1
        return count

    @staticmethod
    def _forwarding(messages: Iterable[Timed], listener: Listener) -> Iterator[Timed]:
        for message in messages:
            yield message
            listener(message[0], message[1], message[4])

    def _open_sink(self) -> Sink:
        if self._sink is None:
            raise ValueError(f"{self.path}: expected an open log, got one outside its `with` block; write inside it")
        return self._sink

    def _flush_by_clock(self) -> None:
        while not self._stop.wait(self._flush_seconds):
            try:
                self.flush()
            except LogError:
                return  # the sink is dead; the next write says so

    def _write_start(self, sink: Sink) -> None:
        sink.metadata("fdi_torch.run", self._run)
        for name, values in self._start_records.items():
            sink.metadata(f"fdi_torch.{name}", values)
        if self._config_text:
            sink.attachment("config.yaml", "application/yaml", self._config_text.encode())

    def _write_end(self, sink: Sink) -> None:
        """Write results and status, and complete the file."""
        ended = self._clock()
        seconds = f"{(ended - self._started) * 1e-9:.3f}"
        status = {"status": self.status, "reason": self.reason, "ended": _wall_text(ended), "wall_seconds": seconds}
        try:
            if self._arrays:
                sink.attachment("results.npz", "application/x-npz", _npz(self._arrays))
            if self._results:
                sink.metadata("fdi_torch.result", self._results)
            sink.metadata("fdi_torch.status", status)
        except BaseException:  # the process may go on, and must not keep the file locked
            sink.abandon()
            raise
        sink.finish()


def _expect_free(path: Path) -> None:
    if path.suffix != ".mcap":
        raise ValueError(f"{path}: expected a log name that ends in .mcap; rename it")
    with named_errors(path, LogError):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise LogError(f"{path}: exists already; choose another name, or delete it")


def _ending(error: BaseException) -> tuple[str, str]:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", "Ctrl-C"
    if isinstance(error, Terminated):
        return "interrupted", "SIGTERM"
    if isinstance(error, BrokenPipeError):
        return "interrupted", "standard output was closed by its reader"
    if isinstance(error, ValueError | OSError):  # sentences for people
        return "failed", str(error)
    return "failed", f"{type(error).__name__}: {error}"


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _wall_text(nanoseconds: int) -> str:
    moment = datetime.fromtimestamp(nanoseconds // 10**9, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{nanoseconds % 10**9:09d}Z"


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested values as dotted names and texts: {"a": {"b": [1, 2]}} -> {"a.b": "[1,2]"}."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value if isinstance(value, str) else _text(value)
    return flat


def _text(value: Any) -> str:
    try:
        return orjson.dumps(value).decode()
    except TypeError:
        return orjson.dumps(plain({"value": value}).get("value", str(value))).decode()
