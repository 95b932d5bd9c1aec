"""Text of the answer of `fdi gap`: the verdict, short tables with units, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_torch.amounts import rounded
from fdi_torch.cli.screen import Screen
from fdi_torch.clock import clock_unit
from fdi_torch.gap.answer import UNKNOWN, Answer
from fdi_torch.gap.verdict_words import (
    MEAN_FLOW,
    cause_words,
    causes_of,
    closed_sentence,
    explanation_words,
    holdout_warning,
    probability_words,
    rounds,
    verdict_sentence,
)
from fdi_torch.names import listed
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import display_unit, significant
from fdi_torch.report.diagnosed_effects import flows_that_matter, has_causes, reference_models

MOST_ROWS = 5
SMALLEST_SHOWN = 1e-3  # probability
MOVED = 2.0  # tolerances by which a constant must have moved to be shown


def show(answer: Answer, plant: PlantDescription, steps: Sequence[str], screen: Screen) -> None:
    """Print the verdict, doubts, what to do next, and the tables."""
    as_json = answer.to_dict()
    screen.say(verdict_sentence(as_json))
    screen.points([*answer.remarks, *(f"next: {step}" for step in steps)])
    _causes(answer, screen)
    _explanations(as_json, screen)
    rows = [[place, probability_words(p)] for place, p in answer.where[:MOST_ROWS] if p >= SMALLEST_SHOWN]
    if rows and has_causes(as_json):
        screen.table("where", ("location", "probability that the model is wrong there"), rows)
    _disturbances(flows_that_matter(as_json, plant), screen)
    if answer.closure:
        _closure(as_json, screen)
    _constants(answer.constants, has_causes(answer.to_dict()), screen)
    screen.points([*_confusability(answer.impostors), *_limits(answer)])


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
    moved = [name for name, c in answer.constants.items() if _tolerances_off(c, "augmented") > MOVED]
    if moved:
        still = "even with the causes, " if has_causes(answer.to_dict()) else ""
        steps.append(
            f"{still}{listed(moved)} {'is' if len(moved) == 1 else 'are'} more than {MOVED:g} "
            f"tolerances off {'its nominal value' if len(moved) == 1 else 'their nominal values'}: calibrate the plant "
            "file with a fault-free recording (fdi refit --adopt), then repeat the diagnosis with the calibrated file"
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
        written = f"with {adopted} as their plant, {benefit}" if adopted else refused
        steps.append(written or f"--adopt FILE writes the plant file with the causes; with it {benefit}")
    if not has_holdout and answer.verdict != "no_gap":
        steps.append("--holdout FILE, another recording of the same rig, measures how far the gap closes")
    return steps


def _limits(answer: Answer) -> list[str]:
    """What the inputs of the recording cannot show."""
    sentences = []
    hidden, inseparable = answer.excitation.get("hidden", []), answer.excitation.get("inseparable", [])
    if hidden:
        shown = ", ".join(cause_words(c) for c in hidden[:3])
        more = f" and {len(hidden) - 3} more" if len(hidden) > 3 else ""
        sentences.append(f"these inputs cannot show at their typical size: {shown}{more}")
    if inseparable:
        first = " and ".join(cause_words(c) for c in inseparable[0]["between"])
        many = f"{len(inseparable)} pairs of effects, such as {first}" if len(inseparable) > 1 else first
        sentences.append(f"these inputs cannot distinguish {many}")
    return sentences


def _causes(answer: Answer, screen: Screen) -> None:
    rows = []
    for cause in answer.causes:
        for name, amount in cause.parameters.items():
            unit, scale = display_unit(amount.unit, str(ParameterName(cause.location, cause.effect, name)))
            numbers = [rounded(scale * value, scale * amount.std) for value in (amount.value, amount.std)]
            row = [cause.effect, cause.location, name, *numbers, clock_unit(unit, name, amount.value)]
            rows += [] if rounds(cause.effect) else [row]
        if cause.flow is not None:
            unit, scale = display_unit("m^3/s")
            rows.append([cause.effect, cause.location, MEAN_FLOW, significant(scale * cause.flow, 3), "", unit])
    if rows:
        screen.table("causes", ("effect", "at", "parameter", "value", "std error", "unit"), rows, left=3)


def _disturbances(disturbances: Mapping[str, Any], screen: Screen) -> None:
    """Random flow into each tank, estimated together with the likeliest explanation."""
    rows = []
    for tank, flow in disturbances.items():
        unit, scale = display_unit(flow["unit"])
        time = flow["correlation_time"]
        rows.append([tank, f"{scale * flow['std']:.3g}", unit, f"{time:.3g} s" if time else "none"])
    if rows:
        header = ("into", "standard deviation", "unit", "correlation time")
        screen.table("random disturbance flows, which are no fault", header, rows)


def _explanations(answer: Mapping[str, Any], screen: Screen) -> None:
    weighted = [(explanation_words(causes_of(e)), e["probability"]) for e in answer["posterior"]]
    rows = [[words, probability_words(p)] for words, p in weighted if p >= SMALLEST_SHOWN][: MOST_ROWS + 3]
    if answer["unexamined"] >= SMALLEST_SHOWN:
        rows.append(["explanations that were not examined", probability_words(answer["unexamined"])])
    if len(rows) > 1:
        screen.table("explanations", ("causes", "probability"), rows)


def _closure(answer: Mapping[str, Any], screen: Screen) -> None:
    """Free-run errors: one row per model, one column per sensor; and the share that closes, if there are causes."""
    closure = answer["closure"]
    sensors = list(closure["per_sensor"])
    rows = []
    for stage, name in reference_models(answer).items():
        each = [f"{closure['per_sensor'][s][stage]:.3g}" for s in sensors]
        rows.append([name, f"{closure[stage]:.3g}", *each])
    files = ", ".join(Path(source).name for source in closure["holdouts"])
    header = sensors if len(set(closure["units"].values())) == 1 else [f"{s}, {closure['units'][s]}" for s in sensors]
    screen.table(f"error of free runs on {files}, {closure['unit']}", ("plant", "all", *header), rows)
    if not has_causes(answer):
        return
    screen.say(closed_sentence(closure))
    for one in closure.get("per_holdout", []):
        closed = "undefined" if one["closed"] is None else f"{100 * one['closed']:.1f} %"
        screen.say(
            f"- {Path(one['source']).name}: {one['recalibrated']:.3g} to {one['augmented']:.3g}, closed {closed}"
        )
    if closure["augmented_with"] and closure["frozen"]["recalibrated"] > 1.5 * closure["augmented"]:
        screen.say(
            f"With the causes but with the constants recalibrated without them, the error is "
            f"{closure['frozen']['recalibrated']:.3g} {closure['unit']}: recalibration had absorbed part of the gap."
        )


def _constants(constants: Mapping[str, Any], causes: bool, screen: Screen) -> None:
    """Constants that moved far out of their tolerance; causes: whether the last fit has any."""
    fits = ("recalibrated", "augmented") if causes else ("augmented",)
    stages = ("nominal", "tolerance", *fits[:-1])
    rows = []
    for name, c in constants.items():
        if max(_tolerances_off(c, stage) for stage in fits) > MOVED:
            unit, scale = display_unit(c["unit"], name)
            numbers = [f"{scale * c[stage]:.4g}" for stage in stages]
            fitted = [rounded(scale * c[stage], scale * c["std"]) for stage in ("augmented", "std")]
            rows.append([name, *numbers, *fitted, unit])
    if rows:
        header = ("constant", *stages, "with the causes" if causes else "fitted", "std error", "unit")
        screen.table(f"constants more than {MOVED:g} tolerances off", header, rows)


def _tolerances_off(constant: Mapping[str, Any], stage: str) -> float:
    """Distance of a constant from its nominal value, in tolerances."""
    return float(abs(constant[stage] - constant["nominal"]) / constant["tolerance"])


def _confusability(confusability: Mapping[str, Any] | None) -> list[str]:
    """How often another cause would have been given this name under these inputs."""
    simulated = confusability.get("simulated") if confusability else None
    if not simulated:
        return []
    confused, passed, draws = simulated["confused"], simulated["passed"], simulated["draws"]
    return [
        f"reliability of the name: of {draws} simulated recordings with a gap of this size from one of "
        f"{simulated['rivals']} other causes, {confused} were given this name, and {passed} if the library lacked the "
        "true cause"
    ]
