"""The answer of a gap diagnosis: verdict, places, causes with parameters, rivals, closure; the JSON of `fdi gap`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

import torch

from fdi_torch.effects import effect
from fdi_torch.estimate.uncertainty import plain_value
from fdi_torch.parameters import ParameterName, by_prefix
from fdi_torch.plant.constants import leak_pipe, nominal_capacity
from fdi_torch.plant.description import FLOW_KINDS, PlacedEffect, PlantDescription

FORMAT = "fdi_torch.gap/2"
UNKNOWN = "unknown"  # name of a cause that is not in the library
CERTAIN = 0.95  # marginal probability
# Tolerance of an adopted cause: share of its value, or standard errors, whichever is larger
TOLERANCE_SHARE, TOLERANCE_ERRORS = 0.2, 3.0
Verdict = Literal["no_gap", "named", "ambiguous", "unknown"]
CauseName = tuple[str, str]


@dataclass(frozen=True)
class Amount:
    """Value, standard error and SI unit of a parameter; the error is 0 if the readings show the value without a fit."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """An effect at a place, with its parameters by short name, in SI. same_as: equivalent causes. flow: of an effect
    that adds one, such as a leak, at the mean levels of the first recording, m^3/s.
    """

    effect: str
    location: str
    parameters: Mapping[str, Amount] = field(default_factory=dict)
    same_as: tuple[CauseName, ...] = ()
    flow: float | None = None


@dataclass(frozen=True)
class ProbableExplanation:
    """A set of causes, something unknown included, empty for the nominal plant; and its posterior probability."""

    causes: tuple[CauseName, ...]
    probability: float


@dataclass(frozen=True)
class Answer:
    """The answer of a diagnosis; `to_dict` is its JSON.

    excitation: effects that the inputs cannot show or separate. constants: values in each model, by name. curves: the
    discrepancy at the places with causes. arrays: predictions of the models, for the log only.
    """

    verdict: Verdict
    p_value: float
    where: Sequence[tuple[str, float]]
    causes: Sequence[Cause]
    ambiguity_set: Sequence[tuple[CauseName, ...]]
    posterior: Sequence[ProbableExplanation]
    closure: Mapping[str, Any]
    noise: Mapping[str, Any]
    unexamined: float = 0.0
    converged: bool = True
    disturbances: Mapping[str, Any] = field(default_factory=dict)
    shape: Mapping[str, Any] | None = None
    next_input: Mapping[str, Any] | None = None
    impostors: Mapping[str, Any] | None = None
    excitation: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, Any] = field(default_factory=dict)
    curves: Sequence[Mapping[str, Any]] = ()
    remarks: Sequence[str] = ()
    arrays: Mapping[str, torch.Tensor] = field(default_factory=dict)

    @property
    def certain(self) -> list[CauseName]:
        """Causes, unknown ones included, with a marginal probability of 95 %."""
        share: dict[CauseName, float] = {}
        for e in self.posterior:
            for cause in e.causes:
                share[cause] = share.get(cause, 0.0) + e.probability
        return [cause for cause, probability in share.items() if probability >= CERTAIN]

    def to_dict(self) -> dict[str, Any]:
        answer = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("p_value", "arrays")}
        posterior = [{"causes": names(e.causes), "probability": e.probability} for e in self.posterior]
        as_json = {
            "alarm": {"p_value": self.p_value},
            "where": [{"location": place, "share": share} for place, share in self.where],
            "causes": [_cause(c) for c in self.causes],
            "ambiguity_set": [names(causes) for causes in self.ambiguity_set],
            "posterior": posterior,
            "certain": names(self.certain),
        }
        return plain_value({"format": FORMAT} | answer | as_json, "answer")


def adopted(plant: PlantDescription, answer: Answer, constants: bool = False) -> PlantDescription:
    """The plant file with the causes of the answer among its effects.

    The causes get a tolerance, so that a later diagnosis refits them together with what it finds.

    constants: whether to adopt the fitted calibration constants as well. Their tolerances stay those of the file, since
    a fit does not know how far they may vary from day to day.
    """
    named = [c for c in answer.causes if c.effect != UNKNOWN]
    causes = [PlacedEffect(c.effect, c.location, {n: a.value for n, a in c.parameters.items()}) for c in named]
    adopted_places = {(p.effect, p.location) for p in causes}
    effects = (*(e for e in plant.effects if (e.effect, e.location) not in adopted_places), *causes)
    if not constants:
        return replace(plant, effects=effects)
    values = {n: c["augmented"] for n, c in answer.constants.items() if n not in plant.varying}
    fitted = with_constants(plant, {n: v for n, v in values.items() if ParameterName.parse(n).is_constant})
    effects = tuple(_same_flow(_same_shape(_refitted(e, values), plant, fitted), plant, fitted) for e in effects)
    return replace(fitted, effects=effects, tolerances=plant.tolerances | _tolerances_of_causes(answer))


def _refitted(placed: PlacedEffect, values: Mapping[str, float]) -> PlacedEffect:
    """An effect of the plant file with fitted values of its parameters that have a tolerance."""
    return replace(placed, parameters={n: values.get(placed.full_name(n), v) for n, v in placed.parameters.items()})


def _tolerances_of_causes(answer: Answer) -> dict[str, float]:
    """Tolerances of the causes' parameters, within which a later diagnosis may refit them."""
    return {
        str(ParameterName(cause.location, cause.effect, name)): float(
            f"{max(TOLERANCE_SHARE * abs(amount.value), TOLERANCE_ERRORS * amount.std):.2g}"
        )
        for cause in answer.causes
        for name, amount in cause.parameters.items()
        if amount.std > 0.0  # values that the readings show are exact
    }


