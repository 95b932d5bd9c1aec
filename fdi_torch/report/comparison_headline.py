"""The result of a comparison in words: which run explains the recording best, by how much, and what differs."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from fdi_torch.amounts import effect_words
from fdi_torch.logbook import Comparison
from fdi_torch.names import counted, listed
from fdi_torch.quantities import quantity_text
from fdi_torch.report.html import short
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import percent
from fdi_torch.report.predictions import sensor_residuals
from fdi_torch.report.verdict import headline, kind_words
from fdi_torch.tables import Table
from fdi_torch.units import UnitError, in_unit, number_and_unit

MOST_LISTED, MOST_LETTERS = 4, 60
AT_95 = 1.96
VERSIONS = ("env", "git")
MONITOR = "monitor"  # the kind of run whose model follows the readings
NOT_IN_WORDS = ("sha256", "output.name", "output.folder")
NONE = ("", "null")  # texts of a missing setting
ROUNDING = 1e-9  # relative error of an amount that was converted to another unit


def comparison_headline(compared: Comparison, runs: Sequence[Material]) -> list[str]:
    """Sentences: the better run, runs whose model fails, and the differences of recordings, settings and versions."""
    if compared.same_content and not compared.differences:
        return ["All logs have the same content, message by message."]
    failing = [n for n, run in zip(compared.labels, runs, strict=True) if run.unexplained]
    words = [_better(compared, runs)]
    if failing:
        words.append(f"Unreliable: {_first(failing)} (the model does not explain the recording).")
    return [*words, _differences(compared, runs)]


def _better(compared: Comparison, runs: Sequence[Material]) -> str:
    """A sentence that names the run with the smallest residuals; the verdicts instead if the runs did not read the same
    recording, or if a monitor, whose observer follows the readings, stands beside a fit.

    A run's size is the geometric mean of its sensors' root mean squares. Two sizes from N independent readings differ
    by chance by up to 1.96 / sqrt(N) of them at 95 %: the relative variance of each is 1 / (2 N).
    """
    residuals = [sensor_residuals(run) for run in runs]
    common = [name for name in residuals[0] if all(name in each and each[name].rms > 0.0 for each in residuals)]
    same, of_one_kind = _same(runs, "time", "outputs"), len({run.kind == MONITOR for run in runs}) == 1
    if not (same and of_one_kind and common):
        verdicts = "; ".join(f"{label}: {headline(run)}" for label, run in zip(compared.labels, runs, strict=True))
        reason = "" if of_one_kind else " A monitor's observer follows the readings, so residuals do not rank them."
        reason = reason if same else " They read different recordings, so their residuals do not rank them."
        return f"{verdicts}.{reason}"
    sizes = [float(np.mean([math.log(each[name].rms) for name in common])) for each in residuals]
    first, second = np.argsort(sizes, kind="stable")[:2]
    smaller = 1.0 - math.exp(sizes[first] - sizes[second])
    chance = AT_95 / math.sqrt(max(sum(residuals[first][name].readings for name in common), 1))
    best, next_best = compared.labels[first], compared.labels[second]
    equal = {k: excess for k, size in enumerate(sizes) if (excess := 1.0 - math.exp(sizes[first] - size)) <= chance}
    if len(equal) > 1:
        most = max(equal.values())
        by = f"{'at most ' if len(equal) > 2 else ''}{percent(most)}" if most >= 1e-3 else "less than 0.1 %"
        names = listed([compared.labels[k] for k in sorted(equal, key=equal.__getitem__)])
        return f"{names} explain the recording equally well: residuals differ by {by}."
    errors = []
    for name in common:
        pair = residuals[first][name], residuals[second][name]
        texts = [quantity_text(each.rms, each.unit, 3, name) for each in pair]
        errors.append(f"{runs[0].channel_words(name)} {' against '.join(texts)}")
    return (
        f"{best} explains the recording best: its residuals are {percent(smaller)} smaller than those of {next_best} "
        f"({_first(errors)})."
    )


def _same(runs: Sequence[Material], *columns: str) -> bool:
    """Whether the recordings' `time`, `inputs` or `outputs` are the same in all runs, whatever their hold-outs."""
    first, *others = ([getattr(each, name) for each in run.fitted.values() for name in columns] for run in runs)
    return all(
        len(first) == len(other)
        and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, other, strict=True))
        for other in others
    )


