"""The result of a comparison in words: which run explains the recording best, by how much, and what differs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from fdi_torch.amounts import effect_words
from fdi_torch.logbook import Comparison
from fdi_torch.names import listed
from fdi_torch.quantities import quantity_text
from fdi_torch.report.html import short
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import percent
from fdi_torch.report.progress import SensorResidual, sensor_residuals
from fdi_torch.report.verdict import headline, kind_words

MOST_LISTED, MOST_LETTERS = 4, 60
AT_95 = 1.96
VERSIONS = ("env", "git")
NOT_IN_WORDS = ("sha256", "output.name", "output.folder")


def comparison_headline(compared: Comparison, runs: Sequence[Material]) -> list[str]:
    """Sentences: the better run, runs whose model fails, and the differences of recordings, settings and versions."""
    if compared.same_content and not compared.differences:
        return ["All logs have the same content, message by message."]
    failing = [n for n, run in zip(compared.labels, runs, strict=True) if _is_unexplained(run)]
    words = [_better(compared, runs)]
    if failing:
        words.append(f"Unreliable: {_first(failing)} (the model does not explain the recording).")
    return [*words, _differences(compared, runs)]


def _is_unexplained(run: Material) -> bool:
    return run.about("result").get("explained") == "false"


def _better(compared: Comparison, runs: Sequence[Material]) -> str:
    """A sentence that names the run with the smallest residuals; if the runs did not read the same recording, their
    verdicts instead.

    A run's size is the geometric mean of its sensors' root mean squares. Two sizes from N independent readings differ
    by chance by up to 1.96 / sqrt(N) of them at 95 %: the relative variance of each is 1 / (2 N).
    """
    residuals = [sensor_residuals(run) for run in runs]
    common = [name for name in residuals[0] if all(name in each and each[name].rms > 0.0 for each in residuals)]
    same = _same_readings(runs)
    if not same or not common:
        verdicts = "; ".join(f"{label}: {headline(run)}" for label, run in zip(compared.labels, runs, strict=True))
        reason = "" if same else " They read different recordings, so their residuals do not rank them."
        return f"{verdicts}.{reason}"
    sizes = [float(np.mean([math.log(each[name].rms) for name in common])) for each in residuals]
    first, second = np.argsort(sizes, kind="stable")[:2]
    smaller = 1.0 - math.exp(sizes[first] - sizes[second])
    chance = AT_95 / math.sqrt(max(sum(residuals[first][name].readings for name in common), 1))
    best, next_best = compared.labels[first], compared.labels[second]
    if smaller <= chance:
        by = percent(smaller) if smaller >= 1e-3 else "less than 0.1 %"
        return f"{best} and {next_best} explain the recording equally well: residuals differ by {by}."
    errors = _first([_both(name, residuals[first][name], residuals[second][name]) for name in common])
    return (
        f"{best} explains the recording best: its residuals are {percent(smaller)} smaller than those of {next_best} "
        f"({errors})."
    )


def _same_readings(runs: Sequence[Material]) -> bool:
    """Whether all runs have the same readings at the same times."""
    return _same(runs, "time") and _same(runs, "outputs")


def _same(runs: Sequence[Material], columns: str) -> bool:
    """Whether these columns of the recordings, `time`, `inputs` or `outputs`, are the same in all runs."""
    first, *others = ([getattr(recording, columns) for recording in run.recordings] for run in runs)
    return all(
        len(first) == len(other)
        and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, other, strict=True))
        for other in others
    )


def _both(name: str, one: SensorResidual, other: SensorResidual) -> str:
    texts = (quantity_text(each.rms, each.unit, 3, name) for each in (one, other))
    return f"{name} " + " against ".join(texts)


def _differences(compared: Comparison, runs: Sequence[Material]) -> str:
    """What differs in the inputs: recordings, settings, versions."""
    parts = []
    if not _same_readings(runs):
        parts.append(f"the recording ({_recordings_in_words(runs)})")
    elif not _same(runs, "inputs"):
        parts.append("the inputs of the recording")
    kinds = [kind_words(run) for run in runs]
    several = len(set(kinds)) > 1  # their settings have different keys
    parts += [f"the kind of run ({'; '.join(kinds)})"] if several else []
    settings = {} if several else setting_differences(compared)
    if any(compared.differences.get(section) for section in VERSIONS):
        parts.append("versions of the software")
    parts += [f"{key} ({'; '.join(texts)})" for key, texts in settings.items()]
    return f"They differ in {_first(parts)}." if parts else "Recording, settings and versions are the same."


def setting_differences(compared: Comparison) -> dict[str, tuple[str, ...]]:
    """Settings and seeds that differ, in words: key -> one text per run."""
    found = compared.differences.get("config", {}) | compared.differences.get("seeds", {})
    kept = {key: texts for key, texts in found.items() if key not in NOT_IN_WORDS}
    in_words = {key: tuple(plain_text(text) for text in texts) for key, texts in kept.items()}
    return {key: texts for key, texts in in_words.items() if len(set(texts)) > 1}


def plain_text(text: str) -> str:
    """The text of a setting; a JSON list or mapping in words, a number without its rounding error, and 'none' for a
    missing one.
    """
    with suppress(ValueError):
        value = orjson.loads(text)
        text = f"{value:.12g}" if isinstance(value, float) else _in_words(value) if text[0] in "[{" else text
    return short(text, MOST_LETTERS) if text not in ("", "null") else "none"


def _in_words(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_in_words(each) for each in value)
    if isinstance(value, dict) and {"effect", "location"} <= value.keys():
        return effect_words(str(value["effect"]), str(value["location"]))
    if isinstance(value, dict):
        given = {key: each for key, each in value.items() if each is not None}
        return ", ".join(
            _in_words(each) if key == "name" else f"{key} {_in_words(each)}" for key, each in given.items()
        )
    return f"{value:g}" if isinstance(value, float) else str(value)


def _recordings_in_words(runs: Sequence[Material]) -> str:
    """Names of the recordings; what tells them apart if the names are the same."""
    names = [_recordings(run) for run in runs]
    if len(set(names)) > 1:
        return "; ".join(names)
    counts = [f"{sum(len(recording.time) for recording in run.recordings)} samples" for run in runs]
    return f"{names[0]}: {'; '.join(counts) if len(set(counts)) > 1 else 'other readings'}"


def _recordings(run: Material) -> str:
    data = run.about("data")
    names = dict.fromkeys(Path(path).name for key, path in data.items() if key.endswith(".path"))
    return ", ".join(names) or "simulated"


def _first(texts: Sequence[str]) -> str:
    shown = [*texts[:MOST_LISTED], *([f"{len(texts) - MOST_LISTED} more"] if len(texts) > MOST_LISTED else [])]
    return listed(shown)
