"""Curves of the discrepancy at one component: a free function of its local variables with errors, and the named effect.

Both are computed to first order about the trajectory of the best explanation. The influence of the named effect is
added to the residual again, and the free function is fitted to the sum, with the nuisance parameters projected out. The
variables of a free function (a head, the time) share what they have in common. The curves therefore compare what both
do along the trajectory, averaged over samples with the same value of the variable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.free_form import TRIAL_SIZE, free_form, is_free_coefficient
from fdi_torch.gap.free_form_coefficients import Coefficients, coefficients_of, fitted_coefficients
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import OUTSIDE, PlantDescription, Sensor, Tank
from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.operating_range import OperatingRange

BINS = 24  # points of a curve


@dataclass(frozen=True)
class Curve:
    """at (K,): values of `variable`, in `unit`. free, free_std (K,): free form and standard error. effect (K,): named
    effects, if any.

    quantity: 'flow' (m^3/s, into the tank or along the pipe), 'area' (a share) or 'reading' (the sensor's unit).
    """

    location: str
    variable: str
    unit: str
    quantity: str
    quantity_unit: str
    at: Tensor
    free: Tensor
    free_std: Tensor
    effect: Tensor | None = None

    def to_dict(self) -> dict[str, Any]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {n: v.tolist() if isinstance(v, Tensor) else v for n, v in values.items() if v is not None}


def curves_at(fitter: Fitter, fit: Fit, place: str, operating_range: OperatingRange) -> list[Curve]:
    """One curve for each local variable of a place.

    The causes that the fit has there are added to the residual of the free form; a free form that the fit contains is
    shown itself.
    """
    here = tuple(p for p in fit.candidate.placements if p.location == place)
    if any(p.effect.name.startswith("free_") for p in here):
        coefficients = fitted_coefficients(fitter, fit, here)
        stages = dict.fromkeys(p.effect.stage for p in here)  # a tank has an inflow and a cross-section
        groups = [tuple(p for p in here if p.effect.stage is stage) for stage in stages]
        return [curve for group in groups for curve in _curves(fitter, fit, group, coefficients, None)]
    free = _of_stage(free_form(place, fitter.data.plant, operating_range), here)
    coefficients = coefficients_of(fitter, fit, free, operating_range, returned=here)
    return _curves(fitter, fit, free, coefficients, _effect(fitter, fit, place, here) if here else None)


def _curves(
    fitter: Fitter, fit: Fit, free: Sequence[Placement], coefficients: Coefficients, effect: Tensor | None
) -> list[Curve]:
    """The curves of free functions of one stage, and of the influence (X,) of named effects."""
    place, prefixes = free[0].location, {p.prefix for p in free}
    own = [i for i, name in enumerate(coefficients.names) if ParameterName.parse(name).prefix in prefixes]
    names, covariance = [coefficients.names[i] for i in own], coefficients.covariance[own][:, own]
    units = (
        _local(fitter, fit, place, free, [{n: TRIAL_SIZE if n == one else 0.0 for n in names} for one in names])
        / TRIAL_SIZE
    )
    quantity, quantity_unit = _quantity(fitter, free, place)
    curves = []
    for variable, unit, x in (*_phases(fitter, free, place), *_variables(fitter, fit, place)):
        at, mean = _bins(x)
        free_mean = mean @ units.T
        error = torch.sqrt(torch.einsum("km,mn,kn->k", free_mean, covariance, free_mean).clamp(min=0.0))
        along, function = mean @ effect if effect is not None else None, free_mean @ coefficients.values[own]
        curves.append(Curve(place, variable, unit, quantity, quantity_unit, at, function, error, along))
    return curves


def _effect(fitter: Fitter, fit: Fit, place: str, here: tuple[Placement, ...]) -> Tensor:
    """The influence (X,) of the fit's causes at the place: the change by their sizes at nominal, which switches them
    off, with the opposite sign."""
    sizes = [(p, p.effect.parameters(p.location, fitter.data.plant)[0]) for p in here]
    without = _local(fitter, fit, place, here, [{p.full_name(size.name): size.nominal for p, size in sizes}])[0]
    return -without / (1.0 + without) if any(p.effect.stage is Stage.STORAGE for p in here) else -without


def _of_stage(free: Sequence[Placement], here: Sequence[Placement]) -> tuple[Placement, ...]:
    """The free functions that belong to a tank's effects: the cross-section for effects on it, else the inflow."""
    storage = any(p.effect.stage is Stage.STORAGE for p in here)
    return tuple(p for p in free if (p.effect.stage is Stage.STORAGE) == storage) or tuple(free)


def _local(
    fitter: Fitter,
    fit: Fit,
    place: str,
    placements: Sequence[Placement],
    changes: Sequence[Mapping[str, float]],
) -> Tensor:
    """Change of what happens at the place along the fit's trajectory by each change, (M, X): of the flow at the middle
    of each step, the share of the cross-section, or the reading at each sample.

    placements: effects that the changes belong to. changes: values of their parameters; coefficients of free forms
    change from zero, other parameters from their fitted values.
    """
    plant, levels = fitter.data.plant, fit.linearised.levels
    present = {p.prefix for p in fit.candidate.placements}
    candidate = Candidate((*fit.candidate.placements, *(p for p in placements if p.prefix not in present)))
    free = {*fit.effect_values, *changes[0]}
    engine = fitter.engine(candidate, sorted(free))
    start = {n: v for n, v in fit.values.items() if n in engine.space}
    start |= {n: 0.0 for n in free if is_free_coefficient(n)}
    rows = torch.stack([engine.space.vector({**start, **change}) for change in ({}, *changes)])
    component = None if len(plant.tanks_at(place)) == 2 else plant.component(place)
    if isinstance(component, Sensor):
        readings = engine.read(levels, rows)[..., [s.name for s in plant.sensors].index(place)]
        return readings[1:] - readings[:1]
    name, sign = _tank_and_sign(component, place, plant)
    tank = [t.name for t in plant.tanks].index(name)
    rates = engine.rates(0.5 * (levels[:, 1:] + levels[:, :-1]), rows)[..., tank]
    before, after = rates[:1], rates[1:]
    if any(p.effect.stage is Stage.STORAGE for p in placements):
        moving = before.abs() > 1e-9 * before.abs().max()
        return torch.where(moving, before / torch.where(moving, after, 1.0) - 1.0, 0.0)
    return sign * (after - before) * plant.tanks[tank].area


def _tank_and_sign(component: Any, place: str, plant: PlantDescription) -> tuple[str, float]:
    """The tank whose balance contains the component's flow, and the sign of the flow there."""
    if isinstance(component, FlowComponent):
        return component.near_tank, 1.0 if component.source == OUTSIDE else -1.0
    if isinstance(component, Tank):
        return component.name, 1.0
    return plant.tanks_at(place)[0], -1.0


def _quantity(fitter: Fitter, free: Sequence[Placement], place: str) -> tuple[str, str]:
    if any(p.effect.stage is Stage.STORAGE for p in free):
        return "area", "1"
    sensor = next((s for s in fitter.data.plant.sensors if s.name == place), None)
    return ("reading", sensor.unit) if sensor else ("flow", "m^3/s")


def _variables(fitter: Fitter, fit: Fit, place: str) -> list[tuple[str, str, Tensor]]:
    """Name, SI unit and values (X,) of the local variables of a place, time last."""
    data, linearised = fitter.data, fit.linearised
    plant, experiment = data.plant, data.experiment
    middle = 0.5 * (linearised.levels[0, 1:] + linearised.levels[0, :-1])
    tanks = {t.name: middle[:, i] for i, t in enumerate(plant.tanks)}
    clock = ("time", "s", experiment.nodes[:-1] + 0.5 * experiment.steps)
    component = None if len(plant.tanks_at(place)) == 2 else plant.component(place)
    if isinstance(component, Sensor):
        index = [s.name for s in plant.sensors].index(place)
        read = (f"{component.name} read", component.unit, linearised.readings[0, :, index])
        return [read, ("time", "s", experiment.sample_times)]
    if isinstance(component, FlowComponent) and component.commanded and component.input_channel:
        name, unit = component.input_channel
        command = (f"{name} commanded", unit, experiment.inputs[:, plant.channels().index(name)])
        return [command, (f"level of {component.near_tank}", "m", tanks[component.near_tank]), clock]
    if isinstance(component, FlowComponent):
        near, *far = component.depends_on
        name = " − ".join(component.depends_on) if far else f"level of {near}"
        return [(name, "m", tanks[near] - (tanks[far[0]] if far else 0.0)), clock]
    if isinstance(component, Tank):
        return [(f"level of {component.name}", "m", tanks[component.name]), clock]
    first, second = plant.tanks_at(place)
    return [(f"{first} − {second}", "m", tanks[first] - tanks[second]), clock]


def _phases(fitter: Fitter, free: Sequence[Placement], place: str) -> list[tuple[str, str, Tensor]]:
    """The time within one period, for a free form with sinusoids."""
    periods = [period for p in free for period in getattr(p.effect, "periods", ())]
    if not periods:
        return []
    experiment, sensors = fitter.data.experiment, {s.name for s in fitter.data.plant.sensors}
    middle = experiment.nodes[:-1] + 0.5 * experiment.steps
    clock = experiment.sample_times if place in sensors else middle
    return [(f"time within each {periods[0]:.3g} s", "s", torch.remainder(clock, periods[0]))]


def _bins(x: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (K,) and averaging weights (K, X) of values in groups of equal size, or one by one if they are few."""
    resolution = 1e-6 * float(x.max() - x.min())
    values, groups = torch.unique(torch.round(x / resolution) if resolution > 0.0 else x, return_inverse=True)
    if len(values) > BINS:
        edges = torch.quantile(x, torch.linspace(0.0, 1.0, BINS + 1, dtype=x.dtype)[1:-1])
        groups = torch.searchsorted(edges, x.contiguous())
    members = torch.nn.functional.one_hot(groups, int(groups.max()) + 1).to(x.dtype).T
    members = members[members.sum(dim=1) > 0]
    weights = members / members.sum(dim=1, keepdim=True)
    return weights @ x, weights
