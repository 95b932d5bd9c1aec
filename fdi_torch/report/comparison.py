"""Comparison of runs on a page: differences, agreement of results, and their convergence and residuals together."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fdi_torch.amounts import AT_95, with_error
from fdi_torch.effects import EFFECTS
from fdi_torch.logbook import Comparison, align
from fdi_torch.logbook.compare import Result
from fdi_torch.names import counted, listed
from fdi_torch.parameters import ParameterName
from fdi_torch.quantities import display_unit
from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.comparison_headline import comparison_headline, setting_table
from fdi_torch.report.diagnosed_effects import diagnosed_effects
from fdi_torch.report.html import folded, short, shown, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number
from fdi_torch.report.predictions import residuals
from fdi_torch.report.section import Picture, Section, channel_signals, signals
from fdi_torch.report.style import MARK, MODEL, OTHER, SOFT
from fdi_torch.tables import Table

MOST_LETTERS = 160  # of a setting or result that differs; a longer one, such as a covariance, is cut
DIFFERENCE = "difference, std errors"
PIPE_CAPACITY = re.compile(r"plant\.pipes\..*\.(area|discharge_coefficient)")
COLOURS = (MODEL, MARK, OTHER, SOFT)
CURVES = {
    "/estimator/de/generation": ("Search", "generation", "best_cost"),
    "/estimator/refine/iteration": ("Refinement", "iteration", "cost"),
}


def comparison_section(compared: Comparison, runs: Sequence[Material]) -> Section:
    """The section about all runs, given in the order of the comparison, in the units of the first run's plant."""
    with runs[0].in_its_units():
        return _section(compared, runs)


def _section(compared: Comparison, runs: Sequence[Material]) -> Section:
    first, *sentences = comparison_headline(compared, runs)
    blocks: list[Any] = [
        tag("h3", first),
        *(tag("p", sentence) for sentence in (*sentences, *in_words(compared, runs))),
    ]
    blocks += [shown(result_table(compared))] if compared.results else []
    pictures = [*_convergence(compared, runs), *_residuals(compared, runs)]
    blocks += [pictures] if pictures else []
    tables = {"settings": replace(setting_table(compared, runs), title="")}
    for name in (name for name in compared.differences if name not in ("config", "seeds")):
        rows = [(key, *texts) for key, texts in compared.differences[name].items()]
        rows = [row for row in rows if name != "result" or not any(text.startswith("[") for text in row[1:])]
        tables[name] = replace(tables["settings"], rows=rows, summary="")
    for name, each in tables.items():  # lists of numbers in the results are the table above
        rows = [(key, *(short(text, MOST_LETTERS) for text in texts)) for key, *texts in each.rows]
        blocks += [folded(f"{name}: {len(rows)} differ", shown(replace(each, rows=rows)))] if rows else []
    return Section("Comparison", blocks)


def in_words(compared: Comparison, runs: Sequence[Material]) -> list[str]:
    """Agreement of the estimates that several runs have, with their number, one sentence each.

    Runs agree only if all of them explain their recordings and name the same faults.
    """
    failing = [run.unexplained for run in runs]
    unreliable = [label for label, fails in zip(compared.labels, failing, strict=True) if fails]
    shared = [result for result in compared.results if not math.isnan(result.apart)]
    if not shared:
        return [f"The estimates are not compared, as {_are_unreliable(unreliable)}."] if unreliable else []
    # The difference of estimates from one recording is smaller than that of independent ones with these errors.
    beyond = [result for result in shared if (result.apart > AT_95 if compared.shares_data else result.agree is False)]
    apart = [result.name for result in beyond]
    words = [
        _shared_words(shared, len(compared.results), len(runs) - len(unreliable), "reliable " if unreliable else "")
    ]
    doubt = _are_unreliable(unreliable) if unreliable else ""
    doubt = doubt or ("the runs name different faults" if _name_different_faults(runs) else "")
    if compared.shares_data:
        words[0] += "."
        words.append(_differences_on_one_recording(compared, shared) + (f"; but {doubt}." if doubt else "."))
    elif apart:
        words[0] += f"; at 95 % these differ: {', '.join(apart)}."
    elif doubt:
        words[0] += f"; none of these differs at 95 %, but {doubt}."
    else:
        words[0] += "; there they agree at 95 %."
    relative = {effect.name for effect in EFFECTS if effect.capacity_share}  # to the capacity of a pipe, as a leak
    shares = [name for name in apart if (p := ParameterName.parse(name)).field == "size" and p.effect in relative]
    pipes = [key for key in compared.differences.get("config", {}) if PIPE_CAPACITY.fullmatch(key)]
    if shares and pipes:
        words.append(
            f"{listed(shares)}: relative to the capacity of a pipe in the plant file; {listed(pipes)} differs."
        )
    return words


