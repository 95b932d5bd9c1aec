"""The volume balance of each tank along a recording, and the likelihood of its readings without a simulation:

    dh/dt = sum of b_i q_i / A         b_i = 1 for a plant that is right

Level changes, metered flows (pumps, transfers) and flows by laws (pipes, weirs, known effects) follow from the readings
and commands. Each flow has its own coefficient, because what remains of flows that nearly cancel tells little about a
unit. The coefficients are estimated by least squares from sums over many intervals; their covariance is that of groups
of consecutive sums, which count as independent (Liang and Zeger, 1986, Biometrika 73, 13-22).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import build_network
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.inverted_sensor import INSTANT
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.operating_point import PlaceValues
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording

SAMPLES = 20_000
"""Maximum number of samples; longer recordings are thinned for speed."""
GROUPS, SUMS = 16, 4
"""Groups of each tank's balance, and sums of successive intervals in each group."""
DEVIATION = 0.07
"""How far an inexact constant, an unmodelled effect or a fault usually moves a coefficient from 1: less than this in
three of four of the 1583 coefficients of 186 practice recordings that are determined to 0.1."""
SCALE = DEVIATION / math.tan(0.375 * math.pi)
"""Scale of the Cauchy distribution that has three quarters within DEVIATION. It has half within 0.03, 90 % within 0.18
and 95 % within 0.37; of these coefficients it is 0.03, 0.21 and 0.45."""
HALF_OF_DIGITS = math.sqrt(torch.finfo(torch.float64).eps)
"""Relative tolerance, half of the digits of float64: a smaller share of the largest term counts as rounding."""
UNRELATED = 0.1
"""Probability that a tank's readings do not depend on its flows: swapped channels, a stuck sensor."""


@dataclass(frozen=True)
class TankBalance:
    """Changes of a tank's level in m, by its sensor and by its F flows, as GROUPS SUMS sums.

    Each sum is over equally many successive intervals in which sensor and flows are known. measured: by the sensor
    (GROUPS, SUMS), exact to `digits`, m. by_flow: (GROUPS, SUMS, F). metered: whether each flow is metered (F,).
    intervals: number in each sum, 0 if too few are known.
    """

    measured: Tensor
    digits: float
    by_flow: Tensor
    metered: Tensor
    intervals: int

    def scaled(self, metered: float, by_laws: float) -> TankBalance:
        """The balance with other values for metered flows and for flows by laws."""
        return replace(self, by_flow=self.by_flow * torch.where(self.metered, metered, by_laws))

    def log_evidence(self, rounding: float, unrelated: float = UNRELATED) -> float:
        """Log likelihood of the measured changes, up to a constant that all corrections share; NaN without intervals.

        rounding: numerical error of the flows in a sum, the lower limit of their uncertainty, m. unrelated: probability
        that the readings do not depend on the flows.

        The variance of the sums is unknown; with GROUPS independent ones, the best fit of mean square s^2 has the
        likelihood s^-GROUPS. The prior of b is the multivariate Cauchy distribution of centre 1 and scale SCALE, a
        mixture of normal ones of variance v; the readings are UNRELATED if b = 0. With b in the directions of the
        eigenvectors of its information, whose eigenvalues are l, each normal one gives

            -2 log L = sum(log(1 + v l) + l (b - 1)^2 / (1 + v l)),

        where a direction that the recording does not determine, l = 0, counts nothing.
        """
        if not self.intervals:
            return math.nan
        excess = self.measured - self.by_flow.sum(-1)
        information, directions, off, residual = _regression(self.by_flow, excess, rounding)
        if not len(information):
            return math.nan
        variance = SCALE**2 * torch.logspace(-2, 16, 73).to(off)
        share = torch.log_softmax(-0.5 * (variance.log() + SCALE**2 / variance), dim=0)
        wider = 1.0 + variance[:, None] * information
        squares = information * (off @ directions).square()
        related = torch.logsumexp(share - 0.5 * (wider.log() + squares / wider).sum(-1), dim=0)
        without_flows = -0.5 * (information * ((1.0 + off) @ directions).square()).sum()
        weights = torch.tensor([1.0 - unrelated, unrelated]).log()
        either = torch.logsumexp(torch.stack([related, without_flows]) + weights, dim=0)
        return float(either - 0.5 * GROUPS * (residual + self.digits**2).log())


@dataclass(frozen=True)
class Balance:
    """The balance of each tank."""

    tanks: tuple[TankBalance, ...]

    def scaled(self, metered: Tensor, by_laws: Tensor) -> Balance:
        """The balances with other values for metered flows and for flows by laws, of each tank (tanks)."""
        factors = zip(self.tanks, metered.tolist(), by_laws.tolist(), strict=True)
        return Balance(tuple(tank.scaled(*each) for tank, *each in factors))

    @property
    def is_metered(self) -> bool:
        return any(bool((tank.by_flow[..., tank.metered] != 0.0).any()) for tank in self.tanks)

    def log_evidence(self, unrelated: float = UNRELATED) -> Tensor:
        """Log likelihood of the readings of each tank (tanks), up to a constant that all corrections share.

        NaN for a tank without known sums. unrelated: as of `TankBalance.log_evidence`.
        """
        known = [tank for tank in self.tanks if tank.intervals]
        largest = max((float(tank.by_flow.abs().max()) / tank.intervals for tank in known), default=0.0)
        return torch.tensor([tank.log_evidence(HALF_OF_DIGITS * largest, unrelated) for tank in self.tanks])