def _same_shape(placed: PlacedEffect, before: PlantDescription, after: PlantDescription) -> PlacedEffect:
    """The effect at `after`, with the parameters that it had at `before` even if their nominal values have changed."""
    old, new = (effect(placed.effect).parameters(placed.location, plant) for plant in (before, after))
    moved = {a.name: a.nominal for a, b in zip(old, new, strict=True) if a.nominal != b.nominal}
    return replace(placed, parameters={**moved, **placed.parameters})


def _same_flow(placed: PlacedEffect, before: PlantDescription, after: PlantDescription) -> PlacedEffect:
    """The effect with an unchanged flow if its size is a share of a pipe's capacity that has changed."""
    if not effect(placed.effect).capacity_share:
        return placed
    tank = before.tanks_at(placed.location)[0]
    old, new = (nominal_capacity(p, leak_pipe(p, tank)) for p in (before, after))
    return replace(placed, parameters={**placed.parameters, "size": placed.parameters["size"] * old / new})


def with_constants(plant: PlantDescription, values: Mapping[str, float]) -> PlantDescription:
    """The plant with other constants, by full name, SI: 'P13.discharge_coefficient'."""
    changed = by_prefix(values)

    def updated(parts: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(replace(part, **changed.get(part.name, {})) for part in parts)

    parts = ("tanks", *(kind.part() for kind in FLOW_KINDS), "sensors")
    changes: dict[str, Any] = {part: updated(getattr(plant, part)) for part in parts}
    return replace(plant, **changes)


def names(causes: Iterable[CauseName]) -> list[dict[str, str]]:
    """Causes as the JSON lists them."""
    return [{"effect": name, "location": location} for name, location in causes]


def _cause(cause: Cause) -> dict[str, Any]:
    parameters = {n: asdict(a) for n, a in cause.parameters.items()}
    named: dict[str, Any] = {"effect": cause.effect, "location": cause.location, "parameters": parameters}
    named |= {} if cause.flow is None else {"flow": cause.flow}
    return named | ({"same_as": names(cause.same_as)} if cause.same_as else {})
