"""The verdict in one sentence, and explanations in words, for terminal and report pages.

Functions take the answer as JSON in format 1 or 2, as it is in logs. A log may come from anybody, so its texts are not
trusted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fdi_torch.amounts import effect_words, probability_words
from fdi_torch.effects import effect
from fdi_torch.gap.answer import UNKNOWN
from fdi_torch.gap.constant_remarks import OFF_TOLERANCES
from fdi_torch.names import listed
from fdi_torch.quantities import quantity_text

FORMAT_1 = "fdi_torch.gap/1"
Named = Mapping[str, Any]
MEAN_FLOW = "flow at mean levels"
"""The flow of a cause in tables, beside its parameters."""


def causes_of(explanation: Named) -> list[Named]:
    """The causes of an item of the posterior, something unknown included; format 1 has it in `unknown_at` only."""
    causes = [c for c in explanation.get("causes") or [] if isinstance(c, Mapping)]
    place = explanation.get("unknown_at")
    if place and not any(c.get("effect") == UNKNOWN for c in causes):
        causes.append({"effect": UNKNOWN, "location": place})
    return causes


def rounds(name: str) -> bool:
    """Whether an effect, its name with '_' or spaces, is the rounding of a sensor's readings, which is no fault."""
    try:
        return effect(name.replace(" ", "_")).quantizes
    except ValueError:
        return False


def apart_from_rounding(causes: Sequence[Named]) -> list[Named]:
    """The causes without the rounding of readings."""
    return [cause for cause in causes if not rounds(str(cause.get("effect", "")))]


def rounding_words(causes: Sequence[Named]) -> str:
    """'Readings are rounded, which is no fault: hA to 1 %.'; empty if none are."""
    steps = [
        f"{c['location']} to {quantity_text(float(step['value']), str(step.get('unit', '1')), 4, name)}"
        for c in causes
        if rounds(str(c.get("effect", "")))
        for field, step in (c.get("parameters") or {}).items()
        for name in [f"{c['location']}.{c['effect']}.{field}"]
    ]
    return f"Readings are rounded, which is no fault: {', '.join(steps)}." if steps else ""


def cause_words(cause: Named) -> str:
    """'leak at T1', 'something unknown at Q1'."""
    effect = "something unknown" if cause.get("effect") == UNKNOWN else str(cause.get("effect", ""))
    return effect_words(effect, str(cause.get("location", "")))


def explanation_words(causes: Sequence[Named]) -> str:
    """'leak at T1 and pump lag at Q1', or that nothing lies beyond tolerances; without the rounding of readings."""
    return listed([cause_words(cause) for cause in apart_from_rounding(causes)]) or "nothing beyond tolerances"


def verdict_sentence(answer: Named, best: str = "") -> str:
    """What causes the gap, how sure that is, and which readings are rounded. Empty without a verdict.

    best: the likeliest explanation in words, for example with sizes; by default without.
    """
    sentences = (
        holdout_warning(answer),
        _verdict(answer, best),
        convergence_warning(answer),
        rounding_words(answer.get("causes") or []),
    )
    return " ".join(filter(None, sentences))


def holdout_warning(answer: Named) -> str:
    """A sentence if the error of a hold-out grows with the causes; empty otherwise."""
    closure = answer.get("closure")
    if not isinstance(closure, Mapping):
        return ""
    interval = closure.get("closed_ci95")
    most = interval[-1] if isinstance(interval, list | tuple) and interval else None
    if isinstance(most, int | float) and most < 0.0:
        return "Do not adopt these causes: they make the prediction of the hold-out worse."
    closed = closure.get("closed")
    fails = isinstance(closed, int | float) and closed < 0.0
    return "These causes do not close the gap of the hold-out." if fails else ""


def convergence_warning(answer: Named) -> str:
    """A sentence if the fit of the likeliest causes has not converged; empty otherwise.

    Without causes it says nothing: a better fit would explain the recording even better.
    """
    if answer.get("converged") is not False or answer.get("verdict") == "no_gap":
        return ""
    return "Its fit has not converged, so that its sizes and its probability may be wrong."