def _differences_on_one_recording(compared: Comparison, shared: Sequence[Result]) -> str:
    """By how much estimates from one recording differ: noise that they have in common does not show in a difference."""
    most = max(shared, key=lambda result: result.apart)
    which = "All runs" if compared.same_data else "Some of the runs"
    return (
        f"{which} read the same recording: their errors are not independent, so that standard errors do not add and no "
        f"test of agreement applies; the estimates differ by at most {number(most.apart, 2)} of the smaller standard "
        f"error ({most.name})"
    )


def _are_unreliable(labels: Sequence[str]) -> str:
    return f"{listed(labels)} {'is' if len(labels) == 1 else 'are'} unreliable"


def _shared_words(shared: Sequence[Result], count: int, runs: int, kind: str) -> str:
    """'Of 7 parameters 1 is in both runs': how many of `count` parameters have an error in several of the runs of this
    kind.
    """
    in_all = all(sum(math.isfinite(std) for std in result.std) >= runs for result in shared)
    if in_all and len(shared) == count:
        same = "the same parameter" if count == 1 else f"the same {count} parameters"
        return f"{'Both' if runs == 2 else 'All'} {kind}runs have {same}"
    where = f"more than one {kind}run" if not in_all else f"{'both' if runs == 2 else 'all'} {kind}runs"
    return f"Of {counted(count, 'parameter')} {len(shared)} {'is' if len(shared) == 1 else 'are'} in {where}"


def _name_different_faults(runs: Sequence[Material]) -> bool:
    """Whether the runs name different faults; a monitor names those that it has isolated."""
    return len({frozenset(f.words for f in diagnosed_effects(run) if f.present) for run in runs}) > 1


def result_table(compared: Comparison) -> Table:
    """Parameter, unit, value and error of each run and, if runs share one, p-value and agreement; of runs that read the
    same recording, their difference in standard errors.
    """
    verdicts = {True: "yes", False: "no", None: ""}
    rows = []
    for result in compared.results:
        unit, scale = display_unit(result.unit, result.name)
        ends = result.ends or [""] * len(result.values)
        numbers = zip(result.values, result.std, ends, strict=True)
        values = ["–" if math.isnan(v) else with_error(scale * v, scale * s, end) for v, s, end in numbers]
        chance = "" if math.isnan(result.p_value) else number(result.p_value, 2)
        p_value = "< 0.0001" if result.p_value < 1e-4 else chance
        difference = "" if math.isnan(result.apart) else number(result.apart, 2)
        last = [difference] if compared.shares_data else [p_value, verdicts[result.agree]]
        rows.append([result.name, unit or "1", *values, *last])
    last = [DIFFERENCE] if compared.shares_data else ["p", "agree"]
    return Table(("parameter", "unit", *compared.labels, *last), rows, "estimates")


def _convergence(compared: Comparison, runs: Sequence[Material]) -> list[Picture]:
    """Cost of each run; with several problems or starts, that of the first."""
    pictures = []
    for k, (topic, (title, step, field)) in enumerate(CURVES.items()):
        if sum(bool(run.counts.get(topic)) for run in runs) < 2:
            continue
        steps, costs = align([run.run.path for run in runs], topic, field, {"problem": 0})
        lines: list[Line] = []
        for label, cost, colour in zip(compared.labels, costs, COLOURS, strict=False):
            present = np.isfinite(cost)
            lines.append(Line(label, steps[present], cost[present], colour))
        pictures.append(signals(f"compare_cost_{k + 1}", Chart(title, step, "cost", lines, log=True)))
    return pictures


def _residuals(compared: Comparison, runs: Sequence[Material]) -> list[Picture]:
    """Residuals of each sensor, for the runs whose log has predictions."""
    lines: dict[tuple[str, str], list[Line]] = {}
    for label, run, colour in zip(compared.labels, runs, COLOURS, strict=False):
        residual = residuals(run, 0) if run.groups else None
        if residual is None:
            continue
        recording = run.recordings[0]
        for i, sensor in enumerate(zip(recording.output_names, recording.output_units, strict=True)):
            lines.setdefault(sensor, []).append(Line(label, recording.time, residual[:, i], colour))
    pictures = []
    for k, ((name, unit), of_sensor) in enumerate(lines.items()):
        words = f"compare_residual_{k + 1}", runs[0].channel_words(name), "measured − model"
        pictures.append(channel_signals(*words, unit, of_sensor, name, level=0.0, clock="residuals"))
    return pictures
