"""Comparison of runs: the differences of their records, the agreement of their results, curves on a common axis, and a
hash of a log's content (topic, time and payload of every message) independent of chunks and wall time.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import orjson

from fdi_torch.logbook.payload import WALL
from fdi_torch.logbook.reader import Message, Run, read_run
from fdi_torch.logbook.signals import own_signals, recording_groups, series


def content_hash(messages: Iterable[Message]) -> str:
    """SHA-256 over the messages in their order, as hexadecimal text."""
    digest = hashlib.sha256()
    for message in messages:
        topic, data = message.topic.encode(), canonical(message)
        digest.update(struct.pack("<qqq", len(topic), message.log_time, len(data)) + topic + data)
    return digest.hexdigest()


def canonical(message: Message) -> bytes:
    """The payload in canonical form: JSON with sorted keys and without wall time; other encodings unchanged."""
    if message.channel.encoding != "json":
        return message.data
    try:
        fields = orjson.loads(message.data)
    except ValueError:
        return message.data
    if isinstance(fields, dict):
        fields.pop(WALL, None)
    return orjson.dumps(fields, option=orjson.OPT_SORT_KEYS)


SECTIONS = ("run", "config", "seeds", "data", "env", "git", "status", "result")
_WALL = {"run": ("started", "run_id", "parent_run_id"), "status": ("ended", "wall_seconds")}
# The field that identifies an event of a topic; all other topics are aligned by plant time.
AXES = {"/estimator/de/generation": "generation", "/estimator/refine/iteration": "iteration", "/study/trial": "trial"}


@dataclass(frozen=True)
class Result:
    """One estimated parameter in all runs; NaN if a run lacks it. ends: 'low' or 'high' where a run's estimate lies at
    that end of its range, otherwise ''.

    p_value: of the hypothesis that all runs estimate one true value with independent errors, by Cochran's Q = sum w (x
    - mean)^2, w = 1 / std^2, against chi^2; for two runs Q = z^2. Runs whose model does not explain their recording are
    left out, since their errors do not hold. NaN if fewer than two runs have standard errors, or if runs read the same
    recording. apart: the largest difference between two of these runs, in the smaller of their standard errors; NaN if
    fewer than two have one.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    std: tuple[float, ...]
    p_value: float
    ends: tuple[str, ...] = ()
    apart: float = math.nan

    @property
    def agree(self) -> bool | None:
        """Whether the runs agree at 95 %; None if there is no p-value."""
        return None if math.isnan(self.p_value) else self.p_value >= 0.05


@dataclass(frozen=True)
class Comparison:
    """labels: one per run. differences: section -> key -> one text per run, "" if a run lacks it.

    same_content: whether all logs have the same messages. same_data: whether all runs used the same data. shares_data:
    whether two runs used a recording in common; their errors are then not independent: the variance of a difference is
    not the sum of the variances, and `agree` is None.
    """

    labels: tuple[str, ...]
    differences: dict[str, dict[str, tuple[str, ...]]]
    results: tuple[Result, ...]
    same_content: bool
    same_data: bool
    shares_data: bool = False

    def rows(self) -> list[list[str]]:
        """The whole comparison as a table with a header, for CSV."""
        table = [["section", "key", *self.labels, "unit", "p_value"]]
        for section, entries in self.differences.items():
            table += [[section, key, *texts, "", ""] for key, texts in entries.items()]
        for result in self.results:
            p_value = "" if math.isnan(result.p_value) else repr(result.p_value)
            table.append(["estimate", result.name, *map(repr, result.values), result.unit, p_value])
            table.append(["std", result.name, *map(repr, result.std), result.unit, ""])
        return table


def compare(paths: Sequence[str | Path]) -> Comparison:
    """Compare two or more logs. Raises LogError for an unreadable log, ValueError for fewer than two."""
    if len(paths) < 2:
        raise ValueError(f"expected at least two logs to compare, got {len(paths)}; name more")
    runs = [read_run(path) for path in paths]
    used = [_recordings(run) for run in runs]
    shares_data = any(not a.isdisjoint(b) for a, b in combinations(used, 2))
    return Comparison(
        labels_of([run.path for run in runs]),
        {section: entries for section in SECTIONS if (entries := _differing(runs, section))},
        _results(runs, independent=not shares_data),
        len({content_hash(run.messages()) for run in runs}) == 1,
        shares_data and all(other == used[0] for other in used),
        shares_data,
    )


def _recordings(run: Run) -> set[bytes | str]:
    """The recordings that a run used, hold-outs left out: hashes of their logged readings, or else of their files."""
    topics = dict.fromkeys(message.topic for message in run.messages())
    groups = [group for group in recording_groups(topics) if not group.startswith("holdout")]
    if logged := [own_signals(run, group) for group in groups]:
        return {hashlib.sha256(each.time.tobytes() + each.outputs.tobytes()).digest() for each in logged}
    return {text for key, text in run.about("data").items() if key.endswith("sha256") and text}


