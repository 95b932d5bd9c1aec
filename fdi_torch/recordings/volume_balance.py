"""The volume balance of each tank along a recording: the likelihood of a plant's numbers without a simulation.

    A dh/dt = b_1 q_metered + b_2 q_law(h)         b_1 = b_2 = 1 for a plant that is right

Stored volume, metered flows (pumps, transfers) and flows by laws (pipes, weirs, known effects) follow from the readings
and commands. The coefficients b are estimated by least squares; their covariance is that of groups of consecutive
sums, which count as independent (Liang and Zeger, 1986, Biometrika 73, 13-22).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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

SAMPLES = 1000
"""Most samples of a thinned recording, for speed."""
GROUPS, SUMS = 16, 4
"""Groups of each tank's balance, and sums of successive intervals in each group."""
DEVIATION = 0.1
"""How far an inexact constant, an unmodelled effect or a fault usually moves a coefficient from 1: less than this in
three of four coefficients of the practice recordings that are determined to 0.1."""
SCALE = DEVIATION / math.tan(0.375 * math.pi)
"""Scale of the Cauchy distribution that has three quarters within DEVIATION. It has half within 0.04, 90 % within 0.26
and 95 % within 0.53; of 1009 coefficients of 186 practice recordings it is 0.04, 0.28 and 0.51."""
UNRELATED = 0.1
"""Probability that a tank's readings do not depend on its flows: swapped channels, a stuck sensor."""


@dataclass(frozen=True)
class Volumes:
    """Volumes (intervals, tanks), m^3, per tank: stored, entered by metered flows, and by laws. NaN where unknown."""

    stored: Tensor
    metered: Tensor
    by_laws: Tensor

    def log_evidence(self) -> Tensor:
        """Log likelihood of the readings of each tank (tanks), up to a constant that all corrections share.

        NaN for a tank with too few intervals whose volume balance is known.
        """
        terms = torch.stack([self.stored, self.metered, self.by_laws], dim=-1)
        rounding = math.sqrt(torch.finfo(terms.dtype).eps) * float(terms.nan_to_num().abs().max())
        return torch.tensor([_log_evidence(tank, rounding) for tank in terms.unbind(1)])


def volumes_along(plant: PlantDescription, recording: Recording) -> Volumes:
    """The volumes between samples of a recording whose inputs are known, thinned to about SAMPLES.

    Metered flows are not limited here, since they are proportional to a wrong unit only below their greatest flow.
    """
    recording = recording.every(math.ceil(len(recording) / SAMPLES))
    network = build_network(plant)
    limits = ParameterSpace([network.constants[f"{component.name}.max_flow"] for component in plant.metered_flows()])
    values = network.bind(limits, torch.full_like(limits.nominal(), math.inf))
    levels = _levels(network, recording, values)
    middle = [0.5 * (level[1:] + level[:-1]) for level in levels]
    inputs = (
        recording.inputs if recording.hold == "zero_order" else 0.5 * (recording.inputs[1:] + recording.inputs[:-1])
    )
    columns = [recording.input_names.index(channel) for channel in plant.channels()]
    channels = [inputs[: len(recording) - 1, columns[channel]] for _, channel in network.actuators()]
    instant = recording.time.new_tensor(INSTANT)
    clock = Clock(recording.time[:-1], instant, instant)
    commands, _ = network.commands(channels, network.steady_command_memory(channels, clock, values), clock, values)
    point = network.operating_point(middle, commands, clock, values)
    flows = network.flows(point)
    last, net = network.last_flows(point, network.net_inflows(point, flows))
    metered = [torch.zeros_like(level) for level in middle]
    for component in plant.flow_components():
        if isinstance(component, MeteredFlow):
            network.transfer(metered, component.source, component.target, (flows | last)[component.name])
    areas = [1.0 / rate for rate in network.level_rates(point, [torch.ones_like(level) for level in middle])]
    stored = [area * torch.diff(level) for area, level in zip(areas, levels, strict=True)]
    interval = torch.diff(recording.time)
    entered = [[interval * q for q in each] for each in (metered, (t - q for t, q in zip(net, metered, strict=True)))]
    return Volumes(*(torch.stack(volumes, dim=-1) for volumes in (stored, *entered)))


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


