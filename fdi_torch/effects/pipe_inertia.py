"""A pipe whose flow is delayed by the inertia of its water column."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from fdi_torch.plant.constants import source_height
from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale

NO_FLOW = 1e-3  # share of the smoothed root's flow at its width, below which ratios of flows are not formed
SLOWEST, STARTS = 60.0, (1.0, 6.0)  # time constants at the full head, in units of the plant's time scale


class PipeInertia(Effect):
    """L/(g a) dQ/dt = x - Q|Q|/K^2, the rigid water column under the head x (Wylie & Streeter, 1993, "Fluid Transients
    in Systems", ch. 1; Chaudhry, 2014, "Applied Hydraulic Transients", ch. 1), where the pipe with its other effects
    carries the flow K sqrt(x) in steady state. This is a lag of the flow with the time constant L K^2 / (g a (q + Q))
    behind its steady value q. A time constant below the integrator's resolution r delays the flow by the same time: Q =
    q + (tau / r) (Q_r - q) with r dQ_r/dt = q - Q_r. At length 0 the flow is the steady one.

    L: length of a column with the pipe's cross-section a, the sum of L_i a / a_i over the sections of the pipe.
    Typical: a time constant of 0.1 to 5 s. Levels of two tanks that a wide pipe joins oscillate (U-tube). Nearly the
    same as a lag of the readings if the time constant is far below those of the tanks.
    """

    name = "pipe_inertia"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    states = 1
    searched = False
    mistaken_for = ("plugging", "coefficient_drift", "sensor_lag", "sensor_delay", "valve_lag")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = SLOWEST * time_scale(plant) * _length_per_second(plant, place)
        return (Parameter("length", "m", 0.0, 0.0, high, meaning="length of the water column"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        unit = time_scale(plant) * _length_per_second(plant, place)
        return [{"length": factor * unit} for factor in STARTS]

    def steady_states(self, flow: torch.Tensor, local: Local, p: Values) -> tuple[torch.Tensor, ...]:
        return (flow / _flow_of_unit_state(local),)

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        column = _Column.of(flow, local, p)
        time_constant = column.time_constant
        share = time_constant / torch.maximum(time_constant, local.clock.resolution)
        return flow + share * (column.delayed - flow)

    def state_rates(self, flow: torch.Tensor, local: Local, p: Values) -> tuple[torch.Tensor, ...]:
        column, resolution = _Column.of(flow, local, p), local.clock.resolution
        rate = (flow - column.delayed) / torch.maximum(column.time_constant, resolution)
        return ((rate + column.unsmoothed(flow, local)) / _flow_of_unit_state(local),)


@dataclass(frozen=True)
class _Column:
    """A moving water column, all (*batch).

    delayed: its flow Q, m^3/s. inertia: L K^2/(g a), m^3. friction: (q|q| - Q|Q|) / (q - Q), m^3/s, which is |q| + |Q|
    where both have one sign. least: friction of the smoothed root at zero head, K sqrt(w), m^3/s.
    """

    delayed: torch.Tensor
    inertia: torch.Tensor
    friction: torch.Tensor
    least: torch.Tensor
    squared_capacity: torch.Tensor

    @classmethod
    def of(cls, flow: torch.Tensor, local: Local, p: Values) -> _Column:
        delayed = local.states[0] * _flow_of_unit_state(local)
        nominal, least = local.capacity * local.command, local.capacity * torch.sqrt(local.width)
        at_rest = NO_FLOW * least
        unchanged = nominal * local.root(local.head)
        changed = (flow * flow + at_rest * at_rest) / (unchanged * unchanged + at_rest * at_rest)
        squared_capacity = nominal * nominal * changed
        inertia = p["length"] * squared_capacity / (local.gravity * local.constants["area"])
        squares = flow * flow + delayed * delayed + 2.0 * torch.clamp(flow * delayed, min=0.0)
        friction = squares / (torch.abs(flow) + torch.abs(delayed) + at_rest)
        return cls(delayed, inertia, friction, least, squared_capacity)

    @property
    def time_constant(self) -> torch.Tensor:
        return self.inertia / (self.friction + self.least)

    def unsmoothed(self, flow: torch.Tensor, local: Local) -> torch.Tensor:
        """Further rate of change of the flow without the smoothing of the root, m^3/s^2.

        A water column whose acceleration the integrator resolves needs no smoothing: the head changes its flow at a
        finite rate.
        """
        smallest = local.clock.resolution * self.least
        resolved = torch.clamp(self.inertia - smallest, min=0.0) / torch.maximum(self.inertia, smallest)
        missing = self.squared_capacity * local.head - flow * torch.abs(flow) - self.least * (flow - self.delayed)
        driven = flow * local.head > 0.0  # an outlet above the level has a negative head and no flow
        return torch.where(driven, resolved * missing, 0.0) / torch.maximum(self.inertia, smallest)


def _flow_of_unit_state(local: Local) -> torch.Tensor:
    """Flow per unit of the state, m^2/s: the state is the tank's height where the flow is that of the full tank."""
    return local.capacity / torch.sqrt(local.height)


def _length_per_second(plant: PlantDescription, place: str) -> float:
    """Length of a column whose time constant at the full head is 1 s, sqrt(2 g h) / C_d, m/s."""
    pipe = plant.pipe(place)
    return math.sqrt(2.0 * plant.gravity * source_height(plant, place)) / pipe.discharge_coefficient
