"""What terminal, page and notebook show of the answer of a gap diagnosis: its tables, and sentences about its limits.

Functions take the answer as JSON, as it is in logs. A log may come from anybody, so nothing in it is trusted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from fdi_torch.amounts import kind_words
from fdi_torch.clock import clock_unit
from fdi_torch.gap.answer import UNKNOWN
from fdi_torch.gap.verdict_words import MEAN_FLOW, apart_from_rounding, causes_of, explanation_words
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import emptying_time
from fdi_torch.report.numbers import as_float, number, percent
from fdi_torch.tables import Table, in_display_unit

Answer = Mapping[str, Any]
MODEL_NAMES = {
    "nominal": "nominal model",
    "recalibrated": "recalibrated",
    "augmented": "with the causes",
    "ceiling": "with freely fitted curves there",
    "noise_floor": "noise",
}
FROZEN = {"recalibrated": "but constants as recalibrated", "nominal": "but constants of the plant file"}
ABSORBED = 1.5
"""Ratio of free-run errors with the causes, with other constants to fitted ones, from which recalibration counts as
having absorbed part of the gap."""
HARDLY_SHOWN = (
    "at a usual size (of most effects a tenth of the largest), noise or recalibration within the tolerances would hide "
    "them"
)
"""What it means that inputs hardly show some effects."""
SMALLEST_MOVE = 0.1
"""Standard deviation of a level, in those of the best sensor's noise. Less adds below 1 % to the readings' variance."""


def has_causes(answer: Answer) -> bool:
    """Whether the answer names anything, a place with an unknown cause included, that a model can be augmented with."""
    return answer.get("verdict") != "no_gap"


def model_names(answer: Answer) -> dict[str, str]:
    """Names of the models that suit the answer, and of the noise, by their key in its closure.

    A cause without a name is a freely fitted curve, beside which there is no better one.
    """
    if not has_causes(answer):
        return {key: name for key, name in MODEL_NAMES.items() if key not in ("augmented", "ceiling")}
    first: Mapping[str, Any] = next(iter(answer.get("posterior") or []), {})
    unnamed = any(cause.get("effect") == UNKNOWN for cause in causes_of(first))
    if answer.get("verdict") == "unknown" or (answer.get("verdict") == "ambiguous" and unnamed):
        named = any(cause.get("effect") != UNKNOWN for cause in apart_from_rounding(causes_of(first)))
        augmented = f"with {'the causes and ' if named else ''}a freely fitted curve"
        return {k: n for k, n in (MODEL_NAMES | {"augmented": augmented}).items() if k != "ceiling"}
    return MODEL_NAMES


def reference_models(answer: Answer) -> dict[str, str]:
    """Names of the compared models and of the noise that the closure of the answer has errors of, by their key."""
    closure = answer.get("closure") or {}
    return {key: name for key, name in model_names(answer).items() if isinstance(closure.get(key), int | float)}


def cause_table(answer: Answer) -> Table:
    """One row per parameter of each cause, and one for its flow."""
    rows: list[tuple[Any, ...]] = []
    for cause in apart_from_rounding(answer.get("causes") or []):
        effect, at = str(cause["effect"]), str(cause["location"])
        named = []
        for name, amount in (cause.get("parameters") or {}).items():
            value, std = as_float(amount.get("value")), as_float(amount.get("std"))
            full = f"{at}.{effect}.{name}"
            unit, *numbers = in_display_unit(full, str(amount.get("unit", "")), value, std)
            named.append((str(name).replace("_", " "), *numbers, clock_unit(unit, name, value)))
        if math.isfinite(flow := as_float(cause.get("flow"))):
            unit, flow = in_display_unit("", "m^3/s", flow)
            named.append((MEAN_FLOW, float(f"{flow:.3g}"), None, unit))
        rows += [(kind_words(effect, at), at, *each) for each in named or [("", None, None, "")]]
    return Table(("effect", "at", "parameter", "value", "std error", "unit"), rows, "causes")


def explanation_table(answer: Answer, least: float = 0.0) -> Table:
    """All explanations of at least that probability, likeliest first, and those that were not examined."""
    posterior, unexamined = answer.get("posterior") or [], as_float(answer.get("unexamined"))
    weighted = [(explanation_words(causes_of(each)), as_float(each.get("probability"))) for each in posterior]
    rows = [row for row in weighted if row[1] >= least]
    rows += [("explanations that were not examined", unexamined)] if unexamined > least else []
    return Table(("explanation", "probability"), rows, "explanations")


def flow_table(answer: Answer, plant: PlantDescription | None) -> Table:
    """Random flow into each tank for which it matters, estimated together with the likeliest explanation."""
    rows = []
    for tank, flow in flows_that_matter(answer, plant).items():
        unit, std = in_display_unit("", str(flow.get("unit", "")), as_float(flow.get("std")))
        time = as_float(flow.get("correlation_time"))
        rows.append((tank, std, unit, f"{number(time, 3)} s" if time else "none"))
    header = ("into", "standard deviation", "unit", "correlation time")
    return Table(header, rows, "random disturbance flows, which are no fault", digits=3)


def flows_that_matter(answer: Answer, plant: PlantDescription | None) -> dict[str, Mapping[str, Any]]:
    """Tank -> its random flow, if it moves the tank's level by more than `SMALLEST_MOVE`; all without a plant.

    A flow w that is constant moves the level of a tank by w T / A, with area A and emptying time T; a random flow of
    that standard deviation moves it by less. A tank without an outlet has no such bound, hence its flow matters.
    """
    flows = answer.get("disturbances")
    flows = {k: f for k, f in flows.items() if isinstance(f, Mapping)} if isinstance(flows, Mapping) else {}
    noise = answer.get("noise")
    if plant is None or not isinstance(noise, Mapping) or not noise:
        return flows
    gains = {sensor.name: abs(sensor.gain) for sensor in plant.sensors}
    stds = [as_float((noise.get(s) or {}).get("std")) / gain for s, gain in gains.items() if s in noise]
    best = min(stds, default=math.nan)
    tanks = {t.name: emptying_time(plant, t) / t.area for t in plant.tanks}
    return {
        name: flow
        for name, flow in flows.items()
        if name not in tanks or not as_float(flow.get("std")) * tanks[name] <= SMALLEST_MOVE * best
    }


def error_tables(answer: Answer) -> list[Table]:
    """Free-run errors on the hold-outs: one row per model and one column per sensor; of several, one row per file."""
    closure, models = answer.get("closure") or {}, reference_models(answer)
    if not models:
        return []
    unit, units = str(closure.get("unit", "")), closure.get("units") or {}
    sensors = {str(s): e for s, e in (closure.get("per_sensor") or {}).items()}
    several = len(set(units.values())) > 1
    header = ["plant", "all", *(f"{s}, {units[s]}" if several and s in units else s for s in sensors)]
    errors = [(name, closure[m], *(each.get(m) for each in sensors.values())) for m, name in models.items()]
    frozen = (closure.get("frozen") or {}) if "augmented" in models else {}
    none = [None] * len(sensors)
    errors += [(f"{models['augmented']}, {o}", frozen[k], *none) for k, o in FROZEN.items() if k in frozen]
    files = ", ".join(PurePath(str(source)).name for source in closure.get("holdouts") or [])
    title = f"error of free runs{' on ' if files else ''}{files}{', ' if unit else ''}{unit}"
    tables = [Table(header, [(name, *map(as_float, each)) for name, *each in errors], title, digits=3)]
    compared = {key: name for key, name in models.items() if key in ("recalibrated", "augmented", "noise_floor")}
    closes = ("closed",) if "augmented" in models else ()
    rows = []
    for one in closure.get("per_holdout") or []:
        share = one.get("closed")
        closed = percent(share) if isinstance(share, int | float) else "undefined"
        name = PurePath(str(one.get("source", ""))).name
        rows.append((name, *(as_float(one.get(key)) for key in compared), *([closed] if closes else [])))
    tables.append(Table(("hold-out", *compared.values(), *closes), rows, "each hold-out", digits=3))
    return tables if rows else tables[:1]


def absorbed_sentence(answer: Answer) -> str:
    """That recalibration without the causes had absorbed part of the gap; empty if it had not."""
    closure = answer.get("closure") or {}
    frozen, own = ((closure.get("frozen") or {}).get("recalibrated"), closure.get("augmented"))
    if not has_causes(answer) or not closure.get("augmented_with") or not as_float(frozen) > ABSORBED * as_float(own):
        return ""
    return (
        f"With the causes but with the constants as recalibrated, the error is {as_float(frozen):.3g} "
        f"{closure.get('unit', '')}: recalibrated without the causes, the constants compensate part of the gap. Do not "
        "combine them with the causes."
    )


def constant_table(answer: Answer, moved: float = 0.0) -> Table:
    """Constants more than so many tolerances off: nominal values, and those fitted without and with the causes."""
    causes = has_causes(answer)
    header = ("constant", "nominal", "tolerance", *(["recalibrated"] if causes else []))
    fits = ("recalibrated", "augmented") if causes else ("augmented",)
    rows = []
    for name, constant in (answer.get("constants") or {}).items():
        if not max(abs(tolerances_off(constant, fit)) for fit in fits) < moved:
            numbers = (as_float(constant.get(stage)) for stage in ("nominal", "tolerance", *fits, "std"))
            unit, *shown = in_display_unit(str(name), str(constant.get("unit", "1")), *numbers)
            rows.append((str(name), *shown, float(f"{tolerances_off(constant, 'augmented'):.2g}"), unit))
    title = f"constants more than {moved:g} tolerances off" if moved else "constants with a tolerance"
    header = (*header, model_names(answer).get("augmented", "fitted"), "std error", "tolerances off", "unit")
    return Table(header, rows, title, digits=4)


def tolerances_off(constant: Mapping[str, Any], stage: str) -> float:
    """Distance of a constant from its nominal value, in tolerances."""
    off = as_float(constant.get(stage)) - as_float(constant.get("nominal"))
    return off / as_float(constant.get("tolerance"))


def hidden_effects(answer: Answer) -> list[str]:
    """Effects that the inputs hardly show, see `HARDLY_SHOWN`; the causes of the answer are not among them."""
    causes = [cause for cause in answer.get("causes") or [] if isinstance(cause, Mapping)]
    named = {(c.get("effect"), c.get("location")) for each in causes for c in (each, *(each.get("same_as") or []))}
    hidden = (answer.get("excitation") or {}).get("hidden") or []
    return [explanation_words([c]) for c in hidden if (c.get("effect"), c.get("location")) not in named]


def inseparable_pairs(answer: Answer) -> list[str]:
    """Pairs of effects that the inputs cannot distinguish."""
    pairs = (answer.get("excitation") or {}).get("inseparable") or []
    return [" and ".join(explanation_words([cause]) for cause in pair["between"]) for pair in pairs]


def reliability_sentences(answer: Answer) -> list[str]:
    """What the answer would have been without the cause in the library, and how often another one gets its name."""
    confusability, sentences = answer.get("impostors") or {}, []
    best, unexplained = confusability.get("best"), confusability.get("left_open")
    if best and isinstance(unexplained, int | float):
        sentences.append(
            f"If the library had lacked the cause, the best explanation would have been {explanation_words(best)}, "
            f"with {percent(unexplained)} of the gap unexplained."
        )
    simulated = confusability.get("simulated")
    if isinstance(simulated, dict):
        passed_for = [explanation_words([c]) for c in simulated.get("passed_for") or []]
        mostly = f", mostly where it was {' or '.join(passed_for[:3])}" if passed_for else ""
        sentences.append(
            f"Reliability of the name: {simulated.get('draws')} simulated recordings deviate from the model as much "
            f"as this one, each because of one of {simulated.get('rivals')} other causes, which would have been "
            f"mistaken for the one named here in {simulated.get('confused')} of them, and in {simulated.get('passed')} "
            f"if the library lacked it{mostly}."
        )
    return sentences