def _log_evidence(terms: Tensor, rounding: float) -> float:
    """Log likelihood of the stored volumes of a tank, given its `terms` (intervals, 3): stored, metered, by laws.

    rounding: half of the digits of the largest volume of all tanks, m^3.

    The prior of b is the multivariate Cauchy distribution of centre 1 and scale SCALE, a mixture of normal ones of
    variance v; the tank is UNRELATED if b = 0. With b in the directions of the eigenvectors of its information, whose
    eigenvalues are l, each normal one gives

        -2 log L = sum(log(1 + v l) + l (b - 1)^2 / (1 + v l)),

    where a direction that the recording does not determine, l = 0, counts nothing.
    """
    terms = terms[torch.isfinite(terms).all(dim=-1)]
    length = len(terms) // (GROUPS * SUMS)
    if not length:
        return math.nan
    sums = terms[: GROUPS * SUMS * length].reshape(GROUPS, SUMS, length, 3).sum(dim=2)
    information, directions, off = _regression(sums, rounding)
    if not bool((information > 0.0).any()):
        return math.nan
    variance = SCALE**2 * torch.logspace(-2, 16, 73).to(off)
    share = torch.log_softmax(-0.5 * (variance.log() + SCALE**2 / variance), dim=0)
    wider = 1.0 + variance[:, None] * information
    squares = information * (off @ directions).square()
    related = torch.logsumexp(share - 0.5 * (wider.log() + squares / wider).sum(-1), dim=0)
    unrelated = -0.5 * (information * ((1.0 + off) @ directions).square()).sum()
    return float(torch.logaddexp(related + math.log1p(-UNRELATED), unrelated + math.log(UNRELATED)))


def _regression(sums: Tensor, rounding: float) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues (2) and eigenvectors (2, 2) of the information of b, and b - 1 (2), by sums (GROUPS, SUMS, 3).

    In steady state without noise, the sums differ by rounding only, and their scatter does not measure their errors;
    each counts as uncertain by `rounding`, m^3, at least. Whether a direction is determined is asked of flows scaled to
    their root mean square, so that the answer does not depend on units; the smaller eigenvalue is then the determinant
    divided by the larger one.
    """
    flows, excess = sums[..., 1:], sums[..., 0] - sums[..., 1] - sums[..., 2]
    rms = flows.square().mean(dim=(0, 1)).sqrt()
    size = torch.where(rms > 0.0, rms, 1.0)
    scaled = flows / size
    product = torch.einsum("gni,gnj->ij", scaled, scaled)
    off = _inverse(product) @ torch.einsum("gni,gn->i", scaled, excess)
    scores = torch.einsum("gni,gn->gi", scaled, excess - scaled @ off)
    variance = scores.T @ scores * GROUPS / (GROUPS - 2) + rounding**2 * product
    information = product @ _inverse(variance) @ product
    smaller, larger = torch.linalg.eigvalsh(information)
    eigenvalues, eigenvectors = torch.linalg.eigh(size[:, None] * information * size)
    determinant = smaller * larger * size.square().prod()
    both = smaller > 2.0 * torch.finfo(sums.dtype).eps * larger
    least = torch.where(both, determinant / eigenvalues[1], 0.0)
    return torch.stack([least, eigenvalues[1]]), eigenvectors, off / size


def _inverse(matrix: Tensor) -> Tensor:
    """Pseudoinverse of a symmetric matrix; directions below half of the digits count as zero."""
    return torch.linalg.pinv(matrix, hermitian=True, rtol=math.sqrt(torch.finfo(matrix.dtype).eps))