def closed_sentence(closure: Named) -> str:
    """The share of the gap on the hold-outs, after recalibration, that the causes explain."""
    closed, interval = closure.get("closed"), closure.get("closed_ci95")
    if not isinstance(closed, int | float):
        return (
            "After recalibration, too little of the hold-out's gap is left, compared with its standard error, to say "
            "how much of it the causes close."
        )
    if closed < 0.0:
        return "The gap does not close on data not used for fitting: the causes do not carry over to them."
    between = ""
    if isinstance(interval, list | tuple) and len(interval) == 2:
        between = f" (95 % interval {100.0 * interval[0]:.1f} to {100.0 * interval[1]:.1f} %)"
    return f"{100.0 * closed:.1f} % of the gap closes on data not used for fitting{between}."


def _verdict(answer: Named, best: str) -> str:
    verdict = answer.get("verdict", "")
    first: Named = next(iter(answer.get("posterior") or []), {})
    probability = first.get("probability")
    chance = f", probability {probability_words(probability)}" if isinstance(probability, int | float) else ""
    best = best or _with_equivalents(causes_of(first), answer.get("causes") or [])
    if verdict == "no_gap":
        return f"No gap: {_explained(answer, 'noise')}."
    if verdict == "named" and not apart_from_rounding(causes_of(first)):
        return f"No gap: {_explained(answer, 'rounding', 'noise')}{chance}."
    if verdict == "named":
        return f"The gap comes from {best}{chance}."
    explanations, certain = answer.get("ambiguity_set") or [], apart_from_rounding(answer.get("certain") or [])
    certain = [] if convergence_warning(answer) else certain
    count, surely = len(explanations), f" Present with at least 95 %: {explanation_words(certain)}." if certain else ""
    if verdict == "ambiguous":
        whether = "is" if all(map(apart_from_rounding, explanations)) else "may be"
        plausible = f"{count} explanations are plausible at 95 %, " if count > 1 else ""
        rest = "" if count > 1 or convergence_warning(answer) else _unfitted(answer)
        return f"There {whether} a gap; {plausible}the likeliest is {best}{chance}.{rest}{surely}"
    if verdict != "unknown":
        return ""
    if causes_of(first) and count > 1:
        plausible = f"{count} explanations are plausible at 95 %, the likeliest is {best}{chance}."
        return f"The gap comes from something that no effect of the library describes; {plausible}{surely}"
    if causes_of(first):
        return f"The gap comes from {best}{chance}; no effect of the library describes the unknown part."
    place = next((str(w["location"]) for w in answer.get("where") or []), "a sensor")  # logs of earlier versions
    return f"Readings of {place} are outliers or stuck; apart from these, the plant file explains the recording."


def _explained(answer: Named, *within: str) -> str:
    """That the plant file explains the recording, and within what; constants that had to move far for it are named."""
    moved = _moved_constants(answer)
    if not moved:
        return f"the plant file explains the recording within {listed([*within, 'tolerances'])}"
    those = "its tolerance" if len(moved) == 1 else "their tolerances"
    return f"apart from {listed(moved)}, beyond {those}, the plant file explains the recording within {listed(within)}"


def _moved_constants(answer: Named) -> list[str]:
    """Constants that are OFF_TOLERANCES tolerances off or more: 'link.discharge_coefficient (3.1 tolerances off)'."""
    moved = []
    for name, constant in (answer.get("constants") or {}).items():
        numbers = [constant.get(key) for key in ("nominal", "augmented", "tolerance")]
        nominal, fitted, tolerance = (float(x) if isinstance(x, int | float) else math.nan for x in numbers)
        if tolerance > 0.0 and abs(fitted - nominal) > OFF_TOLERANCES * tolerance:
            moved.append(f"{name} ({(fitted - nominal) / tolerance:.2g} tolerances off)")
    return moved


def _with_equivalents(explanation: Sequence[Named], fitted: Sequence[Named]) -> str:
    """'plugging at drain, or equivalently leak at B'. fitted: the causes with their equivalents."""
    words = {cause_words(c): equivalents_words(c) for c in fitted}
    names = [cause_words(cause) for cause in apart_from_rounding(explanation)]
    return listed([name + words.get(name, "") for name in names]) or explanation_words([])


def equivalents_words(cause: Named) -> str:
    """', or equivalently leak at B'; empty for a cause without an equivalent."""
    equivalents = [c for c in cause.get("same_as") or [] if isinstance(c, Mapping)]
    return f", or equivalently {' or '.join(map(cause_words, equivalents))}" if equivalents else ""


def _unfitted(answer: Named) -> str:
    """Why a single explanation does not suffice: others, which were not fitted, may be likely."""
    unexamined = answer.get("unexamined")
    if not isinstance(unexamined, int | float):
        return ""
    return f" Explanations that were not fitted have {probability_words(unexamined)} together."