def _differences(compared: Comparison, runs: Sequence[Material]) -> str:
    """What differs in the inputs: recordings, settings, versions."""
    parts, labels = [], compared.labels
    if not _same(runs, "time", "outputs"):
        parts.append(f"the recording ({_recordings_in_words(labels, runs)})")
    elif not _same(runs, "inputs"):
        parts.append("the inputs of the recording")
    kinds = [kind_words(run) for run in runs]
    several = len(set(kinds)) > 1  # their settings have different keys
    parts += [f"the kind of run ({by_run(labels, kinds)})"] if several else []
    settings = {} if several else setting_differences(compared, runs)[0]
    if any(compared.differences.get(section) for section in VERSIONS):
        parts.append("versions of the software")
    parts += [f"{key} ({by_run(labels, texts)})" for key, texts in settings.items()]
    return f"They differ in {_first(parts)}." if parts else "Recording, settings and versions are the same."


def setting_differences(compared: Comparison, runs: Sequence[Material]) -> tuple[dict[str, tuple[str, ...]], int]:
    """Settings and seeds that differ, in words: key -> one text per run, and the number of keys that are left out.

    If some runs lack a part of the plant, such as a tank, the parts of each run are listed by name, as in
    plant.tanks -> ("A, B", "T1, T2, T3"), and the settings of parts that only some runs have are left out.
    """
    differing = compared.differences.get("config", {}) | compared.differences.get("seeds", {})
    records = [run.about("config") | run.about("seeds") for run in runs]
    has = [{part for key, text in each.items() if text not in NONE for part in _parts(key)} for each in records]
    settings: dict[str, tuple[str, ...]] = {}
    lacking: dict[str, dict[str, str]] = {}  # section -> key -> its part that some runs lack
    for key, texts in (entry for each in differing.items() for entry in _without_common(*each).items()):
        words = tuple(plain_text(text) for text in texts)
        if key in NOT_IN_WORDS or len(set(words)) == 1 or _are_one_amount(words):
            continue
        settings[key] = words
        if key not in differing:  # within a setting of JSON
            continue
        part = next((part for part in _parts(key) if not all(part in each for each in has)), key)
        if part != key and len({text for text in texts if text not in NONE}) == 1:
            lacking.setdefault(part.rpartition(".")[0], {})[key] = part
    rows: dict[str, tuple[str, ...]] = {}
    left_out = 0
    for section, parts in lacking.items():
        if len(parts) > 1:
            rows |= _part_differences(section, dict.fromkeys(parts.values()), has)
            left_out += len(parts)
            settings = {key: words for key, words in settings.items() if key not in parts}
    return rows | settings, left_out