def align(
    paths: Sequence[str | Path], topic: str, field: str, where: Mapping[str, float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """One field of all runs on a common axis: axis (K,), values (runs, K), NaN for missing events.

    The axis is the generation, the iteration, the trial, or plant time in s; never wall time. where: only messages with
    these numbers, such as {"problem": 0}. If several messages have the same axis value, the last one counts.
    """
    axis_field, where = AXES.get(topic, "t"), where or {}
    columns = []
    for path in paths:
        table = series(read_run(path), topic, [axis_field, field, *where])
        kept = np.all([table[name] == value for name, value in where.items()], axis=0) & np.isfinite(table[axis_field])
        columns.append(dict(zip(table[axis_field][kept].tolist(), table[field][kept].tolist(), strict=True)))
    axis = np.array(sorted(set().union(*columns)))
    return axis, np.array([[column.get(place, np.nan) for place in axis.tolist()] for column in columns])


def labels_of(paths: Sequence[Path]) -> tuple[str, ...]:
    """The shortest ends of the paths that distinguish the runs."""
    for depth in range(1, max(len(path.resolve().parts) for path in paths)):
        ends = ["/".join(path.resolve().parts[-depth:]).removesuffix(".mcap") for path in paths]
        if len(set(ends)) == len(ends):
            return tuple(ends)
    return tuple(f"{path.stem}#{number}" for number, path in enumerate(paths, 1))


def chi2_p_value(values: Sequence[float], std: Sequence[float]) -> float:
    """Cochran's Q test of one common value; NaN for fewer than two values with positive standard errors."""
    x, s = np.asarray(values, dtype=np.float64), np.asarray(std, dtype=np.float64)
    usable = np.isfinite(x) & np.isfinite(s) & (s > 0)
    x, s = x[usable], s[usable]
    if len(x) < 2:
        return float("nan")
    from scipy.special import chdtrc  # SciPy takes a while to load, and most users of logs do not compare them

    weights = s**-2.0
    q = float(np.sum(weights * (x - np.sum(weights * x) / np.sum(weights)) ** 2))
    return float(chdtrc(len(x) - 1, q))


def _differing(runs: Sequence[Run], section: str) -> dict[str, tuple[str, ...]]:
    records = [run.about(section) for run in runs]
    keys = dict.fromkeys(key for record in records for key in record if key not in _WALL.get(section, ()))
    table = {key: tuple(record.get(key, "") for record in records) for key in keys}
    return {key: texts for key, texts in table.items() if len(set(texts)) > 1}


def _apart(values: Sequence[float], std: Sequence[float]) -> float:
    """The largest difference of two values in the smaller of their standard errors; NaN for fewer than two with one."""
    known = [(x, s) for x, s in zip(values, std, strict=True) if math.isfinite(x) and math.isfinite(s) and s > 0.0]
    return max((abs(a - b) / min(s, t) for (a, s), (b, t) in combinations(known, 2)), default=math.nan)


def _results(runs: Sequence[Run], independent: bool) -> tuple[Result, ...]:
    estimates, results = [_estimates(run) for run in runs], []
    failing = [run.about("result").get("explained") == "false" for run in runs]
    for name in dict.fromkeys(name for each in estimates for name in each):
        values, std, units = zip(*(each.get(name, (math.nan, math.nan, "")) for each in estimates), strict=True)
        ends = tuple(run.at_bounds.get(name, "") for run in runs)
        counted = [math.nan if unreliable else error for unreliable, error in zip(failing, std, strict=True)]
        p_value, unit = chi2_p_value(values, counted) if independent else math.nan, next(filter(None, units), "")
        results.append(Result(name, unit, values, std, p_value, ends, _apart(values, counted)))
    return tuple(results)


def _estimates(run: Run) -> dict[str, tuple[float, float, str]]:
    """Parameter -> (value, standard error, unit), from the last estimate of each problem, the causes of a gap, and the
    faults that a monitor last held for present.
    """
    estimates: dict[str, tuple[float, float, str]] = {}
    for message in run.messages(["/estimate/final"]):
        payload = message.payload
        prefix = f"{payload['problem']}:" if payload.get("problem") else ""
        names, values, std = payload["names"], payload["values"], payload["std"]
        units = payload.get("units") or [""] * len(names)
        for name, value, error, unit in zip(names, values, std, units, strict=True):
            estimates[prefix + name] = (float(value), float(error), unit)
    for message in run.messages(["/gap/verdict"]):
        for cause in orjson.loads(message.payload.get("answer", "{}")).get("causes", []):
            for field, size in cause.get("parameters", {}).items():
                numbers = (_number(size.get(key)) for key in ("value", "std"))
                estimates[f"{cause['location']}.{cause['effect']}.{field}"] = (*numbers, size.get("unit", ""))
    last = {(m.payload["location"], m.payload["fault"]): m.payload for m in run.messages(["/diagnosis/fault"])}
    for (location, fault), payload in last.items():
        if payload.get("present"):
            numbers = (_number(payload.get(key)) for key in ("size", "size_std"))
            estimates.setdefault(f"{location}.{fault}", (*numbers, payload.get("unit", "")))
    return estimates


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
