"""A pipe whose flow is delayed by the inertia of its water column."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import source_height
from fdi_torch.plant.description import Pipe, PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.operating_range import OperatingRange
from fdi_torch.plant.scales import time_scale

SLOWEST, STARTS = 60.0, (1.0, 6.0)  # time constants at the full head, in units of the plant's time scale


class PipeInertia(Effect):
    """L/(g a) dQ/dt = x - k Q|Q|, the rigid water column (Wylie & Streeter, 1993, "Fluid Transients in Systems", ch. 1;
    Chaudhry, 2014, "Applied Hydraulic Transients", ch. 1), with k of the orifice, 1/(C_d o a)^2/2g. Around the quasi-
    static flow q, this is tau dQ/dt = q - Q with tau = L C_d^2 o^2 2 a / (|q| + |Q|). Time constants below the time
    resolution r of the integration have the same delay in first order, Q = q - tau dQ'/dt with r dQ'/dt = q - Q', and
    the length 0 is the quasi-static law.

    L: length of a column with the pipe's cross-section a, the sum of L_i a / a_i over the sections of the pipe.
    Typical: a time constant of 0.1 to 5 s; two tanks that a wide pipe joins oscillate (U-tube). Nearly the same as a
    delay of the levels if tau is far below the tanks' time constants.
    """

    name = "pipe_inertia"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    states = 1
    mistaken_for = ("plugging", "coefficient_drift", "sensor_lag", "sensor_delay", "valve_lag")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = SLOWEST * time_scale(plant) * _length_per_second(plant, place)
        return (Parameter("length", "m", 0.0, 0.0, high, meaning="length of the water column"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        unit = time_scale(plant) * _length_per_second(plant, place)
        return [{"length": factor * unit} for factor in STARTS]

    def steady_states(self, flow: Tensor, local: Local, p: Values) -> tuple[Tensor, ...]:
        return (flow / _flow_of_unit_state(local),)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        delayed = local.states[0] * _flow_of_unit_state(local)
        time_constant = _time_constant(flow, delayed, local, p)
        return flow + _share(time_constant, local) * (delayed - flow)

    def state_rates(self, flow: Tensor, local: Local, p: Values) -> tuple[Tensor, ...]:
        unit = _flow_of_unit_state(local)
        delayed = local.states[0] * unit
        time_constant = _time_constant(flow, delayed, local, p)
        return ((flow - delayed) / unit / torch.maximum(time_constant, local.clock.resolution),)


def _flow_of_unit_state(local: Local) -> Tensor:
    """Flow per unit of the state, m^2/s: the state is the tank's height where the flow is that of the full tank."""
    return local.capacity / torch.sqrt(local.height)


def _time_constant(flow: Tensor, delayed: Tensor, local: Local, p: Values) -> Tensor:
    """tau = L c^2 / (g a s), s, with c = C_d o a sqrt(2 g) and s = (q|q| - Q|Q|) / (q - Q).

    s is |q| + |Q|, or (q^2 + Q^2) / (|q| + |Q|) if the signs differ. Near zero flow it is that of the root's smoothing.
    """
    least = local.capacity * torch.sqrt(local.width)
    squares = flow * flow + delayed * delayed + 2.0 * torch.clamp(flow * delayed, min=0.0)
    slope = squares / (torch.abs(flow) + torch.abs(delayed) + least) + least
    open_capacity = local.capacity * local.command
    return p["length"] * open_capacity * open_capacity / (local.gravity * local.constants["area"] * slope)


def _share(time_constant: Tensor, local: Local) -> Tensor:
    return time_constant / torch.maximum(time_constant, local.clock.resolution)


def _length_per_second(plant: PlantDescription, place: str) -> float:
    """Length of a column whose time constant at the full head is 1 s, sqrt(2 g h) / C_d, m/s."""
    pipe = plant.component(place)
    assert isinstance(pipe, Pipe)
    return math.sqrt(2.0 * plant.gravity * source_height(plant, place)) / pipe.discharge_coefficient