def _without_common(key: str, texts: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """A setting of JSON as the keys below it that differ, such as recordings.file; of lists, what not every run has."""
    try:
        values = [orjson.loads(text) if text else None for text in texts]
    except ValueError:
        return {key: tuple(texts)}
    if not all(isinstance(value, list | dict) for value in values):
        return {key: tuple(texts)}
    return {name: tuple(map(_json, each)) for name, each in _differing_leaves(key, values).items()}


def _differing_leaves(key: str, values: Sequence[Any]) -> dict[str, Sequence[Any]]:
    """The deepest keys whose values differ between runs, with the value of each run.

    Lists of mappings without a name are compared entry by entry if those of all runs have equally many entries. Of any
    other list, only the entries that some run lacks are kept; but a list stays whole if all are short and one run has
    no entry of its own.
    """
    if all(value == values[0] for value in values):
        return {}
    if all(isinstance(value, dict) for value in values):
        names = dict.fromkeys(name for value in values for name in value)
        each = (_differing_leaves(f"{key}.{name}", [value.get(name) for value in values]) for name in names)
        return {name: texts for leaves in each for name, texts in leaves.items()}
    if not all(isinstance(value, list) for value in values):
        return {key: values}
    count = len(values[0])
    if all(len(value) == count and all(map(_is_nameless_table, value)) for value in values):
        numbered = [f"{key}.{k + 1}" if count > 1 else key for k in range(count)]
        each = (
            _differing_leaves(name, of_runs) for name, of_runs in zip(numbered, zip(*values, strict=True), strict=True)
        )
        return {name: texts for leaves in each for name, texts in leaves.items()}
    rest = [[entry for entry in value if not all(entry in other for other in values)] for value in values]
    if not any(rest):  # the same entries in another order
        return {key: values}
    short_lists = all(len(_in_words(value)) <= MOST_LETTERS for value in values)
    return {key: rest if all(rest) or not short_lists else values}


def _is_nameless_table(entry: Any) -> bool:
    return isinstance(entry, dict) and not {"name", "effect"} & entry.keys()


def _json(value: Any) -> str:
    """A value as text of a setting, '' for none."""
    return value if isinstance(value, str) else "" if value in (None, [], {}) else orjson.dumps(value).decode()


def _part_differences(section: str, parts: Collection[str], has: Sequence[set[str]]) -> dict[str, tuple[str, ...]]:
    """The names of all parts of a section in each run if some lack several of them, otherwise whether each has it."""
    if not section or len(parts) == 1:
        return {part: tuple("given" if part in each else "none" for each in has) for part in parts}
    names = [sorted(part for part in each if _is_part_of(section, part, each)) for each in has]
    return {section: tuple(", ".join(part.rpartition(".")[2] for part in each) or "none" for each in names)}


def _is_part_of(section: str, part: str, of_run: set[str]) -> bool:
    """Whether a key is directly below a section and has keys below itself."""
    return part.rpartition(".")[0] == section and any(key.startswith(f"{part}.") for key in of_run)


def _parts(key: str) -> list[str]:
    """'plant.tanks.A' -> 'plant', 'plant.tanks', 'plant.tanks.A'."""
    names = key.split(".")
    return [".".join(names[: k + 1]) for k in range(len(names))]


def _are_one_amount(texts: Sequence[str]) -> bool:
    """Whether all texts are the same quantity, perhaps in different units."""
    try:
        (first, unit), *others = map(number_and_unit, texts)
        return all(math.isclose(in_unit(number, other, unit), first, rel_tol=ROUNDING) for number, other in others)
    except UnitError:
        return False


def setting_table(compared: Comparison, runs: Sequence[Material]) -> Table:
    """The settings that differ, in words, with a sentence about those that are left out."""
    settings, left_out = setting_differences(compared, runs)
    rows, header = [(key, *texts) for key, texts in settings.items()], ("key", *compared.labels)
    summary = (
        f"{counted(left_out, 'setting')} of parts that not every run has are left out; "
        "fdi compare --csv FILE lists all of them."
    )
    return Table(header, rows, "settings", words=len(header), summary=summary if left_out else "")


def plain_text(text: str) -> str:
    """A setting as text: JSON in words, a number without its rounding error, 'none' for a missing one."""
    with suppress(ValueError):
        value = orjson.loads(text)
        text = f"{value:.12g}" if isinstance(value, float) else _in_words(value) if text[0] in "[{" else text
    return short(text, MOST_LETTERS) if text not in NONE else "none"


def _in_words(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_in_words(each) for each in value)
    if isinstance(value, dict) and {"effect", "location"} <= value.keys():
        return effect_words(str(value["effect"]), str(value["location"]))
    if isinstance(value, dict):
        given = {key: each for key, each in value.items() if each not in (None, "", [], {})}
        return ", ".join(
            _in_words(each) if key == "name" else f"{key} {_in_words(each)}" for key, each in given.items()
        )
    return f"{value:g}" if isinstance(value, float) else str(value)


def by_run(labels: Sequence[str], texts: Sequence[str]) -> str:
    """'a and c: pump lag at Q; b: none': which run has which text."""
    runs: dict[str, list[str]] = {}
    for label, text in zip(labels, texts, strict=True):
        runs.setdefault(text, []).append(label)
    return "; ".join(f"{listed(having)}: {text}" for text, having in runs.items())


def _recordings_in_words(labels: Sequence[str], runs: Sequence[Material]) -> str:
    """Names of the recordings; what tells them apart if the names are the same."""
    names = [_recordings(run) for run in runs]
    if len(set(names)) > 1:
        return by_run(labels, names)
    counts = [f"{sum(len(recording.time) for recording in run.fitted.values())} samples" for run in runs]
    return by_run(labels, counts) if len(set(counts)) > 1 else f"{names[0]}: other readings"


def _recordings(run: Material) -> str:
    data = run.about("data")
    names = dict.fromkeys(Path(path).name for key, path in data.items() if key.endswith(".path"))
    return ", ".join(names) or run.about("config").get("recording.file", "simulated")  # of a followed file or source


def _first(texts: Sequence[str]) -> str:
    shown = [*texts[:MOST_LISTED], *([f"{len(texts) - MOST_LISTED} more"] if len(texts) > MOST_LISTED else [])]
    return listed(shown)
