"""Text of the answer of `fdi gap`: the verdict, short tables with units, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_torch.cli.screen import Screen
from fdi_torch.gap.answer import UNKNOWN, Answer
from fdi_torch.gap.constant_remarks import OFF_TOLERANCES
from fdi_torch.gap.verdict_words import closed_sentence, holdout_warning, rounds, verdict_sentence
from fdi_torch.plant.description import PlantDescription
from fdi_torch.report.gap_tables import (
    HARDLY_SHOWN,
    absorbed_sentence,
    cause_table,
    constant_table,
    error_tables,
    explanation_table,
    flow_table,
    has_causes,
    hidden_effects,
    inseparable_pairs,
    reliability_sentences,
)
from fdi_torch.tables import Table

MOST_ROWS = 5
SMALLEST_SHOWN = 1e-3  # probability


def show(answer: Answer, plant: PlantDescription, steps: Sequence[str], screen: Screen) -> None:
    """Print the verdict, doubts, what to do next, and the tables."""
    as_json = answer.to_dict()
    screen.say(verdict_sentence(as_json))
    screen.points([*answer.remarks, *(f"next: {step}" for step in steps)])
    likely = explanation_table(as_json, SMALLEST_SHOWN)
    places = [(place, p) for place, p in answer.where[:MOST_ROWS] if p >= SMALLEST_SHOWN]
    where = Table(("location", "probability that the model is wrong there"), places, "where")
    tables = [cause_table(as_json), *([likely] if len(likely) > 1 else []), *([where] if has_causes(as_json) else [])]
    screen.show(*tables, flow_table(as_json, plant), *error_tables(as_json))
    if answer.closure and has_causes(as_json):
        screen.say(closed_sentence(answer.closure))
        screen.points(filter(None, [absorbed_sentence(as_json)]))
    screen.show(constant_table(as_json, OFF_TOLERANCES if has_causes(as_json) else 0.0))
    screen.points([*reliability_sentences(as_json), *_limits(as_json)])


def next_steps(
    answer: Answer,
    has_holdout: bool,
    library: Sequence[str] | None,
    planned: Path | None,
    adopted: str | None,
    rim_denied: bool = False,
    refused: str = "",
) -> list[str]:
    """What to do next. planned: path of the next input; adopted: path of the adopted plant file; None if
    not written. rim_denied: whether readings lie above a rim of the plant file. refused: why nothing was adopted.
    """
    steps = []
    if rim_denied:
        steps.append(
            "correct the plant file as said above, then repeat the diagnosis; until then train, refit and monitor "
            "refuse this recording"
        )
    if planned and answer.next_input:
        samples = answer.next_input.get("parted_after_samples")
        when = f"after some {samples} samples" if samples else "in a longer run"
        steps.append(f"record the input {planned}; it should distinguish the two likeliest explanations {when}")
    elif answer.verdict == "ambiguous" and len(answer.ambiguity_set) > 1:
        steps.append("no input within the limits of pumps and levels soon distinguishes the two explanations")
    if answer.verdict == "unknown" and library is None:
        steps.append("--library all also searches the other effects; the report draws the discrepancy's shape")
    if answer.verdict == "unknown":
        steps.append(
            "--named-only reports the best named effect instead of `unknown`, which helps if several things are "
            "wrong at once; --adopt can then write it, and the next diagnosis continues from there"
        )
    if holdout_warning(answer.to_dict()):
        steps.append(
            "compare dimensions and constants of the plant file with the rig, calibrate it with a fault-free recording "
            "(fdi refit --adopt), and repeat the diagnosis before you adopt anything"
        )
    elif not rim_denied and any(c.effect != UNKNOWN and not rounds(c.effect) for c in answer.causes):
        benefit = "train and monitor no longer take the gap for a fault"
        if adopted or refused:
            steps.append(f"with {adopted} as their plant, {benefit}" if adopted else refused)
        elif answer.verdict != "ambiguous":
            steps.append(f"--adopt FILE writes the plant file with the causes; with it {benefit}")
    if not has_holdout and answer.verdict != "no_gap":
        steps.append("--holdout FILE, another recording of the same rig, measures how far the gap closes")
    return steps


def _limits(answer: Mapping[str, Any]) -> list[str]:
    """What the inputs of the recording cannot show."""
    hidden, pairs, sentences = hidden_effects(answer), inseparable_pairs(answer), []
    if hidden:
        more = f" and {len(hidden) - 3} more" if len(hidden) > 3 else ""
        sentences.append(f"these inputs hardly show {', '.join(hidden[:3])}{more}: {HARDLY_SHOWN}")
    if pairs:
        many = f"{len(pairs)} pairs of effects, such as {pairs[0]}" if len(pairs) > 1 else pairs[0]
        sentences.append(f"these inputs cannot distinguish {many}")
    return sentences
