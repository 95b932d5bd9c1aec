"""Effects placed in a plant: the parameters of a placement, and whether it fits its component."""

from __future__ import annotations

from dataclasses import replace

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement, Stage, fits, place_kinds_of
from fdi_torch.plant.flow_component import FlowComponent, FlowOrder


def placed_parameters(placement: Placement, plant: PlantDescription) -> list[Parameter]:
    """The effect's parameters under their full names ('T1.leak.size'), nominal at the placement's known values."""
    known = dict(placement.values or {})
    parameters = []
    for p in placement.effect.parameters(placement.location, plant):
        nominal = known.pop(p.name, p.nominal)
        low, high = min(p.low, nominal), max(p.high, nominal)
        name = placement.full_name(p.name)
        std = plant.tolerances.get(name, p.std)
        parameters.append(replace(p, name=name, nominal=nominal, low=low, high=high, std=std))
    if known:
        expected = ", ".join(p.name for p in placement.effect.parameters(placement.location, plant))
        raise ValueError(f"{placement.prefix}: expected parameters of {expected}, got {', '.join(known)}")
    return parameters


def expect_fit(plant: PlantDescription, placement: Placement) -> None:
    """Raises ValueError for a placement where its effect cannot be."""
    if not fits(placement.effect, plant, placement.location):
        kinds = " or ".join(place_kinds_of(placement.effect))
        raise ValueError(f"{placement.prefix}: expected a place of kind {kinds}, got {placement.location}")
    stage = placement.effect.stage
    if not placement.effect.states or stage is Stage.BALANCE:
        return
    component = plant.component(placement.location)
    by_levels = isinstance(component, FlowComponent) and component.order <= FlowOrder.BY_LEVELS
    if stage is not Stage.FLOW or not by_levels:
        raise ValueError(
            f"{placement.prefix}: expected states only in a BALANCE effect, or in a FLOW effect of a component whose "
            f"flow depends on levels and commands alone, got {stage.name} at {placement.location}"
        )
