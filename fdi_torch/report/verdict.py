"""The result of a run in one sentence, for the top of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from fdi_torch.amounts import parameter_words, with_error
from fdi_torch.clock import clock_text
from fdi_torch.estimate.misfit import fault_statement, unreliable
from fdi_torch.estimate.uncertainty import convergence_warning
from fdi_torch.gap.verdict_words import verdict_sentence
from fdi_torch.names import counted, listed
from fdi_torch.report.diagnosed_effects import combinations_of, diagnosed_effects, rivals_of
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, number
from fdi_torch.report.sections.monitor import rehearsal_tables
from fdi_torch.report.sections.study import SHOWN
from fdi_torch.report.sections.windows import logged_windows

MOST_LISTED = 2  # alarms in the headline
KINDS = {
    "train": "Fault diagnosis",
    "simulate": "Simulation",
    "monitor": "Monitoring",
    "study": "Study",
    "gap": "Sim-to-real gap",
    "challenge": "Blind benchmark",
    "rehearsal": "Validation of a monitor",
}


def kind_words(material: Material) -> str:
    return KINDS.get(material.kind, material.kind or "Recording")


def headline(material: Material) -> str:
    """The verdict, or the status of the run if it has none."""
    kinds = [gap_words, monitor_words, fault_words, alarm_words]
    kinds += [benchmark_words, rehearsal_words, study_words, windows_words]
    with material.in_its_units():
        if words := next(filter(None, (of_kind(material) for of_kind in kinds)), ""):
            return unreliable_words(material) + words
    words, reason = (material.status or "did not end").capitalize(), material.about("status").get("reason")
    return f"{words}: {reason}" if reason else words


def unreliable_words(material: Material) -> str:
    """The warning of a model that has not converged or does not explain its recording; old logs lack the ratio."""
    result = material.about("result")
    warnings = [convergence_warning(result.get("status", "")) if material.kind == "train" else ""]
    if material.unexplained:
        ratio = result.get("unexplained_ratio", "null")
        share = float(result.get("explained_share", 1.0))
        warnings.append(unreliable(math.inf if ratio == "null" else float(ratio), share))
    return "".join(f"{warning}. " for warning in warnings if warning)


def fault_words(material: Material) -> str:
    """The faults that are present, with their sizes; those that are not isolated with their determined combination."""
    effects = diagnosed_effects(material)
    if not effects:
        return ""
    present = [f.sized for f in effects if f.present]
    not_isolated = [combination.sized_rivals for combination in combinations_of(material, "not_isolated")]
    not_isolated += [rivals.sized_rivals for rivals in rivals_of(material)]
    words = fault_statement(present, not_isolated, not material.unexplained)
    return words[:1].upper() + words[1:]


def gap_words(material: Material) -> str:
    """The sentence of the terminal, with the sizes of the named causes."""
    sized = listed([finding.sized + finding.equivalents for finding in diagnosed_effects(material)])
    return verdict_sentence(material.answer, sized).removesuffix(".")


def monitor_words(material: Material) -> str:
    """The explanations above 5 % of each open alarm, from the last event about it, and the recovered faults."""
    if material.kind != "monitor":
        return ""
    last = {m["alarm"]: m for m in material.of("/observer/alarm") if m.get("alarm") and m.get("headline")}
    states = {m["alarm"]: str(m.get("state", "")) for m in material.of("/observer/alarm") if m.get("alarm")}
    unfinished = {n: m for n, m in last.items() if states[n] not in ("recovered", "retired")}
    still_open = [f"{m['headline']}{_since(m)} ({states[n]})" for n, m in unfinished.items()]
    ended = [f"{m['headline']}" for n, m in last.items() if states[n] == "recovered"]
    parts = [_latest("open alarms", still_open)] if still_open else []
    parts += [f"recovered: {_latest('alarms', ended)}"] if ended else []
    text = "; ".join(parts)
    return text[:1].upper() + text[1:]


def _latest(what: str, items: list[str]) -> str:
    """All of a few items; the number of many and the latest, as the others are among the events."""
    if len(items) <= MOST_LISTED:
        return listed(items)
    return f"{len(items)} {what}, the latest: {items[-1]}"


def _since(event: Mapping[str, Any]) -> str:
    onset = event.get("onset")
    if not isinstance(onset, int | float):
        return ""
    moment, std = clock_text(float(onset)), as_float(event.get("onset_std"))
    shown = with_error(float(onset), std) if math.isfinite(std) else number(float(onset), 4)
    return f", since {shown} s" + (f", {moment}" if moment else "")


def alarm_words(material: Material) -> str:
    if not material.counts.get("/observer/residual"):
        return ""
    alarms = [m for m in material.of("/observer/alarm") if m.get("event") in ("alarm", "raised")]
    if not alarms:
        return "No alarm"
    channels = listed(list(dict.fromkeys(str(m["channel"]) for m in alarms if m.get("channel"))))
    first = f"the first at {number(float(alarms[0]['t']), 6)} s"
    return f"{counted(len(alarms), 'alarm')}, {first}{': ' + channels if channels else ''}"


def benchmark_words(material: Material) -> str:
    answers = [m for m in material.of("/study/trial") if m.get("by") == "fdi"] if material.kind == "challenge" else []
    if not answers:
        return ""
    right, wrong = (sum(bool(m.get(name)) for m in answers) for name in ("right", "named_wrong"))
    return f"{right} of {len(answers)} hidden causes diagnosed correctly, {wrong or 'none'} named wrongly"


def rehearsal_words(material: Material) -> str:
    """The summaries of its tables; without a result, the names of the plans."""
    tables = rehearsal_tables(material)
    if any(entry.get("said") for entry in tables):
        words = "; ".join(str(entry["said"]) for entry in tables if entry.get("said"))
        return words[:1].upper() + words[1:]
    groups = [str(m.get("group", "")) for m in material.of("/study/trial")] if material.kind == "rehearsal" else []
    plans = listed(list(dict.fromkeys(group.partition("/")[0] for group in groups)))
    return plans[:1].upper() + plans[1:] + ("" if tables or not plans else ", without a result yet")


def study_words(material: Material) -> str:
    """Number of trials, and the errors of the study's first estimator over the Cramér-Rao bound."""
    trials, settings = material.counts.get("/study/trial", 0), material.of("/study/summary")
    if not trials and not settings:
        return ""
    text = counted(trials, "trial") + (f" in {counted(len(settings), 'setting')}" if settings else "")
    estimator = next((name for name in SHOWN if any(f"{name}.failures" in m for m in settings)), "")
    ratios = [
        float(v)
        for m in settings
        for k, v in m.items()
        if estimator and k.startswith(f"{estimator}.") and k.endswith(".over_bound") and isinstance(v, int | float)
    ]
    if not ratios:
        return text
    low, high = number(min(ratios), 3), number(max(ratios), 3)
    return f"{text}: errors {low if low == high else f'{low} to {high}'} times the Cramér-Rao bound"


def windows_words(material: Material) -> str:
    """Which faults were present for a time, and when."""
    windows, stretches = logged_windows(material)
    if not windows:
        return ""
    when: dict[str, list[str]] = {}
    for stretch in stretches:
        spans = when.setdefault(parameter_words(str(stretch["name"])), [])
        spans.append(f"{number(float(stretch['start']), 6)} to {number(float(stretch['stop']), 6)} s")
    text = "; ".join(f"{fault} from {listed(spans)}" for fault, spans in when.items()) or "no fault in any window"
    return text[:1].upper() + text[1:]


def how_it_ended(material: Material) -> str:
    """Status, start and duration of the run."""
    status = material.about("status")
    reason = f" ({status['reason']})" if status.get("reason") else ""
    parts = [f"{material.status or 'no end in the log'}{reason}"]
    parts += [f"started {material.started} UTC"] if material.started else []
    # The log of a blind benchmark has only the time of its writing, after all diagnoses.
    seconds = "" if material.kind == "challenge" else status.get("wall_seconds", "")
    with suppress(ValueError):
        seconds = number(float(seconds), 3)
    return " · ".join([*parts, *([f"took {seconds} s"] if seconds else [])])
