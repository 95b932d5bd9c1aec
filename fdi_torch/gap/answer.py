"""A diagnosis as it is handed over: verdict, places, causes with parameters, rivals, closure; the JSON of `fdi gap`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from fdi_torch.plant.description import PlacedEffect, PlantDescription

FORMAT = "fdi_torch.gap/1"
Verdict = Literal["no_gap", "named", "ambiguous", "unknown"]
CauseName = tuple[str, str]


@dataclass(frozen=True)
class Amount:
    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """An effect at a place; parameters by their short names, SI."""

    effect: str
    location: str
    parameters: Mapping[str, Amount] = field(default_factory=dict)
    same_as: tuple[CauseName, ...] = ()


@dataclass(frozen=True)
class Explanation:
    """A set of causes, empty for none; probability among all explanations weighed."""

    causes: tuple[CauseName, ...]
    probability: float
    unknown_at: str | None = None


@dataclass(frozen=True)
class Answer:
    """See the protocol of gap diagnosis; `to_dict` is its JSON."""

    verdict: Verdict
    p_value: float
    where: Sequence[tuple[str, float]]
    causes: Sequence[Cause]
    ambiguity_set: Sequence[tuple[CauseName, ...]]
    posterior: Sequence[Explanation]
    closure: Mapping[str, Any]
    noise: Mapping[str, Any]
    shape: Mapping[str, Any] | None = None
    next_input: Mapping[str, Any] | None = None
    impostors: Mapping[str, Any] | None = None
    remarks: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        answer: dict[str, Any] = {
            "format": FORMAT,
            "verdict": self.verdict,
            "alarm": {"p_value": self.p_value},
            "where": [{"location": place, "share": share} for place, share in self.where],
            "causes": [_cause(c) for c in self.causes],
            "ambiguity_set": [[_name(c) for c in causes] for causes in self.ambiguity_set],
            "posterior": [_explanation(e) for e in self.posterior],
            "closure": dict(self.closure),
            "noise": dict(self.noise),
            "shape": self.shape,
            "next_input": self.next_input,
            "impostors": self.impostors,
            "remarks": list(self.remarks),
        }
        return finite(answer)


def adopted(plant: PlantDescription, answer: Answer) -> PlantDescription:
    """The plant as the answer says it is: its file with the causes among its effects."""
    placed = [PlacedEffect(c.effect, c.location, {n: a.value for n, a in c.parameters.items()}) for c in answer.causes]
    known = {(p.effect, p.location) for p in placed}
    return replace(plant, effects=(*(e for e in plant.effects if (e.effect, e.location) not in known), *placed))


def finite(value: Any) -> Any:
    """What is not finite becomes None: JSON has no other word for it."""
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _name(cause: CauseName) -> dict[str, str]:
    return {"effect": cause[0], "location": cause[1]}


def _cause(cause: Cause) -> dict[str, Any]:
    parameters = {n: {"value": a.value, "std": a.std, "unit": a.unit} for n, a in cause.parameters.items()}
    named: dict[str, Any] = {"effect": cause.effect, "location": cause.location, "parameters": parameters}
    return named | ({"same_as": [_name(c) for c in cause.same_as]} if cause.same_as else {})


def _explanation(explanation: Explanation) -> dict[str, Any]:
    shown: dict[str, Any] = {"causes": [_name(c) for c in explanation.causes], "probability": explanation.probability}
    return shown | ({"unknown_at": explanation.unknown_at} if explanation.unknown_at else {})