def balance_along(plant: PlantDescription, recording: Recording, units: Mapping[str, float] | None = None) -> Balance:
    """The balance between samples of a recording whose inputs are known, thinned to about SAMPLES.

    units: of the level changes of tanks, m, by default 1. Metered flows are not limited here, since they are
    proportional to a wrong unit only below their maximum flow.
    """
    recording = recording.every(math.ceil(len(recording) / SAMPLES))
    network = build_network(plant)
    limits = ParameterSpace([network.constants[f"{component.name}.max_flow"] for component in plant.metered_flows()])
    values = network.bind(limits, torch.full_like(limits.nominal(), math.inf))
    levels = _levels(network, recording, values)
    inputs = (
        recording.inputs if recording.hold == "zero_order" else 0.5 * (recording.inputs[1:] + recording.inputs[:-1])
    )
    columns = recording.input_columns(plant.channels())
    channels = [inputs[: len(recording) - 1, columns[channel]] for _, channel in network.actuators()]
    instant = recording.time.new_tensor(INSTANT)
    clock = Clock(recording.time[:-1] - recording.time[0], instant, instant)  # as of a simulation
    commands, _ = network.commands(channels, network.steady_command_memory(channels, clock, values), clock, values)
    middle = [0.5 * (level[1:] + level[:-1]) for level in levels]
    point = network.operating_point(middle, commands, clock, values)
    flows = network.flows(point)
    at_last, net = network.last_flows(point, network.net_inflows(point, flows))
    flows = flows | at_last
    per_volume = network.level_rates(point, [torch.ones_like(level) for level in middle])
    interval, balances = torch.diff(recording.time), []
    for tank, level, total, per_area in zip(plant.tanks, levels, net, per_volume, strict=True):
        own = [component for component in plant.flow_components() if tank.name in (component.source, component.target)]
        entering = [flows[each.name] if each.target == tank.name else -flows[each.name] for each in own]
        entering.append(total - sum(entering))  # by effects
        metered = torch.tensor([*(isinstance(component, MeteredFlow) for component in own), False])
        changes = torch.stack([torch.diff(level), *(interval * per_area * flow for flow in entering)], dim=-1)
        changes /= (units or {}).get(tank.name, 1.0)
        changes = changes[torch.isfinite(changes).all(dim=-1)]
        intervals = len(changes) // (GROUPS * SUMS)
        sums = changes[: GROUPS * SUMS * intervals].reshape(GROUPS, SUMS, intervals, 2 + len(own)).sum(dim=2)
        balances.append(TankBalance(sums[..., 0], HALF_OF_DIGITS * tank.height, sums[..., 1:], metered, intervals))
    return Balance(tuple(balances))


def _levels(network: TankNetwork, recording: Recording, values: PlaceValues) -> list[Tensor]:
    """Level of each tank (samples), m; NaN without a reading."""
    unknown = torch.full_like(recording.time, math.nan)
    levels = {tank.name: unknown for tank in network.description.tanks}
    for sensor in reversed(network.description.sensors):
        if sensor.column in recording.output_names:
            readings = recording.readings[:, recording.output_names.index(sensor.column)]
            constants = values[sensor.name]
            levels[sensor.tank] = (readings - constants["offset"]) / constants["gain"]
    return list(levels.values())


def _regression(flows: Tensor, excess: Tensor, rounding: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Eigenvalues (D,) and eigenvectors (F, D) of the information of b, b - 1 (F,) and the mean square of the residual.

    flows (GROUPS, SUMS, F), excess (GROUPS, SUMS): m. In steady state without noise, the sums differ by rounding only,
    and their scatter does not measure their errors; each counts as uncertain by `rounding`, m, at least. Which D
    directions the readings determine is asked of flows scaled to their root mean square, so that the answer does not
    depend on units.
    """
    rms = flows.square().mean(dim=(0, 1)).sqrt()
    flowing = rms > HALF_OF_DIGITS * rms.max()
    size, count = torch.where(flowing, rms, torch.inf), int(flowing.sum())
    scaled = flows / size
    product = torch.einsum("gni,gnj->ij", scaled, scaled)
    inverse = torch.linalg.pinv(product, hermitian=True, rtol=HALF_OF_DIGITS)
    off = inverse @ torch.einsum("gni,gn->i", scaled, excess)
    residual = excess - scaled @ off
    scores = torch.einsum("gni,gn->gi", scaled, residual)
    variance = scores.T @ scores * GROUPS / max(GROUPS - count, 1) + rounding**2 * product
    variances, axes = torch.linalg.eigh(variance)
    known = variances > HALF_OF_DIGITS * variances[-1]
    root = product @ axes[:, known] / variances[known].sqrt()
    directions, lengths, _ = torch.linalg.svd(torch.where(flowing, size, 0.0)[:, None] * root, full_matrices=False)
    return lengths.square(), directions, off / size, residual.square().mean()
